"""Longitudinal vehicle dynamics and the torque envelope of the drive.

Torques are at the machine shaft, forces act along the road.
"""

from math import cos, pi, sin

from plant_sim.params import MachineParams, VehicleParams

ROLLING_FROM_MPS = 0.05


def motor_speed_rpm(v_mps: float, p: VehicleParams) -> float:
    """Rotor speed at a vehicle speed: n = 30 v i / (pi r)."""
    return 30.0 * v_mps * p.gear_ratio / (pi * p.wheel_radius_m)


def acceleration_mps2(v_mps: float, torque_nm: float, slope_rad: float, p: VehicleParams) -> float:
    """Acceleration by drive and friction torque, slope, air and rolling resistance."""
    force = torque_nm * p.gear_ratio / p.wheel_radius_m
    force -= p.mass_kg * p.gravity_mps2 * sin(slope_rad)
    force -= 0.5 * p.drag_coeff * p.frontal_area_m2 * p.rho_air_kg_m3 * v_mps * v_mps
    if v_mps > ROLLING_FROM_MPS:
        force -= p.mass_kg * p.gravity_mps2 * p.roll_coeff * cos(slope_rad)
    return force / p.mass_kg


def vehicle_step(
    x_m: float, v_mps: float, torque_nm: float, slope_rad: float, dt_s: float, p: VehicleParams
) -> tuple[float, float]:
    """Advance position and speed by one explicit Euler step; the car never rolls backwards."""
    v_next = v_mps + dt_s * acceleration_mps2(v_mps, torque_nm, slope_rad, p)
    return x_m + dt_s * v_mps, max(v_next, 0.0)


def motoring_limit_nm(speed_rpm: float, p: MachineParams) -> float:
    """Largest driving torque at a rotor speed: torque limit, then constant power."""
    omega = abs(speed_rpm) * pi / 30.0
    return p.torque_max_nm if omega * p.torque_max_nm <= p.power_max_w else p.power_max_w / omega


def regen_limit_nm(speed_rpm: float, v_mps: float, p: MachineParams) -> float:
    """Largest braking torque (positive number); fades out between 12 and 5 km/h."""
    omega = abs(speed_rpm) * pi / 30.0
    limit = (
        p.regen_torque_max_nm
        if omega * p.regen_torque_max_nm <= p.regen_power_max_w
        else p.regen_power_max_w / omega
    )
    fade = (v_mps - p.regen_v_lo_mps) / (p.regen_v_hi_mps - p.regen_v_lo_mps)
    return limit * min(max(fade, 0.0), 1.0)
