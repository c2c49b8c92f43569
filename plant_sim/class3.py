"""A road cycle with the phase lengths, distances and top speeds of the class-3 regulation cycle.

Not the regulation's trace: micro-trips are drawn at random, followed by a rate-limited car, and bent until
each phase covers its distance. Seed 0 is the base trace.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from plant_sim.cycles import Cycle
from plant_sim.errors import CycleError


@dataclass(frozen=True)
class Phase:
    """One phase: regulated length, distance, top speed and standstill time; the number of trips is ours."""

    name: str
    duration_s: int
    distance_m: float
    v_top_kmh: float
    idle_s: int
    trips: int


PHASES = (
    Phase("low", 589, 3095.0, 56.5, 150, 6),
    Phase("medium", 433, 4756.0, 76.6, 48, 3),
    Phase("high", 455, 7162.0, 97.4, 31, 2),
    Phase("extra-high", 323, 8254.0, 131.3, 8, 1),
)
_SUB = 10  # inner steps per second
_DECEL = 1.35
_LAG_S = 2.0


@lru_cache(maxsize=64)
def class3_trace(seed: int = 0) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return speed in m/s at 0..1800 s (1801,) and the five phase borders in s, both read only."""
    rng = np.random.default_rng([seed, 3])
    traces = [_phase_trace(phase, rng) for phase in PHASES]
    borders = np.cumsum([0] + [p.duration_s for p in PHASES])
    v = np.concatenate([[0.0], *traces])
    v.setflags(write=False)
    borders.setflags(write=False)
    return v, borders


def class3_cycle(seed: int = 0, v_max_mps: float = 130.0 / 3.6) -> Cycle:
    """Return the plain cycle on a flat road, clipped to the car's top speed."""
    v, _ = class3_trace(seed)
    v = np.minimum(v, v_max_mps)
    return Cycle(f"class3-{seed}", False, 1.0, v, np.zeros_like(v))


def _phase_trace(phase: Phase, rng: np.random.Generator) -> NDArray[np.float64]:
    """One phase at 1..duration seconds, from rest to rest, with the exact distance and top speed."""
    for _ in range(200):
        level, peak = _levels(phase, rng)
        low, high = 0.05, 6.0
        if not _distance(level, peak, low, phase) > phase.distance_m > _distance(level, peak, high, phase):
            continue
        for _ in range(60):
            middle = 0.5 * (low + high)
            if middle in (low, high):
                break
            if _distance(level, peak, middle, phase) > phase.distance_m:
                low = middle
            else:
                high = middle
        v = _follow(level, peak, high, phase)
        if abs(v.max() - phase.v_top_kmh / 3.6) < 1e-9 and v[-1] == 0.0 and 0.35 < high < 2.5:
            return v
    raise CycleError(f"class-3 generator: phase '{phase.name}' found no trace; use another seed")


def _levels(phase: Phase, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Relative target speed per inner step (0 = stop), and where the phase's top speed is held."""
    level = np.zeros(phase.duration_s * _SUB)
    peak = np.zeros(level.size, dtype=bool)
    v_top = phase.v_top_kmh / 3.6
    driving = phase.duration_s - phase.idle_s
    share = rng.dirichlet(np.full(phase.trips, 5.0))
    idle = rng.dirichlet(np.full(phase.trips + 1, 3.0)) * phase.idle_s
    fast = int(rng.integers(phase.trips)) if phase.trips > 1 else 0
    fast = int(np.argmax(share)) if share[fast] * driving < 3.2 * v_top else fast
    at = idle[0]
    for trip in range(phase.trips):
        length = share[trip] * driving
        top = 1.0 if trip == fast else rng.uniform(0.45, 0.9)
        brake = min(top * v_top / _DECEL + 2.0 * _LAG_S, 0.45 * length)
        cruise = length - brake
        count = max(1, int(cruise / rng.uniform(9.0, 22.0)))
        edges = at + cruise * np.concatenate([[0.0], np.cumsum(rng.dirichlet(np.full(count, 4.0)))])
        fractions = top * rng.uniform(0.35, 0.97, count)
        summit = int(np.argmax(np.diff(edges)[count // 3 :])) + count // 3
        fractions[summit] = top
        for k in range(count):
            a, b = int(edges[k] * _SUB), int(edges[k + 1] * _SUB)
            level[a:b] = fractions[k]
            if trip == fast and k == summit:
                peak[a:b] = True
        at += length + idle[trip + 1]
    return level, peak


def _follow(
    level: NDArray[np.float64], peak: NDArray[np.bool_], bend: float, phase: Phase
) -> NDArray[np.float64]:
    """Speed at full seconds of a rate-limited car that follows the bent levels."""
    v_top = phase.v_top_kmh / 3.6
    # Aim above the top where it is held, and cut: the top speed is then reached exactly.
    target = v_top * np.where(peak, 1.06, np.minimum(level**bend, 1.0) * (level > 0.0))
    v, out = 0.0, np.empty(phase.duration_s)
    dt = 1.0 / _SUB
    for i, wanted in enumerate(target.tolist()):
        rate = (wanted - v) / _LAG_S
        rise = 1.45 - 0.027 * v
        if rate > rise:
            rate = rise
        elif rate < -_DECEL:
            rate = -_DECEL
        v += dt * rate
        if wanted == 0.0 and v < 0.15:
            v = 0.0
        if (i + 1) % _SUB == 0:
            out[(i + 1) // _SUB - 1] = min(v, v_top)
    return out


def _distance(level: NDArray[np.float64], peak: NDArray[np.bool_], bend: float, phase: Phase) -> float:
    """Distance in m of the trace, integrated over its 1-s samples."""
    return float(np.sum(_follow(level, peak, bend, phase)))
