#include "est_cycle.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

_Static_assert(sizeof(est_cycle) <= 800000, "est_cycle.h says so");
_Static_assert((int)EST_CYCLE_FRAMES_PER_JOB <= 11, "send queue of a CAN interface and its controller: more would be lost");

static const int64_t NS_PER_S = 1000000000;
static const int64_t IDENTITY_EVERY_S = 10;

/* Feeds a minute of made-up driving to the estimator, which then starts afresh: pages and caches are warm. */
static void rehearse(estimator_t *estimator, const est_setting_t *setting) {
    estimator_out_t out;
    for (uint32_t tick = 0; tick < 6000; tick++) {
        estimator_feed_motor(estimator, (uint16_t)tick, 50.0, 5000.0, true);
        if (tick % ESTIMATOR_TICKS == 0) {
            estimator_feed_temp(estimator, (uint16_t)tick, 60.0, 50.0, true, true);
            estimator_step(estimator, &out);
        }
    }
    (void)estimator_init(estimator, setting); /* succeeded before */
}

static void set_due(est_cycle *self, int64_t t0_ns) {
    self->next_counters_ns = t0_ns + NS_PER_S;
    self->next_identity_ns = t0_ns;
}

est_cycle_status est_cycle_init(est_cycle *self, const rt_task_config *config, const rt_clock *clock,
                                const est_setting_t *setting, const est_io *io, const est_identity *identity) {
    memset(self, 0, sizeof *self);
    if (estimator_init(&self->estimator, setting) != ESTIMATOR_OK) {
        return EST_CYCLE_BAD_SETTING;
    }
    rehearse(&self->estimator, setting);
    if (rt_task_init(&self->task, config, clock) != RT_TASK_OK) {
        return EST_CYCLE_BAD_PERIOD;
    }
    est_bus_init(&self->bus);
    self->io = *io;
    self->identity = *identity;
    for (int ch = 0; ch < MHE_CHANNELS; ch++) { /* nothing is known before the first job */
        self->calibration.offset_degc[ch] = self->calibration.sigma_degc[ch] = (double)NAN;
    }
    set_due(self, config->t0_ns);
    return EST_CYCLE_OK;
}

void est_cycle_start_grid(est_cycle *self) {
    const int64_t now_ns = self->task.clock.now_ns(self->task.clock.ctx);
    if (rt_task_start_grid(&self->task, now_ns) == RT_TASK_OK) {
        set_due(self, now_ns);
    }
}

static void feed(estimator_t *estimator, const est_input *input) {
    if (input->id == EST_RX_MOTOR_STATE) {
        estimator_feed_motor(estimator, input->tick, input->motor.torque_nm, input->motor.speed_rpm, input->motor.valid);
    } else if (input->id == EST_RX_TEMP_MEAS) {
        estimator_feed_temp(estimator, input->tick, input->temp.theta_w_degc, input->temp.theta_r_degc,
                            input->temp.valid_w, input->temp.valid_r);
    } else {
        estimator_feed_coolant(estimator, input->coolant.coolant_degc, input->coolant.soaked,
                               input->coolant.valid);
    }
}

static est_cycle_status read_inputs(est_cycle *self) {
    struct canfd_frame frame;
    est_input input;
    int64_t at_ns = 0;
    for (int i = 0; i < EST_CYCLE_MAX_FRAMES; i++) {
        const est_io_status status = self->io.recv(self->io.ctx, &frame, &at_ns);
        if (status == EST_IO_SKIPPED) {
            i += EST_IO_SKIP_COST - 1; /* a storm of error frames: read on, within the same budget */
            continue;
        }
        if (status != EST_IO_OK) {
            return status == EST_IO_GONE ? EST_CYCLE_GONE : EST_CYCLE_OK;
        }
        if (est_bus_accept(&self->bus, &frame, at_ns, &input) == EST_BUS_INPUT) {
            feed(&self->estimator, &input);
        }
    }
    return EST_CYCLE_OK;
}

static bool estimates(estimator_status_t status) {
    return status == ESTIMATOR_RUNNING || status == ESTIMATOR_PREDICTING || status == ESTIMATOR_OPEN_LOOP ||
           status == ESTIMATOR_FALLBACK;
}

static est_output output_of(const estimator_out_t *out, bool motor_stale) {
    estimator_status_t status = out->status;
    if (motor_stale && estimates(status)) {
        status = ESTIMATOR_INPUT_STALE; /* the core knows ticks only; that none comes any more, the bus knows */
    }
    const est_output output = {
        .status = (uint8_t)status,
        .sweeps = (uint8_t)(out->sweeps < 0 ? 0 : out->sweeps > UINT8_MAX ? UINT8_MAX : out->sweeps),
        .tick = out->tick16,
        .theta_w_degc = out->theta_w_degc,
        .theta_r_degc = out->theta_r_degc,
        .innov_w_degc = out->innov_w_degc,
        .innov_r_degc = out->innov_r_degc,
        .validity = out->validity,
        .channel = {out->channel[0], out->channel[1]},
    };
    return output;
}

/* Sends `count` frames; a full bus loses a frame (counted by the port), a bus that has ended ends the cycle. */
static est_cycle_status send_all(est_cycle *self, const struct canfd_frame *frames, size_t count) {
    for (size_t i = 0; i < count; i++) {
        if (self->io.send(self->io.ctx, &frames[i]) == EST_IO_GONE) {
            return EST_CYCLE_GONE;
        }
    }
    return EST_CYCLE_OK;
}

static est_cycle_status publish(est_cycle *self, const est_output *output, bool *sent) {
    struct canfd_frame frame;
    est_bus_estimate(&self->bus, output, &frame);
    const est_io_status status = self->io.send(self->io.ctx, &frame);
    *sent = status == EST_IO_OK;
    self->estimates_sent += *sent ? 1U : 0U;
    self->estimates_lost += *sent ? 0U : 1U;
    self->status_jobs[output->status & 15U]++;
    if (status == EST_IO_GONE) {
        return EST_CYCLE_GONE;
    }
    struct canfd_frame more[4];
    est_bus_innov(&self->bus, output, &more[0]);
    est_bus_validity(&self->bus, output, &more[1]);
    est_bus_winding(&self->bus, output, &more[2]);
    est_bus_rotor(&self->bus, output, &more[3]);
    return send_all(self, more, 4);
}

static est_cycle_status publish_timing(est_cycle *self, const rt_job *job, bool stale, int64_t now_ns) {
    const timing_job timing = {
        .miss_late = job->miss_late,
        .warmup = job->warmup,
        .stale_input = stale,
        .after_skip = job->after_skip,
        .miss_cause = (uint8_t)job->cause,
        .output = TIMING_OUTPUT_COMPUTED,
        .release_index = job->index,
        .wake_lat_ns = job->wake_lat_ns,
        .exec_wall_ns = job->exec_wall_ns,
        .exec_cpu_ns = job->exec_cpu_ns,
        .resp_ns = job->resp_ns,
        .canary_ns = TIMING_NA,
        .in_age_ns = {est_bus_in_age_ns(&self->bus, EST_RX_MOTOR_STATE, now_ns),
                      est_bus_in_age_ns(&self->bus, EST_RX_TEMP_MEAS, now_ns)},
    };
    struct canfd_frame frames[TIMING_JOB_FRAMES];
    est_bus_timing(&self->bus, &timing, frames);
    return send_all(self, frames, TIMING_JOB_FRAMES);
}

static timing_stat stat_of(const rt_stats *stats) {
    enum { P99 = 9900 };
    timing_stat out = {TIMING_NA, stats->count > 0 ? stats->max_ns : TIMING_NA};
    if (rt_stats_quantile(stats, P99, &out.p99_ns) == RT_QUANTILE_NA) {
        out.p99_ns = TIMING_NA;
    }
    return out;
}

static timing_counters timing_of(const est_cycle *self) {
    const rt_tally *tally = &self->task.total;
    const rt_stats *stats = self->task.stats;
    const timing_counters out = {
        .releases = tally->releases,
        .jobs = tally->jobs,
        .miss_late = tally->miss_late,
        .miss_skipped = tally->miss_skipped,
        .overrun = tally->overrun,
        .consec_miss_max = tally->consec_miss_max,
        .mk_worst = tally->mk_worst,
        .run_delay_ns = TIMING_NA,
        .steal_ns = TIMING_NA,
        .canary = {TIMING_NA, TIMING_NA},
        .wake = stat_of(&stats[RT_METRIC_WAKE_LAT]),
        .exec = stat_of(&stats[RT_METRIC_EXEC_WALL]),
        .resp = stat_of(&stats[RT_METRIC_RESP]),
    };
    return out;
}

void est_cycle_counters(const est_cycle *self, est_counters *out) {
    est_bus_faults faults;
    est_io_counters io;
    est_bus_read_faults(&self->bus, &faults);
    self->io.counters(self->io.ctx, &io);
    const estimator_counters_t *core = &self->estimator.counters;
    const est_counters counters = {
        .timing = timing_of(self),
        .crc_errors = faults.crc_errors,
        .seq_errors = faults.seq_errors,
        .stale_inputs = self->stale_jobs,
        .rx_drops = io.rx_drops,
        .tx_drops = io.tx_drops,
        .rejected = io.rejected + io.error_frames + faults.rejected,
        .restarts = core->restarts,
        .held_intervals = core->held_intervals,
        .late_measurements = core->late_measurements,
        .stray_ticks = core->stray_ticks,
        .off_grid = core->off_grid,
        .invalid_inputs = core->invalid_inputs,
        .unconverged = core->unconverged,
        .repeated_ticks = core->repeated_ticks,
        .calibration = self->calibration,
    };
    *out = counters;
}

est_cycle_status est_cycle_send_final(est_cycle *self) {
    est_counters counters;
    struct canfd_frame frames[EST_COUNTER_FRAMES];
    est_cycle_counters(self, &counters);
    for (size_t i = 0; i < EST_COUNTER_FRAMES; i++) {
        est_bus_counter(&self->bus, i, &counters, &frames[i]);
    }
    return send_all(self, frames, EST_COUNTER_FRAMES);
}

/* The first multiple of `every_ns` on the grid of `due_ns` after `now_ns`. */
static int64_t next_due(int64_t due_ns, int64_t every_ns, int64_t now_ns) {
    return due_ns + ((now_ns - due_ns) / every_ns + 1) * every_ns;
}

/* Begins a round with what is due. Counters are taken once for all of its frames, so that they fit together. */
static void begin_round(est_cycle *self, int64_t release_ns) {
    const bool counters_due = release_ns >= self->next_counters_ns;
    const bool identity_due = release_ns >= self->next_identity_ns;
    if (counters_due) {
        self->next_counters_ns = next_due(self->next_counters_ns, NS_PER_S, release_ns);
        est_cycle_counters(self, &self->round);
    }
    if (identity_due) {
        self->next_identity_ns = next_due(self->next_identity_ns, IDENTITY_EVERY_S * NS_PER_S, release_ns);
    }
    self->round_next = counters_due ? 0 : EST_COUNTER_FRAMES;
    self->round_end = EST_COUNTER_FRAMES + (identity_due ? (size_t)EST_IDENTITY_FRAMES : 0);
}

static est_cycle_status housekeeping(est_cycle *self, const rt_job *job) {
    struct canfd_frame frames[EST_CYCLE_HOUSEKEEPING_FRAMES];
    size_t count = 0;
    if (self->round_next == self->round_end) {
        begin_round(self, job->release_ns);
    }
    for (; count < EST_CYCLE_HOUSEKEEPING_FRAMES && self->round_next < self->round_end; self->round_next++) {
        if (self->round_next < EST_COUNTER_FRAMES) {
            est_bus_counter(&self->bus, self->round_next, &self->round, &frames[count++]);
        } else {
            est_bus_identity(&self->bus, self->round_next - EST_COUNTER_FRAMES, &self->identity, &frames[count++]);
        }
    }
    return send_all(self, frames, count);
}

/* `now_ns`: when the inputs are read. In lock-step record time stands still while a job runs; in real time it is when we woke. */
static est_cycle_status run(est_cycle *self, rt_job *job, int64_t now_ns) {
    estimator_out_t out;
    bool sent = false;
    self->io.begin(self->io.ctx, now_ns);
    est_cycle_status status = read_inputs(self);
    const bool bus_stale = est_bus_stale(&self->bus, now_ns, job->index);
    estimator_step(&self->estimator, &out);
    const bool stale = bus_stale || out.stale_input;
    self->stale_jobs += stale ? 1U : 0U;
    self->calibration = out.calibration;
    const est_output output = output_of(&out, est_bus_is_stale(&self->bus, EST_RX_MOTOR_STATE));
    rt_task_stepped(&self->task, job);
    /* A job that finds the bus gone still ends in good order: every started job is accounted for. */
    const est_cycle_status published = publish(self, &output, &sent);
    rt_task_published(&self->task, job, sent, stale);
    estimator_finish(&self->estimator);
    status = status == EST_CYCLE_OK ? published : status;
    if (status == EST_CYCLE_OK) {
        status = publish_timing(self, job, stale, now_ns);
    }
    if (status == EST_CYCLE_OK) {
        status = housekeeping(self, job);
    }
    rt_task_done(&self->task, job);
    return status;
}

est_cycle_status est_cycle_wait_and_run(est_cycle *self) {
    rt_job job;
    if (rt_task_wait(&self->task, &job) != RT_TASK_OK) {
        return EST_CYCLE_INTERRUPTED;
    }
    return run(self, &job, job.start_ns);
}

est_cycle_status est_cycle_run_released(est_cycle *self) {
    rt_job job;
    rt_task_release(&self->task, &job);
    return run(self, &job, job.release_ns);
}

est_cycle_status est_cycle_run_replayed(est_cycle *self, uint64_t index, int64_t now_ns) {
    rt_job job;
    self->task.next_index = index;
    rt_task_release(&self->task, &job);
    return run(self, &job, now_ns);
}
