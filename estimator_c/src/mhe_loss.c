#include "mhe_loss.h"

void mhe_losses(const mhe_t *self, bool careful, mhe_losses_t *out)
{
    const real_t per_scale = 1 / self->loss_scale;
    for (int k = 0; k < MHE_NODES; k++) {
        const mhe_node_t *node = &self->node[(self->head + k) & (MHE_NODES - 1)];
        for (int ch = 0; ch < MHE_CHANNELS; ch++) {
            out->residual[k][ch] = node->theta[ch] - node->y[ch];
            out->pull[k][ch] = 1;
            out->curvature[k][ch] = 1;
        }
    }
    if (self->loss == EST_LOSS_GEMAN_MCCLURE) {
        for (int k = 0; k < MHE_NODES; k++) {
            for (int ch = 0; ch < MHE_CHANNELS; ch++) {
                const real_t x = out->residual[k][ch] * per_scale;
                const real_t d = 1 / (1 + x * x);
                const real_t own = (1 - 3 * x * x) * d; /* times the pull */
                const real_t kept = (own + real_abs(own)) * (real_t)0.5;
                out->pull[k][ch] = d * d;
                out->curvature[k][ch] = d * d * (careful ? 1 : kept);
            }
        }
    } else if (self->loss == EST_LOSS_HUBER) {
        for (int k = 0; k < MHE_NODES; k++) {
            for (int ch = 0; ch < MHE_CHANNELS; ch++) {
                const real_t x = real_abs(out->residual[k][ch] * per_scale);
                out->pull[k][ch] = 1 / real_max(x, 1);
                out->curvature[k][ch] = careful ? out->pull[k][ch] : x > 1 ? 0 : 1;
            }
        }
    }
}

real_t mhe_loss_value(const mhe_t *self, real_t r)
{
    const real_t half = (real_t)0.5;
    const real_t s = self->loss_scale;
    const real_t x = real_abs(r / s);
    if (self->loss == EST_LOSS_GEMAN_MCCLURE) {
        return half * r * r / (1 + x * x);
    }
    return self->loss == EST_LOSS_HUBER && x > 1 ? s * s * (x - half) : half * r * r;
}
