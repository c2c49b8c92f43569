/* The canary: a thread that does nothing but wake up, on the core of the job and one priority above it.
 *
 * Our own work never delays it, however long it takes; only the machine does (the hypervisor took the core, or the
 * kernel held it). So when it woke late, the core was not ours from `due` to `woke`, and a job that was late over
 * the same time is excused. It wakes twice a period, at r + T/4 and r + 3T/4: not on the releases, where it would
 * delay the job; a theft it does not see is shorter than T/2. At T = 1 ms that is 2000 wake-ups a second of a few
 * microseconds each, less than 1 % of the core.
 *
 * Its records go through a ring of one writer and one reader, without locks. Where the thread cannot be raised above
 * the job (no SCHED_FIFO, priority 99, no core of its own) it runs all the same, in the same class, and is not
 * `conclusive`: its figures are shown, but nothing is blamed on the machine for them. */
#ifndef RT_CANARY_H
#define RT_CANARY_H

#include <pthread.h>
#include <semaphore.h>
#include <stdbool.h>
#include <stdint.h>

#include "rt_clock.h"
#include "rt_grant.h"

enum { RT_CANARY_RING = 1024 }; /* half a second at T = 1 ms, for a job that does not look for so long */

typedef struct {
    int64_t due_ns;
    int64_t woke_ns;
} rt_canary_record;

/* One writer, one reader. Both only ever move forward. */
typedef struct {
    uint64_t written;  /* by the writer */
    uint64_t read;     /* by the reader */
    uint64_t lost;     /* by the writer: the ring was full */
    int64_t due_ns;    /* by the writer: what it sleeps for; 0: nothing yet */
    rt_canary_record record[RT_CANARY_RING];
} rt_canary_ring;

/* Empties it. Before either side uses it. */
void rt_canary_ring_init(rt_canary_ring *self);

/* Writer: O(1), never waits. A record that finds the ring full is dropped and counted. */
void rt_canary_ring_push(rt_canary_ring *self, rt_canary_record record);

/* Writer: it sleeps until `due_ns` from here on. O(1). */
void rt_canary_ring_arm(rt_canary_ring *self, int64_t due_ns);

/* Reader: what the canary sleeps for, or slept for if it has not run yet although that is past; INT64_MAX before the
 * first. O(1). */
int64_t rt_canary_ring_due(const rt_canary_ring *self);

/* Reader: O(1), never waits. False when there is none. */
bool rt_canary_ring_pop(rt_canary_ring *self, rt_canary_record *out);

/* Records dropped so far. Any thread. */
uint64_t rt_canary_ring_lost(const rt_canary_ring *self);

/* About 17 kB; belongs in static storage. Fields are private but for those named. */
typedef struct {
    rt_canary_ring ring;   /* for rt_task_set_canary */
    bool running;          /* read: the thread exists */
    bool conclusive;       /* read: above the job on the job's core, so that its lateness is the machine's */
    rt_policy policy;      /* read: what it was granted */
    int priority;
    int core;              /* -1: not pinned */
    int64_t period_ns;
    int64_t t0_ns;
    rt_request request;
    rt_clock clock;
    pthread_t thread;
    sem_t granted;
    sem_t aimed;
    bool stop;
} rt_canary;

/* Starts the thread, which then waits for its grid. `job` is what the job's thread was granted: same class, same
 * core, priority one above. What could not be had is a warning in `job`; without a thread `running` is false and
 * everything else works. Takes about 1 ms; set-up only (allocates a stack of 64 kB). `self` must outlive the thread. */
void rt_canary_start(rt_canary *self, int64_t period_ns, rt_granted *job);

/* The grid begins at `t0_ns`, the job's r_0. Once. O(1). */
void rt_canary_aim(rt_canary *self, int64_t t0_ns);

/* Ends the thread and waits for it: up to T/2. After the loop, also when nothing was started. */
void rt_canary_stop(rt_canary *self);

/* The first activation after `now_ns` on the grid r_0 + T/4 + k·T/2, k >= 0. Pure. */
int64_t rt_canary_next_due_ns(int64_t t0_ns, int64_t period_ns, int64_t now_ns);

#endif
