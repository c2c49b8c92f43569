#include "derating_rule.h"

double derating_rule_share(const derating_rule_t *self, double theta_w_degc, double theta_r_degc)
{
    const double theta[2] = {theta_w_degc, theta_r_degc};
    double share = 1.0;
    for (int k = 0; k < 2; k++) {
        const double own = (self->end_degc[k] - theta[k]) / (self->end_degc[k] - self->start_degc[k]);
        if (!(own >= share)) { /* a NaN too */
            share = own > 0.0 ? own : 0.0;
        }
    }
    return share;
}
