/* What drive_stub prints: one JSON object a line. */
#ifndef REPORT_H
#define REPORT_H

#include <stdbool.h>
#include <stdint.h>

#include "ipmsm_can/drive.h"

/* What the library does not keep by itself. */
struct facts {
    uint32_t now_us;         /* of the clock that the drive goes by */
    double now_s;            /* CLOCK_MONOTONIC [s] */
    uint64_t sent;           /* frames the bus took */
    uint64_t samples;
    uint64_t slips;          /* times the machine stood still for so long that time was given up */
    uint32_t beyond_limit;   /* commands that asked for more than the clamp */
    double probe_peak;       /* largest probing voltage put out [V] */
    uint64_t usable;         /* periods in which the angle could be used */
    double error_deg;        /* largest error of a usable angle since the last report [deg electrical] */
    uint64_t command_sample; /* when the command in force was taken */
    uint32_t command_us;
    uint32_t errors;         /* calls the kernel refused */
};

void report_start(const struct facts *facts, uint8_t node, double rate, bool fd);
void report_probing(const struct facts *facts, uint8_t waveform);
void report_angle(const struct facts *facts, enum ipmsm_angle_verdict verdict);

/* event: "counts" or "end". */
void report_counts(const struct facts *facts, const struct ipmsm_drive *drive, const char *event);

#endif
