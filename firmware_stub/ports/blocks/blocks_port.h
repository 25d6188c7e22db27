/* Whole stretches of control periods at once, in virtual time: the library under a simulated drive.
 *
 * A simulation gives samples by the block and wants the probing voltages and the companion's angle of a block
 * before it simulates it.  Both depend on what is heard alone, not on the samples.  So a block is first rehearsed, on a copy of the drive, and then run: the same calls in the same order, those of
 * an interrupt, and therefore the same voltages.
 *
 * Frames are rows of 72 bytes, Linux' struct canfd_frame.  The Python package reads the declarations below as
 * they stand, so no line but the directives may need a preprocessor.
 */
#ifndef BLOCKS_PORT_H
#define BLOCKS_PORT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct blocks_drive;

struct blocks_settings {
    uint8_t node;
    bool fd;
    float sample_rate;     /* [Hz] */
    float probing_limit;   /* [V peak] */
    float probing_ramp;    /* [V/s] */
    float sigma_limit;     /* [deg electrical] */
    uint32_t estimate_time_to_live_us;
    uint32_t timing_every; /* samples between two DriveTiming, and so on; 0 for none */
    uint32_t status_every;
    uint32_t reference_every;
    float v_dc;        /* [V] */
    float temperature; /* [degC] */
};

/* Of enum ipmsm_e2e_status each: ok, some lost, repeated, wrong sequence, wrong CRC. */
struct blocks_counts {
    uint32_t estimates[5];
    uint32_t commands[5];
    uint32_t late;     /* estimates too old when they came, or within the first 1024 periods */
    uint32_t rejected; /* commands refused, not executable ones included */
};

/* Bytes of a struct blocks_drive, to be provided by the caller, aligned as for malloc. */
size_t blocks_size(void);

/* false if the library refuses the settings. */
bool blocks_init(struct blocks_drive *blocks, const struct blocks_settings *settings);

/* What n periods will put out, with the first `count` rows of `heard` waiting when they begin.  probe: 4 rows of
 * n: voltage (alpha, beta) [V], waveform, amplitude [V peak].  told: 3 rows of n: whether the companion's angle may
 * be used (enum ipmsm_angle_verdict), what it is at the sample [rad electrical], NaN where it may not, and the
 * speed with it [rad/s electrical]. */
void blocks_rehearse(const struct blocks_drive *blocks, const uint8_t *heard, size_t count, size_t n,
                     double *probe, double *told);

/* Run n periods.  samples: 6 rows of n: i_alpha, i_beta [A], v_alpha, v_beta [V], and for the encoder theta_e
 * [rad], omega_e [rad/s].  condition: 3 rows of n: enum ipmsm_mode, faults, and whether DriveStatus is sent out of
 * turn; an encoder that is faulty says nothing.  out, at: the frames sent, with room for 4 n, and the sample each
 * was sent with.  used: rows of `heard` that were taken.  Gives back the number of frames. */
size_t blocks_run(struct blocks_drive *blocks, const uint8_t *heard, size_t count, size_t n,
                  const double *samples, const uint8_t *condition, uint8_t *out, int64_t *at, size_t *used);

void blocks_count(const struct blocks_drive *blocks, struct blocks_counts *counts);

#endif
