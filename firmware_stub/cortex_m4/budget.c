/* Instructions, RAM and stack of the calls in the control interrupt, under QEMU with -icount shift=0: there
 * an instruction takes 1 ns, and SysTick, at 25 MHz, counts one for every 40.  Each figure is the mean of
 * CALLS calls of the same kind; every kind takes the same path each time.  The port does nothing. */
#include <stdio.h>

#include "check.h"
#include "ipmsm_can/drive.h"

#define SYSTICK_CONTROL (*(volatile uint32_t *)0xE000E010)
#define SYSTICK_RELOAD (*(volatile uint32_t *)0xE000E014)
#define SYSTICK_VALUE (*(volatile uint32_t *)0xE000E018)
#define INSTRUCTIONS_A_TICK (40u)
#define CALLS (4000u)
#define STACK_WORDS (512u)
#define PAINT (0xA5A5A5A5u)

#define MOST_INSTRUCTIONS_A_SAMPLE (600u)
#define MOST_RAM (512u)

static struct ipmsm_frame waiting;
static bool is_waiting;
static uint32_t microseconds;

static bool transmit(void *context, const struct ipmsm_frame *frame)
{
    (void)context;
    (void)frame;
    return true;
}
static bool receive(void *context, struct ipmsm_frame *frame)
{
    (void)context;
    if (!is_waiting) {
        return false;
    }
    is_waiting = false;
    *frame = waiting;
    return true;
}
static uint32_t now_us(void *context)
{
    (void)context;
    return microseconds;
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
static const struct ipmsm_hal hal = {NULL, transmit, receive, now_us, lock, unlock};

static struct ipmsm_drive drive;
static const struct ipmsm_sample sample = {1.234f, -2.345f, 100.1f, -50.2f};
static volatile float sink;

static void nothing(void) { __asm volatile(""); }
static void send_sample(void) { (void)ipmsm_drive_sample(&drive, &sample); }
static void take_in(void) { ipmsm_drive_receive(&drive); }
static void probe(void)
{
    float v_alpha;
    float v_beta;
    ipmsm_drive_probe(&drive, &v_alpha, &v_beta);
    sink = v_alpha + v_beta;
}
static void angle(void)
{
    float theta_e = 0.0f;
    (void)ipmsm_drive_angle(&drive, 1.5f, &theta_e);
    sink = theta_e;
}

static uint32_t ticks(void (*call)(void))
{
    const uint32_t before = SYSTICK_VALUE;
    call();
    return (before - SYSTICK_VALUE) & 0xFFFFFFu;
}

static uint32_t instructions(uint32_t total, uint32_t empty)
{
    return (total - empty) * INSTRUCTIONS_A_TICK / CALLS;
}

/* Deepest word of the stack below this function that call overwrites. */
static uint32_t __attribute__((noinline)) stack_of(void (*call)(void))
{
    volatile uint32_t *top;
    __asm volatile("mov %0, sp" : "=r"(top));
    for (uint32_t n = 1; n <= STACK_WORDS; n++) {
        top[-(int32_t)n] = PAINT;
    }
    call();
    uint32_t deepest = 0;
    for (uint32_t n = 1; n <= STACK_WORDS; n++) {
        if (top[-(int32_t)n] != PAINT) {
            deepest = n;
        }
    }
    return 4u * deepest;
}

static uint32_t empty_calls(void)
{
    uint32_t total = 0;
    for (uint32_t n = 0; n < CALLS; n++) {
        total += ticks(nothing);
    }
    return total;
}

static void begin(bool fd)
{
    struct ipmsm_config config = ipmsm_config_default();
    config.fd = fd;
    CHECK(ipmsm_drive_init(&drive, &config, &hal));
    drive.receiver.warm_up = 0;
}

static uint32_t worst_sample(bool fd, uint32_t empty)
{
    uint32_t total[7] = {0};
    const uint32_t kinds = fd ? 7u : 1u;
    begin(fd);
    for (uint32_t n = 0; n < CALLS; n++) {
        for (uint32_t j = 0; j < kinds; j++) {
            total[j] += ticks(send_sample);
        }
    }
    uint32_t worst = 0;
    for (uint32_t j = 0; j < kinds; j++) {
        const uint32_t found = instructions(total[j], empty);
        worst = (found > worst) ? found : worst;
    }
    return worst;
}

static void receiving(uint32_t empty)
{
    const struct command_values order = {2, 5.0f, 400.0f, 1.0f, 200.0f};
    struct estimate_values estimate = {1.0f, 200.0f, 2.0f, 0, true, true, true, true};
    uint32_t total[5] = {0};
    begin(false);
    for (uint32_t n = 0; n < CALLS; n++) {
        send_sample();
        waiting = command_frame(0, (uint8_t)(n & 15u), order);
        is_waiting = true;
        total[0] += ticks(take_in);
        estimate.sample = n;
        waiting = estimate_frame(0, (uint8_t)(n & 15u), estimate);
        is_waiting = true;
        total[1] += ticks(take_in);
        total[2] += ticks(take_in);
        total[3] += ticks(probe);
        total[4] += ticks(angle);
        CHECK(ipmsm_drive_angle_usable(&drive) && drive.rejected == 0u);
    }
    static const char *const names[5] = {"receive, with a command", "receive, with an estimate",
                                         "receive, nothing there", "probe, pulsating", "angle"};
    for (uint32_t j = 0; j < 5u; j++) {
        printf("%-32s %5lu instructions\n", names[j], (unsigned long)instructions(total[j], empty));
    }
}

static void stacks(void)
{
    const struct command_values order = {2, 5.0f, 400.0f, 1.0f, 200.0f};
    begin(true);
    uint32_t worst = stack_of(send_sample);
    waiting = command_frame(0, 0, order);
    is_waiting = true;
    void (*const calls[])(void) = {take_in, probe, angle};
    for (uint32_t j = 0; j < 3u; j++) {
        const uint32_t found = stack_of(calls[j]);
        worst = (found > worst) ? found : worst;
    }
    printf("%-32s %5lu bytes\n", "stack, deepest call", (unsigned long)worst);
}

void budget(void)
{
    SYSTICK_RELOAD = 0xFFFFFFu;
    SYSTICK_VALUE = 0;
    SYSTICK_CONTROL = 5;
    const uint32_t empty = empty_calls();
    const uint32_t single = worst_sample(false, empty);
    const uint32_t block = worst_sample(true, empty);
    printf("%-32s %5lu instructions\n", "sample, classical", (unsigned long)single);
    printf("%-32s %5lu instructions\n", "sample, FD, costliest of seven", (unsigned long)block);
    receiving(empty);
    stacks();
    printf("%-32s %5lu bytes\n", "RAM of a drive", (unsigned long)sizeof drive);
    CHECK(single > 0u && single < MOST_INSTRUCTIONS_A_SAMPLE);
    CHECK(block > 0u && block < MOST_INSTRUCTIONS_A_SAMPLE);
    CHECK(sizeof drive < MOST_RAM);
}
