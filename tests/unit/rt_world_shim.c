/* A machine in virtual time around rt_task: it wakes late, preempts, computes in iterations, steals the core, blocks
 * a send; a canary wakes beside the job. Everything the clock said is handed back, so that a model can say what
 * should have come of it. Compiled by tests (rt_shim.py), not by the build. */
#include <stdlib.h>
#include <string.h>

#include "rt_canary.h"
#include "rt_task.h"

typedef struct {
    int64_t interrupts;  /* signals that end the sleep before it succeeds */
    int64_t wake_ns;     /* woken this much late */
    int64_t iterations;  /* of the solver, which asks between them whether to end */
    int64_t cpu_ns;      /* processor time of each */
    int64_t away_ns;     /* time off the processor during the step */
    int64_t publish_ns;
    int64_t rest_ns;     /* published -> done */
    int64_t sent;
    int64_t stale;
    int64_t core;
} step;

/* The core is gone from `from_ns` to `to_ns`. */
typedef struct {
    int64_t from_ns;
    int64_t to_ns;
} theft;

typedef struct {
    int64_t start_ns;        /* the clock before the first sleep */
    int64_t canary;          /* 0: none, 1: there, but not conclusive, 2: conclusive */
    int64_t canary_lat_ns;   /* how long it takes to wake */
    int64_t theft_is_cpu;    /* stolen time shows as processor time of the thread */
} machine;

typedef struct {
    int64_t slept_until_ns, index, release_ns, start_ns, start_cpu_ns;
    int64_t stepped_ns, stepped_cpu_ns, published_ns, done_ns;
    int64_t asked, asked_ns, expired, late_now;
    int64_t wake_lat_ns, exec_wall_ns, exec_cpu_ns, preempt_ns, resp_ns, stolen_ns, canary_ns;
    int64_t warmup, after_skip, queued, cut, miss_late, cause;
    int64_t releases, jobs, miss_skipped, queued_now, overrun, phase_ns, broken;
} outcome;

typedef struct {
    int64_t now_ns;
    int64_t cpu_ns;
    int64_t slept_until_ns;
    step step;
    const machine *machine;
    const theft *thefts;
    size_t theft_count;
    size_t next_theft;     /* the first that may still hit the job */
    int64_t t0_ns;
    int64_t period_ns;
    int64_t canary_at_ns;  /* when it went to sleep */
    rt_canary_ring ring;
    rt_canary_record *heard;
    size_t heard_count;
    size_t heard_room;
} world;

static int64_t world_now(void *ctx) { return ((world *)ctx)->now_ns; }
static int64_t world_cpu(void *ctx) { return ((world *)ctx)->cpu_ns; }
static int world_core(void *ctx) { return (int)((world *)ctx)->step.core; }

/* The job runs, or waits on the run queue, for `ns` of the core's time. */
static void move(world *w, int64_t ns, bool on_processor) {
    int64_t end_ns = w->now_ns + ns;
    w->cpu_ns += on_processor ? ns : 0;
    for (; w->next_theft < w->theft_count && w->thefts[w->next_theft].from_ns < end_ns; w->next_theft++) {
        const theft *t = &w->thefts[w->next_theft];
        const int64_t lost_ns = t->to_ns - (t->from_ns > w->now_ns ? t->from_ns : w->now_ns);
        if (lost_ns > 0) {
            end_ns += lost_ns;
            w->cpu_ns += on_processor && w->machine->theft_is_cpu != 0 ? lost_ns : 0;
        }
    }
    w->now_ns = end_ns;
}

static int64_t back_on_core_ns(const world *w, int64_t at_ns) {
    for (size_t i = 0; i < w->theft_count; i++) {
        if (w->thefts[i].from_ns <= at_ns && at_ns < w->thefts[i].to_ns) {
            return w->thefts[i].to_ns;
        }
    }
    return at_ns;
}

static bool world_sleep(void *ctx, int64_t at_ns) {
    world *w = ctx;
    w->slept_until_ns = at_ns;
    if (w->step.interrupts > 0) {
        w->step.interrupts--;
        return false;
    }
    const int64_t due_ns = at_ns > w->now_ns ? at_ns : w->now_ns;
    w->now_ns = back_on_core_ns(w, due_ns);
    while (w->next_theft < w->theft_count && w->thefts[w->next_theft].to_ns <= w->now_ns) {
        w->next_theft++;
    }
    move(w, w->step.wake_ns, false);
    return true;
}

/* All of the canary's wake-ups up to now, which it had before the job could look. */
static void run_canary(world *w) {
    while (w->machine->canary != 0) {
        const int64_t due_ns = rt_canary_next_due_ns(w->t0_ns, w->period_ns, w->canary_at_ns);
        const int64_t woke_ns = back_on_core_ns(w, due_ns) + w->machine->canary_lat_ns;
        rt_canary_ring_arm(&w->ring, due_ns);
        if (woke_ns > w->now_ns || w->heard_count == w->heard_room) {
            return;
        }
        const rt_canary_record record = {due_ns, woke_ns};
        rt_canary_ring_push(&w->ring, record);
        w->heard[w->heard_count++] = record;
        w->canary_at_ns = woke_ns;
    }
}

/* What it still sleeps for, as a wake-up that never came. */
static void end_canary(world *w) {
    if (w->machine->canary != 0 && w->heard_count < w->heard_room) {
        const rt_canary_record pending = {rt_canary_next_due_ns(w->t0_ns, w->period_ns, w->canary_at_ns), INT64_MAX};
        w->heard[w->heard_count++] = pending;
    }
}

static bool conserved(const rt_tally *t) { return t->releases == t->jobs + t->miss_skipped + t->queued_now; }

static int64_t broken(const rt_task *task) {
    return !conserved(&task->total) || !conserved(&task->warmup) || !conserved(&task->judged) ||
           task->total.releases != task->warmup.releases + task->judged.releases;
}

static void run_job(rt_task *task, rt_job *job, world *w, outcome *o) {
    const step *s = &w->step;
    o->start_ns = w->now_ns;
    o->start_cpu_ns = w->cpu_ns;
    move(w, s->away_ns, false);
    for (int64_t i = 0; i < s->iterations && o->expired == 0; i++) {
        move(w, s->cpu_ns, true);
        if (i + 1 < s->iterations) {
            o->asked++;
            o->asked_ns = w->now_ns;
            o->expired = rt_task_expired(task, job);
        }
    }
    o->stepped_ns = w->now_ns;
    rt_task_stepped(task, job);
    o->stepped_cpu_ns = w->cpu_ns;
    o->late_now = rt_task_late_now(task, job);
    o->broken |= broken(task);
    move(w, s->publish_ns, true);
    run_canary(w);
    o->published_ns = w->now_ns;
    rt_task_published(task, job, s->sent != 0, s->stale != 0);
    o->broken |= broken(task);
    move(w, s->rest_ns, true);
    o->done_ns = w->now_ns;
    rt_task_done(task, job);
    o->broken |= broken(task);
}

static void fill(outcome *o, const rt_task *task, const rt_job *job, const world *w) {
    const rt_tally *t = &task->total;
    o->slept_until_ns = w->slept_until_ns;
    o->index = (int64_t)job->index;
    o->release_ns = job->release_ns;
    o->broken |= o->start_ns != job->start_ns || o->start_cpu_ns != job->start_cpu_ns ||
                 o->stepped_ns != job->stepped_ns || o->published_ns != job->published_ns || o->done_ns != job->done_ns;
    o->wake_lat_ns = job->wake_lat_ns;
    o->exec_wall_ns = job->exec_wall_ns;
    o->exec_cpu_ns = job->exec_cpu_ns;
    o->preempt_ns = job->preempt_ns;
    o->resp_ns = job->resp_ns;
    o->stolen_ns = job->stolen_ns;
    o->canary_ns = job->canary_ns;
    o->warmup = job->warmup;
    o->after_skip = job->after_skip;
    o->queued = job->queued;
    o->cut = job->cut;
    o->miss_late = job->miss_late;
    o->cause = job->cause;
    o->releases = (int64_t)t->releases;
    o->jobs = (int64_t)t->jobs;
    o->miss_skipped = (int64_t)t->miss_skipped;
    o->queued_now = (int64_t)t->queued_now;
    o->overrun = (int64_t)t->overrun;
    o->phase_ns = task->phase_ns;
}

/* Runs up to `n` jobs. Returns how many ran (fewer: the task stopped itself), or -1 for a configuration it refused. */
int64_t world_run(rt_task *task, const rt_task_config *config, const machine *m, const theft *thefts,
                  size_t theft_count, const step *steps, size_t n, outcome *out,
                  rt_canary_record *heard, size_t *heard_count) {
    world *w = calloc(1, sizeof *w);
    const rt_clock clock = {w, world_now, world_cpu, world_sleep, world_core};
    w->machine = m;
    w->now_ns = m->start_ns;
    w->thefts = thefts;
    w->theft_count = theft_count;
    w->t0_ns = w->canary_at_ns = config->t0_ns;
    w->period_ns = config->period_ns;
    w->heard = heard;
    w->heard_room = *heard_count;
    int64_t ran = -1;
    if (rt_task_init(task, config, &clock) == RT_TASK_OK) {
        if (m->canary != 0) {
            rt_task_set_canary(task, &w->ring, m->canary == 2);
        }
        for (ran = 0; ran < (int64_t)n; ran++) {
            rt_job job;
            rt_task_status status = RT_TASK_INTERRUPTED;
            w->step = steps[ran];
            while (status == RT_TASK_INTERRUPTED) {
                status = rt_task_wait(task, &job);
                out[ran].broken |= broken(task);
            }
            if (status != RT_TASK_OK) {
                break;
            }
            run_job(task, &job, w, &out[ran]);
            fill(&out[ran], task, &job, w);
        }
    }
    end_canary(w);
    *heard_count = w->heard_count;
    free(w);
    return ran;
}

/* Sizes and contents for a test without the C's structures. */
size_t world_task_size(void) { return sizeof(rt_task); }
const char *world_metric(size_t metric) { return rt_metric_name[metric]; }

static void tally(const rt_tally *t, uint64_t out[11]) {
    const uint64_t values[11] = {t->releases, t->jobs, t->miss_late, t->miss_skipped, t->overrun, t->consec_miss_max,
                                 t->mk_worst, t->queued, t->queued_now, t->mk_misses_max, t->mk_violations};
    memcpy(out, values, sizeof values);
}

void world_counters(const rt_task *task, uint64_t total[11], uint64_t warmup[11], uint64_t judged[11],
                    uint64_t causes[3][RT_CAUSES], uint64_t other[4]) {
    tally(&task->total, total);
    tally(&task->warmup, warmup);
    tally(&task->judged, judged);
    memcpy(causes[0], task->causes, sizeof causes[0]);
    memcpy(causes[1], task->skipped_causes, sizeof causes[1]);
    memcpy(causes[2], task->judged_causes, sizeof causes[2]);
    const uint64_t values[4] = {task->cut_jobs, task->rebased, (uint64_t)task->phase_ns, task->migrations};
    memcpy(other, values, sizeof values);
}

/* The histogram of a metric: summary and the buckets that are not empty, three numbers each; returns how many. */
size_t world_histogram(const rt_task *task, size_t metric, int warmup, rt_summary *summary, int64_t (*rows)[3],
                       size_t room) {
    const rt_stats *stats = warmup ? &task->warmup_stats[metric] : &task->stats[metric];
    size_t used = 0;
    rt_stats_summary(stats, summary);
    for (size_t i = 0; i < RT_STATS_BUCKETS && used < room; i++) {
        if (stats->bucket[i] > 0) {
            rt_stats_bucket_bounds(i, &rows[used][0], &rows[used][1]);
            rows[used++][2] = (int64_t)stats->bucket[i];
        }
    }
    return used;
}
