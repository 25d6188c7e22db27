#include "ipmsm_can/sender.h"

#include <stddef.h>

#include "ipmsm_can.h"
#include "ipmsm_can/angle.h"
#include "ipmsm_can/e2e.h"
#include "ipmsm_can_parameters.h"

#define CLASSICAL_BYTES (8u)
#define BLOCK_HEADER (8u) /* bytes of DriveSampleBlock before its samples */
#define BLOCK_SAMPLE (8u) /* bytes of one sample in it */
#define CRC_BYTES (2u)

#define SATURATED(value, name) saturated((value), IPMSM_CAN_##name##_MIN, IPMSM_CAN_##name##_MAX)

static float saturated(float value, float low, float high)
{
    if (value < low) {
        return low;
    }
    if (value > high) {
        return high;
    }
    return (value == value) ? value : 0.0f;
}

static void begin(struct ipmsm_frame *frame, uint32_t base, uint8_t node, uint8_t length, uint8_t flags)
{
    frame->id = base + node;
    frame->length = length;
    frame->flags = flags;
}

static uint8_t *put16(uint8_t *at, uint16_t value)
{
    at[0] = (uint8_t)(value & 0xFFu);
    at[1] = (uint8_t)(value >> 8);
    return at + 2;
}

void ipmsm_sender_init(struct ipmsm_sender *sender, uint8_t node, bool fd, float sample_rate)
{
    *sender = (struct ipmsm_sender){.sample_rate = sample_rate, .node = node, .fd = fd};
    if (fd) {
        begin(&sender->frame, IPMSM_CAN_DRIVE_SAMPLE_BLOCK_FRAME_ID, node, IPMSM_CAN_DRIVE_SAMPLE_BLOCK_LENGTH,
              IPMSM_FRAME_FD);
    } else {
        begin(&sender->frame, IPMSM_CAN_DRIVE_SAMPLE_FRAME_ID, node, CLASSICAL_BYTES, 0);
    }
}

static void single_sample(struct ipmsm_sender *sender, const struct ipmsm_sample *sample)
{
    const struct ipmsm_can_drive_sample_t raw = {
        .i_alpha = ipmsm_can_drive_sample_i_alpha_encode(SATURATED(sample->i_alpha, DRIVE_SAMPLE_I_ALPHA)),
        .i_beta = ipmsm_can_drive_sample_i_beta_encode(SATURATED(sample->i_beta, DRIVE_SAMPLE_I_BETA)),
        .v_alpha = ipmsm_can_drive_sample_v_alpha_encode(SATURATED(sample->v_alpha, DRIVE_SAMPLE_V_ALPHA)),
        .v_beta = ipmsm_can_drive_sample_v_beta_encode(SATURATED(sample->v_beta, DRIVE_SAMPLE_V_BETA)),
        .sample_counter = (uint8_t)(sender->next & 0x0Fu),
    };
    (void)ipmsm_can_drive_sample_pack(sender->frame.data, &raw, CLASSICAL_BYTES);
}

/* The block is packed and its CRC carried on sample by sample: done at once, the seventh sample would cost
 * several times what the others do, and an interrupt has to be planned for its longest run. */
static void begin_block(struct ipmsm_sender *sender)
{
    uint8_t *data = sender->frame.data;
    data[2] = sender->block_counter++;
    (void)put16(put16(&data[3], (uint16_t)(sender->next & 0xFFFFu)), (uint16_t)(sender->next >> 16));
    data[7] = IPMSM_CAN_BLOCK_SAMPLES;
    sender->crc = ipmsm_e2e_crc16(IPMSM_E2E_CRC16_START, &data[CRC_BYTES], BLOCK_HEADER - CRC_BYTES);
}

static bool block_sample(struct ipmsm_sender *sender, const struct ipmsm_sample *sample)
{
    if (sender->filled == 0u) {
        begin_block(sender);
    }
    uint8_t *first = &sender->frame.data[BLOCK_HEADER + BLOCK_SAMPLE * sender->filled];
    uint8_t *at = first;
    at = put16(at, (uint16_t)ipmsm_can_drive_sample_block_i_alpha_0_encode(
                       SATURATED(sample->i_alpha, DRIVE_SAMPLE_BLOCK_I_ALPHA_0)));
    at = put16(at, (uint16_t)ipmsm_can_drive_sample_block_i_beta_0_encode(
                       SATURATED(sample->i_beta, DRIVE_SAMPLE_BLOCK_I_BETA_0)));
    at = put16(at, (uint16_t)ipmsm_can_drive_sample_block_v_alpha_0_encode(
                       SATURATED(sample->v_alpha, DRIVE_SAMPLE_BLOCK_V_ALPHA_0)));
    (void)put16(at, (uint16_t)ipmsm_can_drive_sample_block_v_beta_0_encode(
                        SATURATED(sample->v_beta, DRIVE_SAMPLE_BLOCK_V_BETA_0)));
    sender->crc = ipmsm_e2e_crc16(sender->crc, first, BLOCK_SAMPLE);
    sender->filled++;
    if (sender->filled < IPMSM_CAN_BLOCK_SAMPLES) {
        return false;
    }
    const uint16_t data_id = (uint16_t)(IPMSM_CAN_DRIVE_SAMPLE_BLOCK_DATA_ID + sender->node);
    (void)put16(sender->frame.data, ipmsm_e2e_crc16_end(sender->crc, data_id));
    sender->filled = 0;
    return true;
}

const struct ipmsm_frame *ipmsm_sender_sample(struct ipmsm_sender *sender, const struct ipmsm_sample *sample)
{
    bool complete = true;
    if (sender->fd) {
        complete = block_sample(sender, sample);
    } else {
        single_sample(sender, sample);
    }
    sender->next++;
    return complete ? &sender->frame : NULL;
}

void ipmsm_sender_sent(struct ipmsm_sender *sender)
{
    sender->sent = sender->next - 1u;
    sender->any_sent = true;
}

bool ipmsm_sender_timing(const struct ipmsm_sender *sender, struct ipmsm_frame *frame)
{
    if (!sender->any_sent) {
        return false;
    }
    const struct ipmsm_can_drive_timing_t raw = {
        .sample_counter = sender->sent,
        .sample_rate =
            ipmsm_can_drive_timing_sample_rate_encode(SATURATED(sender->sample_rate, DRIVE_TIMING_SAMPLE_RATE)),
    };
    begin(frame, IPMSM_CAN_DRIVE_TIMING_FRAME_ID, sender->node, CLASSICAL_BYTES, 0);
    (void)ipmsm_can_drive_timing_pack(frame->data, &raw, CLASSICAL_BYTES);
    return true;
}

void ipmsm_sender_status(const struct ipmsm_sender *sender, const struct ipmsm_status *status,
                         uint8_t waveform, uint8_t rejected, struct ipmsm_frame *frame)
{
    const struct ipmsm_can_drive_status_t raw = {
        .mode = (uint8_t)status->mode,
        .active_waveform = waveform,
        .encoder_available = status->encoder_available ? 1u : 0u,
        .faults = status->faults,
        .v_dc = ipmsm_can_drive_status_v_dc_encode(SATURATED(status->v_dc, DRIVE_STATUS_V_DC)),
        .temperature =
            ipmsm_can_drive_status_temperature_encode(SATURATED(status->temperature, DRIVE_STATUS_TEMPERATURE)),
        .protocol_version = IPMSM_CAN_PROTOCOL_VERSION,
        .rejected_commands = rejected,
    };
    begin(frame, IPMSM_CAN_DRIVE_STATUS_FRAME_ID, sender->node, CLASSICAL_BYTES, 0);
    (void)ipmsm_can_drive_status_pack(frame->data, &raw, CLASSICAL_BYTES);
}

void ipmsm_sender_reference(const struct ipmsm_sender *sender, float theta_e, float omega_e,
                            uint32_t sample_counter, struct ipmsm_frame *frame)
{
    const float step = ipmsm_can_drive_reference_theta_e_decode(1) - ipmsm_can_drive_reference_theta_e_decode(0);
    float theta = ipmsm_wrap(theta_e);
    if (theta >= IPMSM_TWO_PI - 0.5f * step) {
        theta = 0.0f; /* nearer to the next turn than to the largest code */
    }
    const struct ipmsm_can_drive_reference_t raw = {
        .theta_e = ipmsm_can_drive_reference_theta_e_encode(SATURATED(theta, DRIVE_REFERENCE_THETA_E)),
        .omega_e = ipmsm_can_drive_reference_omega_e_encode(SATURATED(omega_e, DRIVE_REFERENCE_OMEGA_E)),
        .sample_counter = sample_counter,
    };
    begin(frame, IPMSM_CAN_DRIVE_REFERENCE_FRAME_ID, sender->node, CLASSICAL_BYTES, 0);
    (void)ipmsm_can_drive_reference_pack(frame->data, &raw, CLASSICAL_BYTES);
}
