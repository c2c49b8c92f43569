#include "slow_observer.h"

#include <math.h>
#include <string.h>

static const double T_MIN_S = 10.0;
static const double T_MAX_S = 50.0;
static const double GROWTH = 0.15;       /* of T with the record */
static const double INTEGRAL_RATIO = 1.0; /* Ti = T: damping 0.5 */
static const double BIAS_MAX = 0.1;       /* degC/s: more is no bias of a rate but a broken model */
static const double STEP_MAX_DEGC = 1.5;
static const double LOW_PASS = 0.05;      /* per step: 2 s */

static double time_constant(const slow_observer_t *self, int channel)
{
    return fmin(T_MAX_S, fmax(T_MIN_S, GROWTH * self->age_s[channel]));
}

void slow_observer_start(slow_observer_t *self, const double theta[SLOW_CHANNELS], const double memory[])
{
    memset(self, 0, sizeof *self);
    memcpy(self->theta, theta, sizeof self->theta);
    memcpy(self->memory, memory, sizeof self->memory);
}

void slow_observer_predict(slow_observer_t *self, const double u[2])
{
    double rate[SLOW_CHANNELS];
    double tape[NET_TAPE];
    net_forward(u, self->theta, self->memory, self->memory, rate, tape);
    for (int ch = 0; ch < SLOW_CHANNELS; ch++) {
        self->rate[ch] = rate[ch] + self->bias[ch];
        self->theta[ch] += NET_DT_S * self->rate[ch];
    }
}

void slow_observer_measure(slow_observer_t *self, int channel, double y)
{
    if (isfinite(y)) {
        const double beside = y - self->theta[channel] - self->innovation[channel];
        const double bounded = fmin(STEP_MAX_DEGC, fmax(-STEP_MAX_DEGC, beside)); /* a spike creeps nowhere */
        self->raw[channel] = self->innovation[channel] + bounded;
        self->innovation[channel] += LOW_PASS * bounded;
    }
}

void slow_observer_follow(slow_observer_t *self, int channel)
{
    const double e = self->raw[channel];
    const double t = time_constant(self, channel);
    self->age_s[channel] += NET_DT_S;
    self->theta[channel] += NET_DT_S * e / t;
    const double bias = self->bias[channel] + NET_DT_S * e / (t * t * INTEGRAL_RATIO);
    self->bias[channel] = fmin(BIAS_MAX, fmax(-BIAS_MAX, bias));
}

void slow_observer_shift(slow_observer_t *self, int channel, double shift)
{
    self->theta[channel] += shift;
    self->innovation[channel] = 0.0;
    self->raw[channel] = 0.0;
}
