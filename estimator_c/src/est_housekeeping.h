/* What a cycle says beside its jobs: the counters once a second, the identity every ten seconds. A part of est_cycle, for it alone.
 *
 * No allocation, no lock, no printing; one thread. */
#ifndef EST_HOUSEKEEPING_H
#define EST_HOUSEKEEPING_H

#include "est_cycle.h"

/* The first counters are due a second after `t0_ns`, the identity at once. */
void est_housekeeping_set_due(est_cycle *self, int64_t t0_ns);

/* Begins a round where one is due and sends at most EST_CYCLE_HOUSEKEEPING_FRAMES of it.
 * Some µs, at the beginning of a round some ten. */
est_cycle_status est_housekeeping(est_cycle *self, const rt_job *job);

/* Sends `count` frames; a full bus loses a frame (counted by the port), a bus that has ended ends the cycle. */
est_cycle_status est_housekeeping_send(est_cycle *self, const struct canfd_frame *frames, size_t count);

#endif
