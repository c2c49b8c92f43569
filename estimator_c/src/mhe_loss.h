/* The loss of a measurement in the MHE: quadratic, Huber's (1965) or Geman and McClure's (1987), as the setting says.
 *
 * Both functions: no allocation, no failure (a residual that is not finite gives what is not finite), any thread. */
#ifndef MHE_LOSS_H
#define MHE_LOSS_H

#include "mhe.h"

/* What the loss does with the residuals of a window, oldest node first: factors on the measurement's weight. */
typedef struct {
    real_pair_t residual[MHE_NODES];  /* degC, theta minus y */
    real_pair_t pull[MHE_NODES];      /* in the gradient: the derivative of rho over the residual */
    real_pair_t curvature[MHE_NODES]; /* in the matrix */
} mhe_losses_t;

/* Of all nodes of the ring, in use or not: a loop of known length is computed two numbers at a time. The curvature: with
 * `careful` the same as the pull, a parabola above the loss that touches it, so that no step can climb; else the loss's
 * own curvature, which ends in fewer sweeps, where that is not negative. About 1000 instructions. */
void mhe_losses(const mhe_t *self, bool careful, mhe_losses_t *out);

/* The loss of a residual r, degC, times the scale squared: 1/2 r^2 where r is small. */
real_t mhe_loss_value(const mhe_t *self, real_t r);

#endif
