/* Probing signals: the voltage a drive adds to its own, one value per control period.
 *
 * Waveforms, ramp and rules are those of ipmsm_can/injection/waveform.py:
 *     rotating          A (cos(phi + a), sin(phi + a))
 *     pulsating         A cos(phi) (cos a, sin a)
 *     polarity_pulses   A sign(cos(phi)) (cos a, sin a)
 * each as its mean over the control period, because that is what an inverter applies.
 */
#ifndef IPMSM_PROBING_H
#define IPMSM_PROBING_H

#include <stdbool.h>
#include <stdint.h>

/* Largest probing amplitude [V peak], whatever the bus or a setting says. */
#ifndef IPMSM_PROBING_LIMIT
#define IPMSM_PROBING_LIMIT (30.0f)
#endif

enum ipmsm_waveform {
    IPMSM_WAVEFORM_OFF = 0,
    IPMSM_WAVEFORM_ROTATING = 1,
    IPMSM_WAVEFORM_PULSATING = 2,
    IPMSM_WAVEFORM_POLARITY_PULSES = 3
};

/* What an InjectionCommand asks for. */
struct ipmsm_command {
    uint8_t waveform;
    float amplitude;    /* [V peak] */
    float frequency;    /* [Hz] */
    float axis_angle;   /* [rad electrical] */
    float time_to_live; /* [ms] */
};

/* Frequency and axis, as the generator needs them. */
struct ipmsm_tone {
    uint32_t step; /* of the phase per period; 2^32 is one turn */
    uint32_t axis; /* 2^32 is one turn */
    float axis_cos, axis_sin;
    float mean; /* of a sine over one period, relative to its middle */
};

struct ipmsm_probing {
    float limit;         /* [V peak] */
    float ramp_step;     /* largest change of the amplitude per sample [V] */
    float samples_in_ms; /* control periods per millisecond */
    uint32_t rate_mhz;   /* samples per 1000 s */
    /* What is being put out ... */
    uint32_t phase; /* 2^32 is one turn */
    struct ipmsm_tone tone;
    float amplitude; /* on its way to the one asked for */
    uint8_t waveform;
    /* ... and what was asked for last. */
    uint8_t asked_waveform;
    float asked_amplitude;
    struct ipmsm_tone asked_tone;
    uint32_t samples_left; /* of the time to live */
    uint32_t asked_us;
    uint32_t time_to_live_us;
};

/* sample_rate [Hz]; limit [V peak], above it IPMSM_PROBING_LIMIT holds; ramp [V/s]. */
void ipmsm_probing_init(struct ipmsm_probing *probing, float sample_rate, float limit, float ramp);

/* Take a command into force; false, and the one in force stays, if it cannot be executed: an unknown
 * waveform, an amplitude below 0, a frequency below 1 mHz or above half the sample rate, a time to live
 * beyond a minute. */
bool ipmsm_probing_ask(struct ipmsm_probing *probing, const struct ipmsm_command *command, uint32_t now_us);

/* Mean probing voltage [V] over the next control period; once per control period.
 *
 * It is 0 from the first period on that begins after the command's time to live, counted in samples and by
 * the clock, whichever runs out first. */
void ipmsm_probing_step(struct ipmsm_probing *probing, uint32_t now_us, float *v_alpha, float *v_beta);

/* Drop the command in force: 0 from the next step on, without a ramp. */
void ipmsm_probing_stop(struct ipmsm_probing *probing);

#endif
