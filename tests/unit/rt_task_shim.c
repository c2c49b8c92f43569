/* A virtual clock with scripted delays around rt_task, for test_rt_task.py. Compiled by that test, not by the build. */
#include <stdlib.h>
#include <string.h>

#include "rt_task.h"

typedef struct {
    int64_t interrupts;   /* signals that end the sleep before it succeeds */
    int64_t interrupt_ns; /* how far before the release each of them comes */
    int64_t wake_ns;      /* woken this much late */
    int64_t cpu_ns;       /* processor time of the step */
    int64_t away_ns;      /* time off the processor during the step */
    int64_t publish_ns;
    int64_t rest_ns;      /* published -> done */
    int64_t sent;
    int64_t stale;
} script;

typedef struct {
    int64_t index, release_ns, start_ns, published_ns, done_ns, wake_lat_ns, resp_ns;
    int64_t after_skip, miss_late, cause, warmup;
} outcome;

typedef struct {
    uint64_t releases, jobs, miss_late, miss_skipped, overrun, consec_miss_max, mk_worst;
} counters;

typedef struct {
    int64_t now_ns;
    int64_t cpu_ns;
    script step;
} world;

static int64_t world_now(void *ctx) { return ((world *)ctx)->now_ns; }
static int64_t world_cpu(void *ctx) { return ((world *)ctx)->cpu_ns; }
static bool world_sleep(void *ctx, int64_t at_ns) {
    world *w = ctx;
    if (w->step.interrupts > 0) {
        w->step.interrupts--;
        const int64_t until = at_ns - w->step.interrupt_ns;
        w->now_ns = w->now_ns > until ? w->now_ns : until;
        return false;
    }
    w->now_ns = (w->now_ns > at_ns ? w->now_ns : at_ns) + w->step.wake_ns;
    return true;
}

static counters view(const rt_tally *t) {
    const counters c = {t->releases, t->jobs,            t->miss_late, t->miss_skipped,
                        t->overrun,  t->consec_miss_max, t->mk_worst};
    return c;
}

static int broken(const rt_task *task) {
    return task->total.releases != task->total.jobs + task->total.miss_skipped ||
           task->warmup.releases != task->warmup.jobs + task->warmup.miss_skipped ||
           task->judged.releases != task->judged.jobs + task->judged.miss_skipped ||
           task->total.releases != task->warmup.releases + task->judged.releases;
}

/* Runs `n` jobs; `out[3]` gets total, warm-up, judged. Returns 0, or the step after which an invariant broke, or -1. */
int shim_run(const rt_task_config *config, int64_t now_ns, const script *steps, size_t n, outcome *jobs, counters *out,
             rt_summary *wake_lat) {
    rt_task *task = malloc(sizeof *task);
    world w = {.now_ns = now_ns};
    const rt_clock clock = {&w, world_now, world_cpu, world_sleep, NULL};
    if (task == NULL || rt_task_init(task, config, &clock) != RT_TASK_OK) {
        free(task);
        return -1;
    }
    int bad = 0;
    for (size_t i = 0; i < n && bad == 0; i++) {
        rt_job job;
        w.step = steps[i];
        if (config->virtual_time) {
            rt_task_release(task, &job);
        } else {
            while (rt_task_wait(task, &job) == RT_TASK_INTERRUPTED) {
                bad |= broken(task);
            }
        }
        bad |= broken(task);
        w.cpu_ns += steps[i].cpu_ns;
        w.now_ns += steps[i].cpu_ns + steps[i].away_ns;
        rt_task_stepped(task, &job);
        w.now_ns += steps[i].publish_ns;
        rt_task_published(task, &job, steps[i].sent != 0, steps[i].stale != 0);
        bad |= broken(task);
        w.now_ns += steps[i].rest_ns;
        rt_task_done(task, &job);
        bad |= broken(task);
        const outcome o = {(int64_t)job.index, job.release_ns, job.start_ns, job.published_ns, job.done_ns,
                           job.wake_lat_ns, job.resp_ns, job.after_skip, job.miss_late, job.cause, job.warmup};
        jobs[i] = o;
        bad = bad != 0 ? (int)i + 1 : 0;
    }
    out[0] = view(&task->total);
    out[1] = view(&task->warmup);
    out[2] = view(&task->judged);
    rt_stats_summary(&task->stats[RT_METRIC_WAKE_LAT], wake_lat);
    free(task);
    return bad;
}

int shim_init(const rt_task_config *config) {
    static rt_task task;
    world w = {0};
    const rt_clock clock = {&w, world_now, world_cpu, world_sleep, NULL};
    return (int)rt_task_init(&task, config, &clock);
}

void shim_stats(const int64_t *values, size_t n, rt_summary *out) {
    rt_stats *stats = malloc(sizeof *stats);
    rt_stats_init(stats);
    for (size_t i = 0; i < n; i++) {
        rt_stats_add(stats, values[i], i);
    }
    rt_stats_summary(stats, out);
    free(stats);
}

void shim_recent(const int64_t *at, const int64_t *values, size_t n, int64_t now_ns, int64_t span_ns, rt_summary *out) {
    rt_recent *recent = malloc(sizeof *recent);
    rt_stats *scratch = malloc(sizeof *scratch);
    rt_recent_init(recent);
    for (size_t i = 0; i < n; i++) {
        rt_recent_add(recent, at[i], values[i], i);
    }
    rt_recent_summary(recent, now_ns, span_ns, scratch, out);
    free(recent);
    free(scratch);
}
