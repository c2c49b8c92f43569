#include <math.h>

#include "estimator_parts.h"

static const double UPPER_SIGMA = 3.0;
static const double MODEL_VARIANCE = 0.01; /* K^2: a plant not quite the one the net knows, see docs/estimator.md */
static const double START_VARIANCE = 0.09; /* the same while the net's memory is still filling */
static const int32_t START_STEPS = 200;

void estimator_publish_theta(const estimator_t *self, const double node[MHE_CHANNELS], const double before[NET_MEMORY],
                             estimator_out_t *out)
{
    const int64_t since = self->newest_tick - self->grid_tick - ESTIMATOR_TICKS * self->next_interval;
    double theta[MHE_CHANNELS] = {node[0], node[1]};
    if (since > 0) {
        const estimator_bin_t *bin = &self->bin[estimator_slot(self->next_interval)];
        double input[2] = {self->held_input[0], self->held_input[1]};
        double memory[NET_MEMORY];
        double rate[MHE_CHANNELS];
        double tape[NET_TAPE];
        if (bin->frames > 0) {
            input[0] = bin->speed_sum / bin->frames;
            input[1] = bin->torque_sum / bin->frames;
        }
        net_forward(input, theta, before, memory, rate, tape);
        for (int ch = 0; ch < MHE_CHANNELS; ch++) {
            theta[ch] += rate[ch] * ESTIMATOR_TICK_S * (double)since;
        }
    }
    out->theta_w_degc = theta[0];
    out->theta_r_degc = theta[1];
}

/* What is said of a channel beside its estimate. The bound grows from the moment its sensor is distrusted. */
static estimator_channel_t channel_now(const estimator_t *self, int ch, double theta_degc)
{
    const sensor_monitor_t *monitor = &self->fusion.monitor[ch];
    const double sigma = sqrt(self->variance[ch]);
    const double offset_sigma = self->calibration.result.sigma_degc[ch];
    const double model = self->fusion.steps < START_STEPS ? START_VARIANCE : MODEL_VARIANCE;
    const double variance = self->variance[ch] + model + offset_sigma * offset_sigma;
    return (estimator_channel_t){
        .fault = monitor->fault,
        .trusted = monitor->trusted && self->fusion.share[ch] > 0.0,
        .sigma_degc = sigma,
        .upper_degc = theta_degc + UPPER_SIGMA * sqrt(variance) + sensor_monitor_gained_degc(monitor),
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
        open_loop = open_loop || sensor_monitor_distrusted_s(monitor) > self->setting.open_loop_s;
    }
    if (self->fusion.fallback) {
        return ESTIMATOR_FALLBACK;
    }
    return open_loop ? ESTIMATOR_OPEN_LOOP : distrusted ? ESTIMATOR_PREDICTING : ESTIMATOR_RUNNING;
}

void estimator_publish(const estimator_t *self, estimator_out_t *out)
{
    if (self->started) {
        estimator_publish_theta(self, self->theta, self->memory, out);
        out->channel[0] = channel_now(self, 0, out->theta_w_degc);
        out->channel[1] = channel_now(self, 1, out->theta_r_degc);
    }
    out->calibration = self->calibration.result;
    out->validity = self->validity.result;
    out->status = self->invalid_pending ? ESTIMATOR_INVALID : status_now(self);
    out->stale_input |= out->status == ESTIMATOR_INPUT_STALE;
    out->innov_w_degc = self->innovation[0];
    out->innov_r_degc = self->innovation[1];
}
