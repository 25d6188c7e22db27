#define _GNU_SOURCE /* clock_gettime, struct ifreq and sockets under -std=c11 */
#include "socketcan_port.h"

#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "ipmsm_can.h"

static bool transmit(void *context, const struct ipmsm_frame *frame)
{
    struct socketcan_port *port = context;
    /* struct can_frame begins like struct canfd_frame: 8 bytes of header, then the payload. */
    struct canfd_frame out;
    memset(&out, 0, sizeof out);
    out.can_id = frame->id;
    out.len = frame->length;
    memcpy(out.data, frame->data, frame->length);
    size_t size = CAN_MTU;
    if ((frame->flags & IPMSM_FRAME_FD) != 0u) {
        out.flags = CANFD_BRS;
        size = CANFD_MTU;
    }
    if (send(port->socket, &out, size, MSG_DONTWAIT) == (ssize_t)size) {
        return true;
    }
    if (errno != EAGAIN && errno != ENOBUFS) {
        port->errors++;
    }
    return false;
}

static bool receive(void *context, struct ipmsm_frame *frame)
{
    struct socketcan_port *port = context;
    struct canfd_frame in;
    const ssize_t size = recv(port->socket, &in, sizeof in, MSG_DONTWAIT);
    if (size != (ssize_t)CAN_MTU && size != (ssize_t)CANFD_MTU) {
        if (size >= 0 || errno != EAGAIN) {
            port->errors++;
        }
        return false;
    }
    frame->id = in.can_id & CAN_EFF_MASK;
    frame->flags = (size == (ssize_t)CANFD_MTU) ? IPMSM_FRAME_FD : 0u;
    if ((in.can_id & CAN_EFF_FLAG) != 0u) {
        frame->flags |= IPMSM_FRAME_EXTENDED;
    }
    if ((in.can_id & CAN_RTR_FLAG) != 0u) {
        frame->flags |= IPMSM_FRAME_REMOTE;
    }
    const size_t most = (size == (ssize_t)CANFD_MTU) ? CANFD_MAX_DLEN : CAN_MAX_DLEN;
    frame->length = (uint8_t)((in.len < most) ? in.len : most);
    memcpy(frame->data, in.data, frame->length);
    return true;
}

static uint32_t now_us(void *context)
{
    (void)context;
    struct timespec now;
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint32_t)((uint64_t)now.tv_sec * 1000000u + (uint64_t)now.tv_nsec / 1000u);
}

static uint32_t lock(void *context)
{
    struct socketcan_port *port = context;
    (void)pthread_mutex_lock(&port->mutex);
    return 0;
}

static void unlock(void *context, uint32_t before)
{
    struct socketcan_port *port = context;
    (void)before;
    (void)pthread_mutex_unlock(&port->mutex);
}

static int set_up(int fd_socket, unsigned index, uint8_t node, bool fd)
{
    const struct can_filter wanted[2] = {
        {IPMSM_CAN_POSITION_ESTIMATE_FRAME_ID + node, CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG},
        {IPMSM_CAN_INJECTION_COMMAND_FRAME_ID + node, CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG},
    };
    const int on = 1;
    struct sockaddr_can address;
    memset(&address, 0, sizeof address);
    address.can_family = AF_CAN;
    address.can_ifindex = (int)index;
    if (setsockopt(fd_socket, SOL_CAN_RAW, CAN_RAW_FILTER, wanted, sizeof wanted) != 0
        || (fd && setsockopt(fd_socket, SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &on, sizeof on) != 0)
        || bind(fd_socket, (const struct sockaddr *)&address, sizeof address) != 0) {
        return errno;
    }
    return 0;
}

int socketcan_port_open(struct socketcan_port *port, struct ipmsm_hal *hal, const char *interface,
                        uint8_t node, bool fd)
{
    *port = (struct socketcan_port){.socket = -1, .fd = fd};
    const unsigned index = if_nametoindex(interface);
    if (index == 0u) {
        return errno;
    }
    port->socket = socket(PF_CAN, SOCK_RAW | SOCK_CLOEXEC, CAN_RAW);
    if (port->socket < 0) {
        return errno;
    }
    int failure = set_up(port->socket, index, node, fd);
    if (failure == 0) {
        failure = pthread_mutex_init(&port->mutex, NULL);
    }
    if (failure != 0) {
        (void)close(port->socket);
        port->socket = -1;
        return failure;
    }
    *hal = (struct ipmsm_hal){
        .context = port,
        .transmit = transmit,
        .receive = receive,
        .now_us = now_us,
        .lock = lock,
        .unlock = unlock,
    };
    return 0;
}

void socketcan_port_close(struct socketcan_port *port)
{
    if (port->socket >= 0) {
        (void)close(port->socket);
        (void)pthread_mutex_destroy(&port->mutex);
        port->socket = -1;
    }
}
