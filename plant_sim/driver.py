"""PI driver: turns a speed error into driving, regenerating and friction torque; or a controller's command instead."""

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


class TorqueCommand(NamedTuple):
    """What a controller asks of machine and brakes, at the machine shaft: accelerate >= 0, brake and friction <= 0."""

    accelerate_nm: float
    brake_nm: float
    friction_nm: float


def obey(
    command: TorqueCommand,
    v_mps: float,
    v_ref_mps: float,
    drive_limit_nm: float,
    regen_limit_nm: float,
    p: DriverParams,
) -> DriverCommand:
    """Clip a command to the envelope at this speed; a part of the wrong sign is no torque.

    Returns
    -------
    DriverCommand
        Its integrator is the one that makes the PI driver ask for the same torque: it takes over without a jump.
    """
    drive = min(max(command.accelerate_nm, 0.0), drive_limit_nm)
    regen = max(min(command.brake_nm, 0.0), -regen_limit_nm)
    friction = max(min(command.friction_nm, 0.0), p.u_min_nm)
    integral = drive + regen + friction - p.kp_nm_per_mps * (v_ref_mps - v_mps)
    return DriverCommand(drive, regen, friction, min(max(integral, -p.integral_max_nm), p.integral_max_nm))


def linear_share(theta_degc: float, start_degc: float, end_degc: float) -> float:
    """Linear derating: 1 up to the start, 0 from the end on."""
    return min(max((end_degc - theta_degc) / (end_degc - start_degc), 0.0), 1.0)


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
