"""The judge: figures by hand, both net formats, and the paper's table through the command line."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from estimator_c.formulation.errors import FormulationError
from estimator_c.formulation.weights import load_weights
from rt_runner import cli
from tests.support.nets import random_net, reference_folder, weights_document
from tools.evaluate import document, evaluate, open_loop, predict, synthetic_lap, table
from tools.evaluate import main as evaluate_main
from tools.plain_net import load_net
from tools.rows import DataError, Rows, hash_of, load_npz, rows_from

ROOT = Path(__file__).parents[2]


def drive(n: int, seed: int) -> np.ndarray:
    """Values (n, 6) of a made-up drive whose rates are those of its temperatures."""
    rng = np.random.default_rng(seed)
    theta = 60.0 + np.cumsum(rng.normal(0.02, 0.05, (n + 1, 2)), axis=0)
    inputs = np.column_stack([11000.0 * rng.random(n), 160.0 * rng.random(n)])
    return np.column_stack([inputs, theta[:-1], np.diff(theta, axis=0) / 0.1])


def rows_of(*lengths: int, seed: int = 1) -> Rows:
    values = np.concatenate([drive(n, seed + i) for i, n in enumerate(lengths)])
    return rows_from(values, np.repeat(np.arange(len(lengths)), lengths))


def constant_net(folder: Path, rate_w: float, rate_r: float) -> Path:
    """A net that says the same rates whatever it sees."""
    zero = np.zeros((8, 2))
    net = weights_document(np.zeros((8, 4)), zero, np.zeros(8), np.zeros((2, 2)), np.zeros(2))
    for port, value in zip(net["outputs"], (rate_w, rate_r), strict=True):
        port["offset"] = value
    path = folder / "constant.json"
    path.write_text(json.dumps(net))
    return path


# ---- figures ----------------------------------------------------------------------------------------------


def test_every_figure_by_hand_over_several_drives(tmp_path):
    rows = rows_of(900, 300, 650)
    net = load_weights(constant_net(tmp_path, 0.2, -0.1))
    figures = evaluate(net, rows)
    error = np.array([0.2, -0.1]) - rows.rates_degc_s
    time_s = np.concatenate([np.arange(n) * 0.1 for n in (900, 300, 650)])
    late, warm = time_s >= 20.0, time_s >= 60.0
    drift = []
    for piece in rows.pieces():
        x = rows.x[piece]
        drift.append(x[0, 2:] + 0.1 * np.arange(len(x))[:, None] * [0.2, -0.1] - x[:, 2:])
    drift = np.concatenate(drift)
    for i, c in enumerate("wr"):
        rms, rms_late = (math.sqrt(np.mean(e[:, i] ** 2)) for e in (error, error[late]))
        expected = {
            "mae_degc_s": np.abs(error[:, i]).mean(),
            "rmse_degc_s": rms,
            "mean_error_degc_s": error[:, i].mean(),
            "mean_error_after_60s_degc_s": error[warm, i].mean(),
            "nrmse": rms / np.ptp(rows.rates_degc_s[:, i]),
            "nrmse_after_launch": rms_late / np.ptp(rows.rates_degc_s[late, i]),
            "open_loop_max_degc": np.abs(drift[:, i]).max(),
            "open_loop_rmse_degc": math.sqrt(np.mean(drift[:, i] ** 2)),
        }
        assert {name.removesuffix(f"_{c}") for name in figures if name.endswith(f"_{c}")} == set(expected)
        for name, value in expected.items():
            assert figures[f"{name}_{c}"] == pytest.approx(value), name


def test_memory_is_empty_at_the_start_of_every_drive(tmp_path):
    net = load_weights(random_net(tmp_path, 4))
    both = rows_of(300, 300)
    found = predict(net, both)
    for i, piece in enumerate(both.pieces()):
        alone = predict(net, rows_from(drive(300, 1 + i), np.zeros(300, dtype=int)))
        np.testing.assert_array_equal(found.rates_degc_s[piece], alone.rates_degc_s)
        np.testing.assert_array_equal(found.theta_degc[piece], alone.theta_degc)


def test_open_loop_sees_its_own_temperatures_only(tmp_path):
    net = load_weights(random_net(tmp_path, 4))
    x = drive(200, 1)[:, :4]
    other = x.copy()
    other[1:, 2:] += 50.0
    np.testing.assert_array_equal(open_loop(net, x), open_loop(net, other))


def test_json_names_every_figure_and_the_normaliser(tmp_path, capsys):
    net, rows = constant_net(tmp_path, 0.0, 0.0), rows_of(900)
    figures = evaluate(load_weights(net), rows)
    np.savez(tmp_path / "lap.npz", **as_file(rows))
    assert evaluate_main(["--net", str(net), "--lap", str(tmp_path / "lap.npz"), "--json", "-"]) == 0
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    for c in "wr":
        assert set(found[f"theta_{c}"]) == {
            "mae", "rmse", "nrmse_full", "nrmse_t20", "mean_error", "mean_error_t60", "open_loop_max_degc",
            "open_loop_rmse_degc",
        }  # fmt: skip
        assert found[f"theta_{c}"]["nrmse_full"] == figures[f"nrmse_{c}"]
        assert found[f"theta_{c}"]["mae"] == figures[f"mae_degc_s_{c}"]
    assert set(found["nrmse_normaliser"]) == {"nrmse_full", "nrmse_t20"}
    assert found["lap"]["sha256"] == rows.sha256
    assert table(figures) in captured.err


def test_figures_that_cannot_be_formed_are_null(tmp_path):
    net = load_weights(constant_net(tmp_path, 0.0, 0.0))
    values = drive(150, 1)
    values[:, 4] = 0.25
    rows = rows_from(values, np.zeros(150, dtype=int))
    found = document(net, rows, evaluate(net, rows), "short")
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["theta_w"]["nrmse_full"] is None, "a rate that never changes has no range"
    assert found["theta_w"]["rmse"] == pytest.approx(0.25)
    for key in ("nrmse_t20", "mean_error_t60"):
        assert found["theta_r"][key] is None, "15 s have no row that late"
    assert "nan" not in table(evaluate(net, rows_of(900)))


def as_file(rows: Rows) -> dict:
    names = ("n_rpm", "torque_nm", "theta_w_degc", "theta_r_degc", "dtheta_w_degc_s", "dtheta_r_degc_s")
    values = np.column_stack([rows.x, rows.rates_degc_s])
    return {
        **dict(zip(names, values.T, strict=True)),
        "trajectory": rows.trajectory,
        "sha256": hash_of(values, rows.trajectory),
    }


def test_npz_without_rows_is_refused(tmp_path):
    np.savez(tmp_path / "e.npz", **as_file(rows_from(np.empty((0, 6)), np.empty(0, dtype=int))))
    with pytest.raises(DataError, match="no rows"):
        load_npz(tmp_path / "e.npz")


# ---- nets -------------------------------------------------------------------------------------------------


def plain(folder: Path, **changes) -> Path:
    """The random net in the plain format."""
    own = json.loads(random_net(folder, 4).read_text())
    net = {
        "Wu": own["W_u"], "Wh": own["W_h"], "b": own["b"], "Wf": own["W_y"], "bf": own["b_y"], "gate_order": "i,f,g,o",
        "x_norm": "[n/15000, T/160.36, (Tw-60)/100, (Tr-60)/100]",
        "y_denorm": "y*(1.07564811+0.63202183)-0.63202183 [degC/s]",
        **changes,
    }  # fmt: skip
    path = folder / "plain.json"
    path.write_text(json.dumps({k: v for k, v in net.items() if v is not None}))
    return path


def test_plain_format_is_the_same_net(tmp_path):
    own, same = load_net(random_net(tmp_path, 4)), load_net(plain(tmp_path))
    x = drive(50, 1)[:, :4]
    np.testing.assert_array_equal(open_loop(own, x), open_loop(same, x))
    assert (same.name, same.hidden) == ("plain", 4)
    assert same.sha256 != own.sha256, "identified by its own file's bytes"


def test_plain_normalisation_is_read_not_assumed(tmp_path):
    net = load_net(plain(tmp_path, x_norm="[n/9000,T/-2.5e2,(Tw-55.5)/90,(Tr-4)/70]", y_denorm="y*(2+0.5)-0.5[degC/s]"))
    np.testing.assert_array_equal(net.in_offset, [0.0, 0.0, 55.5, 4.0])
    np.testing.assert_array_equal(net.in_scale, [9000.0, -250.0, 90.0, 70.0])
    np.testing.assert_array_equal(net.out_offset, [-0.5, -0.5])
    np.testing.assert_array_equal(net.out_scale, [2.5, 2.5])


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"Wf": None}, "Wf: is missing"),
        ({"gate_order": "i,f,o,g"}, "gate_order"),
        ({"x_norm": "minmax"}, "x_norm: is not understood"),
        ({"y_denorm": "y*(1+2)-3 [degC/s]"}, "y_denorm: must subtract what it adds"),
        ({"b": [1.0]}, "b: must have shape [16], has [1]"),
        ({"Wh": "no"}, "hidden"),
        ({"Wu": [[1.0, "x", 0.0, 0.0]] * 16}, "W_u: holds something that is not a number"),
    ],
)
def test_plain_nets_that_cannot_be(tmp_path, changes, field):
    path = plain(tmp_path, **changes)
    with pytest.raises(FormulationError) as caught:
        load_net(path)
    assert str(caught.value).startswith(f"{path}: {field}")
    assert "\n" not in str(caught.value)


# ---- the command ------------------------------------------------------------------------------------------


def test_papers_table_to_the_last_digit_through_the_command(tmp_path, capfd):
    """The paper's own net on the paper's own lap: Energies 18(14):3813, table of the test set."""
    folder = reference_folder() / "paper"
    out, plot = tmp_path / "figures.json", tmp_path / "paper.svg"
    arguments = ["--net", folder / "lstm_8hu_paper_weights.json", "--lap", folder / "test_nordschleife_10hz.csv"]
    assert cli.main(["evaluate", *map(str, arguments), "--json", str(out), "--plot", str(plot)]) == 0
    found = json.loads(out.read_text())
    w, r = found["theta_w"], found["theta_r"]
    assert (f"{w['rmse']:.5f}", f"{r['rmse']:.5f}") == ("0.03725", "0.02820")
    assert (f"{w['mae']:.5f}", f"{r['mae']:.5f}") == ("0.02882", "0.02096")
    assert (f"{100 * w['nrmse_full']:.2f}", f"{100 * r['nrmse_full']:.2f}") == ("2.77", "9.40")
    assert found["lap"]["rows"] == 6897
    shown = {line.split("  ")[0]: line.split()[-2:] for line in capfd.readouterr().out.splitlines()}
    assert shown["mean absolute error, °C/s"] == ["0.02882", "0.02096"]
    assert shown["root mean square error, °C/s"] == ["0.03725", "0.02820"]
    assert shown["NRMSE by the range of the whole lap, %"] == ["2.77", "9.40"]
    assert plot.stat().st_size > 10_000


def test_without_options_the_embedded_net_on_the_synthetic_lap(tmp_path):
    out = tmp_path / "figures.json"
    assert cli.main(["evaluate", "--json", str(out)]) == 0
    found = json.loads(out.read_text())
    net = ROOT / "estimator_c" / "weights" / "lstm8.json"
    rows = synthetic_lap()
    assert found == document(load_weights(net), rows, evaluate(load_weights(net), rows), found["lap"]["name"])
    printed = json.loads(net.read_text())["metrics"]
    assert found["lap"]["sha256"] == printed["lap_sha256"], "the committed figures are those of this lap"
    for c in "wr":
        assert found[f"theta_{c}"]["rmse"] == pytest.approx(printed["lap"][f"rmse_degc_s_{c}"], rel=1e-6)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["evaluate", "--net", "none.json"], ("evaluate: none.json", "No such file")),
        (["evaluate", "--lap", "none.csv"], ("evaluate: none.csv", "check the path")),
        (["evaluate", "--plot", "a.doc"], ("--plot a.doc", ".svg or .png")),
        (["dataset", "--seed", "-1"], ("dataset: --seed -1", "whole number")),
        (["train", "--data", "none.npz", "--out", "n.json", "--", "--epochs", "0"], ("train:", "none.npz")),
    ],
)
def test_verbs_hand_errors_on_as_one_line(tmp_path, capsys, monkeypatch, arguments, words):
    if arguments[0] == "train" and os.environ.get("RT_REQUIRE_TORCH") != "1":
        pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    assert cli.main(arguments) == 1
    message = capsys.readouterr().err
    assert message.startswith("rt-runner: ")
    assert message.count("\n") == 1
    assert all(word in message for word in words), message


def test_a_missing_package_names_the_extra(tmp_path, capsys, monkeypatch):
    hidden = tmp_path / "hidden"
    hidden.mkdir()
    (hidden / "torch.py").write_text("raise ModuleNotFoundError(\"No module named 'torch'\", name='torch')\n")
    monkeypatch.setenv("PYTHONPATH", str(hidden))
    assert cli.main(["train", "--data", "none.npz"]) == 1
    assert capsys.readouterr().err == "rt-runner: the package torch is missing: pip install -e '.[train]'\n"


def test_ctrl_c_lets_the_tool_end_in_its_own_way(tmp_path):
    """The whole foreground gets the signal, as from a terminal; the verb waits for what its tool says."""
    out = tmp_path / "R.npz"
    command = [sys.executable, "-m", "rt_runner.cli", "dataset", "--out", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(
        command, env=environment, cwd=tmp_path, start_new_session=True, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        assert "1/16" in process.stdout.readline()
        os.killpg(process.pid, signal.SIGINT)
        _, words = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    assert words.count("\n") == 1
    assert "the same command goes on" in words
    assert not out.exists()
    deadline = time.monotonic() + 5.0
    while not list((tmp_path / "R.npz.parts").glob("drive-*.npz")):
        assert time.monotonic() < deadline
