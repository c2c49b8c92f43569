/* A periodic task on an absolute release grid: when to run, what each job took, what was missed and why.
 *
 * Releases are r_n = t0 + n·T for n = 1, 2, …; the grid never moves (but see rebase). Every latency counts from the
 * intended release r_n, never from the actual start. The order of calls in one period is
 *
 *     rt_task_wait       sleeps to the next release   (rt_task_release: virtual time, no sleep; rt_task_event: a
 *                        frame came)
 *         … read inputs, step; between iterations rt_task_expired …
 *     rt_task_stepped
 *         … rt_task_late_now: is this output late already? publish it …
 *     rt_task_published  response time, miss, cause: known from here on
 *         … publish the timing, housekeeping …
 *     rt_task_done       activations hit meanwhile are accounted for
 *
 * An activation passes when the job is done after it (r < done_ns). `overrun` counts those with start_ns <= r <
 * done_ns (3.1 ms of work at T = 1 ms: 3); those that passed before a late wake are no overrun. What becomes of
 * them:
 *   skip     all are skipped and counted; the next job runs at the first r >= done_ns: whole periods are lost, the
 *            phase is kept
 *   queue:N  the oldest wait and run late, one after another, flagged `queued`; those that find N waiting are skipped
 *   rebase   none is lost: the grid moves, so that the next release is done_ns; counted, the total is phase_ns
 * Beside them: `cut`, a budget from the release on that the solver asks for, and `stop`, after so many judged misses.
 * At every instant releases = jobs + miss_skipped + queued_now, in total, in warm-up and after it.
 *
 * Releases 1..warmup_releases are the start-up grace: shown, not judged, and they never stop the task.
 *
 * No allocation, no lock, no printing. One thread, but for rt_task_snapshot. */
#ifndef RT_TASK_H
#define RT_TASK_H

#include <stdbool.h>
#include <stdint.h>

#include "rt_backlog.h"
#include "rt_canary.h"
#include "rt_cause.h"
#include "rt_clock.h"
#include "rt_reaction.h"
#include "rt_seqlock.h"
#include "rt_stats.h"
#include "rt_tally.h"
#include "rt_theft.h"

typedef enum {
    RT_TASK_OK = 0,
    RT_TASK_INTERRUPTED = 1, /* a signal ended the sleep; no release was consumed */
    RT_TASK_BAD_CONFIG = 2,
    RT_TASK_STOPPED = 3      /* the policy's number of misses is reached; nothing has changed */
} rt_task_status;

/* All that is not set is zero: time grid, skip, never stop, no (m, K) monitor. */
typedef struct {
    int64_t period_ns;         /* T > 0 */
    int64_t deadline_ns;       /* 0 < D <= T */
    int64_t t0_ns;             /* r_0, before the first release */
    uint64_t warmup_releases;  /* releases 1..this are shown but not judged */
    bool virtual_time;         /* lock-step: the caller names the release; no wake latency, none late or skipped */
    bool on_event;             /* releases are events (rt_task_event), T: their nominal distance; skip only */
    rt_reaction reaction;
    uint32_t mk_m;             /* (m, K) of the judged releases, m < K <= RT_MK_WINDOW; K = 0: no monitor */
    uint32_t mk_k;
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
    int64_t preempt_ns;        /* exec_wall - exec_cpu, at least 0 */
    int64_t resp_ns;
    int64_t stolen_ns;         /* of [release, published], taken by the machine as the canary saw it; late jobs only */
    int64_t canary_ns;         /* newest wake latency of the canary, -1: none (yet) */
    bool warmup;
    bool after_skip;           /* releases were skipped between the previous job and this one */
    bool queued;               /* its release had passed when the job before was done */
    bool cut;                  /* rt_task_expired told the solver to end */
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
    RT_METRIC_PERIOD_DEV_ABS,  /* |period_dev|, for its quantiles */
    RT_METRIC_PERIOD_DEV,      /* (start_k - start_{k-1}) - (n_k - n_{k-1})·T; about half of it is underflow */
    RT_METRIC_SLACK,           /* D - resp: underflow counts the late jobs */
    RT_METRIC_CANARY,          /* the canary's wake latency; index: the job that read it, the first published then */
    RT_METRICS
} rt_metric;

/* "wake_lat_us", … in the order of rt_metric. */
extern const char *const rt_metric_name[RT_METRICS];

/* Up to 650 kB (checked where it is compiled): belongs in static storage. */
typedef struct {
    rt_task_config config;
    rt_clock clock;
    uint64_t next_index;       /* the next release to run */
    uint64_t seen_index;       /* the newest release accounted for */
    uint64_t last_index;       /* the job before; 0: none */
    int64_t last_start_ns;
    int64_t last_done_ns;
    rt_cause last_delay;       /* what delayed the job before */
    rt_backlog backlog;
    uint64_t owed_skips;       /* releases skipped right behind the job that runs, while it waited */
    rt_seqlock version;        /* of everything below */
    rt_tally total;            /* since start; these never reset */
    rt_tally warmup;
    rt_tally judged;           /* total without warm-up */
    uint64_t causes[RT_CAUSES];         /* finished jobs by cause, since start */
    uint64_t skipped_causes[RT_CAUSES]; /* skipped releases by what delayed the job that took them */
    uint64_t judged_causes[RT_CAUSES];  /* both kinds of judged misses */
    uint64_t cut_jobs;
    uint64_t rebased;          /* times the grid moved */
    int64_t phase_ns;          /* by how much in all */
    uint64_t migrations;       /* jobs that started on another core than the job before */
    int cpu;                   /* where the newest job started; -1: unknown */
    rt_canary_ring *canary;    /* NULL: none */
    bool canary_conclusive;
    int64_t canary_ns;         /* newest wake latency; -1: none yet */
    rt_theft theft;
    rt_stats warmup_stats[RT_METRICS];
    rt_stats stats[RT_METRICS];  /* after warm-up */
    rt_recent recent[RT_METRICS]; /* of the canary at T = 1 ms: its last half second */
} rt_task;

/* Copies `config` and `clock`. RT_TASK_BAD_CONFIG (self untouched) for T <= 0, D outside (0, T], a reaction that
 * rt_reaction_valid refuses, events with another overrun policy than skip, m >= K, K > RT_MK_WINDOW or a missing
 * clock. */
rt_task_status rt_task_init(rt_task *self, const rt_task_config *config, const rt_clock *clock);

/* Puts r_0 at `t0_ns` before the first job has run; afterwards the grid never moves and RT_TASK_BAD_CONFIG is
 * returned. */
rt_task_status rt_task_start_grid(rt_task *self, int64_t t0_ns);

/* Takes the canary's records from `ring` with every job. `conclusive`: its lateness is the machine's, so that a miss
 * can be blamed on steal. Before the first job; the ring must outlive `self`. */
void rt_task_set_canary(rt_task *self, rt_canary_ring *ring, bool conclusive);

/* Sleeps to the next release and opens its job; a release that waits in the queue is opened at once.
 * RT_TASK_INTERRUPTED when a signal came first: nothing has changed, call again or stop. RT_TASK_STOPPED: no job,
 * now and ever after. Blocks up to one period. Not for tasks on events. */
rt_task_status rt_task_wait(rt_task *self, rt_job *job);

/* Virtual time only: opens the next job, whose release is t0 + n·T, without sleeping. O(1). */
void rt_task_release(rt_task *self, rt_job *job);

/* Tasks on events: opens the job of the event at `release_ns` (a kernel stamp, say, on the task's clock; now at the
 * latest). Flagged `queued` and counted as overrun when it came while the job before still ran. RT_TASK_STOPPED as
 * rt_task_wait. O(1). */
rt_task_status rt_task_event(rt_task *self, rt_job *job, int64_t release_ns);

/* Tasks on events: an event at `at_ns` gets no job of its own (a later one stands for it): it is skipped and
 * counted. Between rt_task_done and the next rt_task_event, in order of time. O(1). */
void rt_task_event_passed(rt_task *self, int64_t at_ns);

/* When the next job is due; in the past for one that waits in the queue. Not for tasks on events. O(1). */
int64_t rt_task_next_release_ns(const rt_task *self);

/* True once the policy's number of judged misses is reached. O(1). */
bool rt_task_stopped(const rt_task *self);

/* Policy cut: true when the budget, counted from the release, is used up. Ask where true ends the work: the job is then
 * flagged `cut`. Never true without a budget or in virtual time. O(1), one clock read. */
bool rt_task_expired(const rt_task *self, rt_job *job);

/* The step is over. O(1), two clock reads. */
void rt_task_stepped(rt_task *self, rt_job *job);

/* True when an output published now would be late (now - r > D). After rt_task_stepped, to decide what is published.
 * Never true in virtual time. O(1), one clock read. */
bool rt_task_late_now(const rt_task *self, const rt_job *job);

/* The output has been handed to the bus (`sent`: it was accepted). Fills resp, miss and cause (rules in rt_cause.h) and
 * enters the job's figures. A job in time has a cause when its output was not sent, or rests on stale input.
 * O(1) and up to RT_CANARY_RING records of the canary, one clock read. */
void rt_task_published(rt_task *self, rt_job *job, bool sent, bool stale_input);

/* The job is over: accounts for the activations that passed. O(1), one clock read. */
void rt_task_done(rt_task *self, rt_job *job);

/* What a reader in another thread gets; all of one instant. */
typedef struct {
    rt_tally total;
    rt_tally warmup;
    rt_tally judged;
    uint64_t causes[RT_CAUSES];
    uint64_t skipped_causes[RT_CAUSES];
    uint64_t judged_causes[RT_CAUSES];
    uint64_t cut_jobs;
    uint64_t rebased;
    int64_t phase_ns;
    uint64_t migrations;
} rt_task_counters;

/* A consistent copy of the counters and, where `stats` is not NULL, of one metric (`warmup`: of that window). Any
 * thread, without making the task wait; false when it was busy at all of `tries` attempts, and the outputs are then
 * of no use. About 2 µs a try. */
bool rt_task_snapshot(const rt_task *self, rt_metric metric, bool warmup, unsigned tries, rt_task_counters *counters,
                      rt_stats *stats);

#endif
