#include "mhe.h"

#include <math.h>
#include <string.h>

/* k = 0 is the oldest node of the window. */
static inline mhe_node_t *at(mhe_t *self, int k)
{
    return &self->node[(self->head + k) & (MHE_NODES - 1)];
}

static const double *arrival_weight(const mhe_t *self)
{
    return self->full ? self->weight_arrival : self->weight_prior;
}

/* Measurement weight of node k as the problem counts it. */
static double weight_at(mhe_t *self, int k, int channel)
{
    const bool counted = self->newest_measurement || k + 1 < self->count;
    return counted ? at(self, k)->weight[channel] : 0.0;
}

void mhe_init(mhe_t *self, const est_setting_t *setting)
{
    memset(self, 0, sizeof *self);
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        self->weight_measurement[ch] = setting->weight_measurement[ch];
        self->weight_noise[ch] = setting->weight_noise[ch];
        self->weight_arrival[ch] = setting->weight_arrival[ch];
        self->weight_prior[ch] = setting->weight_prior[ch];
        self->qp[ch].hard = setting->hard_bounds;
        self->qp[ch].rho = setting->bound_weight;
    }
    self->lower = setting->lower_degc;
    self->upper = setting->upper_degc;
    self->tolerance = setting->tolerance_degc;
    self->max_sweeps = setting->max_sweeps;
    self->newest_measurement = setting->newest_measurement;
}

void mhe_start(mhe_t *self, const double prior[MHE_CHANNELS], const double memory[])
{
    self->head = 0;
    self->count = 1;
    self->full = false;
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

/* 1 + dt dF/dtheta enters the matrix only, so it is taken once, when the stage is new. Kept positive so that the
 * matrix stays an M-matrix whatever the net does. */
static void stage_slope(mhe_t *self, int k)
{
    mhe_node_t *from = at(self, k);
    double slope[MHE_CHANNELS];
    net_slope(from->tape, from->memory, slope);
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        from->slope[ch] = fmax(0.1, 1.0 + NET_DT_S * slope[ch]);
    }
}

void mhe_advance(mhe_t *self, const double u[2])
{
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
        to->y[ch] = 0.0;
        to->weight[ch] = 0.0;
    }
}

double mhe_measure(mhe_t *self, int age, int channel, double y)
{
    if (age < 0 || age >= self->count || channel < 0 || channel >= MHE_CHANNELS || !isfinite(y)) {
        return NAN;
    }
    mhe_node_t *node = at(self, self->count - 1 - age);
    node->y[channel] = y;
    node->weight[channel] = self->weight_measurement[channel];
    return y - node->theta[channel];
}

const mhe_node_t *mhe_node(const mhe_t *self, int age)
{
    if (age < 0 || age >= self->count) {
        return NULL;
    }
    return &self->node[(self->head + self->count - 1 - age) & (MHE_NODES - 1)];
}

static void forward_sweep(mhe_t *self)
{
    for (int k = 0; k + 1 < self->count; k++) {
        stage_forward(self, k);
    }
}

/* Gradient of the cost at the point of the last forward sweep, into qp[].gradient. */
static void adjoint_sweep(mhe_t *self)
{
    const double *p0 = arrival_weight(self);
    double memory_bar[NET_MEMORY] = {0};
    double pull[MHE_CHANNELS] = {0}; /* Ww w of the stage that leaves node k + 1 -> seen from its arrival side */

    for (int k = self->count - 1; k >= 0; k--) {
        mhe_node_t *node = at(self, k);
        double theta_bar[MHE_CHANNELS] = {0};
        if (k + 1 < self->count) {
            const mhe_node_t *to = at(self, k + 1);
            double rate_bar[MHE_CHANNELS];
            for (int ch = 0; ch < MHE_CHANNELS; ch++) {
                const double w = to->theta[ch] - node->theta[ch] - NET_DT_S * node->rate[ch];
                pull[ch] = self->weight_noise[ch] * w;
                self->qp[ch].gradient[k + 1] += pull[ch];
                rate_bar[ch] = -NET_DT_S * pull[ch];
            }
            net_adjoint(node->tape, node->memory, rate_bar, memory_bar, theta_bar, memory_bar);
        }
        for (int ch = 0; ch < MHE_CHANNELS; ch++) {
            self->qp[ch].gradient[k] =
                theta_bar[ch] - pull[ch] + weight_at(self, k, ch) * (node->theta[ch] - node->y[ch]);
        }
    }
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        self->qp[ch].gradient[0] += p0[ch] * (at(self, 0)->theta[ch] - self->prior[ch]);
    }
}

/* Gauss-Newton matrix of each channel with the direct slope of each stage; constant within a step. */
static void factor(mhe_t *self)
{
    const double *p0 = arrival_weight(self);
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        box_qp_t *qp = &self->qp[ch];
        const double ww = self->weight_noise[ch];
        qp->n = self->count;
        for (int k = 0; k < self->count; k++) {
            const double a = at(self, k)->slope[ch];
            const double leaving = k + 1 < self->count ? ww * a * a : 0.0;
            const double arriving = k > 0 ? ww : p0[ch];
            qp->diag[k] = arriving + leaving + weight_at(self, k, ch);
            qp->off[k] = -ww * a;
        }
        box_qp_factor(qp);
    }
}

/* Solve both channels for the change of temperature; returns its largest element, NAN if one is not finite. */
static double tridiagonal_step(mhe_t *self, double step[MHE_CHANNELS][MHE_NODES], int *active, bool *settled)
{
    double largest = 0.0;
    double sum = 0.0; /* fmax() drops a NaN, a sum does not */
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
            largest = fmax(largest, fabs(step[ch][k]));
            sum += step[ch][k];
        }
    }
    return isfinite(sum) ? largest : NAN;
}

mhe_status_t mhe_solve(mhe_t *self, mhe_result_t *result)
{
    double step[MHE_CHANNELS][MHE_NODES];
    *result = (mhe_result_t){.theta = {NAN, NAN}, .kkt_degc = NAN};
    if (self->count == 0) {
        return MHE_INVALID;
    }
    mhe_status_t status = MHE_MAX_SWEEPS;
    factor(self);
    /* The stages are up to date on entry: old ones from the last solve, the newest from mhe_advance(). */
    while (result->sweeps < self->max_sweeps) {
        bool settled = true;
        adjoint_sweep(self);
        result->kkt_degc = tridiagonal_step(self, step, &result->active, &settled);
        result->sweeps++;
        if (result->kkt_degc <= self->tolerance && settled) {
            status = MHE_OK;
            break;
        }
        for (int ch = 0; ch < MHE_CHANNELS; ch++) {
            for (int k = 0; k < self->count; k++) {
                at(self, k)->theta[ch] += step[ch][k];
            }
        }
        forward_sweep(self);
    }
    const mhe_node_t *newest = at(self, self->count - 1);
    double sum = result->kkt_degc;
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        result->theta[ch] = newest->theta[ch];
        sum += newest->theta[ch];
    }
    for (int k = 0; k < NET_MEMORY; k++) {
        sum += newest->memory[k];
    }
    return isfinite(sum) ? status : MHE_INVALID;
}

double mhe_cost(mhe_t *self, double gradient[][MHE_CHANNELS])
{
    const double *p0 = arrival_weight(self);
    double cost = 0.0;
    forward_sweep(self);
    adjoint_sweep(self);
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        const double from_prior = at(self, 0)->theta[ch] - self->prior[ch];
        cost += 0.5 * p0[ch] * from_prior * from_prior;
        for (int k = 0; k < self->count; k++) {
            const mhe_node_t *node = at(self, k);
            const double residual = node->theta[ch] - node->y[ch];
            cost += 0.5 * weight_at(self, k, ch) * residual * residual;
            if (k + 1 < self->count) {
                const double w = at(self, k + 1)->theta[ch] - node->theta[ch] - NET_DT_S * node->rate[ch];
                cost += 0.5 * self->weight_noise[ch] * w * w;
            }
            gradient[k][ch] = self->qp[ch].gradient[k];
        }
    }
    return cost;
}
