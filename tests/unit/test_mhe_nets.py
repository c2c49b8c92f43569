"""Every kind of net the generator takes, in the whole estimator: MHE against ipopt, core against its twin, its cost."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from estimator_c.formulation.mhe import MheOracle
from estimator_c.formulation.weights import NetWeights, load_weights
from tests.support.mhe_checks import equals_oracle
from tests.support.nets import random_net
from tools.bench_net import cost_of
from tools.libest import Estimator, Lib, compile_library
from tools.mhe_recorder import Recorder, record

AGREEMENT_DEGC = 1e-6
STEPS = (1, 15, 18)  # the growing window, the first full one, after shifts
NETS = {  # cell, layers, cells per layer
    "lstm 4": ("lstm", 1, 4), "lstm 8": ("lstm", 1, 8), "lstm 16": ("lstm", 1, 16), "lstm 32": ("lstm", 1, 32),
    "lstm 2x8": ("lstm", 2, 8), "gru 8": ("gru", 1, 8), "gru 2x5": ("gru", 2, 5),
}  # fmt: skip
FEW = {"lstm 32": (1, 7)}  # ipopt's own cost grows with the square of the cells times the window


@pytest.fixture(scope="module", params=NETS)
def net(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path, NetWeights, Lib]:
    cell, layers, hidden = NETS[request.param]
    path = random_net(tmp_path_factory.mktemp("net"), hidden, hidden, cell=cell, layers=layers)
    return request.param, path, load_weights(path), Lib(compile_library(path))


def test_mhe_equals_ipopt(net: tuple[str, Path, NetWeights, Lib]) -> None:
    name, _, weights, lib = net
    asked = FEW.get(name, STEPS)
    oracle = MheOracle(weights)
    run = Recorder(lib, weights, lib.setting("default", tolerance_degc=1e-9, max_sweeps=60, loss=0), record(weights))
    equals_oracle(run, oracle, asked, AGREEMENT_DEGC)


def test_core_follows_a_drive_of_its_own_net(net: tuple[str, Path, NetWeights, Lib]) -> None:
    """Frames in, estimate out: the core is built for the net's dimensions and finds the temperatures it made."""
    _, _, weights, lib = net
    drive = record(weights, steps=200)
    setting = lib.setting("default")
    core, errors, status = Estimator(lib, setting), [], None
    assert core.error == 0
    for k in range(200):
        if k >= setting.delay_steps:
            core.feed_temp(10 * k, *(drive.y[k - setting.delay_steps] + setting.offset_degc))
            out = core.step()
            status = out.status
            errors.append(np.array([out.theta_w_degc, out.theta_r_degc]) - drive.theta[k])
        for tick in range(10 * k + 1, 10 * k + 11):
            core.feed_motor(tick, float(drive.u[k, 1]), float(drive.u[k, 0]))
    assert core.counters.restarts == 0
    assert status == 2
    assert np.sqrt(np.mean(np.square(errors[100:]))) < 0.3


def test_cost_is_counted_for_any_net(tmp_path: Path) -> None:
    if shutil.which("valgrind") is None:
        pytest.skip("valgrind is not installed: the instruction counts of a net are NOT checked")
    rng = np.random.default_rng(0)
    rows = rng.uniform([2000, -100, 90, 70], [9000, 150, 91, 71], (41, 4))
    cost = cost_of(random_net(tmp_path, 4, cell="gru", layers=2), rows)
    assert (cost.net, cost.cell, cost.layers, cost.parameters) == ("2 x 4 GRU cells", "gru", 2, 250)
    assert cost.parameters < cost.forward_instructions < 20 * cost.parameters
    assert cost.parameters < cost.adjoint_instructions < cost.forward_instructions
    assert 15 * cost.forward_instructions < min(cost.mhe_step_instructions, cost.core_step_instructions)
    assert cost.net_memory_bytes == 8 * 8
