#include <math.h>
#include <stddef.h>
#include <string.h>

#include "check.h"
#include "ipmsm_can.h"
#include "ipmsm_can/e2e.h"
#include "ipmsm_can/sender.h"
#include "ipmsm_can_parameters.h"

static const struct ipmsm_sample sample = {1.25f, -2.5f, 100.0f, -50.0f};

static void single_samples_count(void)
{
    struct ipmsm_sender sender;
    struct ipmsm_frame timing;
    ipmsm_sender_init(&sender, 2, false, 5000.0f);
    CHECK(!ipmsm_sender_timing(&sender, &timing)); /* nothing was sent yet */
    for (uint32_t k = 0; k < 40u; k++) {
        const struct ipmsm_frame *frame = ipmsm_sender_sample(&sender, &sample);
        struct ipmsm_can_drive_sample_t raw;
        CHECK(ipmsm_can_drive_sample_unpack(&raw, frame->data, 8) == 0);
        CHECK(raw.sample_counter == (k & 15u));
        CHECK(raw.i_alpha == 250 && raw.i_beta == -500 && raw.v_alpha == 4000 && raw.v_beta == -2000);
        if (k < 30u) {
            ipmsm_sender_sent(&sender);
        }
    }
    CHECK(ipmsm_sender_timing(&sender, &timing));
    struct ipmsm_can_drive_timing_t raw;
    CHECK(ipmsm_can_drive_timing_unpack(&raw, timing.data, 8) == 0);
    CHECK(raw.sample_counter == 29u); /* the ones after it had no room on the bus */
    CHECK(raw.sample_rate == 5000000u);
}

static uint16_t crc_of(const struct ipmsm_frame *frame, uint8_t node)
{
    const uint16_t crc = ipmsm_e2e_crc16(IPMSM_E2E_CRC16_START, &frame->data[2], 62);
    return ipmsm_e2e_crc16_end(crc, (uint16_t)(IPMSM_CAN_DRIVE_SAMPLE_BLOCK_DATA_ID + node));
}

/* The block that grows sample by sample is what the generated codec packs at once. */
static void blocks_are_what_the_codec_packs(void)
{
    struct ipmsm_sender sender;
    ipmsm_sender_init(&sender, 5, true, 10000.0f);
    sender.next = 0xFFFFFFFDu;
    sender.block_counter = 254;
    for (uint32_t b = 0; b < 5u; b++) {
        const uint32_t first = sender.next;
        const struct ipmsm_frame *frame = NULL;
        for (int16_t j = 0; j < 7; j++) {
            CHECK(frame == NULL);
            const struct ipmsm_sample s = {0.005f * (float)j, 0.5f, -1.0f, 0.25f * (float)(j + (int16_t)b)};
            frame = ipmsm_sender_sample(&sender, &s);
        }
        CHECK(frame != NULL);
        struct ipmsm_can_drive_sample_block_t raw;
        CHECK(ipmsm_can_drive_sample_block_unpack(&raw, frame->data, 64) == 0);
        CHECK(raw.first_sample == first && raw.sample_count == 7u);
        CHECK(raw.e2e_counter == ((254u + b) & 255u) && raw.e2e_crc == crc_of(frame, 5));
        CHECK(raw.i_alpha_0 == 0 && raw.i_alpha_3 == 3 && raw.i_alpha_6 == 6 && raw.i_beta_4 == 100);
        CHECK(raw.v_alpha_2 == -40 && raw.v_beta_0 == 10 * (int16_t)b && raw.v_beta_6 == 10 * (6 + (int16_t)b));
        uint8_t again[64];
        CHECK(ipmsm_can_drive_sample_block_pack(again, &raw, 64) == 64);
        CHECK(memcmp(again, frame->data, 64) == 0);
    }
}

static void what_is_too_large_saturates(void)
{
    struct ipmsm_sender sender;
    ipmsm_sender_init(&sender, 0, false, 5000.0f);
    const struct ipmsm_sample wild = {INFINITY, -1e20f, NAN, 1e20f};
    struct ipmsm_can_drive_sample_t raw;
    CHECK(ipmsm_can_drive_sample_unpack(&raw, ipmsm_sender_sample(&sender, &wild)->data, 8) == 0);
    CHECK(raw.i_alpha == 16383 && raw.i_beta == -16384 && raw.v_alpha == 0 && raw.v_beta == 16383);
    ipmsm_sender_init(&sender, 0, false, 1e9f);
    ipmsm_sender_sent(&sender);
    struct ipmsm_frame frame;
    CHECK(ipmsm_sender_timing(&sender, &frame));
    struct ipmsm_can_drive_timing_t timing;
    CHECK(ipmsm_can_drive_timing_unpack(&timing, frame.data, 8) == 0);
    CHECK(timing.sample_rate == 0xFFFFFFFFu);
}

static void nearly_a_turn_is_none(void)
{
    struct ipmsm_sender sender;
    struct ipmsm_frame frame;
    struct ipmsm_can_drive_reference_t raw;
    ipmsm_sender_init(&sender, 0, false, 5000.0f);
    ipmsm_sender_reference(&sender, 6.28310f, 0.0f, 7, &frame);
    CHECK(ipmsm_can_drive_reference_unpack(&raw, frame.data, 8) == 0);
    CHECK(raw.theta_e == 65535u);
    ipmsm_sender_reference(&sender, 6.28317f, 0.0f, 7, &frame);
    CHECK(ipmsm_can_drive_reference_unpack(&raw, frame.data, 8) == 0);
    CHECK(raw.theta_e == 0u);
}

void test_sender(void)
{
    single_samples_count();
    blocks_are_what_the_codec_packs();
    what_is_too_large_saturates();
    nearly_a_turn_is_none();
}
