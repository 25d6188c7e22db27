/* A drive on SocketCAN that runs on the C library, with a simulated motor behind it: see --help. */
#define _GNU_SOURCE /* clock_nanosleep, sigaction under -std=c11 */
#include <errno.h>
#include <math.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <time.h>

#include "ipmsm_can/drive.h"
#include "machine.h"
#include "options.h"
#include "report.h"
#include "socketcan_port.h"

#define TWO_PI (6.283185307179586)
#define FALLEN_BEHIND_S (0.5) /* beyond it lost time is given up instead of being caught up with a flood of frames */

struct stub {
    struct options options;
    struct socketcan_port port;
    struct ipmsm_hal bus; /* the port's */
    struct ipmsm_hal hal; /* what the library gets: the port's, with two system calls a tick instead of a period */
    struct ipmsm_drive drive;
    struct machine machine;
    struct facts facts;
    bool heard_all;    /* nothing more waits in this tick */
    uint32_t accepted; /* commands that passed the check */
    uint32_t rejected;
    uint8_t waveform;
    enum ipmsm_angle_verdict verdict;
};

static volatile sig_atomic_t told_to_end;

static void on_signal(int number)
{
    (void)number;
    told_to_end = 1;
}

static double monotonic(void)
{
    struct timespec now;
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* ---- between library and port ------------------------------------------------------------------------ */

static bool transmit(void *context, const struct ipmsm_frame *frame)
{
    struct stub *stub = context;
    const bool taken = stub->bus.transmit(stub->bus.context, frame);
    stub->facts.sent += taken ? 1u : 0u;
    return taken;
}

/* What the library made of the frames so far: it asks for the next one when it is done with the last. */
static void note_command(struct stub *stub)
{
    const struct ipmsm_drive *drive = &stub->drive;
    const uint32_t *counts = drive->receiver.commands.counts;
    const uint32_t accepted = counts[IPMSM_E2E_OK] + counts[IPMSM_E2E_SOME_LOST];
    if (accepted != stub->accepted && drive->rejected == stub->rejected) {
        stub->facts.command_sample = stub->facts.samples;
        stub->facts.command_us = stub->facts.now_us;
        if (drive->probing.asked_amplitude > fminf(drive->probing.limit, IPMSM_PROBING_LIMIT)) {
            stub->facts.beyond_limit++;
        }
    }
    stub->accepted = accepted;
    stub->rejected = drive->rejected;
}

static bool receive(void *context, struct ipmsm_frame *frame)
{
    struct stub *stub = context;
    note_command(stub);
    if (!stub->heard_all) {
        stub->heard_all = !stub->bus.receive(stub->bus.context, frame);
        return !stub->heard_all;
    }
    return false;
}

static uint32_t now_us(void *context)
{
    const struct stub *stub = context;
    return stub->facts.now_us;
}

static uint32_t lock(void *context)
{
    (void)context; /* one thread */
    return 0;
}

static void unlock(void *context, uint32_t before)
{
    (void)context;
    (void)before;
}

/* ---- the drive --------------------------------------------------------------------------------------- */

static bool start(struct stub *stub)
{
    const struct options *options = &stub->options;
    const double omega_e = options->rpm * TWO_PI / 60.0 * machine_m2.pole_pairs;
    struct ipmsm_config config = ipmsm_config_default();
    config.node = options->node;
    config.fd = options->fd;
    config.sample_rate = (float)options->rate;
    config.probing_limit = (float)options->limit;
    stub->hal = (struct ipmsm_hal){
        .context = stub,
        .transmit = transmit,
        .receive = receive,
        .now_us = now_us,
        .lock = lock,
        .unlock = unlock,
    };
    machine_init(&stub->machine, &machine_m2, options->rate, omega_e, 1.0, options->load, options->noise);
    stub->verdict = IPMSM_ANGLE_MISSING;
    return ipmsm_drive_init(&stub->drive, &config, &stub->hal);
}

static void judge_angle(struct stub *stub)
{
    float theta_e = 0.0f;
    const enum ipmsm_angle_verdict verdict = ipmsm_drive_angle(&stub->drive, 0.0f, &theta_e);
    if (verdict != stub->verdict) {
        stub->verdict = verdict;
        report_angle(&stub->facts, verdict);
    }
    if (verdict == IPMSM_ANGLE_USABLE || verdict == IPMSM_ANGLE_DOUBTFUL) {
        const double error = fabs(remainder((double)theta_e - stub->machine.theta_e, TWO_PI)) * 360.0 / TWO_PI;
        stub->facts.usable++;
        stub->facts.error_deg = fmax(stub->facts.error_deg, error);
    }
}

static void background(struct stub *stub)
{
    const uint64_t rate = (uint64_t)stub->options.rate;
    const uint64_t k = stub->facts.samples;
    if (k % (rate / 50u) == 0u) {
        (void)ipmsm_drive_timing(&stub->drive);
    }
    if (k % (rate / 10u) == 0u) {
        const struct ipmsm_status status = {.mode = IPMSM_RUNNING, .encoder_available = true, .v_dc = 540.0f,
                                            .temperature = 40.0f};
        (void)ipmsm_drive_status(&stub->drive, &status);
    }
    if (k % (rate / 100u) == 0u) {
        (void)ipmsm_drive_reference(&stub->drive, (float)stub->machine.theta_e, (float)stub->machine.omega_e,
                                    (uint32_t)k);
    }
    if (k % rate == rate - 1u) {
        report_counts(&stub->facts, &stub->drive, "counts");
        stub->facts.error_deg = 0.0;
    }
}

/* The current-control interrupt, and what the background would do after it. */
static void control_period(struct stub *stub)
{
    struct machine *machine = &stub->machine;
    float v_alpha;
    float v_beta;
    machine_sample(machine);
    const struct ipmsm_sample sample = {
        .i_alpha = (float)machine->measured[0],
        .i_beta = (float)machine->measured[1],
        .v_alpha = (float)machine->v_ended[0],
        .v_beta = (float)machine->v_ended[1],
    };
    (void)ipmsm_drive_sample(&stub->drive, &sample);
    ipmsm_drive_receive(&stub->drive);
    note_command(stub);
    ipmsm_drive_probe(&stub->drive, &v_alpha, &v_beta);
    stub->facts.probe_peak = fmax(stub->facts.probe_peak, hypot((double)v_alpha, (double)v_beta));
    if (stub->drive.probing.waveform != stub->waveform) {
        stub->waveform = stub->drive.probing.waveform;
        report_probing(&stub->facts, stub->waveform);
    }
    judge_angle(stub);
    background(stub);
    machine_advance(machine, (double)v_alpha, (double)v_beta);
    stub->facts.samples++;
}

static void sleep_until(double at)
{
    const time_t seconds = (time_t)at;
    const struct timespec then = {.tv_sec = seconds, .tv_nsec = (long)(1e9 * (at - (double)seconds))};
    (void)clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &then, NULL);
}

static void run(struct stub *stub)
{
    const struct options *options = &stub->options;
    double begin = monotonic();
    uint64_t tick = 0;
    stub->facts.now_s = begin;
    report_start(&stub->facts, options->node, options->rate, options->fd);
    while (told_to_end == 0 && (options->duration <= 0.0 || (double)tick * options->tick < options->duration)) {
        tick++;
        const double due = begin + (double)tick * options->tick;
        sleep_until(due);
        const double now = monotonic();
        if (now - due > FALLEN_BEHIND_S) {
            begin += now - due;
            stub->facts.slips++;
        }
        stub->facts.now_s = now;
        stub->facts.now_us = stub->bus.now_us(stub->bus.context);
        stub->facts.errors = stub->port.errors;
        stub->heard_all = false;
        const uint64_t target = (uint64_t)((double)tick * options->tick * options->rate + 1e-6);
        while (stub->facts.samples < target) {
            control_period(stub);
        }
    }
}

int main(int argc, char **argv)
{
    static struct stub stub;
    const int leave = options_parse(&stub.options, argc, argv);
    if (leave >= 0) {
        return leave;
    }
    const struct sigaction ending = {.sa_handler = on_signal};
    (void)sigaction(SIGINT, &ending, NULL);
    (void)sigaction(SIGTERM, &ending, NULL);
    const int failure = socketcan_port_open(&stub.port, &stub.bus, stub.options.interface, stub.options.node,
                                            stub.options.fd);
    if (failure != 0) {
        fprintf(stderr, "drive_stub: the CAN interface %s cannot be opened: %s\n", stub.options.interface,
                strerror(failure));
        return 1;
    }
    if (!start(&stub)) {
        fprintf(stderr, "drive_stub: the library refuses these settings\n");
        return 2;
    }
    run(&stub);
    report_counts(&stub.facts, &stub.drive, "end");
    socketcan_port_close(&stub.port);
    return (stub.port.errors == 0u) ? 0 : 1;
}
