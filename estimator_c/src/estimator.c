#include "estimator.h"

#include <math.h>
#include <string.h>

#define RING_MASK (ESTIMATOR_RING - 1)
#define OFF_GRID_LIMIT 3 /* that many temperature frames off the grid in a row mean the plant moved its grid */

/* A channel that gives nothing for so many intervals after the first node must not keep back the other's estimate. */
#define START_WAIT 20
#define FALLBACK_WEIGHT 0.01 /* of a made-up prior: one measurement weighs a thousand times more */

/* K^2: of a start from a measurement (the net's memory has yet to fill), and of one from nothing. */
static const double KNOWN_VARIANCE = 10.0, UNKNOWN_VARIANCE = 900.0;
static const double MOVING_RPM = 50.0, MOVING_NM = 5.0;
static const double UPPER_SIGMA = 3.0;
static const double MODEL_VARIANCE = 0.01; /* K^2: a plant that is not quite the one the net knows, see docs/estimator.md */
static const double START_VARIANCE = 0.09; /* the same while the net's memory is still filling */
static const int32_t START_STEPS = 200;
static const double MARGIN_DEGC_S = 0.05; /* of the upper bound, without a trusted sensor */
static const double MARGIN_MAX_DEGC = 10.0;

/* Larger magnitudes are no temperature in degC, torque in Nm or speed in rpm but a broken sender; they would wear off
 * only after a hundred thousand windows. */
#define ABSURD 1.0e6

/* false for NaN too */
static bool usable(double value)
{
    return fabs(value) < ABSURD;
}

static size_t slot(int64_t k)
{
    return (size_t)(k & RING_MASK);
}

/* Everything but the setting, the counters and the sensors' offset back to the beginning. */
static void forget(estimator_t *self)
{
    const est_setting_t setting = self->setting;
    const estimator_counters_t counters = self->counters;
    const offset_calibration_t calibration = self->calibration;
    const bool invalid_pending = self->invalid_pending;
    memset(self, 0, sizeof *self);
    self->setting = setting;
    self->counters = counters;
    self->calibration = calibration;
    self->invalid_pending = invalid_pending;
    fusion_init(&self->fusion, &self->setting);
    validity_init(&self->validity);
    for (int k = 0; k < ESTIMATOR_RING; k++) {
        self->measured[k][0] = NAN;
        self->measured[k][1] = NAN;
    }
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        self->innovation[ch] = NAN;
        self->resume_degc[ch] = NAN;
        self->last_measured_tick[ch] = INT64_MIN / 2; /* never */
    }
}

/* Begin again, the same plant: what is known of the sensors stays known. */
static void restart(estimator_t *self)
{
    sensor_monitor_t monitor[MHE_CHANNELS];
    memcpy(monitor, self->fusion.monitor, sizeof monitor);
    const bool started = self->started;
    double last[MHE_CHANNELS] = {self->theta[0], self->theta[1]};
    self->counters.restarts++;
    forget(self);
    for (int ch = 0; ch < MHE_CHANNELS && started; ch++) {
        if (!monitor[ch].trusted) {
            self->fusion.monitor[ch] = monitor[ch];
            self->resume_degc[ch] = last[ch];
        }
    }
}

estimator_error_t estimator_init(estimator_t *self, const est_setting_t *setting)
{
    memset(self, 0, sizeof *self);
    if (setting->delay_steps < 0 || setting->max_gap_steps < 1 ||
        setting->delay_steps + setting->max_gap_steps + MHE_NODES > ESTIMATOR_RING || setting->max_sweeps < 1) {
        return ESTIMATOR_BAD_SETTING;
    }
    self->setting = *setting;
    offset_calibration_init(&self->calibration, setting->offset_degc, setting->offset_sigma_degc, setting->delay_steps,
                            setting->key_on_calibration);
    forget(self);
    return ESTIMATOR_OK;
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
    if (same_plant) {
        restart(self);
    } else {
        self->counters.restarts++;
        forget(self);
    }
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
    estimator_bin_t *bin = &self->bin[slot(k)];
    bin->speed_sum += speed_rpm;
    bin->torque_sum += torque_nm;
    bin->frames++;
}

/* A channel without any measurement starts at the other's temperature. Held firmly there while nothing else speaks for it
 * (a problem with nothing to hold it converges slowly); but this prior says little, so that from the first measurement on,
 * until a window is full of them, it weighs next to nothing. */
static void fall_back(estimator_t *self, int ch)
{
    self->fallback_left[ch] = MHE_NODES;
    self->fusion.mhe.weight_prior[ch] = self->setting.weight_arrival[ch];
}

static void fallback_measured(estimator_t *self, int ch)
{
    const bool last = --self->fallback_left[ch] == 0;
    self->fusion.mhe.weight_prior[ch] = last ? self->setting.weight_prior[ch] : FALLBACK_WEIGHT;
    self->fusion.mhe.weight_arrival[ch] = last ? self->setting.weight_arrival[ch] : FALLBACK_WEIGHT;
}

/* A measurement for the newest node. */
static void measure(estimator_t *self, int channel, double y)
{
    const double raw = y + self->calibration.result.offset_degc[channel];
    self->innovation[channel] = fusion_measure(&self->fusion, channel, y, raw, &self->innovation_variance[channel]);
    if (self->fallback_left[channel] > 0) {
        fallback_measured(self, channel);
    }
}

/* A measurement for node k: into the window if the node is there, else into the ring for when it comes. */
static void place_measurement(estimator_t *self, int64_t k, int channel, double y)
{
    const int64_t newest_node = self->next_interval - self->setting.delay_steps; /* of the MHE, if started */
    if (self->started && k == newest_node && self->awaited[channel]) {
        estimator_finish(self);
        self->awaited[channel] = false;
        measure(self, channel, y);
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
    self->measured[slot(k)][channel] = y;
}

/* The offset has changed, at a standstill: the window opens anew with the next measurement, nothing from before counts. */
static void reopen(estimator_t *self)
{
    fusion_init(&self->fusion, &self->setting);
    memset(self->early_sum, 0, sizeof self->early_sum);
    memset(self->early_count, 0, sizeof self->early_count);
    for (int k = 0; k < ESTIMATOR_RING; k++) {
        self->measured[k][0] = NAN;
        self->measured[k][1] = NAN;
    }
    memset(self->fallback_left, 0, sizeof self->fallback_left);
    memset(self->awaited, 0, sizeof self->awaited);
    self->measurement_pending = false;
    self->started = false;
}

static bool in_range(const estimator_t *self, double raw)
{
    return raw >= self->setting.range_low_degc && raw <= self->setting.range_high_degc;
}

void estimator_feed_temp(estimator_t *self, uint16_t tick16, double theta_w_degc, double theta_r_degc, bool w_valid,
                         bool r_valid)
{
    const double *offset = self->calibration.result.offset_degc;
    const double y[MHE_CHANNELS] = {theta_w_degc - offset[0], theta_r_degc - offset[1]};
    bool valid[MHE_CHANNELS] = {w_valid && usable(theta_w_degc), r_valid && usable(theta_r_degc)};
    if (!self->started && self->setting.supervise) { /* an open or shorted sensor is no temperature to start from */
        valid[0] = valid[0] && in_range(self, theta_w_degc);
        valid[1] = valid[1] && in_range(self, theta_r_degc);
    }
    int64_t tick = self->motor_seen ? unwrap(self->newest_tick, tick16)
                   : self->anchored ? unwrap(self->newest_temp_tick, tick16)
                                    : tick16;

    /* The grid starts with the last temperature frame before the first motor frame that follows it. */
    const bool waiting = !self->anchored || !self->motor_seen || self->newest_tick <= self->grid_tick;
    if (waiting && (!self->anchored || tick != self->newest_temp_tick)) {
        if (self->motor_seen && self->newest_tick - tick > (int64_t)ESTIMATOR_TICKS * self->setting.max_gap_steps) {
            self->counters.late_measurements++; /* so far back no grid may begin: all up to now would be one step's work */
            return;
        }
        memset(self->early_sum, 0, sizeof self->early_sum);
        memset(self->early_count, 0, sizeof self->early_count);
        self->anchored = true;
        self->grid_tick = tick;
    }
    const int64_t after = tick - self->grid_tick;
    const int64_t node = after / ESTIMATOR_TICKS - self->setting.delay_steps;
    if (after < 0 || after % ESTIMATOR_TICKS != 0) {
        self->counters.off_grid++;
        if (++self->off_grid_run >= OFF_GRID_LIMIT) {
            restart(self);
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

/* Close interval k: the mean of its frames, or the last input held. */
static void close_interval(estimator_t *self, int64_t k, bool *stale)
{
    estimator_bin_t *bin = &self->bin[slot(k)];
    self->newest_held = bin->frames == 0;
    if (bin->frames > 0) {
        self->held_input[0] = bin->speed_sum / bin->frames;
        self->held_input[1] = bin->torque_sum / bin->frames;
    } else {
        self->counters.held_intervals++;
        *stale = true;
    }
    memcpy(self->input[slot(k)], self->held_input, sizeof self->held_input);
    *bin = (estimator_bin_t){0};
}

/* Open the MHE's window at node k once each channel has a measurement to start from, or one of them and a long wait. */
static bool start_at(estimator_t *self, int64_t k)
{
    double prior[MHE_CHANNELS];
    int known = 0;
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        const double now = self->measured[slot(k)][ch];
        prior[ch] = self->early_count[ch] > 0 ? self->early_sum[ch] / self->early_count[ch] : now;
        known += !isnan(prior[ch]);
    }
    if (known == 0 || (known < MHE_CHANNELS && k < START_WAIT)) {
        return false;
    }
    double variance[MHE_CHANNELS];
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        const double measured = prior[ch];
        variance[ch] = KNOWN_VARIANCE;
        if (isnan(prior[ch])) {
            prior[ch] = prior[1 - ch];
            variance[ch] = UNKNOWN_VARIANCE;
            fall_back(self, ch);
        }
        if (isfinite(self->resume_degc[ch])) { /* its sensor is not believed: go on from the last estimate */
            prior[ch] = self->resume_degc[ch];
            variance[ch] = isnan(measured) ? UNKNOWN_VARIANCE : KNOWN_VARIANCE;
        }
    }
    double memory[NET_MEMORY] = {0};
    double rate[MHE_CHANNELS];
    double tape[NET_TAPE];
    /* With delay 0 the interval after node k is not known yet; the one before it is the nearest there is. */
    const int64_t first = self->setting.delay_steps > 0 ? k : k - 1;
    for (int step = 0; step < self->setting.spin_up_steps && first >= 0; step++) {
        net_forward(self->input[slot(first)], prior, memory, memory, rate, tape);
    }
    fusion_start(&self->fusion, prior, variance, memory);
    self->started = true;
    return true;
}

/* The window could not open at node k: what was measured there counts for the prior of a later one. */
static void keep_early(estimator_t *self, int64_t k)
{
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        const double y = self->measured[slot(k)][ch];
        if (!isnan(y)) {
            self->early_sum[ch] += y;
            self->early_count[ch]++;
            self->measured[slot(k)][ch] = NAN;
        }
    }
}

/* Move the pending measurements of node k into the window. */
static void measure_newest(estimator_t *self, int64_t k)
{
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        const double y = self->measured[slot(k)][ch];
        self->measured[slot(k)][ch] = NAN;
        self->awaited[ch] = isnan(y);
        if (!isnan(y)) {
            measure(self, ch, y);
        }
    }
}

/* The newest node's measurement has not come until the next one is due: now it counts as missing. */
static void give_up_waiting(estimator_t *self)
{
    for (int ch = 0; ch < MHE_CHANNELS && self->started; ch++) {
        if (self->awaited[ch]) {
            double variance;
            (void)fusion_measure(&self->fusion, ch, NAN, NAN, &variance);
            self->awaited[ch] = false;
        }
    }
}

void estimator_finish(estimator_t *self)
{
    self->counters.unconverged += fusion_finish(&self->fusion) == MHE_MAX_SWEEPS;
}

/* The estimate at the delayed node, then the net forward to node `now` with the stored inputs. */
static void solve(estimator_t *self, int64_t now, estimator_out_t *out)
{
    fusion_estimate_t estimate;
    double rate[MHE_CHANNELS];
    double tape[NET_TAPE];
    double sum = 0.0;

    fusion_solve(&self->fusion, &estimate);
    self->measurement_pending = false;
    self->counters.unconverged += estimate.status == MHE_MAX_SWEEPS;
    out->sweeps = estimate.sweeps > out->sweeps ? estimate.sweeps : out->sweeps;
    out->kkt_degc = estimate.kkt_degc;
    memcpy(self->theta, estimate.theta, sizeof self->theta);
    memcpy(self->memory, estimate.memory, sizeof self->memory);
    for (int64_t k = now - self->setting.delay_steps; k < now; k++) {
        net_forward(self->input[slot(k)], self->theta, self->memory, self->memory, rate, tape);
        for (int ch = 0; ch < MHE_CHANNELS; ch++) {
            self->theta[ch] += NET_DT_S * rate[ch];
        }
    }
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        self->variance[ch] = estimate.variance[ch];
        sum += self->theta[ch] + self->variance[ch];
    }
    if (!estimate.usable || !isfinite(sum)) {
        self->invalid_pending = true;
        restart(self);
    }
}

/* Interval k is over: one step of the net's rate, whatever the loop's period. */
static void consume_interval(estimator_t *self, estimator_out_t *out)
{
    const int64_t k = self->next_interval;
    estimator_finish(self); /* several intervals in one step: each begins from a finished solution */
    give_up_waiting(self);
    close_interval(self, k, &out->stale_input);
    self->next_interval = k + 1;
    out->intervals++;
    if (self->started) {
        validity_step(&self->validity, self->input[slot(k)], self->theta); /* as the net is fed for interval k */
        self->novelty[slot(k)] = self->validity.result.novelty;
    }

    const int64_t node = k + 1 - self->setting.delay_steps;
    if (!self->started) {
        if (node < 0) {
            return;
        }
        if (!start_at(self, node)) {
            keep_early(self, node);
            return;
        }
    } else {
        fusion_advance(&self->fusion, self->input[slot(node - 1)]);
        fusion_doubt(&self->fusion, self->novelty[slot(node - 1)]);
    }
    measure_newest(self, node);
    solve(self, k + 1, out);
}

/* The estimate at the newest motor frame: the grid node's, moved by the rate for the frames since. */
static void publish_theta(const estimator_t *self, estimator_out_t *out)
{
    const int64_t since = self->newest_tick - self->grid_tick - ESTIMATOR_TICKS * self->next_interval;
    double theta[MHE_CHANNELS] = {self->theta[0], self->theta[1]};
    if (since > 0) {
        const estimator_bin_t *bin = &self->bin[slot(self->next_interval)];
        double input[2] = {self->held_input[0], self->held_input[1]};
        double memory[NET_MEMORY];
        double rate[MHE_CHANNELS];
        double tape[NET_TAPE];
        if (bin->frames > 0) {
            input[0] = bin->speed_sum / bin->frames;
            input[1] = bin->torque_sum / bin->frames;
        }
        net_forward(input, theta, self->memory, memory, rate, tape);
        for (int ch = 0; ch < MHE_CHANNELS; ch++) {
            theta[ch] += rate[ch] * ESTIMATOR_TICK_S * (double)since;
        }
    }
    out->theta_w_degc = theta[0];
    out->theta_r_degc = theta[1];
}

static double distrusted_s(const sensor_monitor_t *monitor)
{
    return monitor->trusted ? 0.0 : NET_DT_S * monitor->distrusted_steps;
}

/* What is said of a channel beside its estimate. The bound grows from the moment its sensor is distrusted. */
static estimator_channel_t channel_now(const estimator_t *self, int ch, double theta_degc)
{
    const sensor_monitor_t *monitor = &self->fusion.monitor[ch];
    const double sigma = sqrt(self->variance[ch]);
    const double offset_sigma = self->calibration.result.sigma_degc[ch];
    const double model = self->fusion.steps < START_STEPS ? START_VARIANCE : MODEL_VARIANCE;
    const double margin = fmin(MARGIN_MAX_DEGC, MARGIN_DEGC_S * distrusted_s(monitor));
    return (estimator_channel_t){
        .fault = monitor->fault,
        .trusted = monitor->trusted && self->fusion.share[ch] > 0.0,
        .sigma_degc = sigma,
        .upper_degc = theta_degc + UPPER_SIGMA * sqrt(self->variance[ch] + model + offset_sigma * offset_sigma) + margin,
        .innov_sigma_degc = isnan(self->innovation[ch]) ? NAN : sqrt(self->innovation_variance[ch]),
    };
}

static estimator_status_t status_now(const estimator_t *self)
{
    if (!self->started) {
        return self->anchored && self->motor_seen ? ESTIMATOR_STARTING : ESTIMATOR_INIT;
    }
    /* Temperature frames that run ahead show that motor frames have stopped. */
    if (self->newest_held || self->newest_temp_tick - self->newest_tick > 2 * ESTIMATOR_TICKS) {
        return ESTIMATOR_INPUT_STALE;
    }
    bool distrusted = false;
    bool open_loop = false;
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        const sensor_monitor_t *monitor = &self->fusion.monitor[ch];
        const double age_s = ESTIMATOR_TICK_S * (double)(self->newest_tick - self->last_measured_tick[ch]);
        distrusted = distrusted || age_s > self->setting.sensor_timeout_s || !monitor->trusted;
        open_loop = open_loop || distrusted_s(monitor) > self->setting.open_loop_s;
    }
    if (self->fusion.fallback) {
        return ESTIMATOR_FALLBACK;
    }
    return open_loop ? ESTIMATOR_OPEN_LOOP : distrusted ? ESTIMATOR_PREDICTING : ESTIMATOR_RUNNING;
}

void estimator_step(estimator_t *self, estimator_out_t *out)
{
    *out = (estimator_out_t){
        .theta_w_degc = NAN, .theta_r_degc = NAN, .innov_w_degc = NAN, .innov_r_degc = NAN, .kkt_degc = NAN,
        .tick = self->newest_tick, .tick16 = (uint16_t)self->newest_tick};
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        out->channel[ch] = (estimator_channel_t){.sigma_degc = NAN, .upper_degc = NAN, .innov_sigma_degc = NAN};
    }
    while (self->anchored && self->motor_seen &&
           self->newest_tick >= self->grid_tick + ESTIMATOR_TICKS * (self->next_interval + 1)) {
        consume_interval(self, out);
    }
    if (self->measurement_pending && self->started) {
        estimator_finish(self);
        solve(self, self->next_interval, out);
    }
    if (self->started) {
        publish_theta(self, out);
        out->channel[0] = channel_now(self, 0, out->theta_w_degc);
        out->channel[1] = channel_now(self, 1, out->theta_r_degc);
    }
    out->calibration = self->calibration.result;
    out->status = self->invalid_pending ? ESTIMATOR_INVALID : status_now(self);
    self->invalid_pending = false;
    out->stale_input |= out->status == ESTIMATOR_INPUT_STALE;
    out->validity = self->validity.result;
    out->innov_w_degc = self->innovation[0];
    out->innov_r_degc = self->innovation[1];
    self->innovation[0] = NAN;
    self->innovation[1] = NAN;
}
