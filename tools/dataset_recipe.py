"""What the training sets are made of: customised class-3 cycles (P, R) and random mountain laps (R only).

A recipe is a row of drives, each a pure function of the seed and of the `Chain` state that the drive before it
left: so a build can stop after any drive and go on later with the same rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from plant_sim.class3 import class3_trace
from plant_sim.cycles import Cycle, CycleSpec, GradeServo
from plant_sim.nodes import N_NODES
from plant_sim.params import PlantParams
from plant_sim.simulate import Run, simulate
from plant_sim.track import random_track
from tools.rows import COLUMNS

CYCLE_S = 1800
LAP_S = 720
Kind = Literal["road", "track"]
_STREAM: dict[Kind, int] = {"road": 1, "track": 2}  # each kind draws from its own random stream
_SPEED_FACTORS = ((1.9, 2.4), (1.5, 1.8), (1.2, 1.4), (0.96, 1.0))


_MIXED_TARGETS_DEGC = ((152.0, 160.0), (125.0, 152.0), (85.0, 125.0), (160.0, 170.0))
_MIXED_SHARES = (0.72, 0.14, 0.08, 0.06)
_HOT: dict[str, Any] = {
    "targets_degc": ((152.0, 158.0), (125.0, 152.0), (85.0, 125.0), (160.0, 170.0)),
    "target_shares": (0.80, 0.10, 0.06, 0.04),
    "payloads_kg": (300.0,),
}


@dataclass(frozen=True)
class Recipe:
    """Composition of a data set: customised road cycles, cold ones among them, and random track laps.

    Attributes
    ----------
    targets_degc, target_shares
        Bands of the winding temperature that the road's grade aims at, and how often each is drawn.
    payloads_kg
        Payload of a road cycle: drawn where there are several.
    """

    cycles: int
    cold: tuple[int, ...]
    laps: int
    targets_degc: tuple[tuple[float, float], ...] = _MIXED_TARGETS_DEGC
    target_shares: tuple[float, ...] = _MIXED_SHARES
    payloads_kg: tuple[float, ...] = (0.0, 150.0, 300.0)

    @property
    def drives(self) -> tuple[tuple[Kind, int], ...]:
        """All drives in the order of the set: kind and number within the kind."""
        roads: list[tuple[Kind, int]] = [("road", k) for k in range(self.cycles)]
        return (*roads, *(("track", k) for k in range(self.laps)))


# P has road cycles only, so they must be hot: a full car on every road is what brings the winding to 150..160 °C at
# speed (steeper roads would, too, but by slow climbing, and a net that learned from that is worse on the lap). R gets
# its heat from the laps and keeps cooler roads with other payloads: who never saw gentle driving does not know it.
RECIPES = {
    "R": Recipe(cycles=6, cold=(0, 3), laps=10),
    "P": Recipe(cycles=10, cold=(0, 4, 7), laps=0, **_HOT),
    "R-hot": Recipe(cycles=6, cold=(0, 3), laps=10, **_HOT),
}


@dataclass(frozen=True, eq=False)
class Chain:
    """What a drive hands to the next of its kind: node temperatures in °C (70,) and the random generator's state."""

    theta_degc: NDArray[np.float64]
    random: dict[str, Any]

    @classmethod
    def begin(cls, kind: Kind, seed: int) -> Chain:
        """Everything at 60 °C, nothing drawn yet."""
        return cls(np.full(N_NODES, 60.0), dict(np.random.default_rng([seed, _STREAM[kind]]).bit_generator.state))


def drive(
    params: PlantParams, recipe: Recipe, seed: int, kind: Kind, number: int, chain: Chain
) -> tuple[NDArray[np.float64], Chain]:
    """Simulate one drive of a recipe; returns its rows (n, 6) in the order of COLUMNS and what it leaves behind."""
    rng = np.random.default_rng()
    rng.bit_generator.state = chain.random
    make = _road if kind == "road" else _track
    run = make(params, recipe, seed, number, rng, chain.theta_degc)
    return rows_of(run), Chain(run.theta_end_degc, dict(rng.bit_generator.state))


def lap_rows(params: PlantParams) -> NDArray[np.float64]:
    """Rows (n, 6) of the synthetic test lap, underated, from 60 °C; never part of a training set."""
    return rows_of(simulate(params, CycleSpec("lap", theta0_degc=60.0)))


def rows_of(run: Run) -> NDArray[np.float64]:
    """Rows (n, 6) of a run in the order of COLUMNS."""
    return np.stack([getattr(run, name) for name in COLUMNS], axis=1)


def _road(
    params: PlantParams, recipe: Recipe, seed: int, k: int, rng: np.random.Generator, theta: NDArray[np.float64]
) -> Run:
    """One customised cycle; only the cold ones restart from a uniform temperature."""
    cold = k in recipe.cold
    start: float | NDArray[np.float64] = float(rng.choice([40.0, 60.0])) if cold else theta
    several = len(recipe.payloads_kg) > 1
    payload = float(rng.choice(recipe.payloads_kg)) if several else recipe.payloads_kg[0]
    heavy = params.varied(vehicle__mass_kg=params.vehicle.mass_kg + payload)
    cycle = customised_cycle(rng, recipe, cold, base_seed=100 * seed + k)
    return simulate(heavy, cycle, CYCLE_S, theta0_degc=start)


def _track(
    params: PlantParams, recipe: Recipe, seed: int, k: int, rng: np.random.Generator, theta: NDArray[np.float64]
) -> Run:
    """One random mountain lap, cut to equal length.

    Every third lap is calmer, every second one derated linearly from 150 °C, every fourth starts anew at
    U(25, 70) °C.
    """
    start: float | NDArray[np.float64] = float(rng.uniform(25.0, 70.0)) if k % 4 == 0 else theta
    factor = float(rng.uniform(0.85, 1.0)) if k % 3 == 2 else 1.0
    rule = (150.0, float(rng.uniform(156.0, 165.0))) if k % 2 == 1 else (0.0, 0.0)
    track = random_track(params, rng, length_m=29000.0, speed_factor=factor, name=f"track-{seed}-{k}")
    return simulate(params, track, LAP_S, theta0_degc=start, rule_degc=rule)


def customised_cycle(rng: np.random.Generator, recipe: Recipe, rotate: bool, base_seed: int) -> Cycle:
    """Return a faster class-3-like cycle on a road whose grade keeps the winding at drawn temperatures.

    Parameters
    ----------
    recipe
        Temperatures to aim at.
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

    def draw_target(rng: np.random.Generator) -> float:
        return rng.uniform(*recipe.targets_degc[rng.choice(len(recipe.targets_degc), p=recipe.target_shares)])

    for out, draw, hold in ((target, draw_target, (90.0, 240.0)), (dither, _draw_dither, (8.0, 40.0))):
        at = 0
        while at <= CYCLE_S:
            end = at + round(rng.uniform(*hold))
            out[at:end] = draw(rng)
            at = end
    return Cycle(f"custom-{base_seed}", False, 1.0, v, np.zeros_like(v), GradeServo(target, dither))


def _draw_dither(rng: np.random.Generator) -> float:
    return rng.normal(0.0, 0.02)
