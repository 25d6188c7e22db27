/* Linux SocketCAN: one raw socket per drive that hears only what is meant for its node. */
#ifndef SOCKETCAN_PORT_H
#define SOCKETCAN_PORT_H

#include <pthread.h>

#include "ipmsm_can/can_hal.h"

struct socketcan_port {
    int socket;
    bool fd;
    pthread_mutex_t mutex;
    uint32_t errors; /* calls the kernel refused for another reason than a full or an empty queue */
};

/* Open `interface` (such as vcan0) for node 0..15 and wire a hal to it; fd: also send CAN FD frames.
 * 0, or an errno value; then nothing is left open. */
int socketcan_port_open(struct socketcan_port *port, struct ipmsm_hal *hal, const char *interface,
                        uint8_t node, bool fd);

void socketcan_port_close(struct socketcan_port *port);

#endif
