"""Whole runs as arrays, at 100 Hz or decimated to 10 Hz."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plant_sim.cycles import Cycle, CycleSpec
from plant_sim.errors import PlantStateError
from plant_sim.lptn import DT_S
from plant_sim.params import PlantParams
from plant_sim.plant import NO_RULE, Engine, Plant
from plant_sim.state import (
    ROW_SLOPE,
    ROW_SPEED,
    ROW_THETA_R,
    ROW_THETA_W,
    ROW_TORQUE,
    ROW_V,
    ROW_V_REF,
    ROW_X,
)


@dataclass(frozen=True, eq=False)
class Run:
    """One run; row k describes the interval from t_s[k] to t_s[k] + period.

    Attributes
    ----------
    torque_nm, n_rpm, v_ref_mps, slope_rad
        Mean over the interval.
    theta_w_degc, theta_r_degc, v_mps, x_m
        At the start of the interval.
    dtheta_w_degc_s, dtheta_r_degc_s
        (theta(k+1) - theta(k)) / period.
    theta_end_degc
        All 70 node temperatures at the end of the run.
    finished_s
        Time at which the cycle's end was reached, None if it was not.
    """

    t_s: NDArray[np.float64]
    n_rpm: NDArray[np.float64]
    torque_nm: NDArray[np.float64]
    theta_w_degc: NDArray[np.float64]
    theta_r_degc: NDArray[np.float64]
    dtheta_w_degc_s: NDArray[np.float64]
    dtheta_r_degc_s: NDArray[np.float64]
    v_mps: NDArray[np.float64]
    x_m: NDArray[np.float64]
    v_ref_mps: NDArray[np.float64]
    slope_rad: NDArray[np.float64]
    theta_end_degc: NDArray[np.float64]
    finished_s: float | None


def simulate(
    params: PlantParams,
    cycle: CycleSpec | Cycle,
    duration_s: float | None = None,
    *,
    theta0_degc: float | NDArray[np.float64] | None = None,
    rule_degc: tuple[float, float] = NO_RULE,
    rate_hz: int = 10,
    engine: Engine = "numba",
    max_s: float = 7200.0,
) -> Run:
    """Drive a cycle without sensors and return it as arrays.

    Parameters
    ----------
    params, cycle, theta0_degc, engine
        As for `Plant`.
    duration_s
        Stop after this time; None runs to the cycle's end (at most ``max_s``).
    rule_degc
        Linear derating (start, end) on the true winding temperature; default none.
    rate_hz
        10 or 100. A last, incomplete 0.1-s interval is dropped.
    """
    if rate_hz not in (10, 100):
        raise PlantStateError(f"rate {rate_hz} Hz is not offered: use 10 or 100")
    plant = Plant(params, cycle, theta0_degc=theta0_degc, engine=engine)
    start = plant.theta_degc
    ticks = round((duration_s if duration_s is not None else max_s) / DT_S)
    first = np.zeros((1, 8))
    first[0, [ROW_THETA_W, ROW_THETA_R]] = _theta_pair(start)
    rows = np.concatenate([first, plant.record(ticks, rule_degc=rule_degc)])
    per = round(1.0 / DT_S) // rate_hz
    count = (rows.shape[0] - 1) // per
    mean = rows[1 : 1 + count * per].reshape(count, per, 8).mean(axis=1)
    at = rows[: count * per + 1 : per]
    period = per * DT_S
    rate = np.diff(at[:, [ROW_THETA_W, ROW_THETA_R]], axis=0) / period
    return Run(
        np.arange(count) * period,
        mean[:, ROW_SPEED],
        mean[:, ROW_TORQUE],
        at[:-1, ROW_THETA_W],
        at[:-1, ROW_THETA_R],
        rate[:, 0],
        rate[:, 1],
        at[:-1, ROW_V],
        at[:-1, ROW_X],
        mean[:, ROW_V_REF],
        mean[:, ROW_SLOPE],
        plant.theta_degc,
        plant.tick * DT_S if plant.done else None,
    )


def _theta_pair(theta: NDArray[np.float64]) -> tuple[float, float]:
    from plant_sim.nodes import THETA_R, THETA_W

    return float(theta[THETA_W]), float(sum(theta[i] for i in THETA_R) / 3.0)
