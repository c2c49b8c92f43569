"""The envelope of the training data and its monitor: C = numpy, every flag fires, wolves are not cried on the lap."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimator_c.formulation.envelope import read_envelope
from estimator_c.formulation.errors import FormulationError
from estimator_c.formulation.weights import load_weights
from tests.support.nets import random_net
from tools.check_validity import CASES, watch
from tools.envelope import envelope_of, novelty_of
from tools.libest import WEIGHTS, Lib, Validity, compile_library
from tools.rows import Rows

JUDGED, SETTLING, NOT_AVAILABLE = 2, 1, 0


def drive(seed: int, n: int = 4000, coolant_degc: float = 60.0) -> np.ndarray:
    """(n, 4) rows of a two-mass machine on random speed and torque: enough of a heat balance to be learned."""
    rng = np.random.default_rng(seed)
    speed = np.repeat(rng.uniform(1000, 9000, n // 50 + 1), 50)[:n]
    torque = np.repeat(rng.uniform(-60, 120, n // 50 + 1), 50)[:n]
    torque = np.minimum(torque, 40e3 / (speed * np.pi / 30))  # a machine of 40 kW
    theta, rows = np.array([80.0, 70.0]), np.empty((n, 4))
    for k in range(n):
        rows[k] = speed[k], torque[k], *theta
        loss = np.array([6e-5 * torque[k] ** 2, 2e-9 * speed[k] ** 2])
        theta = theta + 0.1 * (loss - (theta - coolant_degc) * [0.012, 0.006] + 0.004 * (theta[::-1] - theta))
    return rows


def rows_of(drives: list[np.ndarray]) -> Rows:
    x = np.concatenate(drives)
    trajectory = np.concatenate([np.full(len(d), k) for k, d in enumerate(drives)])
    return Rows(x, np.zeros((len(x), 2)), trajectory, "0" * 64)


@cache
def trained() -> Rows:
    return rows_of([drive(seed) for seed in range(8)])


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A net whose weights file carries the envelope of `trained()`."""
    path = random_net(tmp_path_factory.mktemp("net"), 3)
    document = json.loads(path.read_text())
    document["envelope"] = envelope_of(trained())
    path.write_text(json.dumps(document))
    return path


@pytest.fixture(scope="module")
def lib(net: Path) -> Lib:
    return Lib(compile_library(net))


def test_every_row_of_the_training_data_is_inside(net: Path, lib: Lib) -> None:
    envelope = load_weights(net).envelope
    assert envelope is not None
    for piece in trained().pieces():
        assert novelty_of(envelope, trained().x[piece]).max() <= 1.0
    said = lib.validity(trained().x[trained().pieces()[3]])
    assert not any(any(v.flags) for v in said)
    assert [v.scope for v in said] == [SETTLING] * 1200 + [JUDGED] * 2800


@pytest.mark.parametrize("factor", [1.0, 1.2])
def test_c_equals_numpy(net: Path, lib: Lib, factor: float) -> None:
    envelope = load_weights(net).envelope
    assert envelope is not None
    x = drive(77) * factor
    wanted, said = novelty_of(envelope, x), lib.validity(x)
    np.testing.assert_allclose([v.novelty for v in said], wanted, rtol=1e-12, atol=1e-12)
    assert [any(v.flags) for v in said] == list(wanted > 1.0)
    assert (np.mean(wanted > 1.0) > 0.2) == (factor > 1.0)  # both sides of the face are compared


OUTSIDE: dict[str, tuple[str, Callable[[np.ndarray], Any]]] = {
    "over-speed": ("speed", lambda x: x[:, 0].__imul__(1.5)),
    "over-torque": ("torque", lambda x: x[:, 1].__imul__(2.5)),
    "reverse": ("speed", lambda x: x[:, 0].__imul__(-1.0)),
    "hot winding": ("theta_w", lambda x: x[:, 2].__iadd__(60.0)),
    "cold rotor": ("theta_r", lambda x: x[:, 3].__isub__(60.0)),
}


@pytest.mark.parametrize("name", OUTSIDE)
def test_each_input_alone_is_seen_at_once(lib: Lib, name: str) -> None:
    kind, change = OUTSIDE[name]
    x = drive(78, 400)
    change(x)
    said = lib.validity(x)
    assert any(v.flags[Validity.KINDS.index(kind)] for v in said)
    others = {k for k in Validity.KINDS if k not in (kind, "joint")}
    assert not any(v.flags[Validity.KINDS.index(k)] for v in said for k in others)


def test_too_much_power_is_seen_though_speed_and_torque_are_usual(lib: Lib) -> None:
    x = drive(79, 10)
    x[5, :2] = 8500.0, 110.0
    said = lib.validity(x)
    assert [v.flags for v in said[4:7]] == [(False,) * 5, (False,) * 4 + (True,), (False,) * 5]


def test_failed_coolant_is_seen_before_any_temperature_is_unusual(lib: Lib) -> None:
    x = drive(5, 4000)
    x[2000:, 2:] += 16.0 * (1 - np.exp(-np.arange(2000) / 600.0))[:, None]
    said = lib.validity(x)
    assert not any(any(v.flags) for v in said[:2000])
    flags = np.array([v.flags for v in said])
    only_joint = flags[:, 4] & ~flags[:, :4].any(axis=1)
    assert only_joint.sum() > 50
    assert np.argmax(flags[:, 4]) < np.argmax(flags[:, :4].any(axis=1)) or not flags[:, :4].any()


def test_not_finite_is_outside_and_starts_again(lib: Lib) -> None:
    x = drive(80, 1300)
    x[1250, 2] = math.nan
    said = lib.validity(x)
    assert (said[1249].scope, said[1250].scope, said[1251].scope) == (JUDGED, SETTLING, SETTLING)
    assert all(said[1250].flags)
    assert said[1250].novelty == math.inf
    assert not any(said[1251].flags)


def test_without_an_envelope_nothing_is_said(tmp_path: Path) -> None:
    said = Lib(compile_library(random_net(tmp_path, 3))).validity(drive(81, 5) * 100)
    assert all(v.scope == NOT_AVAILABLE and math.isnan(v.novelty) and not any(v.flags) for v in said)


def test_short_drives_have_no_envelope_and_constant_ones_a_wide_enough_one() -> None:
    assert envelope_of(rows_of([drive(k, 1500) for k in range(1)])) is None
    still = np.tile([5000.0, 50.0, 90.0, 80.0], (2000, 1))
    envelope = read_envelope("net.json", envelope_of(rows_of([still])))
    assert novelty_of(envelope, still).max() < 1.0
    assert novelty_of(envelope, still + [0, 0, 3.0, 0]).max() > 1.0


Change = Callable[[dict[str, Any]], Any]
CORRUPTIONS: dict[str, tuple[str, Change]] = {
    "not an object": ("envelope", lambda d: d.update(envelope=[1])),
    "missing": ("envelope.lower", lambda d: d["envelope"].pop("lower")),
    "text": ("envelope.centre", lambda d: d["envelope"]["centre"].__setitem__(0, "1")),
    "shape": ("envelope.directions", lambda d: d["envelope"]["directions"].pop()),
    "nan": ("envelope.upper", lambda d: d["envelope"]["upper"].__setitem__(0, math.nan)),
    "turned": ("envelope.lower", lambda d: d["envelope"]["lower"].__setitem__(1, 1e4)),
    "power": ("envelope.power_kw", lambda d: d["envelope"].update(power_kw=[3.0, 1.0])),
    "tau": ("envelope.tau_s", lambda d: d["envelope"].update(tau_s=0.0)),
    "settle": ("envelope.settle_s", lambda d: d["envelope"].update(settle_s=-1.0)),
}


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_a_broken_envelope_names_its_field(name: str, net: Path, tmp_path: Path) -> None:
    field, change = CORRUPTIONS[name]
    document = json.loads(net.read_text())
    change(document)
    path = tmp_path / "net.json"
    path.write_text(json.dumps(document))
    with pytest.raises(FormulationError) as caught:
        load_weights(path)
    assert caught.value.field == field
    assert "tools.envelope" in str(caught.value)


# ---- the committed net, the plant, the whole core ---------------------------------------------------------------


@cache
def committed() -> Lib:
    assert load_weights(WEIGHTS).envelope is not None, f"{WEIGHTS.name} carries no envelope: run tools.envelope"
    return Lib(compile_library(WEIGHTS))


def test_false_alarms_on_the_unseen_lap_are_below_one_percent() -> None:
    lap = next(case for case in CASES if case.name == "lap")
    found = watch(committed(), lap, seed=1)
    assert found.steps > 7000
    assert found.flagged_percent < 1.0


@pytest.mark.parametrize(
    ("name", "kind", "duration_s", "within_s"),
    [
        ("coolant 65 -> 95 degC", "joint", 500.0, 240.0),
        ("coolant flow 6 -> 0.1 L/min", "joint", 500.0, 480.0),
        ("over-speed x1.3", "speed", 60.0, 60.0),
        ("over-torque x1.3", "torque", 60.0, 60.0),
        ("cold soak -20 degC", "theta_r", 60.0, 5.0),
    ],
)
def test_faults_are_flagged(name: str, kind: str, duration_s: float, within_s: float) -> None:
    case = next(case for case in CASES if case.name == name)
    found = watch(committed(), case, seed=1, duration_s=duration_s)
    assert found.percent[kind] > 0.0
    assert found.first_s is not None
    assert found.first_s < within_s
