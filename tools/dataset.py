"""Build training data from the plant: data set R (recommended), P (paper protocol), and the test lap.

``python -m tools.dataset --set R --seed 1 --out build/data/R.npz`` writes the set; the lap goes beside it as
``lap.npz``. Rows are 10-Hz intervals: mean speed and torque over the interval, temperatures at its start,
forward-difference rates.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plant_sim.class3 import class3_trace
from plant_sim.cycles import Cycle, CycleSpec, GradeServo
from plant_sim.errors import PlantError
from plant_sim.params import PlantParams, load_params
from plant_sim.simulate import Run, simulate
from plant_sim.track import random_track

CYCLE_S = 1800
LAP_S = 720
COLUMNS = ("n_rpm", "torque_nm", "theta_w_degc", "theta_r_degc", "dtheta_w_degc_s", "dtheta_r_degc_s")
_SPEED_FACTORS = ((1.9, 2.4), (1.5, 1.8), (1.2, 1.4), (0.96, 1.0))
_MASSES_KG = (0.0, 150.0, 300.0)


@dataclass(frozen=True)
class Recipe:
    """Composition of a data set: customised road cycles, cold ones among them, and random track laps."""

    cycles: int
    cold: tuple[int, ...]
    laps: int


RECIPES = {"R": Recipe(cycles=6, cold=(0, 3), laps=10), "P": Recipe(cycles=10, cold=(0, 4, 7), laps=0)}


@dataclass(frozen=True, eq=False)
class DataSet:
    """Rows of many trajectories in order; ``trajectory`` tells which row belongs to which run."""

    values: NDArray[np.float64]
    trajectory: NDArray[np.int32]

    @property
    def sha256(self) -> str:
        """Hash over the rows (little-endian float64, row by row, then the trajectory numbers)."""
        digest = hashlib.sha256(np.ascontiguousarray(self.values, dtype="<f8").tobytes())
        digest.update(np.ascontiguousarray(self.trajectory, dtype="<i4").tobytes())
        return digest.hexdigest()

    def column(self, name: str) -> NDArray[np.float64]:
        """One column by name."""
        return self.values[:, COLUMNS.index(name)]

    def arrays(self) -> dict[str, Any]:
        """Everything that the file holds; ``t_s`` counts from the start of each trajectory."""
        changes = np.flatnonzero(np.diff(self.trajectory, prepend=-1))
        start = np.repeat(changes, np.diff(np.append(changes, self.trajectory.size)))
        out: dict[str, Any] = {name: self.column(name).copy() for name in COLUMNS}
        return out | {
            "t_s": (np.arange(self.trajectory.size) - start) * 0.1,
            "trajectory": self.trajectory,
            "sha256": np.array(self.sha256),
        }


def customised_cycle(rng: np.random.Generator, rotate: bool, base_seed: int) -> Cycle:
    """Return a faster class-3-like cycle on a road whose grade keeps the winding at drawn temperatures.

    Parameters
    ----------
    rotate
        Begin with the extra-high phase (cold-start cycles): fast driving with a cold rotor.
    base_seed
        Which variant of the class-3 generator to bend.
    """
    trace, borders = class3_trace(base_seed)
    phases = [trace[borders[i] + 1 : borders[i + 1] + 1] * rng.uniform(*_SPEED_FACTORS[i]) for i in range(4)]
    v = np.concatenate([[0.0], *([phases[3], *phases[:3]] if rotate else phases)])
    v = np.minimum(v, 130.0 / 3.6)
    target, dither = np.empty(CYCLE_S + 1), np.empty(CYCLE_S + 1)
    for out, draw, hold in ((target, _draw_target, (90.0, 240.0)), (dither, _draw_dither, (8.0, 40.0))):
        at = 0
        while at <= CYCLE_S:
            end = at + round(rng.uniform(*hold))
            out[at:end] = draw(rng)
            at = end
    return Cycle(f"custom-{base_seed}", False, 1.0, v, np.zeros_like(v), GradeServo(target, dither))


def _draw_target(rng: np.random.Generator) -> float:
    """Winding target in degC; mostly the derating region, where accuracy matters."""
    low, high = ((152.0, 160.0), (125.0, 152.0), (85.0, 125.0), (160.0, 170.0))[
        rng.choice(4, p=(0.72, 0.14, 0.08, 0.06))
    ]
    return rng.uniform(low, high)


def _draw_dither(rng: np.random.Generator) -> float:
    return rng.normal(0.0, 0.02)


def road_runs(params: PlantParams, recipe: Recipe, seed: int) -> Iterator[Run]:
    """Drive the customised cycles in a row; only the cold ones restart from a uniform temperature."""
    rng = np.random.default_rng([seed, 1])
    theta: float | NDArray[np.float64] = 60.0
    for k in range(recipe.cycles):
        cold = k in recipe.cold
        if cold:
            theta = float(rng.choice([40.0, 60.0]))
        mass = float(rng.choice(_MASSES_KG))
        heavy = params.varied(vehicle__mass_kg=params.vehicle.mass_kg + mass)
        run = simulate(
            heavy, customised_cycle(rng, cold, base_seed=100 * seed + k), CYCLE_S, theta0_degc=theta
        )
        theta = run.theta_end_degc
        yield run


def track_runs(params: PlantParams, recipe: Recipe, seed: int) -> Iterator[Run]:
    """Drive random mountain laps, cut to equal length.

    Every third lap is calmer, every second one derated linearly from 150 degC, every fourth starts anew at
    U(25, 70) degC.
    """
    rng = np.random.default_rng([seed, 2])
    theta: float | NDArray[np.float64] = 60.0
    for k in range(recipe.laps):
        if k % 4 == 0:
            theta = float(rng.uniform(25.0, 70.0))
        factor = float(rng.uniform(0.85, 1.0)) if k % 3 == 2 else 1.0
        rule = (150.0, float(rng.uniform(156.0, 165.0))) if k % 2 == 1 else (0.0, 0.0)
        track = random_track(params, rng, length_m=29000.0, speed_factor=factor, name=f"track-{seed}-{k}")
        run = simulate(params, track, LAP_S, theta0_degc=theta, rule_degc=rule)
        theta = run.theta_end_degc
        yield run


def build_set(params: PlantParams, name: str, seed: int, progress=lambda text: None) -> DataSet:
    """Build data set R or P; the same seed gives the same rows.

    Raises
    ------
    PlantError
        If a run ended early or produced a value that is not finite.
    """
    recipe = RECIPES[name]
    blocks, labels = [], []
    for runs, length_s in (
        (road_runs(params, recipe, seed), CYCLE_S),
        (track_runs(params, recipe, seed), LAP_S),
    ):
        for run in runs:
            block = rows_of(run)
            if block.shape[0] != length_s * 10 or not np.isfinite(block).all():
                raise PlantError(
                    f"data set {name}, trajectory {len(blocks)}: {block.shape[0]} rows instead of "
                    f"{length_s * 10}, or not finite; change the seed and report the defect"
                )
            labels.append(np.full(block.shape[0], len(blocks), dtype=np.int32))
            blocks.append(block)
            progress(
                f"{name}: trajectory {len(blocks)}/{recipe.cycles + recipe.laps}, {block.shape[0]} rows, "
                f"winding {block[:, 2].min():.0f}..{block[:, 2].max():.0f} degC"
            )
    return DataSet(np.concatenate(blocks), np.concatenate(labels))


def build_lap(params: PlantParams) -> DataSet:
    """Drive the synthetic test lap, underated, from 60 degC; never part of a training set."""
    block = rows_of(simulate(params, CycleSpec("lap", theta0_degc=60.0)))
    return DataSet(block, np.zeros(block.shape[0], dtype=np.int32))


def rows_of(run: Run) -> NDArray[np.float64]:
    """Rows (n, 6) of a run in the order of COLUMNS."""
    return np.stack([getattr(run, name) for name in COLUMNS], axis=1)


def hot_share(data: DataSet) -> float:
    """Share of rows with the winding at 150..160 degC."""
    theta = data.column("theta_w_degc")
    return float(np.mean((theta >= 150.0) & (theta <= 160.0)))


def write_npz(path: Path, data: DataSet) -> None:
    """Write a data set so that a reader never sees half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    with part.open("wb") as file:
        np.savez(file, **data.arrays())
    os.replace(part, path)


def main(argv: list[str] | None = None) -> int:
    """Command line entry."""
    parser = argparse.ArgumentParser(description="Build a training data set and the test lap from the plant.")
    parser.add_argument(
        "--set", choices=sorted(RECIPES), default="R", help="R: cycles and tracks; P: cycles only"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True, help="file to write; lap.npz goes beside it")
    args = parser.parse_args(argv)
    try:
        params = load_params()
        data = build_set(params, args.set, args.seed, lambda text: print(text, flush=True))
        write_npz(args.out, data)
        lap = build_lap(params)
        write_npz(args.out.with_name("lap.npz"), lap)
    except (PlantError, OSError) as error:
        print(f"dataset: {error}", file=sys.stderr)
        return 1
    print(
        f"{args.out}: {data.values.shape[0]} rows, {hot_share(data):.1%} at 150..160 degC, "
        f"sha256 {data.sha256}"
    )
    print(
        f"{args.out.with_name('lap.npz')}: {lap.values.shape[0]} rows, "
        f"winding max {lap.column('theta_w_degc').max():.1f} "
        f"degC, sha256 {lap.sha256}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
