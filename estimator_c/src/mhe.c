#include "mhe.h"

#include <stddef.h>
#include <string.h>

#include "mhe_loss.h"

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
    }
    self->loss = setting->loss;
    self->loss_scale = (real_t)setting->loss_scale_degc;
    self->hard_bounds = setting->hard_bounds;
    self->bound_weight = (real_t)setting->bound_weight;
    self->lower = (real_t)setting->lower_degc;
    self->upper = (real_t)setting->upper_degc;
    const real_t tolerance = (real_t)setting->tolerance_degc;
    self->tolerance = tolerance > 0 ? real_max(tolerance, TOLERANCE_FLOOR_DEGC) : 0;
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
    net_kernel->forward(from->u, from->theta, from->memory, to->memory, from->rate, from->tape);
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
    net_kernel->slope(from->tape, from->memory, slope);
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

void mhe_arrival(mhe_t *self, const real_t prior[MHE_CHANNELS], const real_t weight[MHE_CHANNELS],
                 const real_t memory[])
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

void mhe_weigh(mhe_t *self, const real_t noise[MHE_CHANNELS], real_t loss_scale)
{
    memcpy(self->weight_noise, noise, sizeof self->weight_noise);
    self->loss_scale = loss_scale;
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

/* Gradient of the cost at the point of the last forward sweep. */
static void adjoint_sweep(mhe_t *self, const mhe_losses_t *losses)
{
    const real_t *p0 = arrival_weight(self);
    const int last = self->count - 1;
    real_pair_t rate_bar[MHE_NODES];
    NET_ALIGNED real_t memory_bar[NET_MEMORY] = {0};

    /* What needs no net: measurements and prior, then the noise between each two nodes. */
    for (int k = 0; k <= last; k++) {
        for (int ch = 0; ch < MHE_CHANNELS; ch++) {
            self->gradient[k][ch] = weight_at(self, k, ch) * losses->pull[k][ch] * losses->residual[k][ch];
        }
    }
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        self->gradient[0][ch] += p0[ch] * (at(self, 0)->theta[ch] - self->prior[ch]);
    }
    for (int k = 0; k < last; k++) {
        const mhe_node_t *from = at(self, k);
        const mhe_node_t *to = at(self, k + 1);
        for (int ch = 0; ch < MHE_CHANNELS; ch++) {
            const real_t w = to->theta[ch] - from->theta[ch] - NET_DT_S * from->rate[ch];
            const real_t pull = self->weight_noise[ch] * w;
            self->gradient[k][ch] -= pull;
            self->gradient[k + 1][ch] += pull;
            rate_bar[k][ch] = -NET_DT_S * pull;
        }
    }
    const net_kernel_t *net = net_kernel;
    for (int k = last - 1; k >= 0; k--) {
        const mhe_node_t *from = at(self, k);
        real_t theta_bar[MHE_CHANNELS];
        net->adjoint(from->tape, from->memory, rate_bar[k], memory_bar, theta_bar, memory_bar);
        for (int ch = 0; ch < MHE_CHANNELS; ch++) {
            self->gradient[k][ch] += theta_bar[ch];
        }
    }
}

/* Gauss-Newton matrix of each channel with the direct slope of each stage; constant within a step unless the loss
 * weighs the residuals anew. */
static void factor(mhe_t *self, const mhe_losses_t *losses)
{
    const real_t *p0 = arrival_weight(self);
    const int last = self->count - 1;
    for (int k = 0; k <= last; k++) {
        for (int ch = 0; ch < MHE_CHANNELS; ch++) {
            const real_t ww = self->weight_noise[ch];
            const real_t a = at(self, k)->slope[ch];
            self->diag[k][ch] = weight_at(self, k, ch) * losses->curvature[k][ch] + (ww + ww * a * a);
            self->off[k][ch] = -ww * a;
        }
    }
    for (int ch = 0; ch < MHE_CHANNELS; ch++) { /* no stage before the first node, none after the last */
        const real_t a = at(self, last)->slope[ch];
        self->diag[last][ch] -= self->weight_noise[ch] * a * a;
        self->diag[0][ch] += p0[ch] - self->weight_noise[ch];
    }
    tridiag_pair_factor(&self->factor, self->count, (const real_pair_t *)self->diag, (const real_pair_t *)self->off);
}

/* The step of a channel that would leave the bounds: with them. */
static void bounded_step(mhe_t *self, int ch, real_pair_t step[], int *active, bool *settled)
{
    box_qp_t qp = {.n = self->count, .hard = self->hard_bounds, .rho = self->bound_weight};
    real_t x[MHE_NODES];
    for (int k = 0; k < self->count; k++) {
        qp.diag[k] = self->diag[k][ch];
        qp.off[k] = self->off[k][ch];
        qp.gradient[k] = self->gradient[k][ch];
        qp.lower[k] = self->lower - at(self, k)->theta[ch];
        qp.upper[k] = self->upper - at(self, k)->theta[ch];
    }
    box_qp_factor(&qp);
    const int changes = box_qp_solve(&qp, x);
    *settled = *settled && changes >= 0;
    *active += changes > 0 ? changes : 0;
    for (int k = 0; k < self->count; k++) {
        step[k][ch] = x[k];
    }
}

/* Solve both channels for the change of temperature; returns its largest element, NAN if one is not finite. */
static real_t tridiagonal_step(mhe_t *self, real_pair_t step[], int *active, bool *settled)
{
    real_t largest = 0;
    real_t sum = 0; /* real_max() drops a NaN, a sum does not */
    real_pair_t highest = {self->lower, self->lower};
    real_pair_t lowest = {self->upper, self->upper};
    for (int k = 0; k < self->count; k++) {
        for (int ch = 0; ch < MHE_CHANNELS; ch++) {
            step[k][ch] = -self->gradient[k][ch];
        }
    }
    tridiag_pair_solve(&self->factor, self->count, (const real_pair_t *)step, step);
    for (int k = 0; k < self->count; k++) {
        for (int ch = 0; ch < MHE_CHANNELS; ch++) {
            const real_t theta = at(self, k)->theta[ch] + step[k][ch];
            highest[ch] = real_max(theta, highest[ch]);
            lowest[ch] = -real_max(-theta, -lowest[ch]);
        }
    }
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        if (highest[ch] > self->upper || lowest[ch] < self->lower) {
            bounded_step(self, ch, step, active, settled);
        }
    }
    for (int k = 0; k < self->count; k++) {
        for (int ch = 0; ch < MHE_CHANNELS; ch++) {
            largest = real_max(real_abs(step[k][ch]), largest);
            sum += step[k][ch];
        }
    }
    return real_finite(sum) ? largest : (real_t)NAN;
}

/* One sweep from up-to-date stages: the step that the solve asks for, and there. */
static void sweep(mhe_t *self, mhe_result_t *result)
{
    real_pair_t step[MHE_NODES];
    mhe_losses_t losses;
    const real_t before = result->kkt_degc;
    bool settled = true;
    mhe_losses(self, self->careful, &losses);
    if (result->sweeps == 0 || self->loss != EST_LOSS_QUADRATIC) {
        factor(self, &losses);
    }
    adjoint_sweep(self, &losses);
    result->kkt_degc = tridiagonal_step(self, step, &result->active, &settled);
    result->sweeps++;
    self->careful = self->careful || (result->sweeps > 1 && !(result->kkt_degc < SHRINK * before));
    self->converged = result->kkt_degc <= self->tolerance && settled;
    for (int k = 0; k < self->count; k++) {
        for (int ch = 0; ch < MHE_CHANNELS; ch++) {
            at(self, k)->theta[ch] += step[k][ch];
        }
    }
    self->stale = !self->converged; /* the last step, within the tolerance, betters the estimate but moves no stage */
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

static mhe_status_t finish(mhe_t *self, mhe_result_t *result, bool (*expired)(void *ctx), void *ctx)
{
    if (self->count == 0) {
        return MHE_INVALID;
    }
    refresh(self);
    while (!self->converged && result->sweeps < self->max_sweeps &&
           (expired == NULL || !expired(ctx))) {
        sweep(self, result);
        refresh(self);
    }
    return conclude(self, result);
}

mhe_status_t mhe_finish(mhe_t *self, mhe_result_t *result)
{
    return finish(self, result, NULL, NULL);
}

mhe_status_t mhe_solve(mhe_t *self, mhe_result_t *result)
{
    return mhe_solve_within(self, result, NULL, NULL);
}

mhe_status_t mhe_solve_within(mhe_t *self, mhe_result_t *result, bool (*expired)(void *ctx), void *ctx)
{
    const mhe_status_t status = mhe_feedback(self, result);
    return status == MHE_INVALID ? status : finish(self, result, expired, ctx);
}

real_t mhe_cost(mhe_t *self, real_t gradient[][MHE_CHANNELS])
{
    const real_t half = (real_t)0.5;
    const real_t *p0 = arrival_weight(self);
    real_t cost = 0;
    mhe_losses_t losses;
    forward_sweep(self);
    mhe_losses(self, true, &losses);
    adjoint_sweep(self, &losses);
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        const real_t from_prior = at(self, 0)->theta[ch] - self->prior[ch];
        cost += half * p0[ch] * from_prior * from_prior;
        for (int k = 0; k < self->count; k++) {
            const mhe_node_t *node = at(self, k);
            const real_t residual = node->theta[ch] - node->y[ch];
            cost += weight_at(self, k, ch) * mhe_loss_value(self, residual);
            if (k + 1 < self->count) {
                const real_t w = at(self, k + 1)->theta[ch] - node->theta[ch] - NET_DT_S * node->rate[ch];
                cost += half * self->weight_noise[ch] * w * w;
            }
            gradient[k][ch] = self->gradient[k][ch];
        }
    }
    return cost;
}
