#include "rt_task.h"

#include <stddef.h>
#include <string.h>

_Static_assert(sizeof(rt_task) <= 450000, "rt_task.h says so");

const char *const rt_metric_name[RT_METRICS] = {
    "wake_lat_us", "exec_wall_us", "exec_cpu_us", "preempt_us", "publish_us", "resp_us", "period_dev_abs_us",
};

rt_task_status rt_task_init(rt_task *self, const rt_task_config *config, const rt_clock *clock) {
    if (config->period_ns <= 0 || config->deadline_ns <= 0 || config->deadline_ns > config->period_ns ||
        clock->now_ns == NULL || clock->thread_cpu_ns == NULL ||
        (clock->sleep_until_ns == NULL && !config->virtual_time)) {
        return RT_TASK_BAD_CONFIG;
    }
    memset(self, 0, sizeof *self);
    self->config = *config;
    self->clock = *clock;
    self->next_index = 1;
    return RT_TASK_OK;
}

rt_task_status rt_task_start_grid(rt_task *self, int64_t t0_ns) {
    if (self->total.jobs > 0) {
        return RT_TASK_BAD_CONFIG;
    }
    self->config.t0_ns = t0_ns;
    return RT_TASK_OK;
}

static int64_t release_of(const rt_task *self, uint64_t index) {
    return self->config.t0_ns + (int64_t)index * self->config.period_ns;
}

int64_t rt_task_next_release_ns(const rt_task *self) {
    return release_of(self, self->next_index);
}

/* How many releases lie before `at_ns`: the largest n with r_n < at_ns, never less than 0. */
static uint64_t releases_before(const rt_task *self, int64_t at_ns) {
    const int64_t since = at_ns - self->config.t0_ns;
    return since <= 0 ? 0 : (uint64_t)((since - 1) / self->config.period_ns);
}

static rt_tally *window_tally(rt_task *self, uint64_t index) {
    return index <= self->config.warmup_releases ? &self->warmup : &self->judged;
}

static void record(rt_task *self, const rt_job *job, rt_metric metric, int64_t value_ns) {
    rt_stats *stats = job->warmup ? self->warmup_stats : self->stats;
    rt_stats_add(&stats[metric], value_ns, job->index);
    rt_recent_add(&self->recent[metric], job->release_ns, value_ns, job->index);
}

static void open_job(rt_task *self, rt_job *job) {
    memset(job, 0, sizeof *job);
    job->index = self->next_index;
    job->release_ns = release_of(self, job->index);
    job->warmup = job->index <= self->config.warmup_releases;
    job->after_skip = job->index != self->last_index + 1U;
    job->start_ns = self->clock.now_ns(self->clock.ctx);
    job->start_cpu_ns = self->clock.thread_cpu_ns(self->clock.ctx);
    job->origin_ns = self->config.virtual_time ? job->start_ns : job->release_ns;
    job->wake_lat_ns = self->config.virtual_time ? -1 : job->start_ns - job->release_ns;
    rt_tally_start(&self->total);
    rt_tally_start(window_tally(self, job->index));
}

rt_task_status rt_task_wait(rt_task *self, rt_job *job) {
    if (!self->clock.sleep_until_ns(self->clock.ctx, rt_task_next_release_ns(self))) {
        return RT_TASK_INTERRUPTED;
    }
    open_job(self, job);
    return RT_TASK_OK;
}

void rt_task_release(rt_task *self, rt_job *job) {
    open_job(self, job);
}

void rt_task_stepped(rt_task *self, rt_job *job) {
    job->stepped_ns = self->clock.now_ns(self->clock.ctx);
    job->exec_wall_ns = job->stepped_ns - job->start_ns;
    job->exec_cpu_ns = self->clock.thread_cpu_ns(self->clock.ctx) - job->start_cpu_ns;
}

static int64_t preempted_ns(const rt_job *job) {
    const int64_t away_ns = job->exec_wall_ns - job->exec_cpu_ns;
    return away_ns > 0 ? away_ns : 0; /* the two clocks are read one after the other */
}

static rt_cause largest_part(const rt_job *job) {
    rt_cause cause = RT_CAUSE_LATE_WAKE;
    int64_t largest_ns = job->wake_lat_ns;
    const int64_t away_ns = preempted_ns(job);
    const int64_t compute_ns = job->exec_wall_ns - away_ns;
    const int64_t publish_ns = job->published_ns - job->stepped_ns;
    if (away_ns > largest_ns) {
        largest_ns = away_ns;
        cause = RT_CAUSE_PREEMPTED;
    }
    if (compute_ns > largest_ns) {
        largest_ns = compute_ns;
        cause = RT_CAUSE_LONG_COMPUTE;
    }
    return publish_ns > largest_ns ? RT_CAUSE_BLOCKED_SEND : cause;
}

static void record_job(rt_task *self, const rt_job *job) {
    record(self, job, RT_METRIC_EXEC_WALL, job->exec_wall_ns);
    record(self, job, RT_METRIC_EXEC_CPU, job->exec_cpu_ns);
    record(self, job, RT_METRIC_PREEMPT, preempted_ns(job));
    record(self, job, RT_METRIC_PUBLISH, job->published_ns - job->stepped_ns);
    record(self, job, RT_METRIC_RESP, job->resp_ns);
    if (self->config.virtual_time) {
        return;
    }
    record(self, job, RT_METRIC_WAKE_LAT, job->wake_lat_ns);
    if (self->last_index != 0) {
        const int64_t grid_ns = (int64_t)(job->index - self->last_index) * self->config.period_ns;
        const int64_t dev_ns = job->start_ns - self->last_start_ns - grid_ns;
        record(self, job, RT_METRIC_PERIOD_DEV_ABS, dev_ns < 0 ? -dev_ns : dev_ns);
    }
}

void rt_task_published(rt_task *self, rt_job *job, bool sent, bool stale_input) {
    job->published_ns = self->clock.now_ns(self->clock.ctx);
    job->resp_ns = job->published_ns - job->origin_ns;
    job->miss_late = !self->config.virtual_time && job->resp_ns > self->config.deadline_ns;
    if (job->miss_late) {
        job->cause = largest_part(job);
    } else if (!sent) {
        job->cause = RT_CAUSE_BLOCKED_SEND;
    } else if (stale_input) {
        job->cause = RT_CAUSE_STALE_INPUT;
    }
    self->causes[job->cause]++;
    rt_tally_finish(&self->total, job->miss_late);
    rt_tally_finish(window_tally(self, job->index), job->miss_late);
    record_job(self, job);
}

/* Skips the releases first..last, which may lie on both sides of the end of warm-up. */
static void skip(rt_task *self, uint64_t first, uint64_t last) {
    const uint64_t border = self->config.warmup_releases;
    const uint64_t in_warmup = first > border ? 0 : (last < border ? last : border) - first + 1U;
    const uint64_t count = last - first + 1U;
    rt_tally_skip(&self->total, count);
    rt_tally_skip(&self->warmup, in_warmup);
    rt_tally_skip(&self->judged, count - in_warmup);
}

void rt_task_done(rt_task *self, rt_job *job) {
    job->done_ns = self->clock.now_ns(self->clock.ctx);
    self->last_index = job->index;
    self->last_start_ns = job->start_ns;
    self->next_index = job->index + 1U;
    if (self->config.virtual_time) {
        return;
    }
    const uint64_t before_done = releases_before(self, job->done_ns);
    if (before_done <= job->index) {
        return;
    }
    const uint64_t before_start = releases_before(self, job->start_ns);
    const uint64_t pending = before_start > job->index ? before_start : job->index; /* passed before we even woke */
    rt_tally_overrun(&self->total, before_done - pending);
    rt_tally_overrun(window_tally(self, job->index), before_done - pending);
    skip(self, job->index + 1U, before_done);
    self->next_index = before_done + 1U;
}
