/* Frames as a companion would send them. */
#include <string.h>

#include "check.h"
#include "ipmsm_can.h"
#include "ipmsm_can/e2e.h"
#include "ipmsm_can_parameters.h"

static void finish(struct ipmsm_frame *frame, uint32_t base, uint8_t node, uint8_t counter,
                   const uint8_t data_ids[16])
{
    frame->id = base + node;
    frame->length = 8;
    frame->data[1] = (uint8_t)((frame->data[1] & 0xF0u) | (counter & 0x0Fu));
    frame->data[0] = ipmsm_e2e_crc8(frame->data, 8, (uint8_t)(data_ids[counter & 0x0Fu] + node));
}

struct ipmsm_frame estimate_frame(uint8_t node, uint8_t counter, struct estimate_values values)
{
    static const uint8_t ids[16] = IPMSM_CAN_POSITION_ESTIMATE_DATA_IDS;
    struct ipmsm_frame frame;
    memset(&frame, 0, sizeof frame);
    struct ipmsm_can_position_estimate_t raw;
    memset(&raw, 0, sizeof raw);
    raw.theta_e = ipmsm_can_position_estimate_theta_e_encode(values.theta_e);
    raw.omega_e = ipmsm_can_position_estimate_omega_e_encode(values.omega_e);
    raw.sigma_theta = ipmsm_can_position_estimate_sigma_theta_encode(values.sigma_theta);
    raw.sample_counter = (uint16_t)(values.sample & 0x3FFu);
    raw.valid = values.valid;
    raw.locked = values.locked;
    raw.polarity_known = values.polarity_known;
    raw.injecting = values.injecting;
    (void)ipmsm_can_position_estimate_pack(frame.data, &raw, 8);
    finish(&frame, IPMSM_CAN_POSITION_ESTIMATE_FRAME_ID, node, counter, ids);
    return frame;
}

struct ipmsm_frame command_frame(uint8_t node, uint8_t counter, struct command_values values)
{
    static const uint8_t ids[16] = IPMSM_CAN_INJECTION_COMMAND_DATA_IDS;
    struct ipmsm_frame frame;
    memset(&frame, 0, sizeof frame);
    struct ipmsm_can_injection_command_t raw;
    memset(&raw, 0, sizeof raw);
    raw.waveform = values.waveform;
    raw.amplitude = ipmsm_can_injection_command_amplitude_encode(values.amplitude);
    raw.frequency = ipmsm_can_injection_command_frequency_encode(values.frequency);
    raw.axis_angle = ipmsm_can_injection_command_axis_angle_encode(values.axis_angle);
    raw.time_to_live = ipmsm_can_injection_command_time_to_live_encode(values.time_to_live);
    (void)ipmsm_can_injection_command_pack(frame.data, &raw, 8);
    finish(&frame, IPMSM_CAN_INJECTION_COMMAND_FRAME_ID, node, counter, ids);
    return frame;
}
