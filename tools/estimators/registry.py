"""All estimators by name."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from functools import cache
from pathlib import Path

from estimator_c.formulation.weights import load_weights
from rt_runner.errors import SetupError
from tools.estimators.drive import VARIANCE_K2, Estimator
from tools.estimators.fixed_gain import FixedGain
from tools.estimators.lptn_kf import LptnKf
from tools.estimators.net import Net, pack
from tools.estimators.plain import AVERAGE_ROWS, MovingAverage
from tools.estimators.tuned import Tuned, load_tuned
from tools.estimators.ukf import Ukf

BASE = Path(__file__).resolve().parents[2] / "estimator_c"
GATE_SIGMAS = 4.0
NO_GATE = math.inf
R_K2 = (VARIANCE_K2, VARIANCE_K2)

OFFLINE = ("ukf", "lptn-kf", "fixed-gain", "open-loop", "average", "raw")
GATED = ("ukf-gated", "lptn-kf-gated", "fixed-gain-gated")  # with a gate that the textbook's versions do not have
COMPARED = ("default", "paper", "ekf", *OFFLINE)  # what a comparison shows unless told otherwise


class UnknownEstimator(Exception):
    """No estimator of that name; the message says which there are."""


def settings() -> tuple[str, ...]:
    """Names of the C core's settings, by their files.

    Raises
    ------
    SetupError
        There are none: this is no checkout.
    """
    found = tuple(sorted(path.stem for path in (BASE / "settings").glob("*.toml")))
    if not found:
        raise SetupError(f"{BASE / 'settings'} is missing: settings, weights and DBC are in a checkout: run this there")
    return found


def known() -> tuple[str, ...]:
    """Every name `make` takes."""
    return (*settings(), *OFFLINE, *GATED)


def make(name: str) -> Estimator:
    """The estimator of that name.

    Raises
    ------
    UnknownEstimator
        No such name, or a setting that the built library does not carry.
    """
    if name in OFFLINE + GATED:
        return offline(name, load_tuned())
    if name not in settings():
        raise UnknownEstimator(f"no estimator '{name}': choose from {', '.join(known())}")
    from tools.estimators.core import Core
    from tools.libest import load

    lib = load()
    try:
        return Core(name, lib)
    except (KeyError, AttributeError):
        raise UnknownEstimator(f"{lib.path} has no setting '{name}': run 'make build'") from None


def offline(name: str, tuned: Tuned) -> Estimator:
    """One of the baselines, with the given figures."""
    kind, _, gated = name.partition("-gated")
    del gated
    gate = GATE_SIGMAS if name in GATED else NO_GATE
    std = tuned.innovation_std_degc
    makers: dict[str, Callable[[], Estimator]] = {
        "ukf": lambda: Ukf(name, _net(), _noise_k2(), R_K2, gate),
        "lptn-kf": lambda: LptnKf(name, tuned.network, tuned.lptn_q_k2, R_K2, gate),
        "fixed-gain": lambda: FixedGain(name, _net(), tuned.gain, (gate * std[0], gate * std[1])),
        "open-loop": lambda: FixedGain(name, _net(), (0.0, 0.0), (NO_GATE, NO_GATE)),
        "average": lambda: MovingAverage(name, AVERAGE_ROWS),
        "raw": lambda: MovingAverage(name, 1),
    }
    return makers[kind]()


@cache
def _net() -> Net:
    return pack(load_weights(BASE / "weights" / "lstm8.json"))


@cache
def _noise_k2() -> tuple[float, float]:
    """The default setting's process noise: its weights are inverse variances."""
    with (BASE / "settings" / "default.toml").open("rb") as file:
        w, r = tomllib.load(file)["weights"]["noise"]
    return 1.0 / w, 1.0 / r
