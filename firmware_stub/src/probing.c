#include "ipmsm_can/probing.h"

#include "ipmsm_can/angle.h"

#define HALF_TURN (0x80000000u)
#define QUARTER_TURN (0x40000000)
#define LOWEST_FREQUENCY (0.001f)   /* [Hz] one unit of the phase's arithmetic */
#define RAMP_END (0.01f)            /* of a step */
#define LONGEST_COMMAND (60000.0f) /* [ms] */

void ipmsm_probing_init(struct ipmsm_probing *probing, float sample_rate, float limit, float ramp)
{
    *probing = (struct ipmsm_probing){
        .limit = limit,
        .ramp_step = ramp / sample_rate,
        .samples_in_ms = 0.001f * sample_rate,
        .rate_mhz = (uint32_t)(1000.0f * sample_rate + 0.5f),
    };
}

/* 2^32 numerator / denominator, at most half a turn, to a unit or two; denominator up to 2^30.
 *
 * A float alone would lose the phase over the seconds a command lives, and a 64-bit division costs a tenth of
 * the flash: so a quotient in single precision, and another one of what the first leaves over, which is exact. */
static uint32_t fraction_of_turn(uint32_t numerator, uint32_t denominator)
{
    const float divisor = (float)denominator;
    const uint32_t quotient = (uint32_t)((float)numerator / divisor * 4294967296.0f);
    const int64_t rest = (int64_t)(((uint64_t)numerator << 32) - (uint64_t)quotient * denominator);
    const int32_t correction = (int32_t)((float)(int32_t)(rest / 1024) / divisor * 1024.0f);
    return quotient + (uint32_t)correction;
}

static void make_tone(struct ipmsm_tone *tone, uint32_t frequency_mhz, uint32_t rate_mhz, float axis_angle)
{
    tone->step = fraction_of_turn(frequency_mhz, rate_mhz);
    tone->axis = ipmsm_to_turn(axis_angle);
    ipmsm_cos_sin(tone->axis, &tone->axis_cos, &tone->axis_sin);
    /* sin(width / 2) / (width / 2), width being what the phase moves in a period */
    const float half_width = (float)(tone->step / 2u) * (IPMSM_TWO_PI / 4294967296.0f);
    float cosine;
    float sine;
    ipmsm_cos_sin(tone->step / 2u, &cosine, &sine);
    tone->mean = sine / half_width;
}

bool ipmsm_probing_ask(struct ipmsm_probing *probing, const struct ipmsm_command *command, uint32_t now_us)
{
    if (command->waveform > IPMSM_WAVEFORM_POLARITY_PULSES) {
        return false;
    }
    if (!(command->time_to_live >= 0.0f && command->time_to_live <= LONGEST_COMMAND)) {
        return false;
    }
    if (command->waveform != IPMSM_WAVEFORM_OFF) {
        if (!(command->amplitude >= 0.0f)) {
            return false;
        }
        const float half_rate = 500.0f * probing->samples_in_ms;
        if (!(command->frequency >= LOWEST_FREQUENCY && command->frequency <= half_rate)) {
            return false;
        }
        make_tone(&probing->asked_tone, (uint32_t)(1000.0f * command->frequency + 0.5f), probing->rate_mhz,
                  command->axis_angle);
    }
    probing->asked_waveform = command->waveform;
    probing->asked_amplitude = (command->waveform != IPMSM_WAVEFORM_OFF) ? command->amplitude : 0.0f;
    /* The hundredth keeps a whole number of samples whole where the product rounds down. */
    probing->samples_left = (uint32_t)(command->time_to_live * probing->samples_in_ms + 0.01f);
    probing->time_to_live_us = (uint32_t)(1000.0f * command->time_to_live + 0.5f);
    probing->asked_us = now_us;
    return true;
}

void ipmsm_probing_stop(struct ipmsm_probing *probing)
{
    probing->samples_left = 0;
    probing->waveform = IPMSM_WAVEFORM_OFF;
    probing->amplitude = 0.0f;
}

/* Amplitude and waveform move on by one sample towards what was asked for. */
static void approach(struct ipmsm_probing *probing)
{
    const float change = probing->ramp_step;
    float amplitude = probing->amplitude;
    if (probing->waveform != probing->asked_waveform) {
        /* The present waveform goes down first, with its own frequency and axis. */
        amplitude -= change;
        /* A ramp of n steps up is down after n steps, too, whatever rounding left of it. */
        if (amplitude <= RAMP_END * change) {
            amplitude = 0.0f;
            probing->waveform = probing->asked_waveform;
            probing->phase = 0;
        }
    }
    if (probing->waveform == probing->asked_waveform) {
        probing->tone = probing->asked_tone;
        float target = probing->asked_amplitude;
        if (target > probing->limit) {
            target = probing->limit;
        }
        if (target > IPMSM_PROBING_LIMIT) {
            target = IPMSM_PROBING_LIMIT;
        }
        if (amplitude > target) {
            amplitude -= change;
            amplitude = (amplitude > target) ? amplitude : target;
        } else {
            amplitude += change;
            amplitude = (amplitude < target) ? amplitude : target;
        }
    }
    probing->amplitude = amplitude;
}

/* Integral of sign(cos) from 0: a triangle, in the phase's unit. */
static int32_t square_integral(uint32_t phase)
{
    const int32_t half = (int32_t)(phase - HALF_TURN); /* phase - 1/2 turn, as -1/2..1/2 turn */
    const int32_t centred = (int32_t)phase;
    if (centred > QUARTER_TURN || centred < -QUARTER_TURN) {
        return -half;
    }
    return centred;
}

void ipmsm_probing_step(struct ipmsm_probing *probing, uint32_t now_us, float *v_alpha, float *v_beta)
{
    *v_alpha = 0.0f;
    *v_beta = 0.0f;
    if (probing->samples_left == 0u || now_us - probing->asked_us > probing->time_to_live_us) {
        ipmsm_probing_stop(probing);
        return;
    }
    probing->samples_left--;
    approach(probing);
    if (probing->waveform == IPMSM_WAVEFORM_OFF || !(probing->amplitude > 0.0f)) {
        return;
    }
    const struct ipmsm_tone *tone = &probing->tone;
    const uint32_t start = probing->phase;
    const uint32_t end = start + tone->step;
    const uint32_t middle = start + tone->step / 2u;
    probing->phase = end;
    float mean = probing->amplitude;
    float cosine;
    float sine;
    switch (probing->waveform) {
    case IPMSM_WAVEFORM_ROTATING:
        ipmsm_cos_sin(middle + tone->axis, &cosine, &sine);
        mean *= tone->mean;
        *v_alpha = mean * cosine;
        *v_beta = mean * sine;
        return;
    case IPMSM_WAVEFORM_PULSATING:
        ipmsm_cos_sin(middle, &cosine, &sine);
        mean *= tone->mean * cosine;
        break;
    default: /* polarity pulses; halves, because the whole difference can be one more than an int32 holds */
        mean *= (float)(square_integral(end) / 2 - square_integral(start) / 2) / (0.5f * (float)tone->step);
        break;
    }
    *v_alpha = mean * tone->axis_cos;
    *v_beta = mean * tone->axis_sin;
}
