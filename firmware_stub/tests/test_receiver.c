#include "check.h"
#include "ipmsm_can/receiver.h"

#define NODE (3u)

static struct ipmsm_receiver receiver;
static struct ipmsm_command command;

static const struct estimate_values good = {1.0f, 200.0f, 2.0f, 5000u, true, true, true, false};

static enum ipmsm_received take(struct ipmsm_frame frame, uint32_t sample, uint32_t now_us)
{
    return ipmsm_receiver_take(&receiver, &frame, sample, now_us, &command);
}

/* 10 kHz, angles usable up to 5 deg, for 10 ms: 100 samples. */
static void fresh(void)
{
    CHECK(ipmsm_receiver_init(&receiver, NODE, 10000.0f, 5.0f, 10000u));
    for (uint32_t k = 0; k < 1024u; k++) {
        ipmsm_receiver_expire(&receiver, k, 0);
    }
}

static void refuses_what_it_cannot_serve(void)
{
    CHECK(!ipmsm_receiver_init(&receiver, 16, 10000.0f, 5.0f, 10000u));
    CHECK(!ipmsm_receiver_init(&receiver, 0, 10000.0f, 5.0f, 99u));
    CHECK(ipmsm_receiver_init(&receiver, 15, 10000.0f, 5.0f, 102300u));
    CHECK(receiver.max_age == 1023u);
    CHECK(!ipmsm_receiver_init(&receiver, 0, 10000.0f, 5.0f, 102400u));
}

static void takes_an_estimate(void)
{
    fresh();
    CHECK(ipmsm_receiver_verdict(&receiver, 5000, 0) == IPMSM_ANGLE_MISSING);
    CHECK(take(estimate_frame(NODE, 9, good), 5003, 1000) == IPMSM_RECEIVED_ESTIMATE);
    CHECK(receiver.estimate.sample == 5000u);
    CHECK(ipmsm_receiver_verdict(&receiver, 5003, 1000) == IPMSM_ANGLE_USABLE);
    /* 3 samples and 1.5 periods of 100 us at 200 rad/s */
    CHECK_NEAR(ipmsm_receiver_theta(&receiver, 5003, 0.0f), 1.06f, 3e-4f);
    CHECK_NEAR(ipmsm_receiver_theta(&receiver, 5003, 1.5f) - ipmsm_receiver_theta(&receiver, 5003, 0.0f), 0.03f,
               1e-6f);
    CHECK(receiver.estimates.counts[IPMSM_E2E_OK] == 1u);
}

static void grows_old_by_samples(void)
{
    fresh();
    CHECK(take(estimate_frame(NODE, 0, good), 5040, 0) == IPMSM_RECEIVED_ESTIMATE);
    CHECK(ipmsm_receiver_verdict(&receiver, 5100, 0) == IPMSM_ANGLE_USABLE);
    CHECK(ipmsm_receiver_verdict(&receiver, 5101, 0) == IPMSM_ANGLE_MISSING);
    ipmsm_receiver_expire(&receiver, 5100, 0);
    CHECK(receiver.estimate.held);
    ipmsm_receiver_expire(&receiver, 5101, 0);
    CHECK(!receiver.estimate.held);
    /* Once forgotten it does not come back when a counter comes round. */
    CHECK(ipmsm_receiver_verdict(&receiver, 5050, 0) == IPMSM_ANGLE_MISSING);
}

static void grows_old_by_the_clock(void)
{
    fresh();
    CHECK(take(estimate_frame(NODE, 0, good), 5000, 0xFFFFFFF0u) == IPMSM_RECEIVED_ESTIMATE);
    CHECK(ipmsm_receiver_verdict(&receiver, 5000, 0xFFFFFFF8u) == IPMSM_ANGLE_USABLE);
    CHECK(ipmsm_receiver_verdict(&receiver, 5000, 0xFFFFFFF0u + 10000u) == IPMSM_ANGLE_USABLE);
    CHECK(ipmsm_receiver_verdict(&receiver, 5000, 0xFFFFFFF0u + 10001u) == IPMSM_ANGLE_MISSING);
    ipmsm_receiver_expire(&receiver, 5000, 0xFFFFFFF0u + 10001u);
    CHECK(ipmsm_receiver_verdict(&receiver, 5000, 0xFFFFFFF0u) == IPMSM_ANGLE_MISSING);
}

static void an_estimate_that_comes_late_is_dropped(void)
{
    fresh();
    CHECK(take(estimate_frame(NODE, 0, good), 5101, 0) == IPMSM_RECEIVED_BAD_ESTIMATE);
    CHECK(receiver.late == 1u && !receiver.estimate.held);
    CHECK(take(estimate_frame(NODE, 1, good), 5100, 0) == IPMSM_RECEIVED_ESTIMATE);
    CHECK(ipmsm_receiver_verdict(&receiver, 5100, 0) == IPMSM_ANGLE_USABLE);
    /* A late one leaves the one that is held alone, and one from the future is a late one. */
    CHECK(take(estimate_frame(NODE, 2, good), 4999, 0) == IPMSM_RECEIVED_BAD_ESTIMATE);
    CHECK(receiver.estimate.sample == 5000u && receiver.late == 2u);
    CHECK(ipmsm_receiver_verdict(&receiver, 5100, 0) == IPMSM_ANGLE_USABLE);
}

static void takes_nothing_right_after_the_start(void)
{
    CHECK(ipmsm_receiver_init(&receiver, NODE, 10000.0f, 5.0f, 10000u));
    struct estimate_values v = good;
    for (uint32_t k = 0; k < 1024u; k++) {
        v.sample = k;
        CHECK(take(estimate_frame(NODE, (uint8_t)(k & 15u), v), k, 0) == IPMSM_RECEIVED_BAD_ESTIMATE);
        ipmsm_receiver_expire(&receiver, k, 0);
    }
    CHECK(receiver.late == 1024u);
    v.sample = 1024;
    CHECK(take(estimate_frame(NODE, 0, v), 1024, 0) == IPMSM_RECEIVED_ESTIMATE);
    CHECK(ipmsm_receiver_verdict(&receiver, 1024, 0) == IPMSM_ANGLE_USABLE);
}

static enum ipmsm_angle_verdict verdict_on(struct estimate_values values)
{
    fresh();
    CHECK(take(estimate_frame(NODE, 0, values), 5000, 0) == IPMSM_RECEIVED_ESTIMATE);
    return ipmsm_receiver_verdict(&receiver, 5000, 0);
}

static void says_whether_the_angle_may_be_used(void)
{
    struct estimate_values v = good;
    CHECK(verdict_on(v) == IPMSM_ANGLE_USABLE);
    v.injecting = true;
    CHECK(verdict_on(v) == IPMSM_ANGLE_USABLE);
    v.sigma_theta = 5.0f;
    CHECK(verdict_on(v) == IPMSM_ANGLE_USABLE);
    v.sigma_theta = 5.5f;
    CHECK(verdict_on(v) == IPMSM_ANGLE_UNCERTAIN);
    /* Not valid but within the limit: good enough to go on with, if everything else is. */
    v = good;
    v.valid = false;
    CHECK(verdict_on(v) == IPMSM_ANGLE_DOUBTFUL);
    v.sigma_theta = 5.0f;
    CHECK(verdict_on(v) == IPMSM_ANGLE_DOUBTFUL);
    v.sigma_theta = 5.5f;
    CHECK(verdict_on(v) == IPMSM_ANGLE_INVALID);
    v.sigma_theta = 127.5f;
    CHECK(verdict_on(v) == IPMSM_ANGLE_INVALID);
    v = good;
    v.valid = false;
    v.locked = false;
    CHECK(verdict_on(v) == IPMSM_ANGLE_INVALID);
    v.locked = true;
    v.polarity_known = false;
    CHECK(verdict_on(v) == IPMSM_ANGLE_INVALID);
    v = good;
    v.locked = false;
    CHECK(verdict_on(v) == IPMSM_ANGLE_INVALID);
    v = good;
    v.polarity_known = false;
    CHECK(verdict_on(v) == IPMSM_ANGLE_INVALID);
    /* Unknown is not 127.5 deg, however wide the limit. */
    v = good;
    v.sigma_theta = 127.5f;
    CHECK(verdict_on(v) == IPMSM_ANGLE_UNCERTAIN);
    receiver.sigma_limit = 1000.0f;
    CHECK(ipmsm_receiver_verdict(&receiver, 5000, 0) == IPMSM_ANGLE_UNCERTAIN);
}

static void a_damaged_estimate_changes_nothing(void)
{
    fresh();
    CHECK(take(estimate_frame(NODE, 0, good), 5000, 0) == IPMSM_RECEIVED_ESTIMATE);
    struct estimate_values other = good;
    other.theta_e = 3.0f;
    other.sample = 5010;
    for (uint32_t bit = 0; bit < 64u; bit++) {
        struct ipmsm_frame frame = estimate_frame(NODE, 1, other);
        frame.data[bit / 8u] = (uint8_t)(frame.data[bit / 8u] ^ (1u << (bit % 8u)));
        CHECK(take(frame, 5010, 0) == IPMSM_RECEIVED_BAD_ESTIMATE);
    }
    CHECK(receiver.estimates.counts[IPMSM_E2E_WRONG_CRC] == 64u);
    CHECK_NEAR(receiver.estimate.theta_e, 1.0f, 1e-3f);
    CHECK(take(estimate_frame(NODE, 0, other), 5010, 0) == IPMSM_RECEIVED_BAD_ESTIMATE);
    CHECK(receiver.estimates.counts[IPMSM_E2E_REPEATED] == 1u);
    CHECK(take(estimate_frame(NODE, 15, other), 5010, 0) == IPMSM_RECEIVED_BAD_ESTIMATE);
    CHECK(receiver.estimates.counts[IPMSM_E2E_WRONG_SEQUENCE] == 1u);
    CHECK_NEAR(receiver.estimate.theta_e, 1.0f, 1e-3f);
    CHECK(take(estimate_frame(NODE, 6, other), 5010, 0) == IPMSM_RECEIVED_ESTIMATE); /* 7 on from 15 */
    CHECK(receiver.estimates.counts[IPMSM_E2E_SOME_LOST] == 1u && receiver.estimates.sequence.lost == 6u);
    CHECK_NEAR(receiver.estimate.theta_e, 3.0f, 1e-3f);
}

static void takes_a_command(void)
{
    fresh();
    const struct command_values values = {2, 12.5f, 400.0f, 1.5f, 120.0f};
    CHECK(take(command_frame(NODE, 4, values), 0, 0) == IPMSM_RECEIVED_COMMAND);
    CHECK(command.waveform == 2u);
    CHECK_NEAR(command.amplitude, 12.5f, 1e-5f);
    CHECK_NEAR(command.frequency, 400.0f, 0.0f);
    CHECK_NEAR(command.axis_angle, 1.5f, 8e-4f);
    CHECK_NEAR(command.time_to_live, 120.0f, 0.0f);
    CHECK(take(command_frame(NODE, 4, values), 0, 0) == IPMSM_RECEIVED_BAD_COMMAND);
    CHECK(receiver.commands.counts[IPMSM_E2E_REPEATED] == 1u);
    struct ipmsm_frame frame = command_frame(NODE, 5, values);
    frame.data[0] ^= 1u;
    CHECK(take(frame, 0, 0) == IPMSM_RECEIVED_BAD_COMMAND);
    CHECK(receiver.commands.counts[IPMSM_E2E_WRONG_CRC] == 1u);
    /* The streams are apart. */
    CHECK(receiver.estimates.counts[IPMSM_E2E_OK] == 0u);
}

static void what_is_not_for_it_is_nothing(void)
{
    fresh();
    const struct command_values values = {1, 5.0f, 400.0f, 0.0f, 100.0f};
    struct ipmsm_frame frame = command_frame(NODE, 0, values);
    frame.length = 7;
    CHECK(take(frame, 0, 0) == IPMSM_RECEIVED_NOTHING);
    frame.length = 12;
    CHECK(take(frame, 0, 0) == IPMSM_RECEIVED_NOTHING);
    frame.length = 8;
    frame.flags = IPMSM_FRAME_EXTENDED;
    CHECK(take(frame, 0, 0) == IPMSM_RECEIVED_NOTHING);
    frame.flags = IPMSM_FRAME_REMOTE;
    CHECK(take(frame, 0, 0) == IPMSM_RECEIVED_NOTHING);
    frame.flags = 0;
    frame.id++;
    CHECK(take(frame, 0, 0) == IPMSM_RECEIVED_NOTHING);
    frame.id = 0x200u + NODE; /* a command under the identifier of an estimate */
    CHECK(take(frame, 0, 0) == IPMSM_RECEIVED_BAD_ESTIMATE);
    frame = command_frame(NODE + 1u, 0, values); /* another node's, under mine */
    frame.id--;
    CHECK(take(frame, 0, 0) == IPMSM_RECEIVED_BAD_COMMAND);
    CHECK(receiver.commands.counts[IPMSM_E2E_WRONG_CRC] == 1u);
}

void test_receiver(void)
{
    refuses_what_it_cannot_serve();
    takes_an_estimate();
    grows_old_by_samples();
    grows_old_by_the_clock();
    an_estimate_that_comes_late_is_dropped();
    takes_nothing_right_after_the_start();
    says_whether_the_angle_may_be_used();
    a_damaged_estimate_changes_nothing();
    takes_a_command();
    what_is_not_for_it_is_nothing();
}
