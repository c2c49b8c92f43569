"""One net, many programs: torch, numpy, CasADi and each kernel of the generated C agree to 1e-12 in double precision.

For every kind of net the generator takes; its MHE against ipopt is in test_mhe_nets.py.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from functools import partial
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from estimator_c.formulation.generate import generate
from estimator_c.formulation.lstm_numpy import lstm_sequence, lstm_step
from estimator_c.formulation.net import build_net
from estimator_c.formulation.weights import NetWeights, load_weights
from tests.support.nets import random_net, torch_net
from tools.libest import ROOT, SETTINGS, WEIGHTS, Lib, compile_library

TOLERANCE = 1e-12
STEPS = 300
Sequence = Callable[[NetWeights, Path, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


NETS = {  # cell, layers, cells per layer
    "lstm 4": ("lstm", 1, 4), "lstm 3": ("lstm", 1, 3), "lstm 12": ("lstm", 1, 12),
    "lstm 16": ("lstm", 1, 16), "lstm 32": ("lstm", 1, 32),
    "lstm 2x8": ("lstm", 2, 8), "gru 8": ("gru", 1, 8), "gru 2x5": ("gru", 2, 5),
}  # fmt: skip


@pytest.fixture(scope="module", params=["default", *NETS])
def net_path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    if request.param == "default":
        return WEIGHTS
    cell, layers, hidden = NETS[request.param]
    return random_net(tmp_path_factory.mktemp("net"), hidden=hidden, seed=hidden, cell=cell, layers=layers)


def drive(n: int = STEPS, seed: int = 3) -> np.ndarray:
    """(n, 4) rows of rpm, Nm, degC, degC that change every 20 steps, over the whole operating range."""
    rng = np.random.default_rng(seed)
    levels = np.stack(
        [rng.uniform(0, 11000, n), rng.uniform(-160, 160, n), rng.uniform(20, 170, n), rng.uniform(20, 140, n)], 1
    )
    return np.repeat(levels, 20, axis=0)[:n]


def by_torch(weights: NetWeights, path: Path, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    try:
        import torch
    except ImportError:
        message = "torch is not installed (pip extra 'train'): torch = numpy is NOT checked"
        if os.environ.get("RT_REQUIRE_TORCH") == "1":
            pytest.fail(message)
        pytest.skip(message)
    cells, output = torch_net(weights)
    with torch.no_grad():
        u = torch.tensor((x - weights.in_offset) / weights.in_scale)
        hidden, last = cells(u[None])
        rates = weights.out_offset + weights.out_scale * output(hidden)[0].numpy()
    h, c = last if weights.cell == "lstm" else (last, last[:0])
    return rates, c.numpy().ravel(), h.numpy().ravel()


def by_casadi(weights: NetWeights, path: Path, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    forward = build_net(weights).forward
    memory = np.zeros(weights.memory)
    rates = np.empty((len(x), 2))
    for k, row in enumerate(x):
        memory, rates[k] = (np.array(value).ravel() for value in forward(row[:2], row[2:], memory)[:2])
    return rates, memory[: weights.memory_c], memory[weights.memory_c :]


KERNELS = ("portable", "avx2", "avx512")


def with_kernel(path: Path, kernel: str) -> Lib:
    """The library of a net with that kernel chosen, or a skip that says so."""
    lib = Lib(compile_library(path))
    if not lib.select(kernel):
        assert kernel != "portable"
        pytest.skip(f"this processor has no {kernel}: that kernel is NOT checked")
    return lib


def by_c(weights: NetWeights, path: Path, x: np.ndarray, kernel: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    lib = with_kernel(path, kernel)
    assert lib.sha256 == weights.sha256
    c, h = weights.empty_memory()
    rates = np.empty((len(x), 2))
    for k, row in enumerate(x):
        c, h, rates[k], _ = lib.lstm_forward(row[:2], row[2:], c, h)
    return rates, c, h


PROGRAMS: dict[str, Sequence] = {
    "torch": by_torch, "casadi": by_casadi, **{f"C {kernel}": partial(by_c, kernel=kernel) for kernel in KERNELS},
}  # fmt: skip


@pytest.mark.parametrize("program", PROGRAMS.values(), ids=PROGRAMS)
def test_equals_numpy(program: Sequence, net_path: Path) -> None:
    weights, x = load_weights(net_path), drive()
    expected = lstm_sequence(weights, x)
    assert np.ptp(expected[0]) > 0.01  # the drive moves the net at all
    for found, wanted in zip(program(weights, net_path, x), expected, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=0, atol=TOLERANCE)


def operating_point(weights: NetWeights, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, c, h somewhere in the middle of a drive."""
    rng = np.random.default_rng(seed)
    c, h = weights.empty_memory()
    c, h, _ = lstm_step(weights, drive(1, seed)[0], rng.normal(size=c.shape), rng.uniform(-1, 1, h.shape))
    return drive(1, seed + 100)[0], c, h


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("seed", range(3))
def test_adjoint_in_c_equals_casadis_derivative(net_path: Path, seed: int, kernel: str) -> None:
    weights = load_weights(net_path)
    net, lib, n_m = build_net(weights), with_kernel(net_path, kernel), weights.memory
    x, c, h = operating_point(weights, seed)
    rng = np.random.default_rng(seed)
    bars = [rng.normal(size=size) for size in (2, n_m)]
    memory = np.concatenate([c, h])

    sym = [ca.SX.sym(name, size) for name, size in (("u", 2), ("t", 2), ("m", n_m))]
    memory_next, rate, _ = net.forward(*sym)
    merit = ca.dot(rate, bars[0]) + ca.dot(memory_next, bars[1])
    gradients = ca.Function("g", sym, [ca.gradient(merit, s) for s in sym[1:]])(x[:2], x[2:], memory)

    tape = lib.lstm_forward(x[:2], x[2:], c, h)[3]
    for found, wanted in zip(lib.lstm_adjoint(tape, memory, *bars), gradients, strict=True):
        np.testing.assert_allclose(found, np.array(wanted).ravel(), rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("kernel", KERNELS)
def test_slope_in_c_equals_casadis_derivative(net_path: Path, kernel: str) -> None:
    weights = load_weights(net_path)
    net, lib = build_net(weights), with_kernel(net_path, kernel)
    x, c, h = operating_point(weights, 5)
    memory = np.concatenate([c, h])
    sym = [ca.SX.sym(name, size) for name, size in (("u", 2), ("t", 2), ("m", weights.memory))]
    jacobian = ca.Function("j", sym, [ca.jacobian(net.forward(*sym)[1], sym[1])])(x[:2], x[2:], memory)
    tape = lib.lstm_forward(x[:2], x[2:], c, h)[3]
    np.testing.assert_allclose(lib.lstm_slope(tape, memory), np.diag(np.array(jacobian)), rtol=0, atol=TOLERANCE)


def test_generated_c_is_clean(net_path: Path, tmp_path: Path) -> None:
    generate(net_path, SETTINGS, tmp_path)
    strict = ["-std=c11", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror"]
    base = ROOT / "estimator_c" / "src"
    for source in (*sorted(tmp_path.glob("*.c")), base / "mhe.c", base / "estimator.c"):
        includes = [f"-I{base}", f"-I{base / 'solver'}", f"-I{tmp_path}"]
        target = ["-O1", "-c", "-o", str(tmp_path / "object.o")]
        subprocess.run(["gcc", *strict, *includes, *target, str(source)], check=True)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("cell", ["lstm", "gru"])
def test_saturated_gates_stay_finite(cell: str, kernel: str, tmp_path: Path) -> None:
    """Weights far beyond training drive every exp to its limits; the C must give numpy's 0 and 1, not NaN."""
    path = random_net(tmp_path, seed=1, gain=2000.0, cell=cell)
    weights, x = load_weights(path), drive(50)
    rates, _, _ = by_c(weights, path, x, kernel)
    np.testing.assert_allclose(rates, lstm_sequence(weights, x)[0], rtol=0, atol=TOLERANCE)
