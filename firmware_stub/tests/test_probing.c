#include <math.h>

#include "check.h"
#include "ipmsm_can/angle.h"
#include "ipmsm_can/probing.h"

#define PERIOD_US (100u)

static struct ipmsm_probing probing;
static uint32_t now_us;
static float v_alpha;
static float v_beta;

static void begin(float limit, float ramp)
{
    ipmsm_probing_init(&probing, 10000.0f, limit, ramp);
    now_us = 0xFFFFFF00u; /* the clock wraps on the way */
}

static bool ask(uint8_t waveform, float amplitude, float frequency, float axis, float time_to_live)
{
    const struct ipmsm_command command = {waveform, amplitude, frequency, axis, time_to_live};
    return ipmsm_probing_ask(&probing, &command, now_us);
}

static float step(void)
{
    ipmsm_probing_step(&probing, now_us, &v_alpha, &v_beta);
    now_us += PERIOD_US;
    return sqrtf(v_alpha * v_alpha + v_beta * v_beta);
}

static void silent_until_asked(void)
{
    begin(30.0f, 1e6f);
    CHECK(step() == 0.0f);
    CHECK(probing.waveform == IPMSM_WAVEFORM_OFF);
}

static void ends_with_its_time_to_live(void)
{
    begin(30.0f, 1e6f);
    CHECK(ask(1, 5.0f, 400.0f, 0.0f, 3.0f));
    for (uint32_t k = 0; k < 30u; k++) {
        CHECK(step() > 4.9f);
    }
    CHECK(step() == 0.0f);
    CHECK(probing.waveform == IPMSM_WAVEFORM_OFF && probing.amplitude == 0.0f);
    CHECK(step() == 0.0f);
    CHECK(ask(1, 5.0f, 400.0f, 0.0f, 0.0f));
    CHECK(step() == 0.0f);
    /* A part of a period does not count. */
    CHECK(ask(1, 5.0f, 400.0f, 0.0f, 0.19f));
    CHECK(step() > 4.9f);
    CHECK(step() == 0.0f);
}

static void a_newer_command_renews_it(void)
{
    begin(30.0f, 1e6f);
    for (uint32_t k = 0; k < 100u; k++) {
        if (k % 20u == 0u) {
            CHECK(ask(1, 5.0f, 400.0f, 0.0f, 3.0f));
        }
        CHECK(step() > 4.9f);
    }
}

/* The loop stood still for longer than the command lives: it must not go on where it stopped. */
static void ends_by_the_clock_too(void)
{
    begin(30.0f, 1e6f);
    CHECK(ask(1, 5.0f, 400.0f, 0.0f, 3.0f));
    CHECK(step() > 4.9f);
    now_us += 2900u; /* exactly the time to live now */
    CHECK(step() > 4.9f);
    now_us -= PERIOD_US;
    now_us += 1u;
    CHECK(step() == 0.0f);
    now_us -= 1000u; /* and it is gone for good */
    CHECK(step() == 0.0f);
}

static void the_amplitude_is_clamped(void)
{
    begin(7.0f, 1e6f);
    CHECK(ask(1, 200.0f, 100.0f, 0.0f, 10.0f));
    CHECK_NEAR(step(), 7.0f, 0.01f);
    /* The compile-time limit holds against any setting. */
    begin(1e9f, 1e9f);
    CHECK(ask(1, 200.0f, 100.0f, 0.0f, 10.0f));
    for (uint32_t k = 0; k < 50u; k++) {
        CHECK(step() <= 1.000001f * IPMSM_PROBING_LIMIT);
        CHECK(probing.amplitude == IPMSM_PROBING_LIMIT);
    }
    CHECK(ask(1, INFINITY, 100.0f, 0.0f, 10.0f));
    CHECK_NEAR(step(), IPMSM_PROBING_LIMIT, 0.01f);
    /* A limit that went down takes the amplitude with it. */
    probing.limit = 2.0f;
    CHECK_NEAR(step(), 2.0f, 0.01f);
    begin(0.0f, 1e6f);
    CHECK(ask(1, 5.0f, 100.0f, 0.0f, 10.0f));
    CHECK(step() == 0.0f);
}

static void the_amplitude_ramps(void)
{
    begin(30.0f, 2500.0f); /* 0.25 V a sample */
    CHECK(ask(1, 2.0f, 100.0f, 0.0f, 500.0f));
    for (uint32_t k = 1; k <= 12u; k++) {
        (void)step();
        CHECK(probing.amplitude == ((k < 8u) ? 0.25f * (float)k : 2.0f));
    }
    CHECK(ask(1, 1.0f, 100.0f, 0.0f, 500.0f));
    for (uint32_t k = 1; k <= 6u; k++) {
        (void)step();
        CHECK(probing.amplitude == ((k < 4u) ? 2.0f - 0.25f * (float)k : 1.0f));
    }
    /* Another waveform waits until this one is down, which keeps its frequency and axis meanwhile. */
    const struct ipmsm_tone tone = probing.tone;
    CHECK(ask(2, 1.0f, 900.0f, 1.0f, 500.0f));
    for (uint32_t k = 1; k <= 3u; k++) {
        (void)step();
        CHECK(probing.waveform == IPMSM_WAVEFORM_ROTATING && probing.tone.step == tone.step);
        CHECK(probing.amplitude == 1.0f - 0.25f * (float)k);
    }
    (void)step();
    CHECK(probing.waveform == IPMSM_WAVEFORM_PULSATING && probing.amplitude == 0.25f);
    CHECK(ask(0, 9.0f, 0.0f, 0.0f, 500.0f));
    CHECK(step() == 0.0f && probing.waveform == IPMSM_WAVEFORM_OFF && probing.amplitude == 0.0f);
}

static void what_cannot_be_executed_is_refused(void)
{
    begin(30.0f, 1e6f);
    CHECK(ask(1, 5.0f, 5000.0f, 0.0f, 3.0f)); /* half the sample rate */
    begin(30.0f, 1e6f);
    CHECK(ask(1, 5.0f, 100.0f, 0.0f, 3.0f));
    CHECK(!ask(4, 9.0f, 100.0f, 0.0f, 100.0f));
    CHECK(!ask(255, 9.0f, 100.0f, 0.0f, 100.0f));
    CHECK(!ask(1, -1.0f, 100.0f, 0.0f, 100.0f));
    CHECK(!ask(1, NAN, 100.0f, 0.0f, 100.0f));
    CHECK(!ask(1, 9.0f, 0.0f, 0.0f, 100.0f));
    CHECK(!ask(1, 9.0f, 0.0009f, 0.0f, 100.0f));
    CHECK(!ask(1, 9.0f, -100.0f, 0.0f, 100.0f));
    CHECK(!ask(1, 9.0f, NAN, 0.0f, 100.0f));
    CHECK(!ask(1, 9.0f, 5001.0f, 0.0f, 100.0f));
    CHECK(!ask(1, 9.0f, 1e30f, 0.0f, 100.0f));
    CHECK(!ask(1, 9.0f, 100.0f, 0.0f, -1.0f));
    CHECK(!ask(1, 9.0f, 100.0f, 0.0f, 60001.0f));
    CHECK(!ask(0, 9.0f, 100.0f, 0.0f, NAN));
    /* The one in force stays, as long as it would have, and as large. */
    for (uint32_t k = 0; k < 30u; k++) {
        CHECK_NEAR(step(), 5.0f, 0.01f);
    }
    CHECK(step() == 0.0f);
    CHECK(ask(1, 5.0f, 0.001f, 0.0f, 60000.0f));
    CHECK_NEAR(step(), 5.0f, 1e-5f);
}

static void stops_when_told(void)
{
    begin(30.0f, 1000.0f);
    CHECK(ask(1, 5.0f, 400.0f, 0.0f, 300.0f));
    for (uint32_t k = 0; k < 20u; k++) {
        (void)step();
    }
    ipmsm_probing_stop(&probing);
    CHECK(step() == 0.0f && probing.amplitude == 0.0f && probing.waveform == IPMSM_WAVEFORM_OFF);
    CHECK(ask(1, 5.0f, 400.0f, 0.0f, 300.0f));
    CHECK(step() > 0.0f);
}

/* Means over each period, against 64-fold sampling of the waveform's definition. */
static void waveforms_are_their_means(void)
{
    for (uint8_t waveform = 1; waveform <= 3u; waveform++) {
        const float frequency = 937.0f;
        const float axis = 0.8f;
        begin(30.0f, 1e9f);
        CHECK(ask(waveform, 4.0f, frequency, axis, 500.0f));
        for (uint32_t k = 0; k < 60u; k++) {
            float alpha = 0.0f;
            float beta = 0.0f;
            for (uint32_t j = 0; j < 64u; j++) {
                const float phase = 1e-4f * frequency * IPMSM_TWO_PI * ((float)k + ((float)j + 0.5f) / 64.0f);
                if (waveform == 1u) {
                    alpha += 4.0f * cosf(phase + axis);
                    beta += 4.0f * sinf(phase + axis);
                } else {
                    float along = cosf(phase);
                    if (waveform == 3u) {
                        along = (along > 0.0f) ? 1.0f : -1.0f;
                    }
                    alpha += 4.0f * along * cosf(axis);
                    beta += 4.0f * along * sinf(axis);
                }
            }
            (void)step();
            const float tolerance = (waveform == 3u) ? 0.13f : 2e-3f; /* a jump falls between two of 64 points */
            CHECK_NEAR(v_alpha, alpha / 64.0f, tolerance);
            CHECK_NEAR(v_beta, beta / 64.0f, tolerance);
        }
    }
}

/* At half the sample rate the pulses alternate, with nothing lost to the integer arithmetic. */
static void pulses_at_half_the_rate(void)
{
    begin(30.0f, 1e9f);
    CHECK(ask(3, 4.0f, 5000.0f, 0.0f, 500.0f));
    for (uint32_t k = 0; k < 8u; k++) {
        (void)step();
        CHECK_NEAR(v_alpha, 0.0f, 1e-5f); /* half of a pulse of each sign in every period */
    }
    begin(30.0f, 1e9f);
    CHECK(ask(3, 4.0f, 2500.0f, 0.0f, 500.0f));
    for (uint32_t k = 0; k < 8u; k++) {
        (void)step();
        CHECK_NEAR(v_alpha, (k % 4u == 0u || k % 4u == 3u) ? 4.0f : -4.0f, 1e-5f);
    }
    /* From -1/4 to +1/4 turn in one period, the largest difference there is. */
    begin(30.0f, 1e9f);
    CHECK(ask(3, 4.0f, 5000.0f, 0.0f, 500.0f));
    (void)step();
    probing.phase = 0xC0000000u;
    (void)step();
    CHECK_NEAR(v_alpha, 4.0f, 1e-5f);
    (void)step();
    CHECK_NEAR(v_alpha, -4.0f, 1e-5f);
}

void test_probing(void)
{
    silent_until_asked();
    ends_with_its_time_to_live();
    a_newer_command_renews_it();
    ends_by_the_clock_too();
    the_amplitude_is_clamped();
    the_amplitude_ramps();
    what_cannot_be_executed_is_refused();
    stops_when_told();
    waveforms_are_their_means();
    pulses_at_half_the_rate();
}
