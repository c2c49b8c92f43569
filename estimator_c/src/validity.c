#include "validity.h"

#include <math.h>
#include <string.h>

static const double KW_PER_RPM_NM = 3.14159265358979323846 / 30.0e3;

static const validity_result_t NOTHING = {.scope = VALIDITY_NOT_AVAILABLE, .novelty = NAN};

void validity_init(validity_t *self)
{
    memset(self, 0, sizeof *self);
    self->result = NOTHING;
}

/* Distance from the middle of lower..upper in half-widths. */
static double beyond(double x, double lower, double upper)
{
    return fabs(x - 0.5 * (lower + upper)) / (0.5 * (upper - lower));
}

/* Update the low-pass and return the largest |direction . history - centre|. */
static double judge_history(validity_t *self, const double u[2], const double theta[2], double power_kw)
{
    const double speed_krpm = 1e-3 * u[0];
    const double fast[ENVELOPE_SLOW] = {theta[0], theta[1], speed_krpm * speed_krpm, u[1] * u[1], fabs(power_kw)};
    /* At first the plain mean: the first value must not count as if it had always been there. */
    const double share = fmax(train_envelope.share, 1.0 / (double)(self->steps + 1));
    for (int k = 0; k < ENVELOPE_SLOW; k++) {
        self->slow[k] += share * (fast[k] - self->slow[k]);
    }
    const double q[ENVELOPE_FEATURES] = {
        theta[0], theta[1], theta[0] - self->slow[0], theta[1] - self->slow[1],
        self->slow[2], self->slow[3], self->slow[4]};
    double worst = 0.0;
    for (int row = 0; row < ENVELOPE_FEATURES; row++) {
        double sum = -train_envelope.centre[row];
        for (int k = 0; k < ENVELOPE_FEATURES; k++) {
            sum += train_envelope.direction[row][k] * q[k];
        }
        worst = fmax(worst, fabs(sum));
    }
    return worst;
}

void validity_step(validity_t *self, const double u[2], const double theta[2])
{
    if (!train_envelope.available) {
        return;
    }
    if (!isfinite(u[0] + u[1] + theta[0] + theta[1])) {
        validity_init(self);
        self->result = (validity_result_t){VALIDITY_SETTLING, true, true, true, true, true, INFINITY};
        return;
    }
    const double x[ENVELOPE_RANGES] = {u[0], u[1], theta[0], theta[1]};
    const double power_kw = u[0] * u[1] * KW_PER_RPM_NM;
    double range[ENVELOPE_RANGES];
    double alone = 0.0;
    for (int k = 0; k < ENVELOPE_RANGES; k++) {
        range[k] = beyond(x[k], train_envelope.lower[k], train_envelope.upper[k]);
        alone = fmax(alone, range[k]);
    }
    const bool settled = self->steps >= train_envelope.settle_steps;
    const double past = judge_history(self, u, theta, power_kw);
    self->steps += self->steps < INT32_MAX ? 1 : 0;
    const double joint = fmax(beyond(power_kw, train_envelope.power_kw[0], train_envelope.power_kw[1]),
                              settled ? past : 0.0);
    self->result = (validity_result_t){
        .scope = settled ? VALIDITY_JUDGED : VALIDITY_SETTLING,
        .outside_speed = range[0] > 1.0,
        .outside_torque = range[1] > 1.0,
        .outside_theta_w = range[2] > 1.0,
        .outside_theta_r = range[3] > 1.0,
        .outside_joint = joint > 1.0,
        .novelty = fmax(alone, joint),
    };
}
