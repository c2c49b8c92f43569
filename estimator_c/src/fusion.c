#include "fusion.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

static const int32_t MEMORY_STEPS = 200;      /* 20 s: so long the filter learns what the net should remember */
static const double USABLE_KKT_DEGC = 0.01;   /* an MHE cut short is still used below this ... */
static const double FEEDBACK_KKT_DEGC = 1.0;  /* ... and one sweep may leave that to the next step */
static const double CREEP_VARIANCE = 0.25;    /* K^2, of the slow observer's level */

/* Doubt outside what the net knows. */
static const double DOUBT = 1.0;              /* K^2 per step, one half-width outside the envelope */
static const double DOUBT_MAX = 10.0;         /* K^2, up to which it adds */

/* What the net's rate lacks with this plant, as the slow observer has learned it. */
static const double LACK_USUAL = 0.03;        /* degC/s: no more than any net's ordinary error */
static const double LACK_S = 3.0;             /* how long a lack beyond that keeps its sign, as the window sees it */

void fusion_init(fusion_t *self, const est_setting_t *setting)
{
    memset(self, 0, sizeof *self);
    self->setting = *setting;
    mhe_init(&self->mhe, setting);
    ekf_init(&self->ekf, setting);
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        sensor_monitor_init(&self->monitor[ch], setting, ch);
    }
}

void fusion_start(fusion_t *self, const double prior[MHE_CHANNELS], const double variance[MHE_CHANNELS],
                  const double memory[])
{
    mhe_start(&self->mhe, prior, memory);
    ekf_start(&self->ekf, prior, variance, memory);
    slow_observer_start(&self->slow, prior, memory);
    self->steps = 0;
}

static bool uses_mhe(const fusion_t *self)
{
    return self->setting.kind == EST_KIND_MHE;
}

/* A rate that is wrong by m for a time tau (LACK_S) moves the temperature as noise of variance 2 tau m^2 dt per step
 * would. What the slow observer has learned to be wrong is taken for m as far as it is more than LACK_USUAL. */
static void set_noise(fusion_t *self)
{
    for (int ch = 0; ch < MHE_CHANNELS && self->setting.supervise; ch++) {
        const double m = fmax(0.0, fabs(self->slow.bias[ch]) - LACK_USUAL);
        self->ekf.q[ch] = 1.0 / self->setting.weight_noise[ch] + 2.0 * LACK_S * NET_DT_S * m * m;
    }
}

/* Arrival cost: the filter's prediction of the oldest node says what all measurements before the window say. With it
 * the MHE begins where the filter stood, and no measurement counts twice. */
static void begin_at_oldest(fusion_t *self)
{
    if (!uses_mhe(self) || self->setting.arrival_from != EST_ARRIVAL_FROM_FILTER || !self->mhe.full) {
        return;
    }
    const fusion_prediction_t *oldest = &self->predicted[(self->newest + 1) % MHE_NODES];
    double weight[MHE_CHANNELS];
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        weight[ch] = fmax(self->setting.weight_prior[ch], 1.0 / oldest->variance[ch]);
    }
    mhe_arrival(&self->mhe, oldest->theta, weight, self->steps < MEMORY_STEPS ? oldest->memory : NULL);
}

/* Note the filter's prediction of the newest node. */
static void hand_over(fusion_t *self)
{
    self->newest = (self->newest + 1) % MHE_NODES;
    fusion_prediction_t *now = &self->predicted[self->newest];
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        now->theta[ch] = self->ekf.theta[ch];
        now->variance[ch] = self->ekf.p[ch][ch];
    }
    memcpy(now->memory, self->ekf.memory, sizeof now->memory);
    self->steps++;
    begin_at_oldest(self);
}

void fusion_advance(fusion_t *self, const double u[2])
{
    set_noise(self);
    if (uses_mhe(self)) {
        mhe_advance(&self->mhe, u);
    }
    ekf_predict(&self->ekf, u);
    hand_over(self);
    slow_observer_predict(&self->slow, u);
}

/* Hand the noise to the MHE, and the loss's scale: it bends where values are out of the ordinary, and with a noisy
 * sensor the ordinary is wider. */
static void weigh(fusion_t *self)
{
    double noise[MHE_CHANNELS];
    double wider = 1.0;
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        const sensor_monitor_t *monitor = &self->monitor[ch];
        noise[ch] = 1.0 / self->ekf.q[ch];
        wider = fmax(wider, monitor->spread_r / monitor->r);
    }
    const double scale = self->setting.loss_scale_degc * sqrt(wider);
    const double *now = self->mhe.weight_noise;
    if (noise[0] != now[0] || noise[1] != now[1] || scale != self->mhe.loss_scale) {
        mhe_weigh(&self->mhe, noise, scale);
    }
}

void fusion_doubt(fusion_t *self, double novelty)
{
    if (!(novelty > 1.0)) { /* NAN where the weights carry no envelope */
        return;
    }
    const double beyond = novelty - 1.0;
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        const double room = fmax(0.0, DOUBT_MAX - self->ekf.p[ch][ch]);
        self->ekf.p[ch][ch] += fmin(room, DOUBT * beyond * beyond);
    }
}

static double prediction(const fusion_t *self, int channel)
{
    return uses_mhe(self) ? mhe_node(&self->mhe, 0)->theta[channel] : self->ekf.theta[channel];
}

/* The level of a channel was wrong by `shift`. */
static void move_level(fusion_t *self, int channel, double shift, double variance)
{
    if (uses_mhe(self)) {
        mhe_shift(&self->mhe, channel, shift);
    }
    ekf_shift(&self->ekf, channel, shift, variance);
    for (int age = 0; age < MHE_NODES; age++) { /* what the window said, moved, is now all there is to begin from */
        const mhe_node_t *node = mhe_node(&self->mhe, age);
        fusion_prediction_t *then = &self->predicted[(self->newest + MHE_NODES - age) % MHE_NODES];
        then->theta[channel] = node != NULL ? node->theta[channel] : self->ekf.theta[channel];
        then->variance[channel] = variance;
    }
    begin_at_oldest(self);
}

/* Let the monitor judge the value; returns its share. *y is moved by what the monitor knows it to be off. */
static double judge(fusion_t *self, int channel, double *y, double raw)
{
    const double now = prediction(self, channel);
    const monitor_input_t input = {
        .y = *y,
        .raw = raw,
        .residual = *y - now,
        .variance = self->ekf.p[channel][channel],
        .slow = self->slow.innovation[channel],
        .slow_raw = self->slow.raw[channel],
        .rate = self->slow.rate[channel],
    };
    const monitor_verdict_t verdict = sensor_monitor_step(&self->monitor[channel], &input);
    if (verdict.forget > 0 && uses_mhe(self)) {
        mhe_forget(&self->mhe, channel, verdict.forget);
    }
    if (verdict.creep) {
        move_level(self, channel, self->slow.theta[channel] - now, CREEP_VARIANCE);
    }
    if (verdict.settled) {
        slow_observer_shift(&self->slow, channel, now - self->slow.theta[channel]);
    }
    if (verdict.resume) {
        move_level(self, channel, verdict.level, self->ekf.r[channel] / 10.0);
        slow_observer_shift(&self->slow, channel, now + verdict.level - self->slow.theta[channel]);
    }
    *y -= verdict.offset;
    return verdict.share;
}

double fusion_measure(fusion_t *self, int channel, double y, double raw, double *variance)
{
    const double innovation = y - prediction(self, channel);
    *variance = self->ekf.p[channel][channel] + self->ekf.r[channel];
    slow_observer_measure(&self->slow, channel, y);
    const double share = self->setting.supervise ? judge(self, channel, &y, raw) : isfinite(y) ? 1.0 : 0.0;
    self->share[channel] = share;
    if (uses_mhe(self)) {
        (void)mhe_measure(&self->mhe, 0, channel, y, share);
    }
    ekf_update(&self->ekf, channel, y, share);
    if (share > 0.0 && (self->monitor[channel].trusted || !self->setting.supervise)) {
        slow_observer_follow(&self->slow, channel); /* a noisy sensor with full pull: a minute averages */
    }
    return innovation;
}

double fusion_measure_late(fusion_t *self, int age, int channel, double y, double raw)
{
    if (!uses_mhe(self)) {
        return NAN; /* a filter has no way back */
    }
    const mhe_node_t *node = mhe_node(&self->mhe, age);
    if (node == NULL) {
        return NAN;
    }
    const double variance = self->ekf.p[channel][channel];
    const double share = self->setting.supervise
                             ? sensor_monitor_late(&self->monitor[channel], raw, y - node->theta[channel], variance)
                             : 1.0;
    return mhe_measure(&self->mhe, age, channel, y, share);
}

static bool ekf_finite(const ekf_t *ekf)
{
    double sum = 0.0;
    for (int ch = 0; ch < EKF_CHANNELS; ch++) {
        sum += ekf->theta[ch] + ekf->p[ch][ch];
    }
    for (int k = 0; k < NET_MEMORY; k++) {
        sum += ekf->memory[k];
    }
    return isfinite(sum);
}

/* A window that is not finite stays so: begin another where the filter stands, if that is finite. */
static void mend_window(fusion_t *self, mhe_status_t status)
{
    if (status == MHE_INVALID && ekf_finite(&self->ekf)) {
        mhe_start(&self->mhe, self->ekf.theta, self->ekf.memory);
    }
}

/* The MHE's part of fusion_solve(): its status as published. True: its solution can be used. */
static bool solve_window(fusion_t *self, mhe_status_t *status)
{
    mhe_result_t *result = &self->result;
    const bool feedback = self->setting.mode == EST_MODE_FEEDBACK && self->mhe.full; /* a young window needs more */
    const double left_degc = feedback ? FEEDBACK_KKT_DEGC : USABLE_KKT_DEGC;
    if (self->setting.supervise) {
        weigh(self);
    }
    if (feedback) {
        *status = mhe_feedback(&self->mhe, result);
    } else if (self->expired != NULL) {
        *status = mhe_solve_within(&self->mhe, result, self->expired, self->expired_ctx);
    } else {
        *status = mhe_solve(&self->mhe, result);
    }
    const bool cut_short = *status == MHE_MAX_SWEEPS;
    const bool solved = *status == MHE_OK || (cut_short && result->kkt_degc < left_degc);
    self->unfinished = feedback && cut_short;
    *status = self->unfinished ? MHE_OK : *status;
    return solved;
}

void fusion_limit(fusion_t *self, bool (*expired)(void *ctx), void *ctx)
{
    self->expired = expired;
    self->expired_ctx = ctx;
}

void fusion_solve(fusion_t *self, fusion_estimate_t *estimate)
{
    const mhe_result_t *result = &self->result;
    self->result = (mhe_result_t){.kkt_degc = NAN};
    *estimate = (fusion_estimate_t){.status = MHE_OK};
    const bool solved = uses_mhe(self) && solve_window(self, &estimate->status);
    estimate->kkt_degc = result->kkt_degc;
    estimate->sweeps = result->sweeps;
    estimate->usable = solved || ekf_finite(&self->ekf);
    self->fallback = uses_mhe(self) && !solved;
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        estimate->theta[ch] = solved ? result->theta[ch] : self->ekf.theta[ch];
        estimate->variance[ch] = self->ekf.p[ch][ch];
    }
    estimate->memory = solved ? mhe_node(&self->mhe, 0)->memory : self->ekf.memory;
    mend_window(self, estimate->status);
}

mhe_status_t fusion_finish(fusion_t *self)
{
    if (!self->unfinished) {
        return MHE_OK;
    }
    self->unfinished = false;
    const mhe_status_t status = mhe_finish(&self->mhe, &self->result);
    mend_window(self, status);
    return status;
}
