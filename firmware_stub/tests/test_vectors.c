/* The library against what the Python package makes of the same inputs. */
#include <string.h>

#include "check.h"
#include "ipmsm_can/angle.h"
#include "ipmsm_can/drive.h"
#include "memory_port.h"
#include "vectors.h"

#define COUNT(table) (sizeof(table) / sizeof((table)[0]))

/* Single precision: 1.2e-7 of 13 V over a few operations; a thousandth of what the wire resolves. */
#define VOLTAGE_TOLERANCE (2e-5f)
/* Single precision: 6e-8 of up to 400 rad of extrapolation. */
#define ANGLE_TOLERANCE (3e-5f)

static void crcs(void)
{
    for (uint32_t n = 0; n < COUNT(crc8_vectors); n++) {
        CHECK(ipmsm_e2e_crc8(crc8_vectors[n].payload, 8, crc8_vectors[n].data_id) == crc8_vectors[n].payload[0]);
    }
    for (uint32_t n = 0; n < COUNT(crc16_vectors); n++) {
        const uint8_t *payload = crc16_vectors[n].payload;
        const uint16_t crc = ipmsm_e2e_crc16(IPMSM_E2E_CRC16_START, payload + 2, crc16_vectors[n].length - 2u);
        CHECK(ipmsm_e2e_crc16_end(crc, crc16_vectors[n].data_id) == (payload[0] | payload[1] << 8));
    }
}

static void sequence(void)
{
    struct ipmsm_e2e_sequence state;
    memset(&state, 0, sizeof state);
    for (uint32_t n = 0; n < COUNT(sequence_counter); n++) {
        const enum ipmsm_e2e_status status = ipmsm_e2e_follow(&state, sequence_counter[n], IPMSM_FRAMES_MISSED);
        CHECK((uint32_t)status == sequence_status[n]);
    }
    CHECK(state.lost == sequence_lost);
}

static struct ipmsm_sample sample_of(const float values[4])
{
    const struct ipmsm_sample sample = {values[0], values[1], values[2], values[3]};
    return sample;
}

static void samples(void)
{
    struct ipmsm_sender sender;
    for (uint32_t n = 0; n < COUNT(sample_vectors); n++) {
        ipmsm_sender_init(&sender, sample_vectors[n].node, false, 10000.0f);
        sender.next = sample_vectors[n].counter;
        const struct ipmsm_sample sample = sample_of(sample_vectors[n].values);
        const struct ipmsm_frame *frame = ipmsm_sender_sample(&sender, &sample);
        CHECK(frame != NULL && frame->id == 0x100u + sample_vectors[n].node && frame->length == 8u);
        CHECK(frame->flags == 0u && memcmp(frame->data, sample_vectors[n].payload, 8) == 0);
    }
    for (uint32_t n = 0; n < COUNT(block_vectors); n++) {
        ipmsm_sender_init(&sender, block_vectors[n].node, true, 10000.0f);
        sender.next = block_vectors[n].first;
        sender.block_counter = block_vectors[n].e2e_counter;
        const struct ipmsm_frame *frame = NULL;
        for (uint32_t j = 0; j < 7u; j++) {
            CHECK(frame == NULL);
            const struct ipmsm_sample sample = sample_of(block_vectors[n].values[j]);
            frame = ipmsm_sender_sample(&sender, &sample);
        }
        CHECK(frame != NULL && frame->id == 0x120u + block_vectors[n].node && frame->length == 64u);
        CHECK(frame->flags == IPMSM_FRAME_FD && memcmp(frame->data, block_vectors[n].payload, 64) == 0);
    }
}

static void background(void)
{
    struct ipmsm_sender sender;
    struct ipmsm_frame frame;
    for (uint32_t n = 0; n < COUNT(timing_vectors); n++) {
        ipmsm_sender_init(&sender, timing_vectors[n].node, false, timing_vectors[n].rate);
        sender.next = timing_vectors[n].counter + 1u;
        ipmsm_sender_sent(&sender);
        CHECK(ipmsm_sender_timing(&sender, &frame));
        CHECK(frame.id == 0x140u + timing_vectors[n].node && frame.length == 8u && frame.flags == 0u);
        CHECK(memcmp(frame.data, timing_vectors[n].payload, 8) == 0);
    }
    for (uint32_t n = 0; n < COUNT(status_vectors); n++) {
        ipmsm_sender_init(&sender, status_vectors[n].node, false, 10000.0f);
        const struct ipmsm_status status = {
            .mode = (enum ipmsm_mode)status_vectors[n].mode,
            .faults = status_vectors[n].faults,
            .encoder_available = status_vectors[n].encoder != 0u,
            .v_dc = status_vectors[n].v_dc,
            .temperature = status_vectors[n].temperature,
        };
        ipmsm_sender_status(&sender, &status, status_vectors[n].waveform, status_vectors[n].rejected, &frame);
        CHECK(frame.id == 0x160u + status_vectors[n].node && frame.length == 8u && frame.flags == 0u);
        CHECK(memcmp(frame.data, status_vectors[n].payload, 8) == 0);
    }
    for (uint32_t n = 0; n < COUNT(reference_vectors); n++) {
        const uint8_t *expected = reference_vectors[n].payload;
        ipmsm_sender_init(&sender, reference_vectors[n].node, false, 10000.0f);
        ipmsm_sender_reference(&sender, reference_vectors[n].theta, reference_vectors[n].omega,
                               reference_vectors[n].sample, &frame);
        CHECK(frame.id == 0x180u + reference_vectors[n].node && frame.length == 8u && frame.flags == 0u);
        const int32_t apart = (frame.data[0] | frame.data[1] << 8) - (expected[0] | expected[1] << 8);
        const int32_t allowed = (int32_t)reference_vectors[n].theta_codes_apart;
        CHECK(apart >= -allowed && apart <= allowed);
        CHECK(memcmp(frame.data + 2, expected + 2, 6) == 0);
    }
}

static void estimates(void)
{
    struct ipmsm_receiver receivers[7];
    for (uint8_t node = 0; node < 7u; node++) {
        CHECK(ipmsm_receiver_init(&receivers[node], node, 10000.0f, 10.0f, 10000u));
        receivers[node].warm_up = 0;
    }
    for (uint32_t n = 0; n < COUNT(estimate_vectors); n++) {
        struct ipmsm_receiver *receiver = &receivers[estimate_vectors[n].node];
        struct ipmsm_frame frame = {.id = 0x200u + estimate_vectors[n].node, .length = 8};
        memcpy(frame.data, estimate_vectors[n].payload, 8);
        struct ipmsm_command command;
        const uint32_t before = receiver->estimates.counts[estimate_vectors[n].status];
        const enum ipmsm_received received =
            ipmsm_receiver_take(receiver, &frame, estimate_vectors[n].latest, 5u, &command);
        CHECK(receiver->estimates.counts[estimate_vectors[n].status] == before + 1u);
        if (estimate_vectors[n].status > IPMSM_E2E_SOME_LOST) {
            CHECK(received == IPMSM_RECEIVED_BAD_ESTIMATE);
            continue;
        }
        CHECK(received == IPMSM_RECEIVED_ESTIMATE);
        const struct ipmsm_estimate *estimate = &receiver->estimate;
        CHECK_NEAR(estimate->theta_e, estimate_vectors[n].theta_e, 1e-6f);
        CHECK_NEAR(estimate->omega_e, estimate_vectors[n].omega_e, 0.0f);
        CHECK_NEAR(estimate->sigma_theta, estimate_vectors[n].sigma_theta, 0.0f);
        CHECK(estimate->sample == estimate_vectors[n].named);
        CHECK(estimate->valid == (estimate_vectors[n].valid != 0u));
        CHECK(estimate->locked == (estimate_vectors[n].locked != 0u));
        CHECK(estimate->polarity_known == (estimate_vectors[n].polarity_known != 0u));
        CHECK(estimate->injecting == (estimate_vectors[n].injecting != 0u));
    }
}

static void extrapolations(void)
{
    for (uint32_t n = 0; n < COUNT(extrapolation_vectors); n++) {
        const float found = ipmsm_extrapolate(extrapolation_vectors[n].theta, extrapolation_vectors[n].omega,
                                              extrapolation_vectors[n].elapsed);
        float apart = found - extrapolation_vectors[n].expected;
        if (apart > 3.0f) {
            apart -= IPMSM_TWO_PI;
        } else if (apart < -3.0f) {
            apart += IPMSM_TWO_PI;
        }
        CHECK_NEAR(apart, 0.0f, ANGLE_TOLERANCE);
        CHECK(found >= 0.0f && found < IPMSM_TWO_PI);
    }
}

static void probing(void)
{
    for (uint32_t n = 0; n < COUNT(probing_vectors); n++) {
        struct memory_port port;
        struct ipmsm_hal hal;
        struct ipmsm_drive drive;
        memory_port_init(&port, &hal);
        struct ipmsm_config config = ipmsm_config_default();
        config.node = probing_vectors[n].node;
        config.sample_rate = probing_vectors[n].rate;
        config.probing_limit = probing_vectors[n].limit;
        config.probing_ramp = probing_vectors[n].ramp;
        CHECK(ipmsm_drive_init(&drive, &config, &hal));
        uint32_t next_event = 0;
        for (uint32_t k = 0; k < probing_vectors[n].samples; k++) {
            port.clock_us = (uint32_t)((float)k * 1e6f / config.sample_rate);
            while (next_event < probing_vectors[n].events && probing_vectors[n].event[next_event].at == k) {
                const struct probing_event *event = &probing_vectors[n].event[next_event++];
                struct ipmsm_frame frame = {.id = event->id, .length = (uint8_t)event->length};
                frame.flags = (event->extended != 0u) ? IPMSM_FRAME_EXTENDED : 0u;
                memcpy(frame.data, event->payload, 8);
                CHECK(memory_port_put(&port, &frame));
            }
            float v_alpha;
            float v_beta;
            ipmsm_drive_receive(&drive);
            ipmsm_drive_probe(&drive, &v_alpha, &v_beta);
            CHECK(drive.probing.waveform == probing_vectors[n].waveform[k]);
            CHECK_NEAR(drive.probing.amplitude, probing_vectors[n].amplitude[k], VOLTAGE_TOLERANCE);
            CHECK_NEAR(v_alpha, probing_vectors[n].v_alpha[k], VOLTAGE_TOLERANCE);
            CHECK_NEAR(v_beta, probing_vectors[n].v_beta[k], VOLTAGE_TOLERANCE);
        }
        CHECK(next_event == probing_vectors[n].events);
        CHECK(drive.rejected == probing_vectors[n].rejected);
    }
}

void test_vectors(void)
{
    crcs();
    sequence();
    samples();
    background();
    estimates();
    extrapolations();
    probing();
}
