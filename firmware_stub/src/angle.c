#include "ipmsm_can/angle.h"

#define TURN_PER_RAD (0.159154943091895336f)
#define RAD_PER_STEP (1.46291807926715969e-9f) /* 2 pi / 2^32 */
#define LARGEST_TURNS (8388608.0f)             /* beyond it a float holds no fraction of a turn */

static float fraction_of_turn(float angle)
{
    const float turns = angle * TURN_PER_RAD;
    if (!(turns > -LARGEST_TURNS && turns < LARGEST_TURNS)) {
        return 0.0f;
    }
    float fraction = turns - (float)(int32_t)turns;
    if (fraction < 0.0f) {
        fraction += 1.0f;
    }
    return (fraction < 1.0f) ? fraction : 0.0f; /* a tiny negative one rounds up to 1 */
}

float ipmsm_wrap(float angle)
{
    return fraction_of_turn(angle) * IPMSM_TWO_PI;
}

uint32_t ipmsm_to_turn(float angle)
{
    return (uint32_t)(fraction_of_turn(angle) * 4294967296.0f);
}

void ipmsm_cos_sin(uint32_t turn, float *cosine, float *sine)
{
    /* Quadrant and the rest within an eighth of a turn; polynomials of the Cephes library for that range. */
    const uint32_t quadrant = (turn + 0x20000000u) >> 30;
    const float x = (float)(int32_t)(turn - (quadrant << 30)) * RAD_PER_STEP;
    const float z = x * x;
    const float s = ((-1.9515295891e-4f * z + 8.3321608736e-3f) * z - 1.6666654611e-1f) * z * x + x;
    const float c = ((2.443315711809948e-5f * z - 1.388731625493765e-3f) * z + 4.166664568298827e-2f) * z * z
                    - 0.5f * z + 1.0f;
    switch (quadrant & 3u) {
    case 0u:
        *cosine = c;
        *sine = s;
        break;
    case 1u:
        *cosine = -s;
        *sine = c;
        break;
    case 2u:
        *cosine = -c;
        *sine = -s;
        break;
    default:
        *cosine = s;
        *sine = -c;
        break;
    }
}

float ipmsm_extrapolate(float theta, float omega, float elapsed)
{
    return ipmsm_wrap(theta + omega * elapsed);
}
