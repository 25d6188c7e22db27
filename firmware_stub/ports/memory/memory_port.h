/* A bus that is two arrays, and a clock that stands still until it is moved: for tests. */
#ifndef MEMORY_PORT_H
#define MEMORY_PORT_H

#include "ipmsm_can/can_hal.h"

#define MEMORY_PORT_FRAMES (32u)

struct memory_port {
    struct ipmsm_frame incoming[MEMORY_PORT_FRAMES]; /* ring; put frames in with memory_port_put */
    uint32_t put, taken;
    struct ipmsm_frame sent; /* the frame transmitted last */
    uint32_t sent_count;
    bool full; /* transmit finds no room */
    uint32_t clock_us;
    int32_t lock_depth;   /* 1 inside a critical section */
    uint32_t lock_faults; /* critical sections nested, left unbalanced, or left with the wrong state */
};

/* Zero the port and wire a hal to it. */
void memory_port_init(struct memory_port *port, struct ipmsm_hal *hal);

/* Lay a frame ready for receive; false if the ring is full. */
bool memory_port_put(struct memory_port *port, const struct ipmsm_frame *frame);

#endif
