"""PI driver: turns a speed error into driving, regenerating and friction torque."""

from __future__ import annotations

from typing import NamedTuple

from plant_sim.params import DriverParams

STANDSTILL_MPS = 0.05


class DriverCommand(NamedTuple):
    """Torques asked for at the machine shaft, and the integrator after the step."""

    drive_nm: float
    regen_nm: float
    friction_nm: float
    integral_nm: float


def driver_step(
    v_mps: float,
    v_ref_mps: float,
    integral_nm: float,
    drive_limit_nm: float,
    regen_limit_nm: float,
    derate: float,
    dt_s: float,
    p: DriverParams,
) -> DriverCommand:
    """Advance the driver by one step.

    Parameters
    ----------
    v_mps, v_ref_mps
        Actual and wanted speed.
    integral_nm
        Integrator state.
    drive_limit_nm, regen_limit_nm
        Envelope at this speed, both positive.
    derate
        Derating factor 0..1; scales both limits.

    Returns
    -------
    DriverCommand
        ``regen_nm`` and ``friction_nm`` are zero or negative. At standstill with nothing wanted, all zero:
        the car is held by its brake, not by torque.
    """
    if v_ref_mps <= STANDSTILL_MPS and v_mps <= STANDSTILL_MPS:
        return DriverCommand(0.0, 0.0, 0.0, 0.0)
    error = v_ref_mps - v_mps
    wish = p.kp_nm_per_mps * error + integral_nm
    u = min(max(wish, p.u_min_nm), p.u_max_nm)
    if u >= 0.0:
        drive, regen, friction = min(u, drive_limit_nm * derate), 0.0, 0.0
        shortfall = drive - u
    else:
        drive, regen = 0.0, max(u, -regen_limit_nm * derate)
        friction = u - regen
        shortfall = 0.0
    # The integrator unwinds by what the clip and the envelope take away.
    rate = p.ki_nm_per_m * error + (u - wish + shortfall) * 2.0 * p.ki_nm_per_m / p.kp_nm_per_mps
    integral = min(max(integral_nm + dt_s * rate, -p.integral_max_nm), p.integral_max_nm)
    return DriverCommand(drive, regen, friction, integral)
