/* Frames of the drive: samples as DriveSample or in DriveSampleBlock, DriveTiming, DriveStatus, DriveReference.
 *
 * Values beyond what the DBC can carry saturate; NaN is sent as 0.
 */
#ifndef IPMSM_SENDER_H
#define IPMSM_SENDER_H

#include "ipmsm_can/can_hal.h"

/* Peak values, amplitude-invariant transformation. */
struct ipmsm_sample {
    float i_alpha, i_beta; /* stator current at t_k [A] */
    float v_alpha, v_beta; /* MEAN voltage applied over the interval that ended at t_k [V] */
};

enum ipmsm_mode { IPMSM_OFF = 0, IPMSM_READY = 1, IPMSM_RUNNING = 2, IPMSM_FAULT = 3, IPMSM_SAFE_STOP = 4 };

/* Bits of the faults in DriveStatus. */
#define IPMSM_FAULT_OVERCURRENT (1u << 0)
#define IPMSM_FAULT_OVERVOLTAGE (1u << 1)
#define IPMSM_FAULT_UNDERVOLTAGE (1u << 2)
#define IPMSM_FAULT_OVERTEMPERATURE (1u << 3)
#define IPMSM_FAULT_ENCODER (1u << 4)
#define IPMSM_FAULT_COMMAND_REJECTED (1u << 5) /* set by the library */
#define IPMSM_FAULT_CAN (1u << 6)
#define IPMSM_FAULT_OTHER (1u << 7)

struct ipmsm_status {
    enum ipmsm_mode mode;
    uint8_t faults;
    bool encoder_available;
    float v_dc;        /* [V] */
    float temperature; /* of the heat-sink [degC] */
};

struct ipmsm_sender {
    float sample_rate; /* [Hz] */
    uint32_t next;     /* counter of the next sample */
    uint32_t sent;     /* counter of the sample most recently handed to the bus */
    bool any_sent;
    bool fd;
    uint8_t node;
    uint8_t filled;        /* samples in the block */
    uint8_t block_counter; /* of the next block, profile 5 */
    uint16_t crc;          /* of the block as far as it is filled */
    struct ipmsm_frame frame;
};

/* node 0..15; fd: blocks of seven samples instead of single ones. */
void ipmsm_sender_init(struct ipmsm_sender *sender, uint8_t node, bool fd, float sample_rate);

/* Take in the next sample.  The frame to transmit now, or NULL while a block fills; it holds until the next
 * call.  Tell ipmsm_sender_sent when it was handed over. */
const struct ipmsm_frame *ipmsm_sender_sample(struct ipmsm_sender *sender, const struct ipmsm_sample *sample);
void ipmsm_sender_sent(struct ipmsm_sender *sender);

/* DriveTiming: the sample most recently sent; false, and no frame, before the first one. */
bool ipmsm_sender_timing(const struct ipmsm_sender *sender, struct ipmsm_frame *frame);

/* DriveStatus; waveform: 0..3, what is being put out; rejected: rolling count of commands refused. */
void ipmsm_sender_status(const struct ipmsm_sender *sender, const struct ipmsm_status *status,
                         uint8_t waveform, uint8_t rejected, struct ipmsm_frame *frame);

/* DriveReference: encoder angle [rad electrical, any turn] and speed [rad/s electrical] at that sample. */
void ipmsm_sender_reference(const struct ipmsm_sender *sender, float theta_e, float omega_e,
                            uint32_t sample_counter, struct ipmsm_frame *frame);

#endif
