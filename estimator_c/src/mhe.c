#include "mhe.h"

#include <string.h>

/* Rounding of temperatures around 100 degC leaves changes of that size: nothing with double, 15 uK with float. */
static const real_t TOLERANCE_FLOOR_DEGC = 128 * REAL_EPSILON;

static const real_t SHRINK = (real_t)0.5; /* a sweep that leaves more of the change than this was too bold */

/* k = 0 is the oldest node of the window. */
static inline mhe_node_t *at(mhe_t *self, int k)
{
    return &self->node[(self->head + k) & (MHE_NODES - 1)];
}

static const real_t *arrival_weight(const mhe_t *self)
{
    return self->full ? self->weight_arrival : self->weight_prior;
}

/* Measurement weight of node k as the problem counts it. */
static real_t weight_at(mhe_t *self, int k, int channel)
{
    const bool counted = self->newest_measurement || k + 1 < self->count;
    return counted ? at(self, k)->weight[channel] : 0;
}

void mhe_init(mhe_t *self, const est_setting_t *setting)
{
    memset(self, 0, sizeof *self);
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        self->weight_measurement[ch] = (real_t)setting->weight_measurement[ch];
        self->weight_noise[ch] = (real_t)setting->weight_noise[ch];
        self->weight_arrival[ch] = (real_t)setting->weight_arrival[ch];
        self->weight_prior[ch] = (real_t)setting->weight_prior[ch];
        self->qp[ch].hard = setting->hard_bounds;
        self->qp[ch].rho = (real_t)setting->bound_weight;
    }
    self->loss = setting->loss;
    self->loss_scale = (real_t)setting->loss_scale_degc;
    self->lower = (real_t)setting->lower_degc;
    self->upper = (real_t)setting->upper_degc;
    self->tolerance = real_max((real_t)setting->tolerance_degc, TOLERANCE_FLOOR_DEGC);
    self->max_sweeps = setting->max_sweeps;
    self->newest_measurement = setting->newest_measurement;
}

void mhe_start(mhe_t *self, const real_t prior[MHE_CHANNELS], const real_t memory[])
{
    self->head = 0;
    self->count = 1;
    self->full = false;
    self->stale = false;
    mhe_node_t *node = at(self, 0);
    memset(node, 0, sizeof *node);
    memcpy(node->memory, memory, sizeof node->memory);
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        node->theta[ch] = prior[ch];
        self->prior[ch] = prior[ch];
    }
}

/* The stage from node k to k + 1 at the present temperature: rate, tape and the memory on arrival. */
static void stage_forward(mhe_t *self, int k)
{
    mhe_node_t *from = at(self, k);
    mhe_node_t *to = at(self, k + 1);
    net_forward(from->u, from->theta, from->memory, to->memory, from->rate, from->tape);
}

static void forward_sweep(mhe_t *self)
{
    for (int k = 0; k + 1 < self->count; k++) {
        stage_forward(self, k);
    }
    self->stale = false;
}

/* Bring the stages to the present temperatures, which the last sweep has moved. */
static void refresh(mhe_t *self)
{
    if (self->stale) {
        forward_sweep(self);
    }
}

/* 1 + dt dF/dtheta enters the matrix only, so it is taken once, when the stage is new. Kept positive so that the
 * matrix stays an M-matrix whatever the net does. */
static void stage_slope(mhe_t *self, int k)
{
    mhe_node_t *from = at(self, k);
    real_t slope[MHE_CHANNELS];
    net_slope(from->tape, from->memory, slope);
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        from->slope[ch] = real_max(1 + NET_DT_S * slope[ch], (real_t)0.1);
    }
}

void mhe_advance(mhe_t *self, const real_t u[2])
{
    refresh(self);
    if (self->count == MHE_NODES) {
        self->head = (self->head + 1) & (MHE_NODES - 1);
        self->count--;
        self->full = true;
        memcpy(self->prior, at(self, 0)->theta, sizeof self->prior);
    }
    mhe_node_t *from = at(self, self->count - 1);
    mhe_node_t *to = at(self, self->count);
    memcpy(from->u, u, sizeof from->u);
    self->count++;
    stage_forward(self, self->count - 2);
    stage_slope(self, self->count - 2);
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        to->theta[ch] = from->theta[ch] + NET_DT_S * from->rate[ch];
        to->y[ch] = 0;
        to->weight[ch] = 0;
    }
}

void mhe_arrival(mhe_t *self, const real_t prior[MHE_CHANNELS], const real_t weight[MHE_CHANNELS], const real_t memory[])
{
    memcpy(self->prior, prior, sizeof self->prior);
    memcpy(self->weight_arrival, weight, sizeof self->weight_arrival);
    if (memory != NULL) {
        mhe_node_t *oldest = at(self, 0);
        memcpy(oldest->memory, memory, sizeof oldest->memory);
        forward_sweep(self);
    }
}

real_t mhe_measure(mhe_t *self, int age, int channel, real_t y, real_t share)
{
    if (age < 0 || age >= self->count || channel < 0 || channel >= MHE_CHANNELS || !real_finite(y)) {
        return (real_t)NAN;
    }
    mhe_node_t *node = at(self, self->count - 1 - age);
    node->y[channel] = y;
    node->weight[channel] = share * self->weight_measurement[channel];
    return y - node->theta[channel];
}

void mhe_forget(mhe_t *self, int channel, int nodes)
{
    for (int k = self->count - 1; k >= 0 && k >= self->count - nodes; k--) {
        at(self, k)->weight[channel] = 0;
    }
}

void mhe_shift(mhe_t *self, int channel, real_t shift)
{
    for (int k = 0; k < self->count; k++) {
        at(self, k)->theta[channel] += shift;
    }
    self->prior[channel] += shift;
    if (self->count > 0) {
        forward_sweep(self); /* mhe_solve() expects the stages to be up to date */
    }
}

const mhe_node_t *mhe_node(const mhe_t *self, int age)
{
    if (age < 0 || age >= self->count) {
        return NULL;
    }
    return &self->node[(self->head + self->count - 1 - age) & (MHE_NODES - 1)];
}

/* Weight of residual r under the loss: the derivative of rho over r. 1 where r is small; Huber 1965, Geman and McClure 1987. */
static real_t loss_weight(const mhe_t *self, real_t r)
{
    const real_t x = r / self->loss_scale;
    if (self->loss == EST_LOSS_GEMAN_MCCLURE) {
        const real_t d = 1 / (1 + x * x);
        return d * d;
    }
    return self->loss == EST_LOSS_HUBER ? 1 / real_max(real_abs(x), 1) : 1;
}

/* What residual r adds to the matrix. `careful`: the weight, a parabola above the loss that touches it, so that no step can
 * climb. Else the loss's own curvature, which ends in fewer sweeps, where that is not negative. */
static real_t loss_curvature(const mhe_t *self, real_t r, bool careful)
{
    if (careful) {
        return loss_weight(self, r);
    }
    const real_t x = r / self->loss_scale;
    if (self->loss == EST_LOSS_GEMAN_MCCLURE) {
        const real_t d = 1 / (1 + x * x);
        return real_max((1 - 3 * x * x) * d * d * d, 0);
    }
    return self->loss == EST_LOSS_HUBER && real_abs(x) > 1 ? 0 : 1;
}

/* The loss itself over its scale squared is rho(x); here times the scale squared, 1/2 r^2 where r is small. */
static real_t loss_value(const mhe_t *self, real_t r)
{
    const real_t half = (real_t)0.5;
    const real_t s = self->loss_scale;
    const real_t x = real_abs(r / s);
    if (self->loss == EST_LOSS_GEMAN_MCCLURE) {
        return half * r * r / (1 + x * x);
    }
    return self->loss == EST_LOSS_HUBER && x > 1 ? s * s * (x - half) : half * r * r;
}

/* Gradient of the cost at the point of the last forward sweep, into qp[].gradient. */
static void adjoint_sweep(mhe_t *self)
{
    const real_t *p0 = arrival_weight(self);
    real_t memory_bar[NET_MEMORY] = {0};
    real_t pull[MHE_CHANNELS] = {0}; /* Ww w of the stage that leaves node k + 1 -> seen from its arrival side */

    for (int k = self->count - 1; k >= 0; k--) {
        mhe_node_t *node = at(self, k);
        real_t theta_bar[MHE_CHANNELS] = {0};
        if (k + 1 < self->count) {
            const mhe_node_t *to = at(self, k + 1);
            real_t rate_bar[MHE_CHANNELS];
            for (int ch = 0; ch < MHE_CHANNELS; ch++) {
                const real_t w = to->theta[ch] - node->theta[ch] - NET_DT_S * node->rate[ch];
                pull[ch] = self->weight_noise[ch] * w;
                self->qp[ch].gradient[k + 1] += pull[ch];
                rate_bar[ch] = -NET_DT_S * pull[ch];
            }
            net_adjoint(node->tape, node->memory, rate_bar, memory_bar, theta_bar, memory_bar);
        }
        for (int ch = 0; ch < MHE_CHANNELS; ch++) {
            const real_t residual = node->theta[ch] - node->y[ch];
            self->qp[ch].gradient[k] =
                theta_bar[ch] - pull[ch] + weight_at(self, k, ch) * loss_weight(self, residual) * residual;
        }
    }
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        self->qp[ch].gradient[0] += p0[ch] * (at(self, 0)->theta[ch] - self->prior[ch]);
    }
}

/* Gauss-Newton matrix of each channel with the direct slope of each stage; constant within a step unless the loss weighs
 * the residuals anew. */
static void factor(mhe_t *self, bool careful)
{
    const real_t *p0 = arrival_weight(self);
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        box_qp_t *qp = &self->qp[ch];
        const real_t ww = self->weight_noise[ch];
        qp->n = self->count;
        for (int k = 0; k < self->count; k++) {
            const real_t a = at(self, k)->slope[ch];
            const real_t leaving = k + 1 < self->count ? ww * a * a : 0;
            const real_t arriving = k > 0 ? ww : p0[ch];
            const real_t residual = at(self, k)->theta[ch] - at(self, k)->y[ch];
            qp->diag[k] = arriving + leaving + weight_at(self, k, ch) * loss_curvature(self, residual, careful);
            qp->off[k] = -ww * a;
        }
        box_qp_factor(qp);
    }
}

/* Solve both channels for the change of temperature; returns its largest element, NAN if one is not finite. */
static real_t tridiagonal_step(mhe_t *self, real_t step[MHE_CHANNELS][MHE_NODES], int *active, bool *settled)
{
    real_t largest = 0;
    real_t sum = 0; /* real_max() drops a NaN, a sum does not */
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        box_qp_t *qp = &self->qp[ch];
        for (int k = 0; k < self->count; k++) {
            qp->lower[k] = self->lower - at(self, k)->theta[ch];
            qp->upper[k] = self->upper - at(self, k)->theta[ch];
        }
        const int changes = box_qp_solve(qp, step[ch]);
        *settled = *settled && changes >= 0;
        *active += changes > 0 ? changes : 0;
        for (int k = 0; k < self->count; k++) {
            largest = real_max(real_abs(step[ch][k]), largest);
            sum += step[ch][k];
        }
    }
    return real_finite(sum) ? largest : (real_t)NAN;
}

/* One sweep from up-to-date stages: where the next solve would go, and there unless the tolerance is met. */
static void sweep(mhe_t *self, mhe_result_t *result)
{
    real_t step[MHE_CHANNELS][MHE_NODES];
    const real_t before = result->kkt_degc;
    bool settled = true;
    if (result->sweeps == 0 || self->loss != EST_LOSS_QUADRATIC) {
        factor(self, self->careful);
    }
    adjoint_sweep(self);
    result->kkt_degc = tridiagonal_step(self, step, &result->active, &settled);
    result->sweeps++;
    self->careful = self->careful || (result->sweeps > 1 && !(result->kkt_degc < SHRINK * before));
    self->converged = result->kkt_degc <= self->tolerance && settled;
    if (self->converged) {
        return;
    }
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        for (int k = 0; k < self->count; k++) {
            at(self, k)->theta[ch] += step[ch][k];
        }
    }
    self->stale = true;
}

/* Close the books of a solve: the estimate, and whether all of it is finite. */
static mhe_status_t conclude(const mhe_t *self, mhe_result_t *result)
{
    const mhe_node_t *newest = mhe_node(self, 0);
    real_t sum = result->kkt_degc;
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        result->theta[ch] = newest->theta[ch];
        sum += newest->theta[ch];
    }
    for (int k = 0; k < NET_MEMORY; k++) {
        sum += newest->memory[k];
    }
    return !real_finite(sum) ? MHE_INVALID : self->converged ? MHE_OK : MHE_MAX_SWEEPS;
}

mhe_status_t mhe_feedback(mhe_t *self, mhe_result_t *result)
{
    *result = (mhe_result_t){.theta = {(real_t)NAN, (real_t)NAN}, .kkt_degc = (real_t)NAN};
    if (self->count == 0) {
        return MHE_INVALID;
    }
    /* The stages are up to date on entry: old ones from the last solve, the newest from mhe_advance(). */
    refresh(self);
    self->careful = false;
    sweep(self, result);
    return conclude(self, result);
}

mhe_status_t mhe_finish(mhe_t *self, mhe_result_t *result)
{
    if (self->count == 0) {
        return MHE_INVALID;
    }
    refresh(self);
    while (!self->converged && result->sweeps < self->max_sweeps) {
        sweep(self, result);
        refresh(self);
    }
    return conclude(self, result);
}

mhe_status_t mhe_solve(mhe_t *self, mhe_result_t *result)
{
    const mhe_status_t status = mhe_feedback(self, result);
    return status == MHE_INVALID ? status : mhe_finish(self, result);
}

real_t mhe_cost(mhe_t *self, real_t gradient[][MHE_CHANNELS])
{
    const real_t half = (real_t)0.5;
    const real_t *p0 = arrival_weight(self);
    real_t cost = 0;
    forward_sweep(self);
    adjoint_sweep(self);
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        const real_t from_prior = at(self, 0)->theta[ch] - self->prior[ch];
        cost += half * p0[ch] * from_prior * from_prior;
        for (int k = 0; k < self->count; k++) {
            const mhe_node_t *node = at(self, k);
            const real_t residual = node->theta[ch] - node->y[ch];
            cost += weight_at(self, k, ch) * loss_value(self, residual);
            if (k + 1 < self->count) {
                const real_t w = at(self, k + 1)->theta[ch] - node->theta[ch] - NET_DT_S * node->rate[ch];
                cost += half * self->weight_noise[ch] * w * w;
            }
            gradient[k][ch] = self->qp[ch].gradient[k];
        }
    }
    return cost;
}
