#include "ipmsm_can/drive.h"

#include <stddef.h>

struct ipmsm_config ipmsm_config_default(void)
{
    return (struct ipmsm_config){
        .sample_rate = 10000.0f,
        .probing_limit = IPMSM_PROBING_LIMIT,
        .probing_ramp = 1000.0f,
        .sigma_limit = 10.0f,
        .estimate_time_to_live_us = 10000u,
    };
}

bool ipmsm_drive_init(struct ipmsm_drive *drive, const struct ipmsm_config *config, const struct ipmsm_hal *hal)
{
    if (!(config->sample_rate >= 100.0f && config->sample_rate <= 1e6f)) {
        return false;
    }
    if (!(config->probing_limit >= 0.0f && config->probing_ramp > 0.0f && config->sigma_limit >= 0.0f)) {
        return false;
    }
    *drive = (struct ipmsm_drive){.hal = hal};
    ipmsm_sender_init(&drive->sender, config->node, config->fd, config->sample_rate);
    ipmsm_probing_init(&drive->probing, config->sample_rate, config->probing_limit, config->probing_ramp);
    return ipmsm_receiver_init(&drive->receiver, config->node, config->sample_rate, config->sigma_limit,
                               config->estimate_time_to_live_us);
}

static uint32_t lock(const struct ipmsm_drive *drive)
{
    return drive->hal->lock(drive->hal->context);
}

static void unlock(const struct ipmsm_drive *drive, uint32_t before)
{
    drive->hal->unlock(drive->hal->context, before);
}

static uint32_t now_us(const struct ipmsm_drive *drive)
{
    return drive->hal->now_us(drive->hal->context);
}

static uint32_t latest_sample(const struct ipmsm_drive *drive)
{
    return drive->sender.next - 1u;
}

static bool transmit(struct ipmsm_drive *drive, const struct ipmsm_frame *frame)
{
    const bool taken = drive->hal->transmit(drive->hal->context, frame);
    if (!taken) {
        drive->dropped++;
    }
    return taken;
}

bool ipmsm_drive_sample(struct ipmsm_drive *drive, const struct ipmsm_sample *sample)
{
    bool taken = true;
    const uint32_t before = lock(drive);
    const struct ipmsm_frame *frame = ipmsm_sender_sample(&drive->sender, sample);
    if (frame != NULL) {
        taken = transmit(drive, frame);
        if (taken) {
            ipmsm_sender_sent(&drive->sender);
        }
    }
    unlock(drive, before);
    return taken;
}

static void take(struct ipmsm_drive *drive, const struct ipmsm_frame *frame)
{
    struct ipmsm_command command;
    const uint32_t now = now_us(drive);
    const enum ipmsm_received received =
        ipmsm_receiver_take(&drive->receiver, frame, latest_sample(drive), now, &command);
    const bool refused = (received == IPMSM_RECEIVED_BAD_COMMAND)
                         || (received == IPMSM_RECEIVED_COMMAND
                             && !ipmsm_probing_ask(&drive->probing, &command, now));
    if (refused) {
        drive->rejected++;
        drive->rejected_now = true;
    }
}

void ipmsm_drive_receive(struct ipmsm_drive *drive)
{
    struct ipmsm_frame frame;
    for (uint32_t n = 0; n < IPMSM_RECEIVE_AT_ONCE; n++) {
        if (!drive->hal->receive(drive->hal->context, &frame)) {
            break;
        }
        const uint32_t before = lock(drive);
        take(drive, &frame);
        unlock(drive, before);
    }
    const uint32_t before = lock(drive);
    ipmsm_receiver_expire(&drive->receiver, latest_sample(drive), now_us(drive));
    unlock(drive, before);
}

void ipmsm_drive_probe(struct ipmsm_drive *drive, float *v_alpha, float *v_beta)
{
    const uint32_t before = lock(drive);
    ipmsm_probing_step(&drive->probing, now_us(drive), v_alpha, v_beta);
    unlock(drive, before);
}

void ipmsm_drive_stop_probing(struct ipmsm_drive *drive)
{
    const uint32_t before = lock(drive);
    ipmsm_probing_stop(&drive->probing);
    unlock(drive, before);
}

enum ipmsm_angle_verdict ipmsm_drive_angle(const struct ipmsm_drive *drive, float ahead, float *theta_e)
{
    const uint32_t before = lock(drive);
    const uint32_t sample = latest_sample(drive);
    const enum ipmsm_angle_verdict verdict = ipmsm_receiver_verdict(&drive->receiver, sample, now_us(drive));
    if (verdict == IPMSM_ANGLE_USABLE || verdict == IPMSM_ANGLE_DOUBTFUL) {
        *theta_e = ipmsm_receiver_theta(&drive->receiver, sample, ahead);
    }
    unlock(drive, before);
    return verdict;
}

float ipmsm_drive_speed(const struct ipmsm_drive *drive)
{
    const uint32_t before = lock(drive);
    const float omega_e = drive->receiver.estimate.omega_e;
    unlock(drive, before);
    return omega_e;
}

bool ipmsm_drive_angle_usable(const struct ipmsm_drive *drive)
{
    float theta_e;
    return ipmsm_drive_angle(drive, 0.0f, &theta_e) == IPMSM_ANGLE_USABLE;
}

bool ipmsm_drive_timing(struct ipmsm_drive *drive)
{
    struct ipmsm_frame frame;
    /* One critical section around both, or a sample could come between the counter and its frame. */
    const uint32_t before = lock(drive);
    const bool taken = ipmsm_sender_timing(&drive->sender, &frame) && transmit(drive, &frame);
    unlock(drive, before);
    return taken;
}

bool ipmsm_drive_status(struct ipmsm_drive *drive, const struct ipmsm_status *status)
{
    struct ipmsm_frame frame;
    struct ipmsm_status told = *status;
    const uint32_t before = lock(drive);
    if (drive->rejected_now) {
        told.faults |= IPMSM_FAULT_COMMAND_REJECTED;
    }
    ipmsm_sender_status(&drive->sender, &told, drive->probing.waveform, (uint8_t)(drive->rejected & 0xFFu),
                        &frame);
    const bool taken = transmit(drive, &frame);
    if (taken) {
        drive->rejected_now = false;
    }
    unlock(drive, before);
    return taken;
}

bool ipmsm_drive_reference(struct ipmsm_drive *drive, float theta_e, float omega_e, uint32_t sample_counter)
{
    struct ipmsm_frame frame;
    ipmsm_sender_reference(&drive->sender, theta_e, omega_e, sample_counter, &frame);
    const uint32_t before = lock(drive);
    const bool taken = transmit(drive, &frame);
    unlock(drive, before);
    return taken;
}
