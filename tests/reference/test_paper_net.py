"""The paper's table, reproduced through our code: its net, compiled to C, over its unseen lap."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from estimator_c.formulation.lstm_numpy import lstm_sequence
from estimator_c.formulation.weights import load_weights
from tests.support.nets import paper_net, reference_folder
from tools.libest import Lib, Mhe, compile_library

# Energies 18(14):3813, test set: winding / rotor in degC/s, to the digits its data give.
RMSE = (0.03725, 0.02820)
MAE = (0.02882, 0.02096)
NRMSE = (0.0277, 0.0940)  # RMSE over the range of the lap's rates


@pytest.fixture(scope="module")
def lap() -> np.ndarray:
    """Rows t, rpm, Nm, theta_w, theta_r, dtheta_w, dtheta_r at 10 Hz."""
    path = reference_folder() / "paper" / "test_nordschleife_10hz.csv"
    return np.loadtxt(path, delimiter=",", skiprows=1)


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return paper_net(tmp_path_factory.mktemp("paper"))


def rates_in_c(net: Path, x: np.ndarray) -> np.ndarray:
    lib = Lib(compile_library(net))
    c = h = np.zeros(8)
    rates = np.empty((len(x), 2))
    for k, row in enumerate(x):
        c, h, rates[k], _ = lib.lstm_forward(row[:2], row[2:], c, h)
    return rates


def rates_in_numpy(net: Path, x: np.ndarray) -> np.ndarray:
    return lstm_sequence(load_weights(net), x)[0]


@pytest.mark.parametrize("program", [rates_in_c, rates_in_numpy])
def test_papers_table(program, net: Path, lap: np.ndarray) -> None:
    assert len(lap) == 6897
    error = program(net, lap[:, 1:5]) - lap[:, 5:7]
    rmse = np.sqrt(np.mean(error**2, axis=0))
    np.testing.assert_allclose(rmse, RMSE, rtol=0, atol=0.5e-5)
    np.testing.assert_allclose(np.mean(np.abs(error), axis=0), MAE, rtol=0, atol=0.5e-5)
    np.testing.assert_allclose(rmse / np.ptp(lap[:, 5:7], axis=0), NRMSE, rtol=0, atol=0.5e-4)


def test_mhe_with_the_papers_net_on_the_papers_lap(net: Path, lap: np.ndarray) -> None:
    """Its net and its truth, our estimator: nothing of either was made here."""
    lib = Lib(compile_library(net))
    setting = lib.setting("default")
    rng = np.random.default_rng(0)
    y = lap[:, 3:5] + rng.normal(0, np.sqrt(0.1), (len(lap), 2))
    mhe = Mhe(lib, setting)
    mhe.start(y[0], np.zeros(8), np.zeros(8))
    found = np.empty((len(lap), 2))
    for k in range(len(lap)):
        if k > 0:
            mhe.advance(lap[k - 1, 1:3])
        for channel in range(2):
            mhe.measure(0, channel, float(y[k, channel]))
        status, result = mhe.solve()
        assert status == 0
        found[k] = result.theta[:]
    rmse = np.sqrt(np.mean((found - lap[:, 3:5])[100:] ** 2, axis=0))
    assert rmse[0] < 0.10
    assert rmse[1] < 0.10
