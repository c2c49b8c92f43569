#include "rt_task.h"

#include <stddef.h>
#include <string.h>

_Static_assert(sizeof(rt_task) <= 650000, "rt_task.h says so");

const char *const rt_metric_name[RT_METRICS] = {
    "wake_lat_us", "exec_wall_us",      "exec_cpu_us",   "preempt_us", "publish_us",
    "resp_us",     "period_dev_abs_us", "period_dev_us", "slack_us",   "canary_us",
};

static bool config_valid(const rt_task_config *config) {
    return config->period_ns > 0 && config->deadline_ns > 0 && config->deadline_ns <= config->period_ns &&
           rt_reaction_valid(&config->reaction, config->deadline_ns) &&
           !(config->on_event && config->reaction.overrun != RT_OVERRUN_SKIP) &&
           config->mk_k <= (uint32_t)RT_MK_WINDOW &&
           (config->mk_m < config->mk_k || (config->mk_m | config->mk_k) == 0);
}

rt_task_status rt_task_init(rt_task *self, const rt_task_config *config, const rt_clock *clock) {
    if (!config_valid(config) || clock->now_ns == NULL || clock->thread_cpu_ns == NULL ||
        (clock->sleep_until_ns == NULL && !config->virtual_time)) {
        return RT_TASK_BAD_CONFIG;
    }
    memset(self, 0, sizeof *self);
    self->config = *config;
    self->clock = *clock;
    self->next_index = 1;
    self->cpu = -1;
    self->canary_ns = -1;
    rt_backlog_init(&self->backlog, config->reaction.queue_limit);
    rt_theft_init(&self->theft);
    rt_tally_init_mk(&self->judged, config->mk_m, config->mk_k);
    return RT_TASK_OK;
}

rt_task_status rt_task_start_grid(rt_task *self, int64_t t0_ns) {
    if (self->total.jobs > 0) {
        return RT_TASK_BAD_CONFIG;
    }
    self->config.t0_ns = t0_ns;
    return RT_TASK_OK;
}

void rt_task_set_canary(rt_task *self, rt_canary_ring *ring, bool conclusive) {
    self->canary = ring;
    self->canary_conclusive = conclusive;
}

/* ---- grid ------------------------------------------------------------------------------------------------------ */

static int64_t release_of(const rt_task *self, uint64_t index) {
    return self->config.t0_ns + self->phase_ns + (int64_t)index * self->config.period_ns;
}

int64_t rt_task_next_release_ns(const rt_task *self) {
    return release_of(self, self->next_index);
}

/* How many releases lie before `at_ns`: the largest n with r_n < at_ns, never less than 0. */
static uint64_t releases_before(const rt_task *self, int64_t at_ns) {
    const int64_t since = at_ns - self->config.t0_ns - self->phase_ns;
    return since <= 0 ? 0 : (uint64_t)((since - 1) / self->config.period_ns);
}

static rt_tally *window_tally(rt_task *self, uint64_t index) {
    return index <= self->config.warmup_releases ? &self->warmup : &self->judged;
}

/* How many of the releases first..first + count - 1 are in warm-up. */
static uint64_t in_warmup(const rt_task *self, uint64_t first, uint64_t count) {
    const uint64_t border = self->config.warmup_releases;
    const uint64_t left = first > border ? 0 : border - first + 1U;
    return left < count ? left : count;
}

bool rt_task_stopped(const rt_task *self) {
    const rt_reaction *reaction = &self->config.reaction;
    return (reaction->stop_total > 0 && self->judged.miss_late + self->judged.miss_skipped >= reaction->stop_total) ||
           (reaction->stop_row > 0 && self->judged.consec_miss_max >= reaction->stop_row);
}

/* ---- a job opens ----------------------------------------------------------------------------------------------- */

static void note_core(rt_task *self) {
    const int cpu = self->clock.cpu != NULL ? self->clock.cpu(self->clock.ctx) : -1;
    self->migrations += self->cpu >= 0 && cpu >= 0 && cpu != self->cpu ? 1U : 0U;
    self->cpu = cpu;
}

static void open_job(rt_task *self, rt_job *job, int64_t release_ns) {
    const int64_t start_ns = self->clock.now_ns(self->clock.ctx);
    memset(job, 0, sizeof *job);
    job->start_ns = start_ns;
    job->start_cpu_ns = self->clock.thread_cpu_ns(self->clock.ctx);
    job->index = self->next_index;
    job->release_ns = release_ns;
    job->warmup = job->index <= self->config.warmup_releases;
    job->after_skip = job->index != self->last_index + 1U;
    job->origin_ns = self->config.virtual_time ? start_ns : release_ns;
    job->wake_lat_ns = self->config.virtual_time ? -1 : start_ns - release_ns;
    job->canary_ns = -1;
    rt_seqlock_begin(&self->version);
    note_core(self);
    if (rt_backlog_first(&self->backlog) != NULL) {
        job->queued = true;
        self->owed_skips = rt_backlog_pop(&self->backlog).skipped_after;
        rt_tally_start_queued(&self->total);
        rt_tally_start_queued(window_tally(self, job->index));
    } else {
        self->seen_index = job->index;
        self->owed_skips = 0;
        rt_tally_start(&self->total);
        rt_tally_start(window_tally(self, job->index));
    }
    rt_seqlock_end(&self->version);
}

rt_task_status rt_task_wait(rt_task *self, rt_job *job) {
    if (self->config.on_event) {
        return RT_TASK_BAD_CONFIG;
    }
    if (rt_task_stopped(self)) {
        return RT_TASK_STOPPED;
    }
    const int64_t release_ns = rt_task_next_release_ns(self);
    if (!self->clock.sleep_until_ns(self->clock.ctx, release_ns)) {
        return RT_TASK_INTERRUPTED;
    }
    open_job(self, job, release_ns);
    return RT_TASK_OK;
}

void rt_task_release(rt_task *self, rt_job *job) {
    open_job(self, job, rt_task_next_release_ns(self));
}

/* ---- a job runs ------------------------------------------------------------------------------------------------ */

bool rt_task_expired(const rt_task *self, rt_job *job) {
    const int64_t budget_ns = self->config.reaction.budget_ns;
    if (budget_ns == 0 || self->config.virtual_time) {
        return false;
    }
    job->cut = self->clock.now_ns(self->clock.ctx) - job->origin_ns >= budget_ns;
    return job->cut;
}

void rt_task_stepped(rt_task *self, rt_job *job) {
    job->stepped_ns = self->clock.now_ns(self->clock.ctx);
    job->exec_wall_ns = job->stepped_ns - job->start_ns;
    job->exec_cpu_ns = self->clock.thread_cpu_ns(self->clock.ctx) - job->start_cpu_ns;
    const int64_t away_ns = job->exec_wall_ns - job->exec_cpu_ns;
    job->preempt_ns = away_ns > 0 ? away_ns : 0; /* the two clocks are read one after the other */
}

bool rt_task_late_now(const rt_task *self, const rt_job *job) {
    return !self->config.virtual_time &&
           self->clock.now_ns(self->clock.ctx) - job->origin_ns > self->config.deadline_ns;
}

static void record(rt_task *self, const rt_job *job, rt_metric metric, int64_t value_ns) {
    rt_stats *stats = job->warmup ? self->warmup_stats : self->stats;
    rt_stats_add(&stats[metric], value_ns, job->index);
    rt_recent_add(&self->recent[metric], job->release_ns, value_ns, job->index);
}

static void record_job(rt_task *self, const rt_job *job) {
    record(self, job, RT_METRIC_EXEC_WALL, job->exec_wall_ns);
    record(self, job, RT_METRIC_EXEC_CPU, job->exec_cpu_ns);
    record(self, job, RT_METRIC_PREEMPT, job->preempt_ns);
    record(self, job, RT_METRIC_PUBLISH, job->published_ns - job->stepped_ns);
    record(self, job, RT_METRIC_RESP, job->resp_ns);
    if (self->config.virtual_time) {
        return;
    }
    record(self, job, RT_METRIC_WAKE_LAT, job->wake_lat_ns);
    record(self, job, RT_METRIC_SLACK, self->config.deadline_ns - job->resp_ns);
    if (self->last_index != 0 && !self->config.on_event) {
        const int64_t grid_ns = (int64_t)(job->index - self->last_index) * self->config.period_ns;
        const int64_t dev_ns = job->start_ns - self->last_start_ns - grid_ns;
        record(self, job, RT_METRIC_PERIOD_DEV, dev_ns);
        record(self, job, RT_METRIC_PERIOD_DEV_ABS, dev_ns < 0 ? -dev_ns : dev_ns);
    }
}

static void hear_canary(rt_task *self, rt_job *job) {
    rt_canary_record heard;
    while (self->canary != NULL && rt_canary_ring_pop(self->canary, &heard)) {
        self->canary_ns = heard.woke_ns - heard.due_ns;
        record(self, job, RT_METRIC_CANARY, self->canary_ns);
        rt_theft_note(&self->theft, heard.due_ns, heard.woke_ns);
    }
    if (self->canary != NULL) { /* overdue, and yet we run: its timer comes later still, as ours did */
        const int64_t due_ns = rt_canary_ring_due(self->canary);
        rt_theft_note(&self->theft, due_ns, due_ns < job->start_ns ? job->start_ns : due_ns);
    }
    job->canary_ns = self->canary_ns;
}

static rt_delay delay_until(const rt_task *self, const rt_job *job, int64_t end_ns) {
    const int64_t waited_ns = self->last_index != 0 ? self->last_done_ns - job->release_ns : 0;
    const int64_t backlog_ns = waited_ns > 0 ? waited_ns : 0;
    const rt_delay delay = {
        .backlog_ns = backlog_ns,
        .wake_ns = job->wake_lat_ns - backlog_ns,
        .away_ns = job->preempt_ns,
        .compute_ns = job->exec_wall_ns - job->preempt_ns,
        .send_ns = end_ns - job->stepped_ns,
        .backlog_cause = self->last_delay,
    };
    return delay;
}

static rt_cause cause_of(rt_task *self, rt_job *job, bool sent, bool stale_input) {
    if (job->miss_late) {
        const rt_delay delay = delay_until(self, job, job->published_ns);
        if (self->canary_conclusive) {
            job->stolen_ns = rt_theft_between(&self->theft, job->release_ns, job->published_ns);
        }
        return rt_cause_late(&delay, job->resp_ns, self->config.deadline_ns, job->stolen_ns);
    }
    return !sent ? RT_CAUSE_BLOCKED_SEND : stale_input ? RT_CAUSE_STALE_INPUT : RT_CAUSE_NONE;
}

void rt_task_published(rt_task *self, rt_job *job, bool sent, bool stale_input) {
    job->published_ns = self->clock.now_ns(self->clock.ctx);
    job->resp_ns = job->published_ns - job->origin_ns;
    job->miss_late = !self->config.virtual_time && job->resp_ns > self->config.deadline_ns;
    rt_seqlock_begin(&self->version);
    hear_canary(self, job);
    job->cause = cause_of(self, job, sent, stale_input);
    self->causes[job->cause]++;
    self->judged_causes[job->cause] += job->miss_late && !job->warmup ? 1U : 0U;
    self->cut_jobs += job->cut ? 1U : 0U;
    rt_tally_finish(&self->total, job->miss_late);
    rt_tally_finish(window_tally(self, job->index), job->miss_late);
    record_job(self, job);
    rt_seqlock_end(&self->version);
}

/* ---- a job ends ------------------------------------------------------------------------------------------------ */

static void skip_counted(rt_task *self, uint64_t first, uint64_t count) {
    const uint64_t early = in_warmup(self, first, count);
    rt_tally_skip_counted(&self->total, count);
    rt_tally_skip_counted(&self->warmup, early);
    rt_tally_skip_counted(&self->judged, count - early);
    self->skipped_causes[self->last_delay] += count;
    self->judged_causes[self->last_delay] += count - early;
}

static void skip_settled(rt_task *self, uint64_t first, uint64_t count) {
    const uint64_t early = in_warmup(self, first, count);
    rt_tally_skip_settled(&self->total, count);
    rt_tally_skip_settled(&self->warmup, early);
    rt_tally_skip_settled(&self->judged, count - early);
}

/* The releases seen_index + 1..newest passed. */
static void queue_up(rt_task *self, uint64_t newest) {
    uint64_t next = self->seen_index + 1U;
    for (; next <= newest && rt_backlog_push(&self->backlog, next); next++) {
        rt_tally_queue(&self->total);
        rt_tally_queue(window_tally(self, next));
    }
    if (next <= newest) {
        rt_backlog_skip(&self->backlog, newest - next + 1U);
        skip_counted(self, next, newest - next + 1U);
    }
}

static void pass(rt_task *self, uint64_t newest, int64_t done_ns) {
    const uint64_t first = self->seen_index + 1U;
    switch (self->config.reaction.overrun) {
    case RT_OVERRUN_QUEUE:
        queue_up(self, newest);
        break;
    case RT_OVERRUN_REBASE:
        self->rebased++;
        self->phase_ns += done_ns - release_of(self, first);
        return; /* they have not passed: they have been put off */
    case RT_OVERRUN_SKIP:
    default:
        skip_counted(self, first, newest - first + 1U);
        skip_settled(self, first, newest - first + 1U);
        break;
    }
    self->seen_index = newest;
}

static void account_for_passed(rt_task *self, const rt_job *job) {
    const uint64_t before_done = releases_before(self, job->done_ns);
    const uint64_t before_start = releases_before(self, job->start_ns);
    const uint64_t idle = before_start > job->index ? before_start : job->index; /* passed before we even woke */
    if (before_done > idle) {
        rt_tally_overrun(&self->total, before_done - idle);
        rt_tally_overrun(window_tally(self, job->index), before_done - idle);
    }
    if (self->owed_skips > 0) {
        skip_settled(self, job->index + 1U, self->owed_skips);
    }
    if (before_done > self->seen_index) {
        pass(self, before_done, job->done_ns);
    }
}

void rt_task_done(rt_task *self, rt_job *job) {
    job->done_ns = self->clock.now_ns(self->clock.ctx);
    rt_seqlock_begin(&self->version);
    if (!self->config.virtual_time) {
        const rt_delay delay = delay_until(self, job, job->done_ns);
        self->last_delay = job->miss_late ? job->cause : rt_cause_largest(&delay);
        if (!self->config.on_event) {
            account_for_passed(self, job);
        }
    }
    self->last_index = job->index;
    self->last_start_ns = job->start_ns;
    self->last_done_ns = job->done_ns;
    const rt_waiting *waiting = rt_backlog_first(&self->backlog);
    self->next_index = waiting != NULL ? waiting->index : self->seen_index + 1U;
    rt_seqlock_end(&self->version);
}

/* ---- tasks on events ------------------------------------------------------------------------------------------- */

static bool hit_while_running(const rt_task *self, int64_t at_ns) {
    return self->last_index != 0 && at_ns >= self->last_start_ns && at_ns < self->last_done_ns;
}

static void note_hit(rt_task *self, int64_t at_ns) {
    if (hit_while_running(self, at_ns)) {
        rt_tally_overrun(&self->total, 1);
        rt_tally_overrun(window_tally(self, self->last_index), 1);
    }
}

rt_task_status rt_task_event(rt_task *self, rt_job *job, int64_t release_ns) {
    if (!self->config.on_event) {
        return RT_TASK_BAD_CONFIG;
    }
    if (rt_task_stopped(self)) {
        return RT_TASK_STOPPED;
    }
    open_job(self, job, release_ns);
    if (!self->config.virtual_time && hit_while_running(self, release_ns)) {
        job->queued = true;
        rt_seqlock_begin(&self->version);
        note_hit(self, release_ns);
        self->total.queued++;
        window_tally(self, job->index)->queued++;
        rt_seqlock_end(&self->version);
    }
    return RT_TASK_OK;
}

void rt_task_event_passed(rt_task *self, int64_t at_ns) {
    rt_seqlock_begin(&self->version);
    note_hit(self, at_ns);
    skip_counted(self, self->next_index, 1);
    skip_settled(self, self->next_index, 1);
    self->seen_index = self->next_index;
    self->next_index++;
    rt_seqlock_end(&self->version);
}

/* ---- another thread -------------------------------------------------------------------------------------------- */

_Static_assert(sizeof(rt_tally) % 8 == 0 && sizeof(rt_stats) % 8 == 0, "copied by words");

static void copy_counters(const rt_task *self, rt_task_counters *out) {
    rt_seqlock_copy(&out->total, &self->total, sizeof out->total);
    rt_seqlock_copy(&out->warmup, &self->warmup, sizeof out->warmup);
    rt_seqlock_copy(&out->judged, &self->judged, sizeof out->judged);
    rt_seqlock_copy(out->causes, self->causes, sizeof out->causes);
    rt_seqlock_copy(out->skipped_causes, self->skipped_causes, sizeof out->skipped_causes);
    rt_seqlock_copy(out->judged_causes, self->judged_causes, sizeof out->judged_causes);
    rt_seqlock_copy(&out->cut_jobs, &self->cut_jobs, sizeof out->cut_jobs);
    rt_seqlock_copy(&out->rebased, &self->rebased, sizeof out->rebased);
    rt_seqlock_copy(&out->phase_ns, &self->phase_ns, sizeof out->phase_ns);
    rt_seqlock_copy(&out->migrations, &self->migrations, sizeof out->migrations);
}

bool rt_task_snapshot(const rt_task *self, rt_metric metric, bool warmup, unsigned tries, rt_task_counters *counters,
                      rt_stats *stats) {
    for (unsigned i = 0; i < tries; i++) {
        const uint64_t look = rt_seqlock_look(&self->version);
        copy_counters(self, counters);
        if (stats != NULL) {
            rt_seqlock_copy(stats, warmup ? &self->warmup_stats[metric] : &self->stats[metric], sizeof *stats);
        }
        if (rt_seqlock_unchanged(&self->version, look)) {
            return true;
        }
    }
    return false;
}
