"""Mountain tracks: the synthetic test lap and random training tracks, as speed and slope over distance."""

from __future__ import annotations

from math import pi, sqrt

import numpy as np
from numpy.typing import NDArray

from plant_sim.cycles import Cycle
from plant_sim.interpolation import gaussian_smooth, pchip
from plant_sim.params import PlantParams
from plant_sim.vehicle import acceleration_mps2, motor_speed_rpm, motoring_limit_nm

STEP_M = 1.0
LAP_LENGTH_M = 20832.0
BRAKE_MPS2 = 4.5
START_MPS = 3.0
LAP_SEED = 3
_GRADE_MIN, _GRADE_MAX = -0.13, 0.18

# Our own elevation profile (km, m). Public facts held: 20.832 km, lowest 320 m near km 11, highest 616.8 m in
# the eastern climb, start and finish on the southern plateau. Everything between is authored.
LAP_ANCHORS_KM_M = (
    (0.00, 612.0),
    (0.60, 606.0),
    (1.25, 588.0),
    (1.90, 566.0),
    (2.45, 548.0),
    (3.05, 561.0),
    (3.70, 583.0),
    (4.35, 590.0),
    (5.00, 566.0),
    (5.60, 532.0),
    (6.15, 487.0),
    (6.65, 439.0),
    (7.05, 447.0),
    (7.60, 468.0),
    (8.20, 457.0),
    (8.85, 428.0),
    (9.50, 398.0),
    (10.10, 356.0),
    (10.60, 330.0),
    (11.00, 320.0),
    (11.50, 342.0),
    (12.15, 381.0),
    (12.80, 436.0),
    (13.45, 497.0),
    (14.10, 561.0),
    (14.75, 616.8),
    (15.50, 585.0),
    (16.20, 557.0),
    (17.05, 570.0),
    (18.10, 584.0),
    (19.10, 574.0),
    (20.15, 603.0),
)
_STRAIGHT_M = (18250.0, 20150.0)


def synthetic_lap(params: PlantParams, a_lat_mps2: float = 6.5) -> Cycle:
    """Return the synthetic 20.832-km lap: the test set, never part of a training set."""
    grade = lap_grade()
    curvature = corner_curvature(np.random.default_rng(LAP_SEED), LAP_LENGTH_M, 73, _STRAIGHT_M)
    v_ref = speed_profile(curvature, np.arctan(grade), STEP_M, a_lat_mps2, params)
    return Cycle("lap", True, STEP_M, v_ref, np.arctan(grade))


def lap_grade() -> NDArray[np.float64]:
    """Grade (rise over run) of the lap at each metre, periodic."""
    anchors = np.array(LAP_ANCHORS_KM_M)
    lap = np.array([LAP_LENGTH_M / 1000.0, 0.0])
    wrapped = np.vstack([anchors - lap, anchors, anchors + lap])
    s = np.arange(-500.0, LAP_LENGTH_M + 500.5, STEP_M)
    height = gaussian_smooth(pchip(wrapped[:, 0] * 1000.0, wrapped[:, 1], s), 40.0 / STEP_M)
    return np.clip(np.gradient(height, STEP_M), _GRADE_MIN, _GRADE_MAX)[500:-500]


def random_track(
    params: PlantParams,
    rng: np.random.Generator,
    length_m: float = 23000.0,
    speed_factor: float = 1.0,
    name: str = "track",
) -> Cycle:
    """Return a random mountain track for training: corners and hills like the lap's, never the lap itself.

    Parameters
    ----------
    rng
        Source of corners, hills and lateral acceleration U(5, 8).
    length_m
        Track length.
    speed_factor
        Scales the reference speed, for calmer laps.
    """
    knots = np.arange(0.0, length_m + 1400.0, 1400.0)
    height = [0.0]
    for _ in knots[1:]:
        # Random steps of 45 m per 1.4 km, drawn back to the middle so that a lap stays in the hills.
        height.append(0.93 * height[-1] + rng.normal(0.0, 45.0))
    s = np.arange(0.0, length_m + 0.5, STEP_M)
    grade = np.gradient(gaussian_smooth(pchip(knots, np.array(height), s), 40.0 / STEP_M), STEP_M)
    slope = np.arctan(np.clip(grade, _GRADE_MIN, _GRADE_MAX))
    begin = rng.uniform(0.1, 0.8) * length_m
    straight = (begin, begin + rng.uniform(0.6, 2.0) * 1000.0)
    curvature = corner_curvature(rng, length_m, round(length_m / 285.0), straight)
    v_ref = speed_profile(curvature, slope, STEP_M, rng.uniform(5.0, 8.0), params)
    return Cycle(name, True, STEP_M, np.maximum(v_ref * speed_factor, START_MPS), slope)


def corner_curvature(
    rng: np.random.Generator, length_m: float, corners: int, straight_m: tuple[float, float]
) -> NDArray[np.float64]:
    """Curvature in 1/m at each metre: corners with log-normal radii (105 m, sigma 0.70), one long straight.

    40 of 73 corners turn right (negative), the rest left; the speed profile uses the magnitude only.
    """
    radius = np.clip(rng.lognormal(np.log(105.0), 0.70, corners), 22.0, 600.0)
    turn = rng.uniform(20.0, 90.0, corners) * pi / 180.0
    arc = np.clip(radius * turn, 15.0, 300.0)
    free = length_m - (straight_m[1] - straight_m[0]) - arc.sum()
    gap = rng.dirichlet(np.full(corners + 1, 1.2)) * max(free, 0.0)
    if free < 0.0:
        arc *= (length_m - (straight_m[1] - straight_m[0])) / arc.sum()
    sign = np.ones(corners)
    sign[: round(corners * 40 / 73)] = -1.0
    rng.shuffle(sign)
    s = np.arange(0.0, length_m + 0.5, STEP_M)
    curvature = np.zeros_like(s)
    at = 0.0
    for k in range(corners):
        begin = at + gap[k]
        at = begin + arc[k]
        if begin >= straight_m[0]:  # corners after the straight are pushed behind it
            begin, end = begin + straight_m[1] - straight_m[0], at + straight_m[1] - straight_m[0]
        else:
            end = min(at, straight_m[0])
        curvature[int(begin / STEP_M) : int(end / STEP_M) + 1] = sign[k] / radius[k]
    return gaussian_smooth(curvature, 8.0 / STEP_M)


def speed_profile(
    curvature_1pm: NDArray[np.float64],
    slope_rad: NDArray[np.float64],
    step_m: float,
    a_lat_mps2: float,
    params: PlantParams,
) -> NDArray[np.float64]:
    """Quasi-steady full-power speed profile: cornering limit, forward pass on the envelope, backward on
    brakes.

    Returns
    -------
    v_ref in m/s at each grid point, starting at 3 m/s.
    """
    vehicle = params.vehicle
    with np.errstate(divide="ignore"):
        v = np.minimum(vehicle.v_max_mps, np.sqrt(a_lat_mps2 / np.maximum(np.abs(curvature_1pm), 1e-9)))
    v[0] = min(START_MPS, v[0])
    for i in range(v.size - 1):
        torque = motoring_limit_nm(motor_speed_rpm(v[i], vehicle), params.machine)
        a = acceleration_mps2(v[i], torque, slope_rad[i], vehicle)
        v[i + 1] = min(v[i + 1], sqrt(max(v[i] ** 2 + 2.0 * a * step_m, 1.0)))
    for i in range(v.size - 1, 0, -1):
        v[i - 1] = min(v[i - 1], sqrt(v[i] ** 2 + 2.0 * BRAKE_MPS2 * step_m))
    return v
