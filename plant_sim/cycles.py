"""Driving cycles: what the driver wants to do, over time or over distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plant_sim.errors import CycleError
from plant_sim.params import PlantParams

SLOWEST_MPS = 0.5  # of a cycle over distance
CYCLE_KINDS = ("lap", "class3", "csv")


@dataclass(frozen=True)
class CycleSpec:
    """What cycle to build; small, comparable, fit for a configuration file.

    Attributes
    ----------
    kind
        ``lap`` (synthetic mountain circuit), ``class3`` (regulation-like road cycle) or ``csv``.
    path
        CSV file, for ``csv`` only.
    theta0_degc
        Temperature of all nodes at the start.
    seed
        ``class3``: 0 is the base trace, others are variants. ``lap``: the track is fixed, seed is not used
        for it.
    a_lat_mps2
        Lateral acceleration of the speed profile on a lap or on a CSV with curvature; None takes 6.5 or 8.0.
    length_m
        Stretch a distance CSV to this length; None keeps it.
    """

    kind: str = "lap"
    path: str | None = None
    theta0_degc: float = 60.0
    seed: int = 0
    a_lat_mps2: float | None = None
    length_m: float | None = None


@dataclass(frozen=True, eq=False)
class GradeServo:
    """A road whose grade steers the winding towards a target: brings training data to the hot region.

    Attributes
    ----------
    target_degc, dither
        Target temperature and additional grade per second of the cycle, held within the second.
    """

    target_degc: NDArray[np.float64]
    dither: NDArray[np.float64]
    gain_1_k: float = 0.010
    offset: float = 0.02
    grade_min: float = -0.07
    grade_max: float = 0.11
    filter_s: float = 6.0
    from_mps: float = 3.0


@dataclass(frozen=True, eq=False)
class Cycle:
    """Reference speed and slope on a uniform grid of time or distance, read with linear interpolation.

    Attributes
    ----------
    by_distance
        True: the grid is in metres (with derating the car is slower, the road must not run ahead); False: in
        seconds.
    step
        Grid step in m or s.
    v_ref_mps, slope_rad
        (N,) values at k * step; the first and last value hold beyond the ends.
    servo
        Replaces the slope if present.
    """

    name: str
    by_distance: bool
    step: float
    v_ref_mps: NDArray[np.float64]
    slope_rad: NDArray[np.float64]
    servo: GradeServo | None = None

    def __post_init__(self) -> None:
        if (
            self.v_ref_mps.shape != self.slope_rad.shape
            or self.v_ref_mps.ndim != 1
            or self.v_ref_mps.size < 2
        ):
            raise CycleError(
                f"cycle '{self.name}': speed and slope need the same length of at least 2 samples"
            )
        if not self.step > 0.0:
            raise CycleError(f"cycle '{self.name}': step {self.step} must be positive")
        if not (np.isfinite(self.v_ref_mps).all() and np.isfinite(self.slope_rad).all()):
            raise CycleError(f"cycle '{self.name}': speed and slope must be finite")
        if self.v_ref_mps.min() < 0.0:
            raise CycleError(f"cycle '{self.name}': negative reference speed; the car only drives forwards")
        if self.by_distance and self.v_ref_mps.min() < SLOWEST_MPS:
            raise CycleError(
                f"cycle '{self.name}': reference speed falls below {SLOWEST_MPS} m/s; over distance the car would "
                f"stand there for ever, so raise the speed"
            )

    @property
    def end(self) -> float:
        """Length in m or duration in s."""
        return self.step * (self.v_ref_mps.size - 1)

    def reference(self, t_s: float, x_m: float, lookahead_m: float) -> tuple[float, float]:
        """Return wanted speed (m/s) and slope (rad) at a time and place."""
        if self.by_distance:
            return (
                interpolate(self.v_ref_mps, (x_m + lookahead_m) / self.step),
                interpolate(self.slope_rad, x_m / self.step),
            )
        return interpolate(self.v_ref_mps, t_s / self.step), interpolate(self.slope_rad, t_s / self.step)

    def done(self, t_s: float, x_m: float) -> bool:
        """Whether the cycle's end is reached."""
        return (x_m if self.by_distance else t_s) >= self.end - 1e-9


def interpolate(values: NDArray[np.float64], position: float) -> float:
    """Linear interpolation at a fractional index; the end values hold."""
    position = min(max(position, 0.0), values.size - 1.0)
    i = min(int(position), values.size - 2)
    w = position - i
    return float(values[i] * (1.0 - w) + values[i + 1] * w)


def build_cycle(spec: CycleSpec, params: PlantParams) -> Cycle:
    """Build the cycle that a specification asks for.

    Raises
    ------
    CycleError
        If the kind is unknown, or a CSV file is missing or unusable.
    """
    if spec.kind == "lap":
        from plant_sim.track import synthetic_lap

        return synthetic_lap(params, a_lat_mps2=spec.a_lat_mps2 or 6.5)
    if spec.kind == "class3":
        from plant_sim.class3 import class3_cycle

        return class3_cycle(spec.seed, params.vehicle.v_max_mps)
    if spec.kind == "csv":
        from plant_sim.csv_cycle import read_csv_cycle

        if spec.path is None:
            raise CycleError(
                "cycle kind 'csv' needs a file: set path to a CSV with time or distance, speed, grade"
            )
        return read_csv_cycle(spec.path, params, a_lat_mps2=spec.a_lat_mps2 or 8.0, length_m=spec.length_m)
    raise CycleError(f"unknown cycle kind '{spec.kind}': use one of {', '.join(CYCLE_KINDS)}")
