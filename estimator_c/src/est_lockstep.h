/* The cycle's bus in lock-step: records on pipes instead of a socket, record time instead of a clock.
 *
 * Between two releases frames wait in a queue, as they would in a socket's buffer; what does not fit is dropped and
 * counted. Frames sent get the release's time. Nothing allocates; sends may block on the pipe. One thread. */
#ifndef EST_LOCKSTEP_H
#define EST_LOCKSTEP_H

#include <stdbool.h>
#include <stdint.h>

#include "est_io.h"
#include "rt_record.h"

enum { EST_LOCKSTEP_QUEUE = 4096 };

/* A larger step of record time than this between two records is a mistake of the other side, not a long wait. */
#define EST_LOCKSTEP_MAX_STEP_NS INT64_C(3600000000000)

typedef enum {
    EST_LOCKSTEP_OK = 0,
    EST_LOCKSTEP_BACKWARDS = 1, /* record time before the last record's, or negative */
    EST_LOCKSTEP_JUMP = 2       /* more than EST_LOCKSTEP_MAX_STEP_NS after it */
} est_lockstep_status;

/* Up to 240 kB with its buffers (checked where it is compiled): belongs in static storage. */
typedef struct {
    rt_record_reader reader;
    rt_record_writer writer;
    int64_t now_ns;        /* release of the job that runs */
    int64_t last_ns;       /* time of the record before */
    uint32_t head;         /* oldest frame */
    uint32_t used;
    rt_record queue[EST_LOCKSTEP_QUEUE];
    est_io_counters counters;
    bool broken;           /* writing failed: the other side is gone */
} est_lockstep;

/* Starts at record time 0 on two open descriptors. */
void est_lockstep_init(est_lockstep *self, int in_fd, int out_fd);

/* The bus as the cycle sees it. `self` outlives the result. */
est_io est_lockstep_io(est_lockstep *self);

/* Takes note of the next record's time: it may not go back, and not leap. */
est_lockstep_status est_lockstep_advance(est_lockstep *self, int64_t t_ns);

/* Queues a received frame; one that no CAN bus carries is counted as rejected, an error frame as such. */
void est_lockstep_push(est_lockstep *self, const rt_record *record);

#endif
