#include "ctl_cycle.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

_Static_assert((int)CTL_CYCLE_FRAMES_PER_JOB <= 11, "what a CAN interface and its controller queue");

static const int64_t NS_PER_S = 1000000000;
static const int64_t IDENTITY_EVERY_S = 10;

/* Half a minute on the road, after which the controller starts afresh: pages and caches are warm. */
static void rehearse(controller_t *controller, const char *name, double period_s, const controller_road_t *road) {
    controller_out_t out;
    for (int k = 0; k < 300; k++) {
        controller_feed_estimate(controller, 140.0 + 0.05 * k, 100.0, 0.2, 140.5 + 0.05 * k, true);
        controller_feed_motion(controller, 10.0 * k, 20.0);
        controller_feed_motor(controller, 60.0, 6000.0);
        controller_step(controller, &out);
    }
    (void)controller_init(controller, name, period_s, road); /* succeeded before */
}

static void set_due(ctl_cycle *self, int64_t t0_ns) {
    self->next_counters_ns = t0_ns + NS_PER_S;
    self->next_identity_ns = t0_ns;
}

ctl_cycle_status ctl_cycle_init(ctl_cycle *self, const rt_task_config *config, const rt_clock *clock, const char *name,
                                const controller_road_t *road, const est_io *io, const ctl_identity *identity) {
    const double period_s = (double)config->period_ns * 1e-9;
    memset(self, 0, sizeof *self);
    self->error = controller_init(&self->controller, name, period_s, road);
    if (self->error != CONTROLLER_OK) {
        return CTL_CYCLE_BAD_CONTROLLER;
    }
    rehearse(&self->controller, name, period_s, road);
    if (rt_task_init(&self->task, config, clock) != RT_TASK_OK) {
        return CTL_CYCLE_BAD_PERIOD;
    }
    ctl_bus_init(&self->bus);
    self->io = *io;
    self->identity = *identity;
    set_due(self, config->t0_ns);
    return CTL_CYCLE_OK;
}

void ctl_cycle_start_grid(ctl_cycle *self) {
    const int64_t now_ns = self->task.clock.now_ns(self->task.clock.ctx);
    if (rt_task_start_grid(&self->task, now_ns) == RT_TASK_OK) {
        set_due(self, now_ns);
    }
}

static void take(ctl_cycle *self, const ctl_input *input) {
    switch (input->id) {
    case CTL_RX_MOTOR_STATE:
        controller_feed_motor(&self->controller, input->motor.torque_nm, input->motor.speed_rpm);
        break;
    case CTL_RX_VEHICLE:
        controller_feed_motion(&self->controller, input->vehicle.distance_m, input->vehicle.v_mps);
        self->tick = input->tick;
        break;
    case CTL_RX_ESTIMATE:
        self->estimate = *input;
        self->estimate_new = true;
        break;
    default:
        self->winding = *input;
        self->winding_known = true;
        break;
    }
}

/* Estimate and EstWinding of one job of the estimator are fed as one; a bound of another job is none. */
static void feed_estimate(ctl_cycle *self) {
    if (!self->estimate_new) {
        return;
    }
    const bool together = self->winding_known && self->winding.tick == self->estimate.tick;
    controller_feed_estimate(&self->controller, self->estimate.estimate.theta_w_degc,
                             self->estimate.estimate.theta_r_degc,
                             together ? self->winding.winding.sigma_degc : (double)NAN,
                             together ? self->winding.winding.upper_degc : (double)NAN, self->estimate.estimate.usable);
    self->estimate_new = false;
}

static ctl_cycle_status read_inputs(ctl_cycle *self) {
    struct canfd_frame frame;
    ctl_input input;
    int64_t at_ns = 0;
    for (int i = 0; i < CTL_CYCLE_MAX_FRAMES; i++) {
        const est_io_status status = self->io.recv(self->io.ctx, &frame, &at_ns);
        if (status == EST_IO_SKIPPED) {
            i += EST_IO_SKIP_COST - 1; /* a storm of error frames: read on, within the same budget */
            continue;
        }
        if (status != EST_IO_OK) {
            return status == EST_IO_GONE ? CTL_CYCLE_GONE : CTL_CYCLE_OK;
        }
        if (ctl_bus_accept(&self->bus, &frame, at_ns, &input)) {
            take(self, &input);
        }
    }
    return CTL_CYCLE_OK;
}

/* Sends `count` frames; a full bus loses a frame (counted by the port), a bus that has ended ends the cycle. */
static ctl_cycle_status send_all(ctl_cycle *self, const struct canfd_frame *frames, size_t count) {
    for (size_t i = 0; i < count; i++) {
        if (self->io.send(self->io.ctx, &frames[i]) == EST_IO_GONE) {
            return CTL_CYCLE_GONE;
        }
    }
    return CTL_CYCLE_OK;
}

/* Nothing is known to act on: better said than made up. The plant then drives by itself, under its own rule. */
static bool is_mute(const ctl_cycle *self, const controller_out_t *out) {
    const bool needs_estimate = self->controller.kind != CONTROLLER_NONE;
    return !ctl_bus_is_fresh(&self->bus, CTL_RX_VEHICLE) || (needs_estimate && isnan(out->theta_w_degc));
}

static ctl_cycle_status publish(ctl_cycle *self, const controller_out_t *out, bool *sent) {
    struct canfd_frame frames[CTL_COMMAND_FRAMES];
    const bool mute = is_mute(self, out);
    ctl_bus_command(&self->bus, out, mute, self->tick, frames);
    const est_io_status status = self->io.send(self->io.ctx, &frames[0]);
    *sent = status == EST_IO_OK;
    self->mute_jobs += mute ? 1U : 0U;
    self->commands_sent += *sent ? 1U : 0U;
    self->commands_lost += *sent ? 0U : 1U;
    self->sources[out->source & 3U]++;
    return status == EST_IO_GONE ? CTL_CYCLE_GONE : send_all(self, &frames[1], CTL_COMMAND_FRAMES - 1);
}

static ctl_cycle_status publish_timing(ctl_cycle *self, const rt_job *job, bool stale, int64_t now_ns) {
    const timing_job timing = {
        .miss_late = job->miss_late,
        .warmup = job->warmup,
        .stale_input = stale,
        .after_skip = job->after_skip,
        .cut = job->cut,
        .queued = job->queued,
        .miss_cause = (uint8_t)job->cause,
        .output = TIMING_OUTPUT_COMPUTED,
        .release_index = job->index,
        .wake_lat_ns = job->wake_lat_ns,
        .exec_wall_ns = job->exec_wall_ns,
        .exec_cpu_ns = job->exec_cpu_ns,
        .resp_ns = job->resp_ns,
        .canary_ns = job->canary_ns,
        .in_age_ns = {ctl_bus_in_age_ns(&self->bus, CTL_RX_MOTOR_STATE, now_ns),
                      ctl_bus_in_age_ns(&self->bus, CTL_RX_ESTIMATE, now_ns)},
    };
    struct canfd_frame frames[TIMING_JOB_FRAMES];
    ctl_bus_timing(&self->bus, &timing, frames);
    return send_all(self, frames, TIMING_JOB_FRAMES);
}

void ctl_cycle_watch(ctl_cycle *self, const rt_machine *machine) {
    self->watch.machine = machine;
}

void ctl_cycle_counters(const ctl_cycle *self, ctl_counters *out) {
    ctl_bus_faults faults;
    est_io_counters io;
    timing_counters timing;
    ctl_bus_read_faults(&self->bus, &faults);
    timing_watch_counters(&self->watch, &self->task, &timing);
    self->io.counters(self->io.ctx, &io);
    *out = (ctl_counters){
        .timing = timing,
        .crc_errors = faults.crc_errors,
        .seq_errors = faults.seq_errors,
        .stale_inputs = self->stale_jobs,
        .rx_drops = io.rx_drops,
        .tx_drops = io.tx_drops,
        .rejected = io.rejected + io.error_frames + self->bus.rejected,
        .mute = self->mute_jobs,
        .core = self->controller.counters,
    };
}

ctl_cycle_status ctl_cycle_send_final(ctl_cycle *self) {
    ctl_counters counters;
    struct canfd_frame frames[CTL_COUNTER_FRAMES];
    ctl_cycle_counters(self, &counters);
    for (size_t i = 0; i < CTL_COUNTER_FRAMES; i++) {
        ctl_bus_counter(&self->bus, i, &counters, &frames[i]);
    }
    return send_all(self, frames, CTL_COUNTER_FRAMES);
}

/* The first multiple of `every_ns` on the grid of `due_ns` after `now_ns`. */
static int64_t next_due(int64_t due_ns, int64_t every_ns, int64_t now_ns) {
    return due_ns + ((now_ns - due_ns) / every_ns + 1) * every_ns;
}

/* Begins a round with what is due. Counters are taken once for all of its frames, so that they fit together. */
static void begin_round(ctl_cycle *self, int64_t release_ns) {
    const bool counters_due = release_ns >= self->next_counters_ns;
    const bool identity_due = release_ns >= self->next_identity_ns;
    if (counters_due) {
        self->next_counters_ns = next_due(self->next_counters_ns, NS_PER_S, release_ns);
        ctl_cycle_counters(self, &self->round);
    }
    if (identity_due) {
        self->next_identity_ns = next_due(self->next_identity_ns, IDENTITY_EVERY_S * NS_PER_S, release_ns);
    }
    self->round_next = counters_due ? 0 : CTL_COUNTER_FRAMES;
    self->round_end = CTL_COUNTER_FRAMES + (identity_due ? (size_t)CTL_IDENTITY_FRAMES : 0);
}

static ctl_cycle_status housekeeping(ctl_cycle *self, const rt_job *job) {
    struct canfd_frame frames[CTL_CYCLE_HOUSEKEEPING_FRAMES];
    size_t count = 0;
    if (self->round_next == self->round_end) {
        begin_round(self, job->release_ns);
    }
    for (; count < CTL_CYCLE_HOUSEKEEPING_FRAMES && self->round_next < self->round_end; self->round_next++) {
        if (self->round_next < CTL_COUNTER_FRAMES) {
            ctl_bus_counter(&self->bus, self->round_next, &self->round, &frames[count++]);
        } else {
            ctl_bus_identity(&self->bus, self->round_next - CTL_COUNTER_FRAMES, &self->identity, &frames[count++]);
        }
    }
    return send_all(self, frames, count);
}

/* `now_ns`: when the inputs are read. In lock-step record time stands still while a job runs; in real time it is
 * when we woke. */
static ctl_cycle_status run(ctl_cycle *self, rt_job *job, int64_t now_ns) {
    controller_out_t out;
    bool sent = false;
    self->io.begin(self->io.ctx, now_ns);
    ctl_cycle_status status = read_inputs(self);
    const bool stale = ctl_bus_stale(&self->bus, now_ns);
    self->stale_jobs += stale ? 1U : 0U;
    feed_estimate(self);
    controller_step(&self->controller, &out);
    rt_task_stepped(&self->task, job);
    /* A job that finds the bus gone still ends in good order: every started job is accounted for. */
    const ctl_cycle_status published = publish(self, &out, &sent);
    rt_task_published(&self->task, job, sent, stale);
    status = status == CTL_CYCLE_OK ? published : status;
    if (status == CTL_CYCLE_OK) {
        status = publish_timing(self, job, stale, now_ns);
    }
    timing_watch_job(&self->watch, job);
    if (status == CTL_CYCLE_OK) {
        status = housekeeping(self, job);
    }
    rt_task_done(&self->task, job);
    return status;
}

ctl_cycle_status ctl_cycle_wait_and_run(ctl_cycle *self) {
    rt_job job;
    if (rt_task_wait(&self->task, &job) != RT_TASK_OK) {
        return CTL_CYCLE_INTERRUPTED;
    }
    return run(self, &job, job.start_ns);
}

ctl_cycle_status ctl_cycle_run_released(ctl_cycle *self) {
    rt_job job;
    rt_task_release(&self->task, &job);
    return run(self, &job, job.release_ns);
}

ctl_cycle_status ctl_cycle_run_replayed(ctl_cycle *self, uint64_t index, int64_t now_ns) {
    rt_job job;
    self->task.next_index = index;
    rt_task_release(&self->task, &job);
    return run(self, &job, now_ns);
}
