#include "ipmsm_can/receiver.h"

#include "ipmsm_can.h"
#include "ipmsm_can/angle.h"
#include "ipmsm_can_parameters.h"

#define BYTES (8u)
#define SAMPLE_MASK (0x3FFu) /* PositionEstimate carries ten bits of the sample counter */

_Static_assert(IPMSM_CAN_POSITION_ESTIMATE_LENGTH == BYTES, "E2E profile 2 is computed over 8 bytes");
_Static_assert(IPMSM_CAN_INJECTION_COMMAND_LENGTH == BYTES, "E2E profile 2 is computed over 8 bytes");

static const uint8_t estimate_ids[16] = IPMSM_CAN_POSITION_ESTIMATE_DATA_IDS;
static const uint8_t command_ids[16] = IPMSM_CAN_INJECTION_COMMAND_DATA_IDS;

bool ipmsm_receiver_init(struct ipmsm_receiver *receiver, uint8_t node, float sample_rate, float sigma_limit,
                         uint32_t time_to_live_us)
{
    /* The thousandth keeps a whole number of samples whole where the product rounds down. */
    const float samples = 1e-6f * (float)time_to_live_us * sample_rate + 0.001f;
    if (node >= IPMSM_CAN_NODES || !(samples >= 1.0f && samples < (float)(SAMPLE_MASK + 1u))) {
        return false;
    }
    *receiver = (struct ipmsm_receiver){
        .period = 1.0f / sample_rate,
        .sigma_limit = sigma_limit,
        .max_age = (uint32_t)samples,
        .max_age_us = time_to_live_us,
        .node = node,
        .warm_up = SAMPLE_MASK + 1u,
    };
    return true;
}

static bool is_good(struct ipmsm_stream *stream, const uint8_t *payload, const uint8_t *data_ids, uint8_t node)
{
    enum ipmsm_e2e_status status = IPMSM_E2E_WRONG_CRC;
    if (ipmsm_e2e_intact(payload, data_ids, node)) {
        status = ipmsm_e2e_follow(&stream->sequence, payload[1] & 0x0Fu, IPMSM_FRAMES_MISSED);
    }
    stream->counts[status]++;
    return status <= IPMSM_E2E_SOME_LOST;
}

static bool take_estimate(struct ipmsm_receiver *receiver, const uint8_t *payload, uint32_t sample,
                          uint32_t now_us)
{
    if (!is_good(&receiver->estimates, payload, estimate_ids, receiver->node)) {
        return false;
    }
    struct ipmsm_can_position_estimate_t raw;
    (void)ipmsm_can_position_estimate_unpack(&raw, payload, BYTES);
    const uint32_t age = (sample - raw.sample_counter) & SAMPLE_MASK;
    if (receiver->warm_up > 0u || age > receiver->max_age) {
        receiver->late++;
        return false;
    }
    receiver->estimate = (struct ipmsm_estimate){
        .theta_e = ipmsm_can_position_estimate_theta_e_decode(raw.theta_e),
        .omega_e = ipmsm_can_position_estimate_omega_e_decode(raw.omega_e),
        .sigma_theta = ipmsm_can_position_estimate_sigma_theta_decode(raw.sigma_theta),
        .sample = sample - age,
        .arrived_us = now_us,
        .sigma_known = raw.sigma_theta != IPMSM_CAN_POSITION_ESTIMATE_SIGMA_THETA_UNKNOWN_CHOICE,
        .valid = raw.valid != 0u,
        .locked = raw.locked != 0u,
        .polarity_known = raw.polarity_known != 0u,
        .injecting = raw.injecting != 0u,
        .held = true,
    };
    return true;
}

static bool take_command(struct ipmsm_receiver *receiver, const uint8_t *payload, struct ipmsm_command *command)
{
    if (!is_good(&receiver->commands, payload, command_ids, receiver->node)) {
        return false;
    }
    struct ipmsm_can_injection_command_t raw;
    (void)ipmsm_can_injection_command_unpack(&raw, payload, BYTES);
    *command = (struct ipmsm_command){
        .waveform = raw.waveform,
        .amplitude = ipmsm_can_injection_command_amplitude_decode(raw.amplitude),
        .frequency = ipmsm_can_injection_command_frequency_decode(raw.frequency),
        .axis_angle = ipmsm_can_injection_command_axis_angle_decode(raw.axis_angle),
        .time_to_live = ipmsm_can_injection_command_time_to_live_decode(raw.time_to_live),
    };
    return true;
}

enum ipmsm_received ipmsm_receiver_take(struct ipmsm_receiver *receiver, const struct ipmsm_frame *frame,
                                        uint32_t sample, uint32_t now_us, struct ipmsm_command *command)
{
    if (frame->length != BYTES || (frame->flags & (IPMSM_FRAME_EXTENDED | IPMSM_FRAME_REMOTE)) != 0u) {
        return IPMSM_RECEIVED_NOTHING;
    }
    if (frame->id == IPMSM_CAN_POSITION_ESTIMATE_FRAME_ID + receiver->node) {
        return take_estimate(receiver, frame->data, sample, now_us) ? IPMSM_RECEIVED_ESTIMATE
                                                                    : IPMSM_RECEIVED_BAD_ESTIMATE;
    }
    if (frame->id == IPMSM_CAN_INJECTION_COMMAND_FRAME_ID + receiver->node) {
        return take_command(receiver, frame->data, command) ? IPMSM_RECEIVED_COMMAND
                                                            : IPMSM_RECEIVED_BAD_COMMAND;
    }
    return IPMSM_RECEIVED_NOTHING;
}

static bool is_fresh(const struct ipmsm_receiver *receiver, uint32_t sample, uint32_t now_us)
{
    const struct ipmsm_estimate *estimate = &receiver->estimate;
    return estimate->held && sample - estimate->sample <= receiver->max_age
           && now_us - estimate->arrived_us <= receiver->max_age_us;
}

void ipmsm_receiver_expire(struct ipmsm_receiver *receiver, uint32_t sample, uint32_t now_us)
{
    if (receiver->warm_up > 0u) {
        receiver->warm_up--;
    }
    receiver->estimate.held = is_fresh(receiver, sample, now_us);
}

enum ipmsm_angle_verdict ipmsm_receiver_verdict(const struct ipmsm_receiver *receiver, uint32_t sample,
                                                uint32_t now_us)
{
    const struct ipmsm_estimate *estimate = &receiver->estimate;
    if (!is_fresh(receiver, sample, now_us)) {
        return IPMSM_ANGLE_MISSING;
    }
    const bool certain = estimate->sigma_known && estimate->sigma_theta <= receiver->sigma_limit;
    if (!(estimate->locked && estimate->polarity_known && (estimate->valid || certain))) {
        return IPMSM_ANGLE_INVALID;
    }
    if (!certain) {
        return IPMSM_ANGLE_UNCERTAIN;
    }
    return estimate->valid ? IPMSM_ANGLE_USABLE : IPMSM_ANGLE_DOUBTFUL;
}

float ipmsm_receiver_theta(const struct ipmsm_receiver *receiver, uint32_t sample, float ahead)
{
    const struct ipmsm_estimate *estimate = &receiver->estimate;
    const float periods = (float)(sample - estimate->sample) + ahead;
    return ipmsm_extrapolate(estimate->theta_e, estimate->omega_e, periods * receiver->period);
}
