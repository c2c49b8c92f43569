/* A recorded drive through the estimator's core at once: what the process does frame by frame in lock-step at 10 Hz, without
 * bus and clock. For campaigns of many runs; the process does not use it. */
#ifndef EST_BATCH_H
#define EST_BATCH_H

#include "estimator.h"

enum { EST_BATCH_COLUMNS = 20 };

/* Feed `intervals` intervals to a freshly initialised estimator. Interval k: ten motor frames (torque_nm, speed_rpm:
 * 10 values each, ticks first_tick + 10 k + 1 ...), one temperature frame (meas[2 k], meas[2 k + 1]; NAN: not available)
 * with the tick of the tenth, then one estimator_step(). coolant: one value per interval (NAN: no frame), or NULL;
 * soaked: the flag that goes with it, or NULL. out: EST_BATCH_COLUMNS doubles per interval:
 *   0 theta_w 1 theta_r 2 innov_w 3 innov_r 4 status 5 sweeps 6 kkt
 *   7 fault_w 8 fault_r 9 trusted_w 10 trusted_r 11 sigma_w 12 sigma_r 13 upper_w 14 upper_r
 *   15 innov_sigma_w 16 innov_sigma_r 17 calibration state 18 offset_w 19 offset_r
 * Cost: the sum of its calls. One thread per object. */
void est_batch_run(estimator_t *self, int64_t intervals, uint16_t first_tick, const double torque_nm[],
                   const double speed_rpm[], const double meas[], const double coolant_degc[], const bool soaked[],
                   double out[]);

#endif
