#include <string.h>

#include "check.h"
#include "ipmsm_can.h"
#include "ipmsm_can/drive.h"
#include "memory_port.h"

static struct memory_port port;
static struct ipmsm_hal hal;
static struct ipmsm_drive drive;
static const struct ipmsm_sample sample = {1.0f, 2.0f, 3.0f, 4.0f};
static const struct command_values order = {1, 5.0f, 400.0f, 0.0f, 20.0f};

static void begin(bool fd)
{
    memory_port_init(&port, &hal);
    struct ipmsm_config config = ipmsm_config_default();
    config.node = 6;
    config.fd = fd;
    CHECK(ipmsm_drive_init(&drive, &config, &hal));
}

/* One control period of 100 us; the probing voltage that came of it, squared. */
static float period(void)
{
    float v_alpha;
    float v_beta;
    (void)ipmsm_drive_sample(&drive, &sample);
    ipmsm_drive_receive(&drive);
    ipmsm_drive_probe(&drive, &v_alpha, &v_beta);
    port.clock_us += 100u;
    return v_alpha * v_alpha + v_beta * v_beta;
}

static void hear(struct ipmsm_frame frame)
{
    CHECK(memory_port_put(&port, &frame));
}

static struct ipmsm_can_drive_status_t told_status(void)
{
    const struct ipmsm_status status = {.mode = IPMSM_RUNNING, .faults = IPMSM_FAULT_CAN, .v_dc = 540.0f};
    struct ipmsm_can_drive_status_t raw;
    memset(&raw, 0, sizeof raw);
    CHECK(ipmsm_drive_status(&drive, &status));
    CHECK(port.sent.id == 0x166u);
    CHECK(ipmsm_can_drive_status_unpack(&raw, port.sent.data, 8) == 0);
    return raw;
}

static bool accepts(void (*change)(struct ipmsm_config *))
{
    struct ipmsm_config config = ipmsm_config_default();
    change(&config);
    return ipmsm_drive_init(&drive, &config, &hal);
}
static void nothing(struct ipmsm_config *config) { (void)config; }
static void node_16(struct ipmsm_config *config) { config->node = 16; }
static void rate_99(struct ipmsm_config *config) { config->sample_rate = 99.0f; }
static void rate_2e6(struct ipmsm_config *config) { config->sample_rate = 2e6f; }
static void limit_below_0(struct ipmsm_config *config) { config->probing_limit = -1.0f; }
static void ramp_0(struct ipmsm_config *config) { config->probing_ramp = 0.0f; }
static void sigma_below_0(struct ipmsm_config *config) { config->sigma_limit = -0.1f; }
static void lives_too_long(struct ipmsm_config *config) { config->estimate_time_to_live_us = 200000u; }

static void configurations(void)
{
    memory_port_init(&port, &hal);
    CHECK(accepts(nothing));
    CHECK(!accepts(node_16));
    CHECK(!accepts(rate_99));
    CHECK(!accepts(rate_2e6));
    CHECK(!accepts(limit_below_0));
    CHECK(!accepts(ramp_0));
    CHECK(!accepts(sigma_below_0));
    CHECK(!accepts(lives_too_long));
}

static void samples_go_out(void)
{
    begin(false);
    CHECK(!ipmsm_drive_timing(&drive));
    for (uint32_t k = 0; k < 20u; k++) {
        CHECK(ipmsm_drive_sample(&drive, &sample));
        CHECK(port.sent_count == k + 1u && port.sent.id == 0x106u);
    }
    port.full = true;
    CHECK(!ipmsm_drive_sample(&drive, &sample));
    CHECK(!ipmsm_drive_timing(&drive));
    CHECK(!ipmsm_drive_reference(&drive, 1.0f, 2.0f, 3u));
    CHECK(drive.dropped == 3u);
    port.full = false;
    CHECK(ipmsm_drive_timing(&drive));
    CHECK(port.sent.id == 0x146u && port.sent.data[0] == 19u); /* the 20th of 21 was the last on the bus */
    CHECK(ipmsm_drive_sample(&drive, &sample));
    CHECK(port.sent.data[7] >> 4 == (21u & 15u)); /* the lost one is a gap in the counter */
    CHECK(ipmsm_drive_reference(&drive, 1.0f, 2.0f, 3u));
    CHECK(port.sent.id == 0x186u);
    CHECK(port.lock_faults == 0u && port.lock_depth == 0);
}

static void blocks_go_out(void)
{
    begin(true);
    for (uint32_t k = 1; k <= 35u; k++) {
        CHECK(ipmsm_drive_sample(&drive, &sample));
        CHECK(port.sent_count == k / 7u);
    }
    CHECK(port.sent.id == 0x126u && port.sent.length == 64u && port.sent.flags == IPMSM_FRAME_FD);
    CHECK(ipmsm_drive_sample(&drive, &sample));
    CHECK(ipmsm_drive_timing(&drive));
    CHECK(port.sent.data[0] == 34u); /* the 36th waits in a block */
}

static void obeys_and_says_so(void)
{
    begin(false);
    CHECK(period() == 0.0f);
    CHECK(told_status().active_waveform == 0u);
    hear(command_frame(6, 0, order));
    for (uint32_t k = 0; k < 200u; k++) {
        CHECK(period() > 0.0f);
    }
    CHECK(told_status().active_waveform == 1u);
    CHECK(period() == 0.0f); /* 20 ms are over */
    CHECK(told_status().active_waveform == 0u);
    CHECK(drive.rejected == 0u);
    hear(command_frame(6, 1, order));
    CHECK(period() > 0.0f);
    ipmsm_drive_stop_probing(&drive);
    CHECK(period() == 0.0f);
    CHECK(port.lock_faults == 0u && port.lock_depth == 0);
}

static void forged_commands_are_counted_not_obeyed(void)
{
    begin(false);
    struct command_values wild = order;
    struct ipmsm_frame frame = command_frame(6, 0, order);
    frame.data[3] ^= 0x10u;
    hear(frame);
    CHECK(period() == 0.0f);
    wild.waveform = 7;
    hear(command_frame(6, 1, wild)); /* intact, but not executable */
    CHECK(period() == 0.0f);
    CHECK(drive.rejected == 2u);
    struct ipmsm_can_drive_status_t status = told_status();
    CHECK(status.rejected_commands == 2u);
    CHECK(status.faults == (IPMSM_FAULT_CAN | IPMSM_FAULT_COMMAND_REJECTED));
    status = told_status();
    CHECK(status.rejected_commands == 2u && status.faults == IPMSM_FAULT_CAN);
    /* A frozen counter: obeyed once, and over after its time to live. */
    hear(command_frame(6, 2, order));
    CHECK(period() > 0.0f);
    for (uint32_t k = 1; k < 200u; k++) {
        hear(command_frame(6, 2, order));
        CHECK(period() > 0.0f);
    }
    CHECK(drive.rejected == 201u);
    hear(command_frame(6, 2, order));
    CHECK(period() == 0.0f);
    /* Beyond the clamp. */
    wild = order;
    wild.amplitude = 204.0f;
    wild.time_to_live = 500.0f;
    hear(command_frame(6, 3, wild));
    float largest = 0.0f;
    for (uint32_t k = 0; k < 2500u; k++) {
        const float found = period();
        largest = (found > largest) ? found : largest;
    }
    CHECK(largest <= 1.00001f * IPMSM_PROBING_LIMIT * IPMSM_PROBING_LIMIT);
    CHECK(largest > 0.98f * IPMSM_PROBING_LIMIT * IPMSM_PROBING_LIMIT);
    /* The rolling count rolls; a status the controller has no room for tells nobody. */
    for (uint32_t k = 0; k < 60u; k++) {
        hear(frame);
        (void)period();
    }
    port.full = true;
    const struct ipmsm_status running = {.mode = IPMSM_RUNNING};
    CHECK(!ipmsm_drive_status(&drive, &running));
    port.full = false;
    status = told_status();
    CHECK(status.rejected_commands == (262u & 255u) && (status.faults & IPMSM_FAULT_COMMAND_REJECTED) != 0u);
}

static void the_angle_comes_and_goes(void)
{
    struct estimate_values v = {1.0f, 100.0f, 2.0f, 0, true, true, true, false};
    float theta = -1.0f;
    begin(false);
    for (uint32_t k = 0; k < 1100u; k++) {
        (void)period();
    }
    CHECK(!ipmsm_drive_angle_usable(&drive));
    CHECK(ipmsm_drive_angle(&drive, 0.0f, &theta) == IPMSM_ANGLE_MISSING && theta == -1.0f);
    CHECK(ipmsm_drive_speed(&drive) == 0.0f);
    v.sample = 1095;
    hear(estimate_frame(6, 0, v));
    ipmsm_drive_receive(&drive);
    CHECK(ipmsm_drive_angle_usable(&drive));
    CHECK(ipmsm_drive_angle(&drive, 0.0f, &theta) == IPMSM_ANGLE_USABLE);
    CHECK_NEAR(theta, 1.04f, 3e-4f); /* the latest sample is 1099: 4 periods of 100 us at 100 rad/s */
    CHECK(ipmsm_drive_angle(&drive, 1.5f, &theta) == IPMSM_ANGLE_USABLE);
    CHECK_NEAR(theta, 1.055f, 3e-4f);
    CHECK_NEAR(ipmsm_drive_speed(&drive), 100.0f, 0.3f);
    for (uint32_t k = 0; k < 96u; k++) {
        CHECK(ipmsm_drive_angle_usable(&drive));
        (void)period();
    }
    CHECK(ipmsm_drive_angle_usable(&drive)); /* 100 samples after the one it belongs to */
    (void)period();
    CHECK(!ipmsm_drive_angle_usable(&drive));
    v.sample = 1196;
    v.valid = false;
    hear(estimate_frame(6, 1, v));
    ipmsm_drive_receive(&drive);
    CHECK(ipmsm_drive_angle(&drive, 0.0f, &theta) == IPMSM_ANGLE_DOUBTFUL);
    CHECK_NEAR(theta, 1.0f, 3e-4f);
    CHECK(!ipmsm_drive_angle_usable(&drive)); /* to begin with */
    theta = -1.0f;
    v.locked = false;
    hear(estimate_frame(6, 2, v));
    ipmsm_drive_receive(&drive);
    CHECK(ipmsm_drive_angle(&drive, 0.0f, &theta) == IPMSM_ANGLE_INVALID && theta == -1.0f);
    CHECK(port.lock_faults == 0u && port.lock_depth == 0);
}

/* A flooded bus: one call takes in no more than it may, and what comes later is not lost. */
static void a_call_takes_in_so_many_frames(void)
{
    begin(false);
    struct ipmsm_frame other = command_frame(6, 0, order);
    other.id = 0x7FFu;
    for (uint32_t n = 0; n < 20u; n++) {
        hear(other);
    }
    hear(command_frame(6, 0, order));
    CHECK(period() == 0.0f);
    CHECK(port.taken == IPMSM_RECEIVE_AT_ONCE);
    CHECK(period() > 0.0f);
    CHECK(port.taken == 21u);
}

void test_drive(void)
{
    configurations();
    samples_go_out();
    blocks_go_out();
    obeys_and_says_so();
    forged_commands_are_counted_not_obeyed();
    the_angle_comes_and_goes();
    a_call_takes_in_so_many_frames();
}
