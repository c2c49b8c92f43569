#include "est_housekeeping.h"

#include <stddef.h>

_Static_assert((int)EST_CYCLE_FRAMES_PER_JOB <= 11, "send queue of a CAN interface and its controller: more would be lost");

static const int64_t NS_PER_S = 1000000000;
static const int64_t IDENTITY_EVERY_S = 10;
static const int64_t FINAL_PAUSE_NS = 5000000;

void est_housekeeping_set_due(est_cycle *self, int64_t t0_ns) {
    self->next_counters_ns = t0_ns + NS_PER_S;
    self->next_identity_ns = t0_ns;
}

est_cycle_status est_housekeeping_send(est_cycle *self, const struct canfd_frame *frames, size_t count) {
    for (size_t i = 0; i < count; i++) {
        if (self->io.send(self->io.ctx, &frames[i]) == EST_IO_GONE) {
            return EST_CYCLE_GONE;
        }
    }
    return EST_CYCLE_OK;
}

static timing_counters timing_of(const est_cycle *self) {
    timing_counters out;
    timing_watch_counters(&self->watch, &self->task, &out);
    out.held = self->output_jobs[TIMING_OUTPUT_HELD];
    out.predicted = self->output_jobs[TIMING_OUTPUT_PREDICTED];
    out.invalidated = self->output_jobs[TIMING_OUTPUT_INVALID];
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
    const size_t first = EST_COUNTER_FRAMES / 2;
    const est_cycle_status status = est_housekeeping_send(self, frames, first);
    if (status == EST_CYCLE_OK && !self->task.config.virtual_time) { /* what a CAN interface queues is on the wire by then */
        (void)self->task.clock.sleep_until_ns(self->task.clock.ctx, self->task.clock.now_ns(self->task.clock.ctx) + FINAL_PAUSE_NS);
    }
    return status == EST_CYCLE_OK ? est_housekeeping_send(self, &frames[first], EST_COUNTER_FRAMES - first) : status;
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

est_cycle_status est_housekeeping(est_cycle *self, const rt_job *job) {
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
    return est_housekeeping_send(self, frames, count);
}
