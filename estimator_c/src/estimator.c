#include "estimator.h"

#include <math.h>
#include <string.h>

#include "estimator_parts.h"

/* A channel that gives nothing for so many intervals after the first node must not keep back the other's estimate. */
static const int64_t START_WAIT = 20;
static const double FALLBACK_WEIGHT = 0.01; /* of a made-up prior: one measurement weighs a thousand times more */

/* K^2: of a start from a measurement (the net's memory has yet to fill), and of one from nothing. */
static const double KNOWN_VARIANCE = 10.0, UNKNOWN_VARIANCE = 900.0;

void estimator_forget_measured(estimator_t *self)
{
    for (int k = 0; k < ESTIMATOR_RING; k++) {
        self->measured[k][0] = NAN;
        self->measured[k][1] = NAN;
    }
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
    estimator_forget_measured(self);
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        self->innovation[ch] = NAN;
        self->resume_degc[ch] = NAN;
        self->last_measured_tick[ch] = INT64_MIN / 2; /* never */
    }
}

void estimator_restart(estimator_t *self, bool same_plant)
{
    sensor_monitor_t monitor[MHE_CHANNELS];
    memcpy(monitor, self->fusion.monitor, sizeof monitor);
    const bool known = same_plant && self->started;
    const double last[MHE_CHANNELS] = {self->theta[0], self->theta[1]};
    self->counters.restarts++;
    forget(self);
    for (int ch = 0; ch < MHE_CHANNELS && known; ch++) {
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

/* A channel without any measurement starts at the other's temperature. Held firmly there while nothing else speaks for
 * it (a problem with nothing to hold it converges slowly); but this prior says little, so that from the first
 * measurement on, until a window is full of them, it weighs next to nothing. */
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

void estimator_measure(estimator_t *self, int channel, double y)
{
    const double raw = y + self->calibration.result.offset_degc[channel];
    self->innovation[channel] = fusion_measure(&self->fusion, channel, y, raw, &self->innovation_variance[channel]);
    if (self->fallback_left[channel] > 0) {
        fallback_measured(self, channel);
    }
}

/* Close interval k: the mean of its frames, or the last input held. */
static void close_interval(estimator_t *self, int64_t k, bool *stale)
{
    estimator_bin_t *bin = &self->bin[estimator_slot(k)];
    self->newest_held = bin->frames == 0;
    if (bin->frames > 0) {
        self->held_input[0] = bin->speed_sum / bin->frames;
        self->held_input[1] = bin->torque_sum / bin->frames;
    } else {
        self->counters.held_intervals++;
        *stale = true;
    }
    memcpy(self->input[estimator_slot(k)], self->held_input, sizeof self->held_input);
    *bin = (estimator_bin_t){0};
}

/* Open the MHE's window at node k once each channel has a measurement to start from, or one of them and a long wait. */
static bool start_at(estimator_t *self, int64_t k)
{
    double prior[MHE_CHANNELS];
    int known = 0;
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        const double now = self->measured[estimator_slot(k)][ch];
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
        net_forward(self->input[estimator_slot(first)], prior, memory, memory, rate, tape);
    }
    fusion_start(&self->fusion, prior, variance, memory);
    self->started = true;
    return true;
}

/* The window could not open at node k: what was measured there counts for the prior of a later one. */
static void keep_early(estimator_t *self, int64_t k)
{
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        const double y = self->measured[estimator_slot(k)][ch];
        if (!isnan(y)) {
            self->early_sum[ch] += y;
            self->early_count[ch]++;
            self->measured[estimator_slot(k)][ch] = NAN;
        }
    }
}

/* Move the pending measurements of node k into the window. */
static void measure_newest(estimator_t *self, int64_t k)
{
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        const double y = self->measured[estimator_slot(k)][ch];
        self->measured[estimator_slot(k)][ch] = NAN;
        self->awaited[ch] = isnan(y);
        if (!isnan(y)) {
            estimator_measure(self, ch, y);
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
    double sum = 0.0;

    fusion_solve(&self->fusion, &estimate);
    self->measurement_pending = false;
    self->counters.unconverged += estimate.status == MHE_MAX_SWEEPS;
    out->sweeps = estimate.sweeps > out->sweeps ? estimate.sweeps : out->sweeps;
    out->kkt_degc = estimate.kkt_degc;
    memcpy(self->theta, estimate.theta, sizeof self->theta);
    memcpy(self->memory, estimate.memory, sizeof self->memory);
    estimator_run_forward(self, now - self->setting.delay_steps, now, self->theta, self->memory);
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        self->variance[ch] = estimate.variance[ch];
        sum += self->theta[ch] + self->variance[ch];
    }
    if (!estimate.usable || !isfinite(sum)) {
        self->invalid_pending = true;
        estimator_restart(self, true);
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
        const size_t slot = estimator_slot(k);
        validity_step(&self->validity, self->input[slot], self->theta); /* as the net is fed for interval k */
        self->novelty[slot] = self->validity.result.novelty;
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
        fusion_advance(&self->fusion, self->input[estimator_slot(node - 1)]);
        fusion_doubt(&self->fusion, self->novelty[estimator_slot(node - 1)]);
    }
    measure_newest(self, node);
    solve(self, k + 1, out);
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
    estimator_publish(self, out);
    self->invalid_pending = false;
    self->innovation[0] = NAN;
    self->innovation[1] = NAN;
}

void estimator_step_within(estimator_t *self, estimator_out_t *out, bool (*expired)(void *ctx), void *ctx)
{
    fusion_limit(&self->fusion, expired, ctx); /* lost where the estimator begins anew: then it solves one window */
    estimator_step(self, out);
    fusion_limit(&self->fusion, NULL, NULL);
}
