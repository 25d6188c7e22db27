#include <math.h>

#include "check.h"
#include "ipmsm_can/angle.h"

static void wraps(void)
{
    CHECK_NEAR(ipmsm_wrap(0.0f), 0.0f, 0.0f);
    CHECK_NEAR(ipmsm_wrap(1.0f), 1.0f, 3e-7f);
    CHECK_NEAR(ipmsm_wrap(-1.0f), IPMSM_TWO_PI - 1.0f, 1e-6f);
    CHECK_NEAR(ipmsm_wrap(7.0f), 7.0f - IPMSM_TWO_PI, 1e-6f);
    CHECK_NEAR(ipmsm_wrap(-20.0f), 4.0f * IPMSM_TWO_PI - 20.0f, 3e-6f);
    /* Rounds up to a whole turn, which is 0. */
    CHECK(ipmsm_wrap(-1e-12f) < IPMSM_TWO_PI);
    CHECK(ipmsm_wrap(-1e-12f) >= 0.0f);
    /* No angle: a float of that size has no fraction of a turn. */
    CHECK(ipmsm_wrap(NAN) == 0.0f);
    CHECK(ipmsm_wrap(INFINITY) == 0.0f);
    CHECK(ipmsm_wrap(-INFINITY) == 0.0f);
    CHECK(ipmsm_wrap(6e7f) == 0.0f);
    CHECK(ipmsm_wrap(-6e7f) == 0.0f);
    CHECK(ipmsm_wrap(5e7f) < IPMSM_TWO_PI);
}

static void turns(void)
{
    CHECK(ipmsm_to_turn(0.0f) == 0u);
    CHECK(ipmsm_to_turn(0.25f * IPMSM_TWO_PI) == 0x40000000u);
    CHECK(ipmsm_to_turn(-0.25f * IPMSM_TWO_PI) == 0xC0000000u);
    CHECK(ipmsm_to_turn(1.5f * IPMSM_TWO_PI) == 0x80000000u);
}

static void cosines(void)
{
    for (uint32_t n = 0; n < 4096u; n++) {
        const uint32_t turn = n * 0x00100000u + 0x1234u;
        const float radians = (float)(turn >> 8) * (IPMSM_TWO_PI / 16777216.0f);
        float c;
        float s;
        ipmsm_cos_sin(turn, &c, &s);
        CHECK_NEAR(c, cosf(radians), 5e-7f); /* the argument itself is good to 2.4e-7 only */
        CHECK_NEAR(s, sinf(radians), 5e-7f);
        CHECK_NEAR(c * c + s * s, 1.0f, 2.5e-7f);
    }
}

static void goes_on_with_the_speed(void)
{
    CHECK_NEAR(ipmsm_extrapolate(1.0f, 100.0f, 0.01f), 2.0f, 1e-6f);
    CHECK_NEAR(ipmsm_extrapolate(1.0f, -100.0f, 0.02f), IPMSM_TWO_PI - 1.0f, 1e-6f);
    CHECK_NEAR(ipmsm_extrapolate(6.0f, 100.0f, 0.01f), 7.0f - IPMSM_TWO_PI, 1e-6f);
}

void test_angle(void)
{
    wraps();
    turns();
    cosines();
    goes_on_with_the_speed();
}
