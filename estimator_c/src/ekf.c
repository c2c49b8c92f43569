#include "ekf.h"

#include <math.h>
#include <string.h>

static const double MEMORY_VARIANCE = 0.01; /* cells live in -1..1; after the spin-up the memory is roughly right */

void ekf_init(ekf_t *self, const est_setting_t *setting)
{
    memset(self, 0, sizeof *self);
    for (int ch = 0; ch < EKF_CHANNELS; ch++) {
        self->q[ch] = 1.0 / setting->weight_noise[ch];
        self->r[ch] = setting->weight_measurement[ch] > 0.0 ? 1.0 / setting->weight_measurement[ch] : INFINITY;
    }
}

void ekf_start(ekf_t *self, const double theta[EKF_CHANNELS], const double variance[EKF_CHANNELS],
               const double memory[])
{
    memset(self->p, 0, sizeof self->p);
    for (int ch = 0; ch < EKF_CHANNELS; ch++) {
        self->theta[ch] = theta[ch];
        self->p[ch][ch] = variance[ch];
    }
    memcpy(self->memory, memory, sizeof self->memory);
    for (int k = EKF_CHANNELS; k < EKF_N; k++) {
        self->p[k][k] = MEMORY_VARIANCE;
    }
}

/* Rows of the Jacobian of [theta + dt rate, memory_next]: the adjoint, seeded with one unit vector after the other. */
static void jacobian(const double tape[], const double memory[], double f[EKF_N][EKF_N])
{
    for (int i = 0; i < EKF_N; i++) {
        double rate_bar[EKF_CHANNELS] = {0};
        double memory_bar[NET_MEMORY] = {0};
        if (i < EKF_CHANNELS) {
            rate_bar[i] = NET_DT_S;
        } else {
            memory_bar[i - EKF_CHANNELS] = 1.0;
        }
        net_adjoint(tape, memory, rate_bar, memory_bar, &f[i][0], &f[i][EKF_CHANNELS]);
        if (i < EKF_CHANNELS) {
            f[i][i] += 1.0;
        }
    }
}

void ekf_predict(ekf_t *self, const double u[2])
{
    double f[EKF_N][EKF_N];
    double fp[EKF_N][EKF_N];
    double memory[NET_MEMORY];
    double rate[EKF_CHANNELS];
    double tape[NET_TAPE];
    net_forward(u, self->theta, self->memory, memory, rate, tape);
    jacobian(tape, self->memory, f);
    for (int ch = 0; ch < EKF_CHANNELS; ch++) {
        self->theta[ch] += NET_DT_S * rate[ch];
    }
    memcpy(self->memory, memory, sizeof memory);
    for (int i = 0; i < EKF_N; i++) {
        for (int j = 0; j < EKF_N; j++) {
            fp[i][j] = 0.0;
        }
        for (int k = 0; k < EKF_N; k++) {
            for (int j = 0; j < EKF_N; j++) {
                fp[i][j] += f[i][k] * self->p[k][j];
            }
        }
    }
    for (int i = 0; i < EKF_N; i++) {
        for (int j = 0; j <= i; j++) {
            double sum = i == j && i < EKF_CHANNELS ? self->q[i] : 0.0;
            for (int k = 0; k < EKF_N; k++) {
                sum += fp[i][k] * f[j][k];
            }
            self->p[i][j] = sum;
            self->p[j][i] = sum;
        }
    }
}

void ekf_update(ekf_t *self, int channel, double y, double share)
{
    if (!isfinite(y) || share <= 0.0) {
        return;
    }
    double gain[EKF_N];
    double row[EKF_N];
    const double innovation = y - self->theta[channel];
    const double s = self->p[channel][channel] + self->r[channel] / share;
    for (int i = 0; i < EKF_N; i++) {
        row[i] = self->p[channel][i];
        gain[i] = row[i] / s;
    }
    for (int i = 0; i < EKF_N; i++) {
        for (int j = 0; j < EKF_N; j++) {
            self->p[i][j] -= gain[i] * row[j];
        }
    }
    for (int ch = 0; ch < EKF_CHANNELS; ch++) {
        self->theta[ch] += gain[ch] * innovation;
    }
    for (int k = 0; k < NET_MEMORY; k++) {
        self->memory[k] += gain[EKF_CHANNELS + k] * innovation;
    }
}

void ekf_shift(ekf_t *self, int channel, double shift, double variance)
{
    self->theta[channel] += shift;
    for (int i = 0; i < EKF_N; i++) {
        self->p[channel][i] = 0.0;
        self->p[i][channel] = 0.0;
    }
    self->p[channel][channel] = variance;
}
