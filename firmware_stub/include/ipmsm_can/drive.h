/* One drive on the wire: everything a current-control interrupt and a background loop call.
 *
 * In the interrupt, once per control period and in this order: ipmsm_drive_sample, ipmsm_drive_receive,
 * ipmsm_drive_probe, and ipmsm_drive_angle where the angle is wanted.  In the background: ipmsm_drive_timing
 * at 10 to 100 Hz, ipmsm_drive_status at 10 Hz, and ipmsm_drive_reference if there is an encoder.
 * Nothing blocks, nothing allocates, nothing is global: one struct per drive.
 */
#ifndef IPMSM_DRIVE_H
#define IPMSM_DRIVE_H

#include "ipmsm_can/can_hal.h"
#include "ipmsm_can/probing.h"
#include "ipmsm_can/receiver.h"
#include "ipmsm_can/sender.h"

/* Most frames one call of ipmsm_drive_receive takes in, so that a flooded bus cannot hold the interrupt. */
#ifndef IPMSM_RECEIVE_AT_ONCE
#define IPMSM_RECEIVE_AT_ONCE (16u)
#endif

struct ipmsm_config {
    uint8_t node;                      /* 0..15 */
    bool fd;                           /* CAN FD blocks of seven samples */
    float sample_rate;                 /* control periods per second [Hz], 100..1e6 */
    float probing_limit;               /* [V peak]; never above IPMSM_PROBING_LIMIT */
    float probing_ramp;                /* fastest change of the probing amplitude [V/s], above 0 */
    float sigma_limit;                 /* largest one-sigma of a usable angle [deg electrical] */
    uint32_t estimate_time_to_live_us; /* of an angle; 1 to 1023 control periods */
};

struct ipmsm_drive {
    const struct ipmsm_hal *hal;
    struct ipmsm_sender sender;
    struct ipmsm_receiver receiver;
    struct ipmsm_probing probing;
    uint32_t dropped;  /* frames the controller had no room for */
    uint32_t rejected; /* commands refused: end-to-end check, or not executable */
    bool rejected_now; /* since the last DriveStatus */
};

/* A start to change from: classical, 10 kHz, 10 ms, 10 deg, 1000 V/s, the compile-time probing limit. */
struct ipmsm_config ipmsm_config_default(void);

/* false, and the drive must not be used, if the configuration is outside what its comments allow.
 * The hal must live as long as the drive. */
bool ipmsm_drive_init(struct ipmsm_drive *drive, const struct ipmsm_config *config, const struct ipmsm_hal *hal);

/* Encode the next sample and hand it to the bus, alone or with the block it completes; its counter moves on
 * even if the controller has no room.  false: no room. */
bool ipmsm_drive_sample(struct ipmsm_drive *drive, const struct ipmsm_sample *sample);

/* Take in what has come. */
void ipmsm_drive_receive(struct ipmsm_drive *drive);

/* Probing voltage to add over the next control period [V]. */
void ipmsm_drive_probe(struct ipmsm_drive *drive, float *v_alpha, float *v_beta);

/* End probing now, as on any fault; a later command starts it again. */
void ipmsm_drive_stop_probing(struct ipmsm_drive *drive);

/* Whether the rotor angle may be used, and the angle `ahead` control periods after the latest sample
 * [rad electrical, 0..2 pi] (1.5 for the middle of the interval a voltage computed now is applied in).
 * theta_e is written only where the verdict is IPMSM_ANGLE_USABLE, which is what it takes to begin, or
 * IPMSM_ANGLE_DOUBTFUL, with which a control that runs on the angle already may go on. */
enum ipmsm_angle_verdict ipmsm_drive_angle(const struct ipmsm_drive *drive, float ahead, float *theta_e);

/* Whether a control may begin with the angle: the verdict is IPMSM_ANGLE_USABLE. */
bool ipmsm_drive_angle_usable(const struct ipmsm_drive *drive);

/* Speed of the last estimate [rad/s electrical], 0 before the first; to be used only where the angle may. */
float ipmsm_drive_speed(const struct ipmsm_drive *drive);

/* Background messages; false if there was no room (or, for timing, no sample was sent yet). */
bool ipmsm_drive_timing(struct ipmsm_drive *drive);
bool ipmsm_drive_status(struct ipmsm_drive *drive, const struct ipmsm_status *status);
bool ipmsm_drive_reference(struct ipmsm_drive *drive, float theta_e, float omega_e, uint32_t sample_counter);

#endif
