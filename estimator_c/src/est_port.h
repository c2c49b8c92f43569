/* The cycle's bus in real time: a can_port whose receive stamps are carried over to the monotonic clock. */
#ifndef EST_PORT_H
#define EST_PORT_H

#include "can_port.h"
#include "est_io.h"

typedef struct {
    can_port_t *port;
    int64_t offset_ns;   /* CLOCK_REALTIME - CLOCK_MONOTONIC, read anew at every job: a clock set meanwhile does no harm */
    int64_t now_ns;
    int64_t drained_ns;  /* everything that arrived before this has been read */
} est_port;

/* Wraps an open port, tells a SocketCAN kernel which ids we want, and gives a hub's socket room for a second of frames. Both objects stay with the caller and outlive the
 * result. Never fails: without the filter the cycle ignores foreign ids itself. */
est_io est_port_io(est_port *self, can_port_t *port);

#endif
