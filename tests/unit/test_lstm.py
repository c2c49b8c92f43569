"""One net, four programs: torch, numpy, CasADi and the generated C agree to 1e-12 in double precision."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from estimator_c.formulation.lstm import build_lstm
from estimator_c.formulation.lstm_numpy import lstm_sequence, lstm_step
from estimator_c.formulation.weights import LstmWeights, load_weights
from tests.support.libest import WEIGHTS, Lib, compile_library
from tests.support.nets import random_net

TOLERANCE = 1e-12
STEPS = 300
Sequence = Callable[[LstmWeights, Path, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


@pytest.fixture(scope="module", params=["lstm8", "random-8", "random-3", "random-16"])
def net_path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    if request.param == "lstm8":
        return WEIGHTS
    hidden = int(request.param.split("-")[1])
    return random_net(tmp_path_factory.mktemp("net"), hidden=hidden, seed=hidden)


def drive(n: int = STEPS, seed: int = 3) -> np.ndarray:
    """(n, 4) rows of rpm, Nm, degC, degC that change every 20 steps, over the whole operating range."""
    rng = np.random.default_rng(seed)
    levels = np.stack(
        [rng.uniform(0, 11000, n), rng.uniform(-160, 160, n), rng.uniform(20, 170, n), rng.uniform(20, 140, n)], 1
    )
    return np.repeat(levels, 20, axis=0)[:n]


def by_torch(weights: LstmWeights, path: Path, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    try:
        import torch
    except ImportError:
        message = "torch is not installed (pip extra 'train'): torch = numpy is NOT checked"
        if os.environ.get("RT_REQUIRE_TORCH") == "1":
            pytest.fail(message)
        pytest.skip(message)
    lstm = torch.nn.LSTM(4, weights.hidden, batch_first=True, dtype=torch.float64)
    output = torch.nn.Linear(weights.hidden, 2, dtype=torch.float64)
    with torch.no_grad():
        lstm.weight_ih_l0.copy_(torch.tensor(weights.w_u))
        lstm.weight_hh_l0.copy_(torch.tensor(weights.w_h))
        lstm.bias_ih_l0.copy_(torch.tensor(weights.b))
        lstm.bias_hh_l0.zero_()
        output.weight.copy_(torch.tensor(weights.w_y))
        output.bias.copy_(torch.tensor(weights.b_y))
        u = torch.tensor((x - weights.in_offset) / weights.in_scale)
        hidden, (h, c) = lstm(u[None])
        rates = weights.out_offset + weights.out_scale * output(hidden)[0].numpy()
    return rates, c[0, 0].numpy(), h[0, 0].numpy()


def by_casadi(weights: LstmWeights, path: Path, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    forward = build_lstm(weights).forward
    c = h = np.zeros(weights.hidden)
    rates = np.empty((len(x), 2))
    for k, row in enumerate(x):
        c, h, rate = (np.array(value).ravel() for value in forward(row[:2], row[2:], c, h)[:3])
        rates[k] = rate
    return rates, c, h


def by_c(weights: LstmWeights, path: Path, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    lib = Lib(compile_library(path))
    assert lib.sha256 == weights.sha256
    c = h = np.zeros(weights.hidden)
    rates = np.empty((len(x), 2))
    for k, row in enumerate(x):
        c, h, rates[k], _ = lib.lstm_forward(row[:2], row[2:], c, h)
    return rates, c, h


@pytest.mark.parametrize("program", [by_torch, by_casadi, by_c])
def test_equals_numpy(program: Sequence, net_path: Path) -> None:
    weights, x = load_weights(net_path), drive()
    expected = lstm_sequence(weights, x)
    assert np.ptp(expected[0]) > 0.01  # the drive moves the net at all
    for found, wanted in zip(program(weights, net_path, x), expected, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=0, atol=TOLERANCE)


def operating_point(weights: LstmWeights, seed: int) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    c, h, _ = lstm_step(weights, drive(1, seed)[0], rng.normal(size=weights.hidden), rng.uniform(-1, 1, weights.hidden))
    return drive(1, seed + 100)[0], c, h


@pytest.mark.parametrize("seed", range(3))
def test_adjoint_in_c_equals_casadis_derivative(net_path: Path, seed: int) -> None:
    weights = load_weights(net_path)
    net, lib, n_h = build_lstm(weights), Lib(compile_library(net_path)), weights.hidden
    x, c, h = operating_point(weights, seed)
    rng = np.random.default_rng(seed)
    bars = [rng.normal(size=size) for size in (2, n_h, n_h)]

    sym = [ca.SX.sym(name, size) for name, size in (("u", 2), ("t", 2), ("c", n_h), ("h", n_h))]
    c_next, h_next, rate, _ = net.forward(*sym)
    merit = ca.dot(rate, bars[0]) + ca.dot(c_next, bars[1]) + ca.dot(h_next, bars[2])
    gradients = ca.Function("g", sym, [ca.gradient(merit, s) for s in sym[1:]])(x[:2], x[2:], c, h)

    tape = lib.lstm_forward(x[:2], x[2:], c, h)[3]
    for found, wanted in zip(lib.lstm_adjoint(tape, c, *bars), gradients, strict=True):
        np.testing.assert_allclose(found, np.array(wanted).ravel(), rtol=0, atol=TOLERANCE)


def test_slope_in_c_equals_casadis_derivative(net_path: Path) -> None:
    weights = load_weights(net_path)
    net, lib, n_h = build_lstm(weights), Lib(compile_library(net_path)), weights.hidden
    x, c, h = operating_point(weights, 5)
    sym = [ca.SX.sym(name, size) for name, size in (("u", 2), ("t", 2), ("c", n_h), ("h", n_h))]
    jacobian = ca.Function("j", sym, [ca.jacobian(net.forward(*sym)[2], sym[1])])(x[:2], x[2:], c, h)
    tape = lib.lstm_forward(x[:2], x[2:], c, h)[3]
    np.testing.assert_allclose(lib.lstm_slope(tape, c), np.diag(np.array(jacobian)), rtol=0, atol=TOLERANCE)


def test_saturated_gates_stay_finite(tmp_path: Path) -> None:
    """Weights far beyond training drive every exp to its limits; the C must give numpy's 0 and 1, not NaN."""
    path = random_net(tmp_path, seed=1, gain=2000.0)
    weights, x = load_weights(path), drive(50)
    rates, _, _ = by_c(weights, path, x)
    np.testing.assert_allclose(rates, lstm_sequence(weights, x)[0], rtol=0, atol=TOLERANCE)
