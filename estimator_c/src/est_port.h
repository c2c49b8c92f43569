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
    int64_t drained_ns;  /* everything that arrived before this has been read: start of the last job that read to EMPTY */
} est_port;

/* Wraps an open port, tells a SocketCAN kernel which ids we want, and gives a hub's socket room for a second of frames. Both objects stay with the caller and outlive the
 * result. Never fails: without the filter the cycle ignores foreign ids itself. */
est_io est_port_io(est_port *self, can_port_t *port);

#endif
