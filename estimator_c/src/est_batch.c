#include "est_batch.h"

#include <math.h>
#include <stddef.h>

static void write_row(const estimator_out_t *out, double row[EST_BATCH_COLUMNS])
{
    const double values[EST_BATCH_COLUMNS] = {
        out->theta_w_degc, out->theta_r_degc, out->innov_w_degc, out->innov_r_degc, out->status, out->sweeps,
        out->kkt_degc, out->channel[0].fault, out->channel[1].fault, out->channel[0].trusted, out->channel[1].trusted,
        out->channel[0].sigma_degc, out->channel[1].sigma_degc, out->channel[0].upper_degc, out->channel[1].upper_degc,
        out->channel[0].innov_sigma_degc, out->channel[1].innov_sigma_degc, out->calibration.state,
        out->calibration.offset_degc[0], out->calibration.offset_degc[1]};
    for (int k = 0; k < EST_BATCH_COLUMNS; k++) {
        row[k] = values[k];
    }
}

void est_batch_run(estimator_t *self, int64_t intervals, uint16_t first_tick, const double torque_nm[],
                   const double speed_rpm[], const double meas[], const double coolant_degc[], const bool soaked[],
                   double out[])
{
    uint16_t tick = first_tick;
    for (int64_t k = 0; k < intervals; k++) {
        for (int j = 0; j < ESTIMATOR_TICKS; j++) {
            tick = (uint16_t)(tick + 1);
            estimator_feed_motor(self, tick, torque_nm[k * ESTIMATOR_TICKS + j], speed_rpm[k * ESTIMATOR_TICKS + j], true);
        }
        if (coolant_degc != NULL && !isnan(coolant_degc[k])) {
            estimator_feed_coolant(self, coolant_degc[k], soaked != NULL && soaked[k], true);
        }
        const double w = meas[2 * k];
        const double r = meas[2 * k + 1];
        estimator_feed_temp(self, tick, w, r, !isnan(w), !isnan(r));
        estimator_out_t result;
        estimator_step(self, &result);
        estimator_finish(self);
        write_row(&result, &out[k * EST_BATCH_COLUMNS]);
    }
}
