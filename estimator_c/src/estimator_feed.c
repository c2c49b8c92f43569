#include <math.h>
#include <string.h>

#include "estimator_parts.h"

static const int32_t OFF_GRID_LIMIT = 3; /* temperature frames off the grid in a row: the plant moved its grid */
static const double MOVING_RPM = 50.0, MOVING_NM = 5.0;

/* Larger magnitudes are no temperature in degC, torque in Nm or speed in rpm but a broken sender; they would wear off
 * only after a hundred thousand windows. */
static const double ABSURD = 1.0e6;

/* false for NaN too */
static bool usable(double value)
{
    return fabs(value) < ABSURD;
}

/* The unwrapped tick nearest to `near`; ticks more than half the range apart cannot be told from a step back. */
static int64_t unwrap(int64_t near, uint16_t tick16)
{
    return near + (int16_t)(uint16_t)(tick16 - (uint16_t)near);
}

/* Node k's interval covers ticks 10 k + 1 ... 10 k + 10 after the grid tick. */
static int64_t interval_of(const estimator_t *self, int64_t tick)
{
    const int64_t after = tick - self->grid_tick - 1;
    return after >= 0 ? after / ESTIMATOR_TICKS : -((ESTIMATOR_TICKS - 1 - after) / ESTIMATOR_TICKS);
}

/* The plant started again, or so much is missing that the net's memory is worth nothing: begin at this frame. */
static void restart_at(estimator_t *self, uint16_t tick16, bool same_plant)
{
    estimator_restart(self, same_plant);
    self->motor_seen = true;
    self->newest_tick = tick16;
}

/* Unwrap the tick of a motor frame and make it the newest; false: a repeat, nothing to use. */
static bool take_tick(estimator_t *self, uint16_t tick16)
{
    const int64_t most = (int64_t)ESTIMATOR_TICKS * self->setting.max_gap_steps;
    if (!self->motor_seen) {
        const int64_t tick = self->anchored ? unwrap(self->grid_tick, tick16) : tick16;
        if (self->anchored && (tick - self->grid_tick > most || self->grid_tick - tick > most)) {
            self->anchored = false; /* that grid was another run's */
        }
        self->motor_seen = true;
        self->newest_tick = tick;
        return true;
    }
    const int64_t tick = unwrap(self->newest_tick, tick16);
    if (tick == self->newest_tick) {
        self->counters.repeated_ticks++;
        return false;
    }
    const bool jumped = tick < self->newest_tick || tick - self->newest_tick > most;
    /* Frames may pile up while nobody calls estimator_step(); what can be worked off at once is bounded. */
    const bool piled = self->anchored && interval_of(self, tick) - self->next_interval > self->setting.max_gap_steps;
    /* One such frame alone is a replay or a stray sender; two in a row are the plant, started again. */
    if (jumped && !self->tick_jumped) {
        self->tick_jumped = true;
        self->counters.stray_ticks++;
        return false;
    }
    self->tick_jumped = false;
    if (jumped || piled) {
        restart_at(self, tick16, tick >= self->newest_tick);
    } else {
        self->newest_tick = tick;
    }
    return true;
}

void estimator_feed_motor(estimator_t *self, uint16_t tick16, double torque_nm, double speed_rpm, bool valid)
{
    if (!take_tick(self, tick16)) {
        return;
    }
    if (!valid || !usable(torque_nm) || !usable(speed_rpm)) {
        self->counters.invalid_inputs++;
        return;
    }
    if (fabs(speed_rpm) > MOVING_RPM || fabs(torque_nm) > MOVING_NM) {
        offset_calibration_moving(&self->calibration);
    }
    if (!self->anchored || self->newest_tick <= self->grid_tick) {
        self->held_input[0] = speed_rpm; /* should the first interval stay without a frame */
        self->held_input[1] = torque_nm;
        return;
    }
    const int64_t k = interval_of(self, self->newest_tick);
    if (k < self->next_interval) {
        return;
    }
    estimator_bin_t *bin = &self->bin[estimator_slot(k)];
    bin->speed_sum += speed_rpm;
    bin->torque_sum += torque_nm;
    bin->frames++;
}

/* A measurement for node k: into the window if the node is there, else into the ring for when it comes. */
static void place_measurement(estimator_t *self, int64_t k, int channel, double y)
{
    const int64_t newest_node = self->next_interval - self->setting.delay_steps; /* of the MHE, if started */
    if (self->started && k == newest_node && self->awaited[channel]) {
        estimator_finish(self);
        self->awaited[channel] = false;
        estimator_measure(self, channel, y);
        self->measurement_pending = true;
        return;
    }
    if (self->started && k <= newest_node) {
        const double raw = y + self->calibration.result.offset_degc[channel];
        const double innovation = fusion_measure_late(&self->fusion, (int)(newest_node - k), channel, y, raw);
        if (isnan(innovation)) {
            self->counters.late_measurements++;
            return;
        }
        self->innovation[channel] = innovation;
        self->measurement_pending = true;
        return;
    }
    if (k < 0 || k <= newest_node) {
        self->early_sum[channel] += y;
        self->early_count[channel]++;
        return;
    }
    self->measured[estimator_slot(k)][channel] = y;
}

static void forget_early(estimator_t *self)
{
    memset(self->early_sum, 0, sizeof self->early_sum);
    memset(self->early_count, 0, sizeof self->early_count);
}

/* The offset has changed, at a standstill: the window opens anew with the next measurement, nothing from before
 * counts. */
static void reopen(estimator_t *self)
{
    fusion_init(&self->fusion, &self->setting);
    forget_early(self);
    estimator_forget_measured(self);
    memset(self->fallback_left, 0, sizeof self->fallback_left);
    memset(self->awaited, 0, sizeof self->awaited);
    self->measurement_pending = false;
    self->started = false;
}

void estimator_feed_temp(estimator_t *self, uint16_t tick16, double theta_w_degc, double theta_r_degc, bool w_valid,
                         bool r_valid)
{
    const double *offset = self->calibration.result.offset_degc;
    const double y[MHE_CHANNELS] = {theta_w_degc - offset[0], theta_r_degc - offset[1]};
    bool valid[MHE_CHANNELS] = {w_valid && usable(theta_w_degc), r_valid && usable(theta_r_degc)};
    if (!self->started && self->setting.supervise) { /* an open or shorted sensor is no temperature to start from */
        const sensor_monitor_t *monitor = self->fusion.monitor;
        valid[0] = valid[0] && sensor_monitor_in_range(&monitor[0], theta_w_degc);
        valid[1] = valid[1] && sensor_monitor_in_range(&monitor[1], theta_r_degc);
    }
    int64_t tick = self->motor_seen ? unwrap(self->newest_tick, tick16)
                   : self->anchored ? unwrap(self->newest_temp_tick, tick16)
                                    : tick16;

    /* The grid starts with the last temperature frame before the first motor frame that follows it. */
    const bool waiting = !self->anchored || !self->motor_seen || self->newest_tick <= self->grid_tick;
    if (waiting && (!self->anchored || tick != self->newest_temp_tick)) {
        if (self->motor_seen && self->newest_tick - tick > (int64_t)ESTIMATOR_TICKS * self->setting.max_gap_steps) {
            self->counters.late_measurements++; /* no grid begins so far back: all up to now would be one step's work */
            return;
        }
        forget_early(self);
        self->anchored = true;
        self->grid_tick = tick;
    }
    const int64_t after = tick - self->grid_tick;
    const int64_t node = after / ESTIMATOR_TICKS - self->setting.delay_steps;
    if (after < 0 || after % ESTIMATOR_TICKS != 0) {
        self->counters.off_grid++;
        if (++self->off_grid_run >= OFF_GRID_LIMIT) {
            estimator_restart(self, true);
        }
        return;
    }
    /* Far ahead of the motor frames: the ring does not reach that far. A restart follows when motor frames do. */
    if (node - (self->next_interval - self->setting.delay_steps) >= ESTIMATOR_RING) {
        return;
    }
    self->off_grid_run = 0;
    self->newest_temp_tick = tick;
    const double raw[MHE_CHANNELS] = {valid[0] ? theta_w_degc : NAN, valid[1] ? theta_r_degc : NAN};
    if (offset_calibration_measure(&self->calibration, raw)) {
        reopen(self);
        return;
    }
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        if (valid[ch]) {
            self->last_measured_tick[ch] = tick;
            place_measurement(self, node, ch, y[ch]);
        }
    }
}

void estimator_feed_coolant(estimator_t *self, double coolant_degc, bool soaked, bool valid)
{
    offset_calibration_coolant(&self->calibration, valid ? coolant_degc : NAN, soaked && valid);
}

