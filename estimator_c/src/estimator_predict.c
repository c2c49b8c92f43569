#include <string.h>

#include "estimator_parts.h"

void estimator_run_forward(const estimator_t *self, int64_t from, int64_t to, double theta[MHE_CHANNELS],
                           double memory[NET_MEMORY])
{
    double rate[MHE_CHANNELS];
    double tape[NET_TAPE];
    for (int64_t k = from; k < to; k++) {
        net_forward(self->input[estimator_slot(k)], theta, memory, memory, rate, tape);
        for (int ch = 0; ch < MHE_CHANNELS; ch++) {
            theta[ch] += NET_DT_S * rate[ch];
        }
    }
}

void estimator_base(const estimator_t *self, estimator_base_t *base)
{
    base->known = self->started;
    base->restarts = self->counters.restarts;
    base->next_interval = self->next_interval;
    memcpy(base->theta, self->theta, sizeof base->theta);
    memcpy(base->memory, self->memory, sizeof base->memory);
}

bool estimator_predict(const estimator_t *self, const estimator_base_t *base, estimator_out_t *out)
{
    double theta[MHE_CHANNELS];
    double memory[NET_MEMORY];
    const double solved[MHE_CHANNELS] = {out->theta_w_degc, out->theta_r_degc};
    if (!base->known || !self->started || base->restarts != self->counters.restarts) {
        return false;
    }
    memcpy(theta, base->theta, sizeof theta);
    memcpy(memory, base->memory, sizeof memory);
    estimator_run_forward(self, base->next_interval, self->next_interval, theta, memory);
    estimator_publish_theta(self, theta, memory, out);
    out->channel[0].upper_degc += out->theta_w_degc - solved[0];
    out->channel[1].upper_degc += out->theta_r_degc - solved[1];
    out->status = ESTIMATOR_PREDICTING;
    return true;
}
