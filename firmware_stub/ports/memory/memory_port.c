#include "memory_port.h"

#define STATE_BEFORE (0x5Au) /* what lock hands out and unlock must get back */

static bool transmit(void *context, const struct ipmsm_frame *frame)
{
    struct memory_port *port = context;
    if (port->full) {
        return false;
    }
    port->sent = *frame;
    port->sent_count++;
    return true;
}

static bool receive(void *context, struct ipmsm_frame *frame)
{
    struct memory_port *port = context;
    if (port->taken == port->put) {
        return false;
    }
    *frame = port->incoming[port->taken++ % MEMORY_PORT_FRAMES];
    return true;
}

static uint32_t now_us(void *context)
{
    const struct memory_port *port = context;
    return port->clock_us;
}

static uint32_t lock(void *context)
{
    struct memory_port *port = context;
    if (++port->lock_depth != 1) {
        port->lock_faults++;
    }
    return STATE_BEFORE;
}

static void unlock(void *context, uint32_t before)
{
    struct memory_port *port = context;
    if (--port->lock_depth != 0 || before != STATE_BEFORE) {
        port->lock_faults++;
    }
}

void memory_port_init(struct memory_port *port, struct ipmsm_hal *hal)
{
    *port = (struct memory_port){0};
    *hal = (struct ipmsm_hal){
        .context = port,
        .transmit = transmit,
        .receive = receive,
        .now_us = now_us,
        .lock = lock,
        .unlock = unlock,
    };
}

bool memory_port_put(struct memory_port *port, const struct ipmsm_frame *frame)
{
    if (port->put - port->taken == MEMORY_PORT_FRAMES) {
        return false;
    }
    port->incoming[port->put++ % MEMORY_PORT_FRAMES] = *frame;
    return true;
}
