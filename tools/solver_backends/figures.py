"""From the runner's numbers to figures: quantiles, errors against the oracle, the JSON document."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tools.solver_backends.configs import HPIPM_NAMES, KEYS, Config

Array = NDArray[np.float64]
STEP_NS, SOLVE_NS, AHEAD_NS, THETA, AHEAD, KKT, SWEEPS, STATUS = 0, 1, 2, slice(3, 5), slice(5, 7), 7, 8, 9
COLUMNS, WINDOW_DOUBLES = 10, 33
FIELDS = ("median_us", "p99_us", "max_us", "instructions", "max_error_degc", "state_bytes")
Figures = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Measured:
    """What one run of bench_solver gave; S steps, B backends (the reference first), C chosen steps.

    Attributes
    ----------
    rows : (B, S, COLUMNS)
        See bench_solver.c.
    windows : (C, B, WINDOW_DOUBLES)
        Nodes, then their temperatures.
    problems : (C, ...)
        Length, then the problem of the step.
    state_bytes : (B,)
    """

    rows: Array
    windows: Array
    problems: Array
    state_bytes: tuple[int, ...]

    def window(self, place: int, backend: int) -> Array:
        """Temperatures (nodes, 2) of a chosen step, oldest first."""
        count = int(self.windows[place, backend, 0])
        return self.windows[place, backend, 1 : 1 + 2 * count].reshape(count, 2)


def read_measured(data: Array, words: Sequence[str]) -> Measured:
    """The runner's file and what it printed."""
    steps, backends, places, problem = (int(word) for word in words[:4])
    ends = np.cumsum([backends * steps * COLUMNS, places * backends * WINDOW_DOUBLES, places * problem])
    if len(data) != ends[-1]:
        raise ValueError(f"bench_solver wrote {len(data)} numbers and announced {ends[-1]}")
    rows, windows, problems = np.split(data, ends[:-1])
    return Measured(
        rows.reshape(backends, steps, COLUMNS),
        windows.reshape(places, backends, WINDOW_DOUBLES),
        problems.reshape(places, problem),
        tuple(int(word) for word in words[4:]),
    )


def figures_of(
    measured: Measured, at: int, answers: dict[int, Array], kinds: NDArray[np.str_], compared: bool
) -> Figures:
    """Figures of the backend at place `at`.

    Parameters
    ----------
    answers
        Chosen step -> the oracle's temperatures.
    kinds : (S,)
        Group of each step.
    compared
        It solves the recorded problems to the tolerance: its largest error counts every node of the oracle's windows,
        and the newest node's difference from the reference in all steps. Otherwise None.
    """
    rows = measured.rows[at]
    us, solve_us = rows[:, STEP_NS] / 1e3, rows[:, SOLVE_NS] / 1e3
    apart = np.abs(rows[:, THETA] - measured.rows[0, :, THETA]).max(axis=1)
    to_oracle = [np.abs(measured.window(place, at) - theta).max() for place, theta in answers.items()]
    worst = float(max([apart.max(), *to_oracle])) if compared else None
    return {
        "median_us": float(np.median(us)),
        "p99_us": float(np.percentile(us, 99)),
        "max_us": float(us.max()),
        "instructions": None,
        "max_error_degc": worst if worst is None or np.isfinite(worst) else None,
        "state_bytes": measured.state_bytes[at],
        "solve_median_us": float(np.median(solve_us)),
        "solve_p99_us": float(np.percentile(solve_us, 99)),
        "ahead_median_us": float(np.median(rows[:, AHEAD_NS])) / 1e3,
        "sweeps_mean": float(rows[:, SWEEPS].mean()),
        "sweeps_max": int(rows[:, SWEEPS].max()),
        "unconverged_steps": int((rows[:, STATUS] != 0).sum()),
        "oracle_error_degc": float(max(to_oracle)) if to_oracle else None,
        "apart_degc": {"p99": float(np.percentile(apart, 99)), "max": float(apart.max())},
        "kinds": {
            str(kind): {
                "steps": int((kinds == kind).sum()),
                "median_us": float(np.median(us[kinds == kind])),
                "p99_us": float(np.percentile(us[kinds == kind], 99)),
                "sweeps_mean": float(rows[kinds == kind, SWEEPS].mean()),
                "apart_max_degc": float(apart[kinds == kind].max()),
            }
            for kind in dict.fromkeys(kinds.tolist())
        },
    }


def oracle_figures(took_us: Sequence[float]) -> Figures:
    """Of the oracle's own row."""
    us = np.array(took_us)
    return {
        "median_us": float(np.median(us)), "p99_us": float(np.percentile(us, 99)), "max_us": float(us.max()),
        "instructions": None, "max_error_degc": None, "state_bytes": None,
    }  # fmt: skip


def best_hpipm(found: dict[str, Figures]) -> str | None:
    """The HPIPM configuration with the smallest median."""
    names = [name for name in HPIPM_NAMES if name in found]
    return min(names, key=lambda name: found[name]["median_us"]) if names else None


def document(found: dict[str, Figures]) -> dict[str, dict[str, Any]]:
    """The JSON document: KEYS x FIELDS, null where there is nothing to say."""
    best = best_hpipm(found)
    every = found | ({"best_hpipm": found[best]} if best else {})
    return {key: {field: every.get(key, {}).get(field) for field in FIELDS} for key in KEYS}


def ratio(found: dict[str, Figures], fast: str, slow: str | None) -> float | None:
    """How many times longer the slow one takes, by medians."""
    if slow is None or fast not in found or slow not in found:
        return None
    return found[slow]["median_us"] / found[fast]["median_us"]


def by_name(configs: Sequence[Config], figures: Sequence[Figures]) -> dict[str, Figures]:
    """{name: figures}."""
    return {config.name: figure for config, figure in zip(configs, figures, strict=True)}
