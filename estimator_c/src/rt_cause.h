/* Why a job's output was not what it should be: pure rules over measured times, the same for every process.
 *
 * The delay of a job, from its release to the end of its output, has five parts, in order of time: it waited for an
 * earlier job (backlog), the system woke it late, it was off the processor while computing, it computed, it sent. A
 * late job is blamed
 *   1. on `steal`, when it would have been in time without what the canary saw taken from the core (resp - stolen <=
 *   D);
 *   2. else on the largest part; of equal ones the earliest. Backlog hands on the cause of the job it waited for.
 * Processor time of a thread may contain time the hypervisor took (the guest does not see all of it), so that theft
 * looks like a late wake, preemption, long compute or blocked send alike: hence rule 1 before rule 2. What the
 * canary saw is a lower bound, hence a miss without evidence is never steal.
 *
 * No clock, no state. O(1), any thread, cannot fail. */
#ifndef RT_CAUSE_H
#define RT_CAUSE_H

#include <stdint.h>

/* The values are those of the bus signal `miss_cause`. */
typedef enum {
    RT_CAUSE_NONE = 0,
    RT_CAUSE_LATE_WAKE = 1,    /* the system woke us late */
    RT_CAUSE_PREEMPTED = 2,    /* we were off the processor while computing */
    RT_CAUSE_LONG_COMPUTE = 3, /* the step itself */
    RT_CAUSE_STALE_INPUT = 4,  /* in time, but made without fresh input */
    RT_CAUSE_BLOCKED_SEND = 5, /* publishing took the time, or the output could not be sent at all */
    RT_CAUSE_STEAL = 6,        /* the machine took the core from us, and the canary saw it */
    RT_CAUSES = 7
} rt_cause;

/* "none", "late_wake", … in the order of rt_cause. */
extern const char *const rt_cause_name[RT_CAUSES];

/* The parts of a delay, each >= 0. */
typedef struct {
    int64_t backlog_ns;        /* release -> end of the job before, where that came later */
    int64_t wake_ns;           /* from there -> start */
    int64_t away_ns;           /* off the processor between start and stepped */
    int64_t compute_ns;        /* on it */
    int64_t send_ns;           /* stepped -> published */
    rt_cause backlog_cause;    /* what delayed the job before */
} rt_delay;

/* The largest part's cause. */
rt_cause rt_cause_largest(const rt_delay *delay);

/* The cause of a late job; `stolen_ns` is what the canary saw taken between release and publication, 0 without a
 * canary. */
rt_cause rt_cause_late(const rt_delay *delay, int64_t resp_ns, int64_t deadline_ns, int64_t stolen_ns);

#endif
