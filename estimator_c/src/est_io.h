/* What the estimator's cycle needs of a bus: frames in with their arrival time, frames out, and the losses.
 *
 * Two implementations: est_port (a real bus), which blocks in `wait` alone, and est_lockstep (records over pipes), whose sends
 * wait for the pipe's reader and which has no `wait`. Neither allocates. */
#ifndef EST_IO_H
#define EST_IO_H

#include <linux/can.h>
#include <stdint.h>

typedef enum {
    EST_IO_OK = 0,
    EST_IO_EMPTY = 1, /* recv: nothing more now */
    EST_IO_FULL = 2,  /* send: no room; the frame is lost and counted in tx_drops */
    EST_IO_GONE = 3,  /* the bus has ended */
    EST_IO_SKIPPED = 4, /* recv: EST_IO_SKIP_COST datagrams were no frames, more may wait */
    EST_IO_INTERRUPTED = 5 /* wait: a signal came first */
} est_io_status;

enum { EST_IO_SKIP_COST = 64 }; /* what an EST_IO_SKIPPED costs, in frames */

typedef struct {
    uint64_t received;
    uint64_t sent;
    uint64_t rx_drops;
    uint64_t tx_drops;
    uint64_t rejected;
    uint64_t error_frames;
} est_io_counters;

typedef struct {
    void *ctx;
    /* A job begins at `now_ns` (the task's time base). */
    void (*begin)(void *ctx, int64_t now_ns);
    /* The oldest frame not yet read and when it arrived, in the task's time base. */
    est_io_status (*recv)(void *ctx, struct canfd_frame *frame, int64_t *at_ns);
    est_io_status (*send)(void *ctx, const struct canfd_frame *frame);
    void (*counters)(void *ctx, est_io_counters *out);
    /* Blocks until there is something to receive (OK), or until `until_ns` (EMPTY). Only a cycle triggered by frames needs it;
     * may be NULL. */
    est_io_status (*wait)(void *ctx, int64_t until_ns);
} est_io;

#endif
