/* The cycle's bus in real time: a can_port whose receive stamps are carried over to the monotonic clock.
 *
 * Stamps are CLOCK_REALTIME, which may be set at any time. Both clocks are read side by side at every job, and an arrival
 * lies between the last look that found the queue empty and now, whatever the stamp says. So a clock set back makes the
 * frames of one job look fresh; a clock set forward makes them look as old as that last look, which costs one job its
 * fresh input where the period is longer than the input's timeout. The job after is right again. */
#ifndef EST_PORT_H
#define EST_PORT_H

#include "can_port.h"
#include "est_io.h"

typedef struct {
    can_port_t *port;
    int64_t offset_ns;   /* CLOCK_REALTIME - CLOCK_MONOTONIC, read anew at every job */
    int64_t now_ns;      /* start of the job */
    uint64_t refused;    /* frames of ours that the port would not send; counted in tx_drops */
    int send_buffer_bytes; /* hub: what the kernel gave us, its own bookkeeping included; 0: SocketCAN, or unknown */
    int64_t drained_ns;  /* everything that arrived before this has been read: start of the last job that read to EMPTY */
} est_port;

/* Wraps an open port, tells a SocketCAN kernel which ids we want, and asks for room for a second of frames at the shortest
 * period on a hub's socket; without CAP_NET_ADMIN the kernel gives at most net.core.wmem_max (est_port_short_of says
 * whether that is enough). Both objects stay with the caller and outlive the result. Never fails: without the filter the
 * cycle ignores foreign ids itself. */
est_io est_port_io(est_port *self, can_port_t *port);

/* Hub, after the loop: waits until the hub has taken every frame sent, `limit_ns` at most, so that who is told that we have
 * ended finds all of them on the bus. False: some are still waiting. SocketCAN has no such queue of ours: true at once. */
bool est_port_flush(const est_port *self, int64_t limit_ns);

/* Bytes that the send buffer lacks to hold a second of frames at this period; 0: enough, or no matter (SocketCAN). O(1). */
int est_port_short_of(const est_port *self, int64_t period_us);

#endif
