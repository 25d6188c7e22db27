/* The test harness: nothing but printf, so that it runs on a bare microcontroller with semihosting too. */
#ifndef CHECK_H
#define CHECK_H

#include <stdbool.h>
#include <stdint.h>

#include "ipmsm_can/can_hal.h"

extern unsigned check_count;
extern unsigned check_failures;

void check_that(bool holds, const char *what, const char *file, int line);
void check_near(float found, float expected, float tolerance, const char *what, const char *file, int line);

#define CHECK(holds) check_that((holds), #holds, __FILE__, __LINE__)
#define CHECK_NEAR(found, expected, tolerance) \
    check_near((found), (expected), (tolerance), #found, __FILE__, __LINE__)

/* Frames as a companion would send them, with counter and CRC. */
struct estimate_values {
    float theta_e, omega_e, sigma_theta;
    uint32_t sample;
    bool valid, locked, polarity_known, injecting;
};
struct command_values {
    uint8_t waveform;
    float amplitude, frequency, axis_angle, time_to_live;
};
struct ipmsm_frame estimate_frame(uint8_t node, uint8_t counter, struct estimate_values values);
struct ipmsm_frame command_frame(uint8_t node, uint8_t counter, struct command_values values);

/* One of each file. */
void test_vectors(void);
void test_angle(void);
void test_e2e(void);
void test_sender(void);
void test_receiver(void);
void test_probing(void);
void test_drive(void);

/* On the microcontroller, with WITH_BUDGET defined: what the library costs there. */
void budget(void);

#endif
