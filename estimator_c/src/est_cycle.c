#include "est_cycle.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

#include "est_housekeeping.h"

_Static_assert(sizeof(est_cycle) <= 800000, "est_cycle.h says so");

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

/* How long a job waits for its frame, where frames are the releases. */
static int64_t event_timeout_ns(void) {
    return (int64_t)drive_messages[DRIVE_INDEX_TEMP_MEAS].timeout_ms * 1000000;
}

static void set_due(est_cycle *self, int64_t t0_ns) {
    self->event_due_ns = t0_ns + event_timeout_ns();
    est_housekeeping_set_due(self, t0_ns);
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
    self->event_ns = -1;
    set_due(self, config->t0_ns);
    return EST_CYCLE_OK;
}

void est_cycle_on_miss(est_cycle *self, est_on_miss on_miss) {
    self->on_miss = on_miss;
}

void est_cycle_inject(est_cycle *self, const injections *faults) {
    self->faults = *faults;
}

void est_cycle_watch(est_cycle *self, const rt_machine *machine) {
    self->watch.machine = machine;
}

static int64_t now_of(const est_cycle *self) {
    return self->task.clock.now_ns(self->task.clock.ctx);
}

void est_cycle_start_grid(est_cycle *self) {
    const int64_t now_ns = now_of(self);
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

/* The newest of several frames has the job. */
static void note_event(est_cycle *self, int64_t at_ns) {
    if (self->event_ns >= 0) {
        rt_task_event_passed(&self->task, self->event_ns);
    }
    self->event_ns = at_ns;
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
            if (input.id == EST_RX_TEMP_MEAS && self->task.config.on_event) {
                note_event(self, at_ns);
            }
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
    return est_housekeeping_send(self, more, 4);
}

static est_cycle_status publish_timing(est_cycle *self, const rt_job *job, timing_output put_out, bool stale, int64_t now_ns) {
    const timing_job timing = {
        .miss_late = job->miss_late,
        .warmup = job->warmup,
        .stale_input = stale,
        .after_skip = job->after_skip,
        .miss_cause = (uint8_t)job->cause,
        .cut = job->cut,
        .queued = job->queued,
        .output = put_out,
        .release_index = job->index,
        .wake_lat_ns = job->wake_lat_ns,
        .exec_wall_ns = job->exec_wall_ns,
        .exec_cpu_ns = job->exec_cpu_ns,
        .resp_ns = job->resp_ns,
        .canary_ns = job->canary_ns,
        .in_age_ns = {est_bus_in_age_ns(&self->bus, EST_RX_MOTOR_STATE, now_ns),
                      est_bus_in_age_ns(&self->bus, EST_RX_TEMP_MEAS, now_ns)},
    };
    struct canfd_frame frames[TIMING_JOB_FRAMES];
    est_bus_timing(&self->bus, &timing, frames);
    return est_housekeeping_send(self, frames, TIMING_JOB_FRAMES);
}

/* ---- a job ---------------------------------------------------------------------------------------------------------- */

/* What the cycle hands to the solver, which knows no clock. */
typedef struct {
    rt_task *task;
    rt_job *job;
    uint32_t limit; /* replay: time is up at this question; 0: the task knows */
    uint32_t asked;
} budget;

static bool expired(void *ctx) {
    budget *self = ctx;
    if (self->limit > 0) {
        return ++self->asked >= self->limit;
    }
    return rt_task_expired(self->task, self->job);
}

static void make_faults(est_cycle *self, rt_job *job) {
    const rt_clock *clock = &self->task.clock;
    for (uint32_t i = 0; i < self->faults.count; i++) {
        const injection *fault = &self->faults.item[i];
        if (fault->release != job->index) {
            continue;
        }
        const int64_t until_ns = now_of(self) + fault->duration_ns;
        if (fault->kind == INJECTION_SLEEP) {
            (void)clock->sleep_until_ns(clock->ctx, until_ns);
        } else {
            while (now_of(self) < until_ns && !rt_task_expired(&self->task, job)) {
            }
        }
    }
}

static void invalidate(est_output *output) {
    output->status = ESTIMATOR_INVALID;
    output->sweeps = 0;
    output->theta_w_degc = output->theta_r_degc = (double)NAN;
    output->innov_w_degc = output->innov_r_degc = (double)NAN;
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        output->channel[ch].sigma_degc = output->channel[ch].upper_degc = (double)NAN;
    }
}

/* What is put out in place of an estimate that is late already. */
static timing_output stand_in(est_cycle *self, est_on_miss on_miss, const estimator_base_t *base, estimator_out_t *out, bool motor_stale,
                              est_output *output) {
    if (on_miss == EST_ON_MISS_HOLD && self->has_last) {
        *output = self->last_in_time;
        output->innov_w_degc = output->innov_r_degc = (double)NAN;
        return TIMING_OUTPUT_HELD;
    }
    if (on_miss == EST_ON_MISS_PREDICT && estimator_predict(&self->estimator, base, out)) {
        *output = output_of(out, motor_stale);
        return TIMING_OUTPUT_PREDICTED;
    }
    invalidate(output);
    return TIMING_OUTPUT_INVALID;
}

/* What the job puts out if it is late now; EST_ON_MISS_LATE: what it computed. */
static est_on_miss reaction(est_cycle *self, const rt_job *job) {
    static const est_on_miss replayed[] = {[TIMING_OUTPUT_COMPUTED] = EST_ON_MISS_LATE,
                                           [TIMING_OUTPUT_HELD] = EST_ON_MISS_HOLD,
                                           [TIMING_OUTPUT_PREDICTED] = EST_ON_MISS_PREDICT,
                                           [TIMING_OUTPUT_INVALID] = EST_ON_MISS_INVALID};
    if (self->replayed != NULL) {
        return replayed[self->replayed->output];
    }
    const bool late = self->on_miss != EST_ON_MISS_LATE && rt_task_late_now(&self->task, job);
    return late ? self->on_miss : EST_ON_MISS_LATE;
}

static timing_output choose_output(est_cycle *self, const rt_job *job, const estimator_base_t *base, estimator_out_t *out,
                                   est_output *output) {
    const bool motor_stale = est_bus_is_stale(&self->bus, EST_RX_MOTOR_STATE);
    timing_output put_out = TIMING_OUTPUT_COMPUTED;
    *output = output_of(out, motor_stale);
    const est_on_miss on_miss = reaction(self, job);
    if (on_miss != EST_ON_MISS_LATE) {
        put_out = stand_in(self, on_miss, base, out, motor_stale, output);
    } else {
        self->last_in_time = *output;
        self->has_last = true;
    }
    self->output_jobs[put_out]++;
    return put_out;
}

/* `now_ns`: when the inputs are read. In lock-step record time stands still while a job runs; in real time it is when we woke. */
static est_cycle_status run(est_cycle *self, rt_job *job, int64_t now_ns, est_cycle_status read_status) {
    budget left = {&self->task, job, self->replayed != NULL ? self->replayed->sweep_limit : 0, 0};
    estimator_base_t base;
    estimator_out_t out;
    est_output output;
    bool sent = false;
    est_cycle_status status = read_status;
    self->last_release_ns = job->release_ns;
    if (!self->task.config.on_event) {
        self->io.begin(self->io.ctx, now_ns);
        status = read_inputs(self);
    }
    const bool bus_stale = est_bus_stale(&self->bus, now_ns, job->index);
    make_faults(self, job);
    estimator_base(&self->estimator, &base);
    const bool limited = left.limit > 0 || self->task.config.reaction.budget_ns > 0;
    estimator_step_within(&self->estimator, &out, limited ? expired : NULL, &left);
    const bool stale = bus_stale || out.stale_input;
    self->stale_jobs += stale ? 1U : 0U;
    self->calibration = out.calibration;
    rt_task_stepped(&self->task, job);
    const timing_output put_out = choose_output(self, job, &base, &out, &output);
    /* A job that finds the bus gone still ends in good order: every started job is accounted for. */
    const est_cycle_status published = publish(self, &output, &sent);
    rt_task_published(&self->task, job, sent, stale);
    estimator_finish(&self->estimator);
    status = status == EST_CYCLE_OK ? published : status;
    if (status == EST_CYCLE_OK) {
        status = publish_timing(self, job, put_out, stale, now_ns);
    }
    timing_watch_job(&self->watch, job);
    if (status == EST_CYCLE_OK) {
        status = est_housekeeping(self, job);
    }
    rt_task_done(&self->task, job);
    return status;
}

/* Waits for the frame that releases the next job, feeding what comes before it, and opens that job. */
static est_cycle_status open_on_event(est_cycle *self, rt_job *job, est_cycle_status *read_status) {
    *read_status = EST_CYCLE_OK;
    while (self->event_ns < 0 && *read_status == EST_CYCLE_OK) {
        const est_io_status waited = self->io.wait(self->io.ctx, self->event_due_ns);
        if (waited == EST_IO_INTERRUPTED) {
            return EST_CYCLE_INTERRUPTED;
        }
        const int64_t now_ns = now_of(self);
        self->io.begin(self->io.ctx, now_ns);
        *read_status = waited == EST_IO_GONE ? EST_CYCLE_GONE : read_inputs(self);
        if (self->event_ns < 0 && now_ns >= self->event_due_ns) {
            self->event_ns = self->event_due_ns;
        }
    }
    if (self->event_ns < 0) {
        return *read_status;
    }
    const int64_t release_ns = self->event_ns;
    if (rt_task_event(&self->task, job, release_ns) == RT_TASK_STOPPED) {
        return EST_CYCLE_STOPPED;
    }
    self->event_ns = -1;
    self->event_due_ns = release_ns + event_timeout_ns();
    return EST_CYCLE_OK;
}

est_cycle_status est_cycle_wait_and_run(est_cycle *self) {
    rt_job job;
    if (self->task.config.on_event) {
        est_cycle_status read_status = EST_CYCLE_OK;
        const est_cycle_status status = open_on_event(self, &job, &read_status);
        return status == EST_CYCLE_OK ? run(self, &job, job.start_ns, read_status) : status;
    }
    switch (rt_task_wait(&self->task, &job)) {
    case RT_TASK_OK:
        return run(self, &job, job.start_ns, EST_CYCLE_OK);
    case RT_TASK_STOPPED:
        return EST_CYCLE_STOPPED;
    case RT_TASK_INTERRUPTED:
    case RT_TASK_BAD_CONFIG:
    default:
        return EST_CYCLE_INTERRUPTED;
    }
}

est_cycle_status est_cycle_run_released(est_cycle *self) {
    rt_job job;
    rt_task_release(&self->task, &job);
    return run(self, &job, job.release_ns, EST_CYCLE_OK);
}

est_cycle_status est_cycle_run_replayed(est_cycle *self, uint64_t index, int64_t now_ns, const est_replayed *as) {
    rt_job job;
    self->task.next_index = index;
    self->replayed = as;
    rt_task_release(&self->task, &job);
    const est_cycle_status status = run(self, &job, now_ns, EST_CYCLE_OK);
    self->replayed = NULL;
    return status;
}
