#include "pi_driver.h"

static const double STANDSTILL_MPS = 0.05;

static double within(double x, double low, double high)
{
    return x > high ? high : x < low ? low : x;
}

pi_command_t pi_driver_step(pi_driver_t *self, const mpc_vehicle_t *vehicle, double v_mps, double v_ref_mps,
                            double drive_limit_nm,
                            double regen_limit_nm, double share, double dt_s)
{
    pi_command_t command = {0};
    if (v_ref_mps <= STANDSTILL_MPS && v_mps <= STANDSTILL_MPS) {
        self->integral_nm = 0.0;
        return command;
    }
    const double error = v_ref_mps - v_mps;
    const double wish = vehicle->kp_nm_per_mps * error + self->integral_nm;
    const double u = within(wish, vehicle->u_min_nm, vehicle->u_max_nm);
    double shortfall = 0.0;
    if (u >= 0.0) {
        const double most = drive_limit_nm * share;
        command.drive_nm = u < most ? u : most;
        command.cut = command.drive_nm < (u < drive_limit_nm ? u : drive_limit_nm);
        shortfall = command.drive_nm - u;
    } else {
        const double least = -regen_limit_nm * share;
        command.regen_nm = u > least ? u : least;
        command.friction_nm = u - command.regen_nm;
    }
    /* The integral unwinds by what the clip and the envelope take away. */
    const double unwind = 2.0 * vehicle->ki_nm_per_m / vehicle->kp_nm_per_mps;
    const double rate = vehicle->ki_nm_per_m * error + (u - wish + shortfall) * unwind;
    self->integral_nm = within(self->integral_nm + dt_s * rate, -vehicle->integral_max_nm, vehicle->integral_max_nm);
    return command;
}

void pi_driver_follow(pi_driver_t *self, const mpc_vehicle_t *vehicle, double v_mps, double v_ref_mps, double torque_nm)
{
    const double integral = torque_nm - vehicle->kp_nm_per_mps * (v_ref_mps - v_mps);
    self->integral_nm = within(integral, -vehicle->integral_max_nm, vehicle->integral_max_nm);
}
