/* A periodic task on an absolute release grid: when to run, what each job took, what was missed and why.
 *
 * Releases are r_n = t0 + n·T for n = 1, 2, …; the grid never moves. Every latency counts from the intended release r_n,
 * never from the actual start. The order of calls in one period is
 *
 *     rt_task_wait       sleeps to the next release          (or rt_task_release: virtual time, no sleep)
 *         … read inputs, step …
 *     rt_task_stepped
 *         … publish the output …
 *     rt_task_published  response time, miss, cause: known from here on
 *         … publish the timing, housekeeping …
 *     rt_task_done       activations hit meanwhile are skipped
 *
 * Policy on overrun is `skip`: every activation with r < done_ns that did not run is skipped and counted, the next job
 * runs at the first r >= done_ns, so whole periods are lost and the phase is kept. `overrun` counts the activations with
 * start_ns <= r < done_ns (3.1 ms of work at T = 1 ms: 3). An activation that passed before a late wake is skipped too,
 * but is no overrun. At every instant releases = jobs + miss_skipped.
 *
 * No allocation, no lock, no printing. One thread. */
#ifndef RT_TASK_H
#define RT_TASK_H

#include <stdbool.h>
#include <stdint.h>

#include "rt_clock.h"
#include "rt_stats.h"
#include "rt_tally.h"

typedef enum {
    RT_TASK_OK = 0,
    RT_TASK_INTERRUPTED = 1, /* a signal ended the sleep; no release was consumed */
    RT_TASK_BAD_CONFIG = 2
} rt_task_status;

/* Why a job's output was not what it should be. The values are those of the bus signal `miss_cause`. */
typedef enum {
    RT_CAUSE_NONE = 0,
    RT_CAUSE_LATE_WAKE = 1,    /* the system woke us late */
    RT_CAUSE_PREEMPTED = 2,    /* we were off the processor while computing */
    RT_CAUSE_LONG_COMPUTE = 3, /* the step itself */
    RT_CAUSE_STALE_INPUT = 4,  /* in time, but made without fresh input */
    RT_CAUSE_BLOCKED_SEND = 5  /* publishing took the time, or the output could not be sent at all */
} rt_cause;

typedef struct {
    int64_t period_ns;         /* T > 0 */
    int64_t deadline_ns;       /* 0 < D <= T */
    int64_t t0_ns;             /* r_0, before the first release */
    uint64_t warmup_releases;  /* releases 1..this are shown but not judged */
    bool virtual_time;         /* lock-step: the caller names the release, there is no wake latency, nothing is late or skipped */
} rt_task_config;

/* One execution. `origin_ns` is what latencies count from: the release, or the start in virtual time. */
typedef struct {
    uint64_t index;            /* n */
    int64_t release_ns;        /* r_n */
    int64_t origin_ns;
    int64_t start_ns;          /* first clock read after the sleep */
    int64_t start_cpu_ns;
    int64_t stepped_ns;
    int64_t published_ns;
    int64_t done_ns;
    int64_t wake_lat_ns;       /* -1 in virtual time: not available */
    int64_t exec_wall_ns;
    int64_t exec_cpu_ns;
    int64_t resp_ns;
    bool warmup;
    bool after_skip;           /* releases were skipped between the previous job and this one */
    bool miss_late;
    rt_cause cause;
} rt_job;

typedef enum {
    RT_METRIC_WAKE_LAT = 0,
    RT_METRIC_EXEC_WALL,
    RT_METRIC_EXEC_CPU,
    RT_METRIC_PREEMPT,         /* exec_wall - exec_cpu, at least 0 */
    RT_METRIC_PUBLISH,         /* stepped -> published */
    RT_METRIC_RESP,
    RT_METRIC_PERIOD_DEV_ABS,  /* |(start_k - start_{k-1}) - (n_k - n_{k-1})·T| */
    RT_METRICS
} rt_metric;

/* "wake_lat_us", … in the order of rt_metric. */
extern const char *const rt_metric_name[RT_METRICS];

/* Up to 450 kB (checked where it is compiled): belongs in static storage. */
typedef struct {
    rt_task_config config;
    rt_clock clock;
    uint64_t next_index;       /* the next release to run */
    uint64_t last_index;       /* the job before; 0: none */
    int64_t last_start_ns;
    rt_tally total;            /* since start; these never reset */
    rt_tally warmup;
    rt_tally judged;           /* total without warm-up */
    uint64_t causes[RT_CAUSE_BLOCKED_SEND + 1]; /* jobs by cause, since start */
    rt_stats warmup_stats[RT_METRICS];
    rt_stats stats[RT_METRICS];  /* after warm-up */
    rt_recent recent[RT_METRICS];
} rt_task;

/* Copies `config` and `clock`. RT_TASK_BAD_CONFIG (self untouched) for T <= 0, D outside (0, T] or a missing clock. */
rt_task_status rt_task_init(rt_task *self, const rt_task_config *config, const rt_clock *clock);

/* Puts r_0 at `t0_ns` before the first job has run; afterwards the grid never moves and RT_TASK_BAD_CONFIG is returned. */
rt_task_status rt_task_start_grid(rt_task *self, int64_t t0_ns);

/* Sleeps to the next release and opens its job. RT_TASK_INTERRUPTED when a signal came first: nothing has changed, call
 * again or stop. Blocks up to one period. */
rt_task_status rt_task_wait(rt_task *self, rt_job *job);

/* Virtual time only: opens the next job, whose release is t0 + n·T, without sleeping. O(1). */
void rt_task_release(rt_task *self, rt_job *job);

/* When the next job is due. O(1). */
int64_t rt_task_next_release_ns(const rt_task *self);

/* The step is over. O(1), two clock reads. */
void rt_task_stepped(rt_task *self, rt_job *job);

/* The output has been handed to the bus (`sent`: it was accepted). Fills resp, miss and cause and enters the job's
 * figures. The cause of a late job is the largest of its four parts: wake latency, time off the processor, processor
 * time of the step, time to publish. A job in time has a cause when its output was not sent, or rests on stale input.
 * O(1), one clock read. */
void rt_task_published(rt_task *self, rt_job *job, bool sent, bool stale_input);

/* The job is over: accounts for the activations that passed. O(1), one clock read. */
void rt_task_done(rt_task *self, rt_job *job);

#endif
