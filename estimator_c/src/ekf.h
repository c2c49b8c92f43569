/* Extended Kalman filter with the trained net as its model: state [theta(2), memory(NET_MEMORY)], noise on theta only.
 *
 * The baseline beside the moving horizon estimator, its stand-in when that gives no usable solution, and where its
 * uncertainty comes from: with quadratic loss and no active bound both are the same estimator. Derivatives of the net
 * are exact (its adjoint, row by row).
 *
 * No allocation, no clock, no printing; one thread at a time per object; sizeof(ekf_t) = 3 kB with 8 cells, the
 * caller's. */
#ifndef EKF_H
#define EKF_H

#include "est_settings.h"
#include "thermal_net.h"

enum { EKF_CHANNELS = 2, EKF_N = EKF_CHANNELS + NET_MEMORY };

typedef struct {
    double theta[EKF_CHANNELS];  /* degC */
    double memory[NET_MEMORY];
    double p[EKF_N][EKF_N];      /* covariance of [theta, memory] */
    double q[EKF_CHANNELS];      /* variance of the noise per step, K^2 */
    double r[EKF_CHANNELS];      /* variance of a measurement, K^2 */
} ekf_t;

/* Take noise and measurement variances (inverse weights) of `setting`. Never fails. */
void ekf_init(ekf_t *self, const est_setting_t *setting);

/* Begin at that temperature, known to `variance` (K^2), and that memory of the net, taken as known. Never fails. */
void ekf_start(ekf_t *self, const double theta[EKF_CHANNELS], const double variance[EKF_CHANNELS],
               const double memory[]);

/* One step of the net with u = [speed rpm, torque Nm]. One net step, NET_MEMORY + 2
 * adjoints and two products of EKF_N x EKF_N matrices: about 45 thousand instructions with 8 cells. Never fails. */
void ekf_predict(ekf_t *self, const double u[2]);

/* Use measurement y (offset removed) of a channel with `share` (0..1) of its weight; 0 or a value that is not finite:
 * nothing happens. Never fails. */
void ekf_update(ekf_t *self, int channel, double y, double share);

/* The temperature of a channel was off by `shift`; it is now known to `variance` (K^2), apart from everything else. */
void ekf_shift(ekf_t *self, int channel, double shift, double variance);

#endif
