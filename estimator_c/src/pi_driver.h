/* The driver of the plant, as a law that a controller can follow: proportional, integral, torque limits, friction for
 * the rest. */
#ifndef PI_DRIVER_H
#define PI_DRIVER_H

#include <stdbool.h>

#include "mpc_settings.h"

typedef struct {
    double integral_nm;
} pi_driver_t;

typedef struct {
    double drive_nm;    /* >= 0 */
    double regen_nm;    /* <= 0 */
    double friction_nm; /* <= 0 */
    bool cut;           /* the share took driving torque away */
} pi_command_t;

/* One step of dt_s with the machine's limits (both >= 0) times share (0..1). At standstill with nothing wanted: no
 * torque, no integral. Pure but for the integral; 10 ns. */
pi_command_t pi_driver_step(pi_driver_t *self, const mpc_vehicle_t *vehicle, double v_mps, double v_ref_mps,
                            double drive_limit_nm,
                            double regen_limit_nm, double share, double dt_s);

/* Another one drove: take over its torque without a jump. */
void pi_driver_follow(pi_driver_t *self, const mpc_vehicle_t *vehicle, double v_mps, double v_ref_mps,
                      double torque_nm);

#endif
