#include "timing_watch.h"

#include <stddef.h>

static timing_stat stat_of(const rt_stats *stats) {
    enum { P99 = 9900 };
    timing_stat out = {TIMING_NA, stats->count > 0 ? stats->max_ns : TIMING_NA};
    if (rt_stats_quantile(stats, P99, &out.p99_ns) == RT_QUANTILE_NA) {
        out.p99_ns = TIMING_NA;
    }
    return out;
}

static int64_t since_warm(int64_t now, int64_t warm) {
    return now < 0 || warm < 0 ? TIMING_NA : now - warm;
}

static void environment_of(const timing_watch *self, timing_counters *out) {
    rt_environment now;
    int64_t run_delay_ns = TIMING_NA;
    int64_t steal_ns = TIMING_NA;
    out->run_delay_ns = out->steal_ns = TIMING_NA;
    if (!self->warm_known) {
        return;
    }
    rt_environment_read(&now, false);
    out->minor_faults = now.minor_faults - self->warm.minor_faults;
    out->major_faults = now.major_faults - self->warm.major_faults;
    out->invol_switches = now.invol_switches - self->warm.invol_switches;
    if (self->machine != NULL) {
        rt_machine_read(self->machine, &run_delay_ns, &steal_ns);
        out->run_delay_ns = since_warm(run_delay_ns, self->warm_run_delay_ns);
        out->steal_ns = since_warm(steal_ns, self->warm_steal_ns);
    }
}

void timing_watch_counters(const timing_watch *self, const rt_task *task, timing_counters *out) {
    const rt_tally *tally = &task->total;
    *out = (timing_counters){
        .releases = tally->releases - tally->queued_now,
        .jobs = tally->jobs,
        .miss_late = tally->miss_late,
        .miss_skipped = tally->miss_skipped,
        .overrun = tally->overrun,
        .waiting = tally->queued_now,
        .queued = tally->queued,
        .cut = task->cut_jobs,
        .rebased = task->rebased,
        .consec_miss_max = tally->consec_miss_max,
        .mk_worst = tally->mk_worst,
        .phase_ns = task->phase_ns,
        .migrations = task->migrations,
        .canary = stat_of(&task->stats[RT_METRIC_CANARY]),
        .wake = stat_of(&task->stats[RT_METRIC_WAKE_LAT]),
        .exec = stat_of(&task->stats[RT_METRIC_EXEC_WALL]),
        .resp = stat_of(&task->stats[RT_METRIC_RESP]),
    };
    environment_of(self, out);
}

void timing_watch_job(timing_watch *self, const rt_job *job) {
    if (self->warm_known || job->warmup) {
        return;
    }
    rt_environment_read(&self->warm, false);
    self->warm_run_delay_ns = self->warm_steal_ns = TIMING_NA;
    if (self->machine != NULL) {
        rt_machine_read(self->machine, &self->warm_run_delay_ns, &self->warm_steal_ns);
    }
    self->warm_known = true;
}
