/* Refers to every function of drive.h and to nothing else: what the linker keeps is the library's flash. */
#include "ipmsm_can/drive.h"

void reset_handler(void);

static void (*const used[])(void) = {
    (void (*)(void))ipmsm_config_default,  (void (*)(void))ipmsm_drive_init,
    (void (*)(void))ipmsm_drive_sample,    (void (*)(void))ipmsm_drive_receive,
    (void (*)(void))ipmsm_drive_probe,     (void (*)(void))ipmsm_drive_stop_probing,
    (void (*)(void))ipmsm_drive_angle,     (void (*)(void))ipmsm_drive_angle_usable,
    (void (*)(void))ipmsm_drive_timing,    (void (*)(void))ipmsm_drive_status,
    (void (*)(void))ipmsm_drive_reference,
};

void reset_handler(void)
{
    for (;;) {
        __asm volatile("" ::"r"(used));
    }
}
