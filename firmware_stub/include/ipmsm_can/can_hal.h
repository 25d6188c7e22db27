/* What the library needs of a microcontroller: four functions (the critical section has two ends).
 *
 * Frames are CAN frames as they come and go; the library keeps no pointer to one after a call.
 */
#ifndef IPMSM_CAN_HAL_H
#define IPMSM_CAN_HAL_H

#include <stdbool.h>
#include <stdint.h>

#define IPMSM_FRAME_FD (1u)       /* CAN FD with bit rate switch; classical without */
#define IPMSM_FRAME_EXTENDED (2u) /* 29-bit identifier: never one of ours */
#define IPMSM_FRAME_REMOTE (4u)

#define IPMSM_FRAME_BYTES (64u)

struct ipmsm_frame {
    uint32_t id;
    uint8_t length; /* payload in bytes, 0..8 or, with IPMSM_FRAME_FD, 0..64 */
    uint8_t flags;  /* IPMSM_FRAME_... */
    uint8_t data[IPMSM_FRAME_BYTES];
};

struct ipmsm_hal {
    void *context; /* handed to every function below; NULL if it needs none */

    /* Hand a frame to the controller without waiting; false if it has no room.  Frames of one drive must
     * leave in the order given (transmit FIFO, not priority queue): DriveTiming names the sample before it. */
    bool (*transmit)(void *context, const struct ipmsm_frame *frame);

    /* The oldest frame received; false if there is none. */
    bool (*receive)(void *context, struct ipmsm_frame *frame);

    /* Microseconds of a clock that never jumps; wraps at 2^32. */
    uint32_t (*now_us)(void *context);

    /* Keep everything else that calls the library for this drive out (mask interrupts, take a mutex) and
     * tell how it was; put it back.  Not nested. */
    uint32_t (*lock)(void *context);
    void (*unlock)(void *context, uint32_t before);
};

#endif
