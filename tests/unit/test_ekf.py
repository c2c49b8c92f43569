"""The Kalman filter in C against the textbook's matrices, beside the MHE, and in its place."""

from __future__ import annotations

import struct
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from estimator_c.formulation.lstm_numpy import lstm_step
from estimator_c.formulation.weights import NetWeights, load_weights
from tests.support.faulted_laps import FALLBACK, RUNNING, lap_of, library
from tests.support.libest_parts import Ekf
from tools.compare_drives import sense
from tools.estimators.drive import Drive
from tools.libest import WEIGHTS, Estimator
from tools.mhe_recorder import Record, record

DT_S = 0.1
STEPS = 400
QUADRATIC, FILTER = 0, 1  # EST_LOSS_..., EST_ARRIVAL_FROM_...
SAME = {"loss": QUADRATIC, "supervise": False, "arrival_from": FILTER, "bound_weight": 0.0}


@cache
def weights() -> NetWeights:
    return load_weights(WEIGHTS)


@cache
def data() -> Record:
    return record(weights(), steps=STEPS)


def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """One step of [theta, c, h]; takes complex x, for derivatives."""
    n = weights().memory_c
    c, h, rate = lstm_step(weights(), np.concatenate([u, x[:2]]), x[2 : 2 + n], x[2 + n :])
    return np.concatenate([x[:2] + DT_S * rate, c, h])


def jacobian(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Derivatives of `step` by the complex step: exact to the last digits, and nothing of the adjoint in it."""
    n, tiny = len(x), 1e-30
    columns = [step(x + 1j * tiny * np.eye(n)[k], u).imag / tiny for k in range(n)]
    return np.stack(columns, axis=1)


class TextbookEkf:
    """The filter of the books, with its matrices written out (Joseph's form of the update)."""

    def __init__(self, x: np.ndarray, p: np.ndarray, q: np.ndarray, r: np.ndarray) -> None:
        self.x, self.p, self.q, self.r = x, p, np.diag([*q, *np.zeros(len(x) - 2)]), r

    def predict(self, u: np.ndarray) -> None:
        f = jacobian(self.x, u)
        self.x, self.p = step(self.x, u), f @ self.p @ f.T + self.q

    def update(self, channel: int, y: float, share: float) -> None:
        h = np.eye(len(self.x))[channel]
        r = self.r[channel] / share
        gain = self.p @ h / (h @ self.p @ h + r)
        rest = np.eye(len(self.x)) - np.outer(gain, h)
        self.x = self.x + gain * (y - self.x[channel])
        self.p = rest @ self.p @ rest.T + r * np.outer(gain, gain)


def pair(setting: str = "default") -> tuple[Ekf, TextbookEkf]:
    """Both filters at the record's start."""
    filter_c = Ekf(library(), library().setting(setting))
    memory = np.concatenate(weights().empty_memory())
    filter_c.start(data().y[0], [10.0, 10.0], memory)
    return filter_c, TextbookEkf(filter_c.x, filter_c.p, filter_c.q, filter_c.r)


def test_noises_are_the_settings_inverse_weights() -> None:
    setting = library().setting("default")
    filter_c, _ = pair()
    np.testing.assert_allclose(filter_c.q, 1.0 / np.array(setting.weight_noise[:]), rtol=1e-15)
    np.testing.assert_allclose(filter_c.r, 1.0 / np.array(setting.weight_measurement[:]), rtol=1e-15)
    np.testing.assert_array_equal(np.diag(filter_c.p)[:2], [10.0, 10.0])
    assert (np.diag(filter_c.p)[2:] > 0.0).all(), "the net's memory is not known either"


@pytest.mark.parametrize("setting", ["default", "paper"])
def test_equals_the_textbook_with_missing_and_partial_measurements(setting: str) -> None:
    """Means and covariances of all states to 1e-9, over four hundred steps."""
    filter_c, textbook = pair(setting)
    rng = np.random.default_rng(3)
    for k in range(STEPS - 1):
        for f in (filter_c, textbook):
            f.predict(data().u[k])
        for channel in (0, 1):
            y, share = data().y[k + 1, channel], float(rng.choice([1.0, 0.3, 0.005]))
            if rng.random() < 0.7:
                filter_c.update(channel, y, share)
                textbook.update(channel, y, share)
        np.testing.assert_allclose(filter_c.x, textbook.x, rtol=0, atol=1e-9, err_msg=f"step {k}")
        np.testing.assert_allclose(filter_c.p, textbook.p, rtol=0, atol=1e-9, err_msg=f"step {k}")


@hypothesis_settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), missing=st.floats(0.0, 1.0))
def test_covariance_stays_symmetric_and_positive(seed: int, missing: float) -> None:
    filter_c, _ = pair()
    rng = np.random.default_rng(seed)
    for _ in range(150):
        filter_c.predict([rng.uniform(0, 11_000), rng.uniform(-160, 160)])
        for channel in (0, 1):
            if rng.random() >= missing:
                filter_c.update(channel, float(filter_c.x[channel] + rng.normal(0, 1)), float(rng.uniform(0.001, 1.0)))
        p = filter_c.p
        np.testing.assert_allclose(p, p.T, rtol=0, atol=1e-12 * np.abs(p).max())
        assert np.linalg.eigvalsh(0.5 * (p + p.T)).min() > -1e-12 * np.abs(p).max()
        assert (np.diag(p)[:2] > 0.0).all()


@pytest.mark.parametrize(("y", "share"), [(np.nan, 1.0), (np.inf, 1.0), (-np.inf, 1.0), (130.0, 0.0), (130.0, -1.0)])
def test_what_is_no_measurement_changes_nothing(y: float, share: float) -> None:
    filter_c, _ = pair()
    filter_c.predict(data().u[0])
    x, p = filter_c.x, filter_c.p
    filter_c.update(0, y, share)
    np.testing.assert_array_equal(filter_c.x, x)
    np.testing.assert_array_equal(filter_c.p, p)


def test_a_shift_moves_one_channel_and_cuts_its_ties() -> None:
    filter_c, _ = pair()
    for k in range(30):
        filter_c.predict(data().u[k])
        filter_c.update(0, data().y[k + 1, 0])
    x, p = filter_c.x, filter_c.p
    assert np.abs(p[0, 1:]).max() > 0.0
    filter_c.shift(0, -2.5, 0.25)
    moved = filter_c.p
    np.testing.assert_array_equal(filter_c.x, x - 2.5 * np.eye(len(x))[0])
    np.testing.assert_array_equal(moved[0], 0.25 * np.eye(len(x))[0])
    np.testing.assert_array_equal(moved[:, 0], moved[0])
    np.testing.assert_array_equal(moved[1:, 1:], p[1:, 1:])


# ---- beside the MHE, in the core --------------------------------------------------------------------------------


@cache
def drive() -> Drive:
    """Three minutes of the lap."""
    return sense(lap_of(), 0).cut(2500, 4300)


def run(setting: str, **changes: object) -> np.ndarray:
    """The core's rows over the drive, columns as in est_batch.h."""
    core = Estimator(library(), library().setting(setting, **changes))
    assert core.error == 0
    return core.run(drive().torque_nm, drive().speed_rpm, drive().y, drive().first_tick)


def test_mhe_and_filter_are_the_same_estimator() -> None:
    """Quadratic loss, no bounds, the filter's prediction as arrival cost: within 0.01 degC.

    What is left is the linearisation: the filter's about its predictions, the MHE's about its solution.
    """
    mhe, ekf = run("default", **SAME), run("ekf", **SAME)
    settled = slice(300, None)
    difference = np.abs(mhe[settled, 0:2] - ekf[settled, 0:2])
    assert difference.max() <= 0.01
    assert np.sqrt(np.mean(difference**2)) <= 0.002
    np.testing.assert_array_equal(mhe[settled, 11:13], ekf[settled, 11:13], "one filter gives the sigma of both")
    assert (mhe[settled, 5] > 0).all(), "the MHE did solve"
    assert (ekf[:, 5] == 0).all()


def test_an_mhe_that_is_cut_short_is_replaced_by_the_filter() -> None:
    """One sweep allowed, a tolerance that it cannot meet: where its step was not yet small, the filter speaks."""
    cut = run("default", **SAME | {"max_sweeps": 1, "tolerance_degc": 1e-9})
    ekf, whole = run("ekf", **SAME), run("default")
    fallen = cut[:, 4] == FALLBACK
    assert fallen.sum() >= 50
    assert (cut[fallen, 6] >= 0.01).all(), "an MHE that was nearly there is still used"
    assert (cut[~fallen & (cut[:, 6] >= 0.0), 6] < 0.01).all()
    np.testing.assert_array_equal(cut[fallen, 0:2], ekf[fallen, 0:2])
    running = cut[:, 4] == RUNNING
    assert np.abs(cut[running | fallen, 0:2] - whole[running | fallen, 0:2])[200:].max() < 0.15
    assert (whole[whole[:, 0] > 0.0, 4] == RUNNING).all()


def test_an_mhe_without_a_finite_result_is_replaced_and_comes_back() -> None:
    """Its loss is poisoned for three seconds: meanwhile there is an estimate, called a fallback; then it is well."""
    scale = 2.0 + 2.0**-30  # a value that occurs nowhere else
    setting = library().setting("default", loss_scale_degc=scale)
    core, sound = Estimator(library(), setting), Estimator(library(), setting)
    ekf = run("ekf")
    key, poison = struct.pack("<d", scale), struct.pack("<d", np.nan)
    rows = []
    for first, last in ((0, 600), (600, 630), (630, 1800)):
        part = drive().cut(first, last)
        if first == 600:
            assert core.memory.raw.count(key) == 3  # the core's setting, the fusion's, the MHE's
            core.memory.raw = core.memory.raw.replace(key, poison)
        elif first == 630:
            core.memory.raw = _put(core.memory.raw, sound.memory.raw, key)
        rows.append(core.run(part.torque_nm, part.speed_rpm, part.y, part.first_tick))
        sound.run(part.torque_nm, part.speed_rpm, part.y, part.first_tick)
    ill, well = rows[1], rows[2]
    assert (ill[:, 4] == FALLBACK).all()
    np.testing.assert_allclose(ill[:, 0:2], ekf[600:630, 0:2], rtol=0, atol=0.05)
    assert np.isfinite(well[:, 0:4]).all()
    assert (well[30:, 4] == RUNNING).all()
    assert core.counters.restarts == 0
    truth = lap_of().truth_degc[3130:4300]
    assert np.sqrt(np.mean((well[:, 0] - truth[:, 0]) ** 2)) < 0.12


def _put(into: bytes, like: bytes, key: bytes) -> bytes:
    """`into` with `key` where `like` has it."""
    out, at = bytearray(into), like.find(key)
    while at >= 0:
        out[at : at + len(key)] = key
        at = like.find(key, at + 1)
    return bytes(out)
