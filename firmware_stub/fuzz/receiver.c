/* libFuzzer on everything that comes from the bus: bytes become frames, periods and questions, and whatever
 * they are, what the drive puts out must keep within its rules. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "ipmsm_can/angle.h"
#include "ipmsm_can/drive.h"
#include "ipmsm_can_parameters.h"
#include "memory_port.h"

static const uint8_t estimate_ids[16] = IPMSM_CAN_POSITION_ESTIMATE_DATA_IDS;
static const uint8_t command_ids[16] = IPMSM_CAN_INJECTION_COMMAND_DATA_IDS;

struct input {
    const uint8_t *bytes;
    size_t left;
};

static uint8_t next(struct input *input)
{
    if (input->left == 0u) {
        return 0;
    }
    input->left--;
    return *input->bytes++;
}

static void insist(bool holds)
{
    if (!holds) {
        abort();
    }
}

/* Without help a fuzzer meets the right CRC once in 256 frames; bit 0 of the mode gives it. */
static void hear(struct memory_port *port, uint8_t node, struct input *input)
{
    const uint8_t mode = next(input);
    const bool is_command = (mode & 2u) != 0u;
    struct ipmsm_frame frame;
    memset(&frame, 0, sizeof frame);
    frame.id = (is_command ? 0x220u : 0x200u) + node;
    frame.length = 8;
    if ((mode & 0xE0u) == 0xE0u) {
        frame.length = next(input);
        frame.flags = next(input);
        frame.id ^= next(input);
    }
    for (size_t j = 0; j < 8u; j++) {
        frame.data[j] = next(input);
    }
    if ((mode & 1u) != 0u) {
        const uint8_t id = (is_command ? command_ids : estimate_ids)[frame.data[1] & 15u];
        frame.data[0] = ipmsm_e2e_crc8(frame.data, 8, (uint8_t)(id + node));
    }
    (void)memory_port_put(port, &frame);
}

static void period(struct ipmsm_drive *drive, uint32_t *silent_for)
{
    const struct ipmsm_sample sample = {1.0f, 2.0f, 3.0f, 4.0f};
    const uint32_t left = drive->probing.samples_left;
    float v_alpha;
    float v_beta;
    float theta_e = 0.0f;
    (void)ipmsm_drive_sample(drive, &sample);
    ipmsm_drive_receive(drive);
    const bool renewed = drive->probing.samples_left > left;
    ipmsm_drive_probe(drive, &v_alpha, &v_beta);
    insist(isfinite(v_alpha) && isfinite(v_beta));
    insist(sqrtf(v_alpha * v_alpha + v_beta * v_beta) <= 1.0001f * IPMSM_PROBING_LIMIT);
    /* No command lives longer than 510 ms of 10 kHz. */
    *silent_for = renewed ? 0u : *silent_for + 1u;
    insist(*silent_for <= 5100u || (v_alpha == 0.0f && v_beta == 0.0f));
    insist(drive->probing.waveform <= IPMSM_WAVEFORM_POLARITY_PULSES);
    const enum ipmsm_angle_verdict verdict = ipmsm_drive_angle(drive, 1.5f, &theta_e);
    if (verdict == IPMSM_ANGLE_USABLE || verdict == IPMSM_ANGLE_DOUBTFUL) {
        const struct ipmsm_estimate *estimate = &drive->receiver.estimate;
        insist(theta_e >= 0.0f && theta_e < IPMSM_TWO_PI);
        insist(estimate->locked && estimate->polarity_known);
        insist(estimate->valid == (verdict == IPMSM_ANGLE_USABLE));
        insist(estimate->sigma_known && estimate->sigma_theta <= drive->receiver.sigma_limit);
        insist(drive->sender.next - 1u - estimate->sample <= 100u);
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    struct input input = {data, size};
    struct memory_port port;
    struct ipmsm_hal hal;
    struct ipmsm_drive drive;
    uint32_t silent_for = 0;
    memory_port_init(&port, &hal);
    struct ipmsm_config config = ipmsm_config_default();
    config.node = next(&input) & 15u;
    config.fd = (next(&input) & 1u) != 0u;
    insist(ipmsm_drive_init(&drive, &config, &hal));
    drive.receiver.warm_up = 0;
    drive.sender.next = (uint32_t)next(&input) << 24;
    port.clock_us = (uint32_t)next(&input) << 24;
    while (input.left > 0u) {
        const uint8_t what = next(&input);
        if (what < 128u) {
            hear(&port, config.node, &input);
        } else if (what < 250u) {
            for (uint8_t k = (uint8_t)(what & 7u); k <= 8u; k++) {
                period(&drive, &silent_for);
                port.clock_us += 100u;
            }
        } else {
            port.clock_us += (uint32_t)next(&input) << (4u * (what & 3u));
        }
    }
    insist(port.lock_faults == 0u && port.lock_depth == 0);
    return 0;
}
