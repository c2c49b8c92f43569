#include "est_port.h"

#include <errno.h>
#include <linux/sockios.h>
#include <poll.h>
#include <stddef.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <time.h>

#include "drive_e2e.h"
#include "est_cycle.h"
#include "rt_clock.h"

enum {
    SEND_BUFFER_BYTES = 4 << 20,
    QUEUED_FRAME_BYTES = 800 /* what a queued frame costs the kernel: 212992 bytes hold 277 */
};

static const int64_t NS_PER_S = 1000000000;
static const int64_t FLUSH_LOOK_NS = 1000000;

_Static_assert((int)CAN_PORT_SKIP_MAX == (int)EST_IO_SKIP_COST, "a skip costs what the cycle takes it to cost");

static void begin(void *ctx, int64_t now_ns) {
    est_port *self = ctx;
    const rt_clock clock = rt_clock_system();
    self->now_ns = now_ns;
    self->offset_ns = rt_clock_realtime_ns() - clock.now_ns(clock.ctx); /* side by side: now_ns may be long past */
}

static est_io_status status_of(can_port_status_t status) {
    switch (status) {
    case CAN_PORT_OK:
        return EST_IO_OK;
    case CAN_PORT_EMPTY:
        return EST_IO_EMPTY;
    case CAN_PORT_FULL:
    case CAN_PORT_REFUSED: /* no frame of ours is, but a lost frame is what it would be */
        return EST_IO_FULL;
    case CAN_PORT_SKIPPED:
        return EST_IO_SKIPPED;
    case CAN_PORT_GONE:
        break;
    }
    return EST_IO_GONE;
}

static est_io_status receive(void *ctx, struct canfd_frame *frame, int64_t *at_ns) {
    est_port *self = ctx;
    int64_t rx_ns = 0;
    const est_io_status status = status_of(can_port_recv(self->port, frame, &rx_ns));
    if (status == EST_IO_EMPTY) {
        self->drained_ns = self->now_ns;
    }
    /* The wall clock may have been set between stamp and now; but the frame is not older than the last look that found
     * nothing left, and not of the future. */
    const int64_t at = rx_ns - self->offset_ns;
    *at_ns = at > self->now_ns ? self->now_ns : at < self->drained_ns ? self->drained_ns : at;
    return status;
}

static est_io_status transmit(void *ctx, const struct canfd_frame *frame) {
    est_port *self = ctx;
    const can_port_status_t status = can_port_send(self->port, frame);
    self->refused += status == CAN_PORT_REFUSED ? 1U : 0U;
    return status_of(status);
}

static void counters(void *ctx, est_io_counters *out) {
    const est_port *self = ctx;
    const can_port_counters_t *from = &self->port->counters;
    out->received = from->received;
    out->sent = from->sent;
    out->rx_drops = from->rx_drops;
    out->tx_drops = from->tx_drops + self->refused;
    out->rejected = from->rejected;
    out->error_frames = from->error_frames;
}

static est_io_status wait_until(void *ctx, int64_t until_ns) {
    est_port *self = ctx;
    const rt_clock clock = rt_clock_system();
    const int64_t left_ns = until_ns - clock.now_ns(clock.ctx);
    const struct timespec left = {left_ns > 0 ? left_ns / NS_PER_S : 0, left_ns > 0 ? left_ns % NS_PER_S : 0};
    struct pollfd look = {.fd = self->port->fd, .events = POLLIN};
    const int ready = ppoll(&look, 1, &left, NULL);
    if (ready < 0) {
        return errno == EINTR ? EST_IO_INTERRUPTED : EST_IO_GONE;
    }
    return ready > 0 ? EST_IO_OK : EST_IO_EMPTY; /* a bus that has ended is readable: recv says so */
}

est_io est_port_io(est_port *self, can_port_t *port) {
    self->port = port;
    self->offset_ns = 0;
    self->now_ns = 0;
    self->drained_ns = 0;
    self->refused = 0;
    self->send_buffer_bytes = 0;
    if (port->hub) {
        /* The hub is an ordinary process: when it does not get the processor, our frames wait here. The default holds
         * 0.07 s of a 1 ms loop; this holds a second. */
        socklen_t size = sizeof self->send_buffer_bytes;
        const int bytes = SEND_BUFFER_BYTES;
        if (setsockopt(port->fd, SOL_SOCKET, SO_SNDBUFFORCE, &bytes, sizeof bytes) != 0) {
            (void)setsockopt(port->fd, SOL_SOCKET, SO_SNDBUF, &bytes, sizeof bytes); /* capped by net.core.wmem_max */
        }
        if (getsockopt(port->fd, SOL_SOCKET, SO_SNDBUF, &self->send_buffer_bytes, &size) != 0) {
            self->send_buffer_bytes = 0;
        }
    } else {
        /* On the hub every frame is read anyway: the port would filter here, after the system call. */
        const struct can_filter wanted[] = {
            {drive_messages[DRIVE_INDEX_MOTOR_STATE].can_id, CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG},
            {drive_messages[DRIVE_INDEX_TEMP_MEAS].can_id, CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG},
            {drive_messages[DRIVE_INDEX_COOLANT].can_id, CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG},
        };
        (void)can_port_filter(port, wanted, sizeof wanted / sizeof wanted[0]);
    }
    const est_io io = {self, begin, receive, transmit, counters, wait_until};
    return io;
}

bool est_port_flush(const est_port *self, int64_t limit_ns) {
    const rt_clock clock = rt_clock_system();
    const int64_t until_ns = clock.now_ns(clock.ctx) + limit_ns;
    int left_bytes = 0;
    while (self->port->hub && ioctl(self->port->fd, SIOCOUTQ, &left_bytes) == 0 && left_bytes > 0) {
        const int64_t now_ns = clock.now_ns(clock.ctx);
        if (now_ns >= until_ns) {
            return false;
        }
        (void)clock.sleep_until_ns(clock.ctx, now_ns + FLUSH_LOOK_NS);
    }
    return true;
}

int est_port_short_of(const est_port *self, int64_t period_us) {
    const int64_t frames = EST_CYCLE_FRAMES_PER_JOB + EST_CYCLE_JOB_FRAMES * INT64_C(1000000) / period_us;
    const int64_t lacking = frames * QUEUED_FRAME_BYTES - self->send_buffer_bytes;
    return self->send_buffer_bytes > 0 && lacking > 0 ? (int)lacking : 0;
}
