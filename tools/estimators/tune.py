"""Fit what the baselines need to training-type drives: the four-node network, its noise, the fixed gains and gates.

    python -m tools.estimators.tune            # rewrites tools/estimators/tuned.json, about three minutes

Nothing here has seen the test lap. The network is fitted to data set R, seed 1, which the net was trained on; noise and
gains are tuned on R, seed 2, which neither has seen, with the sensor's noise on top.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plant_sim.params import load_params
from tools.estimators import lptn
from tools.estimators.drive import DELAY_STEPS, OFFSET_DEGC, VARIANCE_K2, Drive, Estimator, run
from tools.estimators.jit import compiled
from tools.estimators.lptn import NODES, ROTOR, Lptn
from tools.estimators.tuned import FILE, Tuned
from tools.files import write_whole
from tools.rows import Rows

Array = NDArray[np.float64]
FIT_SEED, TUNE_SEED = 1, 2
JUDGED_FROM = 100  # rows: 10 s
FORGET_S = 60.0  # the fit sees errors grow for about so long: the time a filter has to live without a sensor
FIT_EVERY = 10  # rows per residual
FIRST_GUESS = Lptn(1900.0, 2000.0, 3200.0, 4300.0, 15.0, 100.0, 27.0, 1.0, 1.6, 6.0, 0.4, 3.7, 0.4, 5.0)


@dataclass(frozen=True, eq=False)
class Example:
    """A training-type drive with its truth (n, 2)."""

    drive: Drive
    truth: Array


def examples(rows: Rows, seed: int) -> list[Example]:
    """Drives of a data set as the bus would carry them; the sensor as in its data sheet."""
    rng, found = np.random.default_rng([seed, 4]), []
    for piece in rows.pieces():
        x = rows.x[piece]
        truth = x[:, 2:].copy()
        # A data set's row holds the input of the interval that leaves its node; here that of the one that arrives.
        u = np.concatenate([x[:1, :2], x[:-1, :2]])
        late = np.concatenate([np.repeat(truth[:1], DELAY_STEPS, axis=0), truth[:-DELAY_STEPS]])
        y = late + OFFSET_DEGC + np.sqrt(VARIANCE_K2) * rng.standard_normal(late.shape)
        found.append(Example(Drive(np.repeat(u[:, 1], 10), np.repeat(u[:, 0], 10), u, y), truth))
    return found


def errors(estimator: Estimator, cases: Sequence[Example]) -> Array:
    """Errors (N, 2) from 10 s of each drive on."""
    found = [run(estimator, case.drive).theta_degc - case.truth for case in cases]
    return np.concatenate([e[JUDGED_FROM:] for e in found])


# ---- the network: smallest prediction error of an observer that forgets in a minute --------------------------------
@compiled
def _drift(network, u, heat, truth, share, out):
    theta, slope = np.empty(NODES), np.empty((NODES, NODES))
    theta[0], theta[ROTOR] = truth[0, 0], truth[0, 1]
    theta[1] = theta[2] = 0.5 * (theta[0] + lptn.COOLANT_DEGC)
    for k in range(1, len(truth)):
        lptn.step(network, u[k, 0], heat[k], theta, slope)
        for ch in range(2):
            at = 0 if ch == 0 else ROTOR
            out[k, ch] = theta[at] - truth[k, ch]
            theta[at] -= share * out[k, ch]


def drift(network: Lptn, case: Example, heat: Array) -> Array:
    """(n, 2): how far the network is off when pulled to the truth with a time constant of FORGET_S."""
    out = np.zeros_like(case.truth)
    _drift(network, case.drive.u, heat, case.truth, lptn.DT_S / FORGET_S, out)
    return out


def fit_network(cases: Sequence[Example]) -> Lptn:
    """Least squares over the logarithms of all parameters; the first minute of a drive is not judged."""
    from scipy.optimize import least_squares

    warm = [lptn.heats(case.drive.u) for case in cases]

    def residuals(logs: Array) -> Array:
        network = Lptn(*np.exp(logs))
        parts = [drift(network, case, heat)[600::FIT_EVERY] for case, heat in zip(cases, warm, strict=True)]
        return np.nan_to_num(np.concatenate(parts).ravel(), nan=1e3, posinf=1e3, neginf=-1e3)

    start = np.log(np.array(FIRST_GUESS))
    found = least_squares(residuals, start, bounds=(start - 3.0, start + 3.0), x_scale=0.3, max_nfev=60)
    print(f"network: RMS drift {np.sqrt(np.mean(found.fun**2)):.4f} K over {len(found.fun)} figures", file=sys.stderr)
    return Lptn(*(float(v) for v in np.exp(found.x)))


# ---- one figure at a time along a ladder of factors, as long as something gets better ------------------------------
def descend(values: list[float], cost: Callable[[list[float]], float], factors: Sequence[float]) -> list[float]:
    """Coordinate search in ratios; `factors` from coarse to fine."""
    best = cost(values)
    for factor in factors:
        moved = True
        while moved:
            moved = False
            for k in range(len(values)):
                for ratio in (factor, 1.0 / factor):
                    trial = [*values]
                    trial[k] *= ratio
                    found = cost(trial)
                    if found < 0.9995 * best:
                        values, best, moved = trial, found, True
    return values


def tune(tuned: Tuned, cases: Sequence[Example]) -> Tuned:
    """Gains and process noise with the least RMSE, relative to the sensor's noise, both channels alike."""
    from tools.estimators.registry import offline

    def cost_of(name: str, candidate: Tuned) -> float:
        return float(np.sum(np.sqrt(np.mean(errors(offline(name, candidate), cases) ** 2, axis=0))))

    gain = descend(
        list(tuned.gain), lambda v: cost_of("fixed-gain", replace(tuned, gain=(v[0], v[1]))), (2.0, 1.25, 1.08)
    )
    tuned = replace(tuned, gain=(gain[0], gain[1]))
    print(f"fixed gain {tuned.gain}: cost {cost_of('fixed-gain', tuned):.4f} K", file=sys.stderr)
    noise = descend(
        list(tuned.lptn_q_k2), lambda v: cost_of("lptn-kf", replace(tuned, lptn_q_k2=tuple(v))), (10.0, 3.0, 1.5)
    )
    tuned = replace(tuned, lptn_q_k2=tuple(noise))
    print(f"lptn-kf noise {tuned.lptn_q_k2}: cost {cost_of('lptn-kf', tuned):.4f} K", file=sys.stderr)
    return replace(tuned, innovation_std_degc=innovation_std(tuned, cases))


def innovation_std(tuned: Tuned, cases: Sequence[Example]) -> tuple[float, float]:
    """Of the fixed-gain observer, per channel: what its gate is a multiple of."""
    from tools.estimators.registry import offline

    found = []
    for case in cases:
        now = run(offline("fixed-gain", tuned), case.drive).theta_degc
        # The observer's estimate of now is its prediction for the measurement that comes 1.5 s later.
        found.append((case.drive.y[DELAY_STEPS:] - OFFSET_DEGC - now[:-DELAY_STEPS])[JUDGED_FROM:])
    std = np.concatenate(found).std(axis=0)
    return float(std[0]), float(std[1])


def main() -> int:
    from tools.dataset import build_set

    params = load_params()
    fit = examples(build_set(params, "R", FIT_SEED).rows, FIT_SEED)
    network = fit_network(fit)
    cases = examples(build_set(params, "R", TUNE_SEED).rows, TUNE_SEED)
    start = Tuned(network, (1e-3, 1e-4, 1e-4, 1e-4), (0.07, 0.03), (0.35, 0.33))
    tuned = tune(start, cases)
    document: dict[str, Any] = {
        "from": f"tools.estimators.tune: network fitted to data set R seed {FIT_SEED}, the rest tuned on seed "
        f"{TUNE_SEED}; units in tools/estimators/tuned.py",
        **asdict(tuned),
        "network": network._asdict(),
    }
    write_whole(Path(FILE), (json.dumps(document, indent=1) + "\n").encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
