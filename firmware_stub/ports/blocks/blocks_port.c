#include "blocks_port.h"

#include <math.h>
#include <string.h>

#include "ipmsm_can.h"
#include "ipmsm_can/drive.h"

#define ROW (72u) /* struct canfd_frame: identifier and flags, length, FD flags, 2 reserved, payload */
#define PAYLOAD (8u)
#define ID_MASK (0x1FFFFFFFu)
#define EXTENDED (0x80000000u)
#define REMOTE (0x40000000u)
#define ERROR (0x20000000u)
#define FD_BRS (0x05u)
#define FD (0x04u)

struct blocks_drive {
    struct ipmsm_drive drive;
    struct ipmsm_hal hal;
    struct blocks_settings settings;
    uint64_t period; /* the one that runs, counted from the start: the clock */
    const uint8_t *heard, *heard_end;
    uint8_t *out; /* NULL while rehearsing */
    int64_t *at;
    size_t sent;
};

static bool transmit(void *context, const struct ipmsm_frame *frame)
{
    struct blocks_drive *blocks = context;
    if (blocks->out == NULL) {
        return true;
    }
    uint8_t *row = &blocks->out[ROW * blocks->sent];
    memset(row, 0, ROW);
    memcpy(row, &frame->id, sizeof frame->id);
    row[4] = frame->length;
    row[5] = ((frame->flags & IPMSM_FRAME_FD) != 0u) ? FD_BRS : 0u;
    memcpy(&row[PAYLOAD], frame->data, frame->length);
    blocks->at[blocks->sent++] = (int64_t)blocks->period;
    return true;
}

/* What a controller's acceptance filter would let through. */
static bool is_wanted(uint32_t header, uint8_t node)
{
    const uint32_t id = header & ID_MASK;
    return (header & (EXTENDED | REMOTE | ERROR)) == 0u
           && (id == IPMSM_CAN_POSITION_ESTIMATE_FRAME_ID + (uint32_t)node
               || id == IPMSM_CAN_INJECTION_COMMAND_FRAME_ID + (uint32_t)node);
}

static bool receive(void *context, struct ipmsm_frame *frame)
{
    struct blocks_drive *blocks = context;
    while (blocks->heard != blocks->heard_end) {
        const uint8_t *row = blocks->heard;
        uint32_t header;
        blocks->heard += ROW;
        memcpy(&header, row, sizeof header);
        if (is_wanted(header, blocks->settings.node)) {
            *frame = (struct ipmsm_frame){.id = header & ID_MASK, .length = row[4]};
            frame->flags = ((row[5] & FD) != 0u) ? IPMSM_FRAME_FD : 0u;
            memcpy(frame->data, &row[PAYLOAD], IPMSM_FRAME_BYTES);
            return true;
        }
    }
    return false;
}

static uint32_t now_us(void *context)
{
    const struct blocks_drive *blocks = context;
    return (uint32_t)(uint64_t)((double)blocks->period * 1e6 / (double)blocks->settings.sample_rate);
}

static uint32_t lock(void *context)
{
    (void)context;
    return 0;
}

static void unlock(void *context, uint32_t before)
{
    (void)context;
    (void)before;
}

static void wire(struct blocks_drive *blocks)
{
    blocks->hal = (struct ipmsm_hal){
        .context = blocks,
        .transmit = transmit,
        .receive = receive,
        .now_us = now_us,
        .lock = lock,
        .unlock = unlock,
    };
    blocks->drive.hal = &blocks->hal;
}

size_t blocks_size(void)
{
    return sizeof(struct blocks_drive);
}

bool blocks_init(struct blocks_drive *blocks, const struct blocks_settings *settings)
{
    *blocks = (struct blocks_drive){.settings = *settings};
    struct ipmsm_config config = ipmsm_config_default();
    config.node = settings->node;
    config.fd = settings->fd;
    config.sample_rate = settings->sample_rate;
    config.probing_limit = settings->probing_limit;
    config.probing_ramp = settings->probing_ramp;
    config.sigma_limit = settings->sigma_limit;
    config.estimate_time_to_live_us = settings->estimate_time_to_live_us;
    if (!ipmsm_drive_init(&blocks->drive, &config, &blocks->hal)) {
        return false;
    }
    wire(blocks);
    return true;
}

/* What an interrupt does. */
static void control_period(struct blocks_drive *blocks, const struct ipmsm_sample *sample, float *v_alpha,
                           float *v_beta)
{
    (void)ipmsm_drive_sample(&blocks->drive, sample);
    ipmsm_drive_receive(&blocks->drive);
    ipmsm_drive_probe(&blocks->drive, v_alpha, v_beta);
}

void blocks_rehearse(const struct blocks_drive *blocks, const uint8_t *heard, size_t count, size_t n,
                     double *probe, double *told)
{
    const struct ipmsm_sample sample = {0.0f, 0.0f, 0.0f, 0.0f};
    struct blocks_drive copy = *blocks;
    wire(&copy);
    copy.heard = heard;
    copy.heard_end = &heard[ROW * count];
    copy.out = NULL;
    for (size_t j = 0; j < n; j++) {
        float v_alpha;
        float v_beta;
        float angle = NAN;
        control_period(&copy, &sample, &v_alpha, &v_beta);
        probe[j] = (double)v_alpha;
        probe[n + j] = (double)v_beta;
        probe[2u * n + j] = (double)copy.drive.probing.waveform;
        probe[3u * n + j] = (double)copy.drive.probing.amplitude;
        told[j] = (double)ipmsm_drive_angle(&copy.drive, 0.0f, &angle);
        told[n + j] = (double)angle;
        told[2u * n + j] = (double)ipmsm_drive_speed(&copy.drive);
        copy.period++;
    }
}

static bool is_due(uint64_t period, uint32_t every)
{
    return every != 0u && period % every == 0u;
}

size_t blocks_run(struct blocks_drive *blocks, const uint8_t *heard, size_t count, size_t n,
                  const double *samples, const uint8_t *condition, uint8_t *out, int64_t *at, size_t *used)
{
    const struct blocks_settings *settings = &blocks->settings;
    struct ipmsm_status status = {.v_dc = settings->v_dc, .temperature = settings->temperature};
    blocks->heard = heard;
    blocks->heard_end = &heard[ROW * count];
    blocks->out = out;
    blocks->at = at;
    blocks->sent = 0;
    for (size_t j = 0; j < n; j++) {
        const struct ipmsm_sample sample = {
            .i_alpha = (float)samples[j],
            .i_beta = (float)samples[n + j],
            .v_alpha = (float)samples[2u * n + j],
            .v_beta = (float)samples[3u * n + j],
        };
        float v_alpha;
        float v_beta;
        control_period(blocks, &sample, &v_alpha, &v_beta);
        if (is_due(blocks->period, settings->timing_every)) {
            (void)ipmsm_drive_timing(&blocks->drive);
        }
        status.mode = (enum ipmsm_mode)condition[j];
        status.faults = condition[n + j];
        status.encoder_available =
            settings->reference_every != 0u && (status.faults & IPMSM_FAULT_ENCODER) == 0u;
        if (is_due(blocks->period, settings->status_every) || condition[2u * n + j] != 0u) {
            (void)ipmsm_drive_status(&blocks->drive, &status);
        }
        if (status.encoder_available && is_due(blocks->period, settings->reference_every)) {
            (void)ipmsm_drive_reference(&blocks->drive, (float)samples[4u * n + j], (float)samples[5u * n + j],
                                        (uint32_t)blocks->period);
        }
        blocks->period++;
    }
    *used = (size_t)(blocks->heard - heard) / ROW;
    return blocks->sent;
}

void blocks_count(const struct blocks_drive *blocks, struct blocks_counts *counts)
{
    const struct ipmsm_receiver *receiver = &blocks->drive.receiver;
    memcpy(counts->estimates, receiver->estimates.counts, sizeof counts->estimates);
    memcpy(counts->commands, receiver->commands.counts, sizeof counts->commands);
    counts->late = receiver->late;
    counts->rejected = blocks->drive.rejected;
}
