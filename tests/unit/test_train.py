"""The trainer: what it learns from, that it learns, what it writes, and how it ends."""

from __future__ import annotations

import dataclasses
import itertools
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

from estimator_c.formulation.lstm_numpy import lstm_sequence
from estimator_c.formulation.weights import load_weights
from tools.evaluate import COLUMNS, DataError, Rows, evaluate, load_rows, open_loop
from tools.evaluate import main as evaluate_main

if os.environ.get("RT_REQUIRE_TORCH") == "1":
    import torch
else:
    torch = pytest.importorskip("torch", reason="torch is absent (extra `train`): the trainer is NOT tested here")

from tools import train
from tools.lstm_torch import (
    LstmRates,
    Scaling,
    format_document,
    net_from_weights,
    spread_time_constants,
    weights_document,
    write_document,
)
from tools.train_windows import Settings, Validation, Windows, loss_of, row_weights, split

ROOT = Path(__file__).parents[2]
QUICK = Settings(hidden=4, epochs=100, batch=4, window_s=20.0, early_s=5.0, validate_every=20)


@pytest.fixture(autouse=True)
def _one_thread():
    torch.set_num_threads(1)


def heat(n_rows: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a small machine: winding on a hidden iron mass, magnets on a hidden core, driven at random."""
    rng = np.random.default_rng(seed)
    knots = rng.random((n_rows // 30 + 2, 2))
    hold = np.repeat(knots, 30, axis=0)[:n_rows]
    n_rpm, torque_nm = 11000.0 * hold[:, 0], 160.0 * hold[:, 1] ** 2
    theta = np.full(4, rng.uniform(40.0, 80.0))  # winding, iron, magnets, core
    x, rates = np.empty((n_rows, 4)), np.empty((n_rows, 2))
    for k in range(n_rows):
        copper = 2.0 * (torque_nm[k] / 160.0) ** 2
        iron, magnet = 0.3 * (n_rpm[k] / 11000.0) ** 1.5, 0.2 * (n_rpm[k] / 11000.0) ** 2
        rate = np.array(
            [
                copper - (theta[0] - theta[1]) / 20.0,
                iron + (theta[0] - theta[1]) / 60.0 - (theta[1] - 65.0) / 100.0,
                magnet - (theta[2] - theta[3]) / 50.0,
                (theta[2] - theta[3]) / 80.0 - (theta[3] - 65.0) / 300.0,
            ]
        )
        x[k], rates[k] = (n_rpm[k], torque_nm[k], theta[0], theta[2]), rate[[0, 2]]
        theta = theta + 0.1 * rate
    return x, rates


def rows_of(lengths: list[int], seed: int = 0) -> Rows:
    drives = [heat(n, seed + i) for i, n in enumerate(lengths)]
    return Rows(
        np.concatenate([x for x, _ in drives]),
        np.concatenate([r for _, r in drives]),
        np.repeat(np.arange(len(lengths)), lengths),
        "ab" * 32,
    )


@pytest.fixture(scope="module")
def rows() -> Rows:
    return rows_of([900, 600, 700, 800, 600, 650, 750])


def save(path: Path, rows: Rows) -> Path:
    columns = dict(zip(COLUMNS, np.hstack([rows.x, rows.rates_degc_s]).T, strict=True))
    np.savez(path, **columns, trajectory=rows.trajectory, sha256=np.array(rows.sha256))
    return path


# ---- what it learns from ----------------------------------------------------------------------------------


@pytest.mark.parametrize("fold", range(5))
def test_split_holds_out_whole_trajectories(fold):
    rows = rows_of([300] * 6 + [120] * 10)
    parts = split(rows, fold)
    held = np.concatenate(parts.held)
    together = np.sort(np.concatenate([*parts.train, held]))
    assert np.array_equal(together, np.arange(len(rows.x)))
    assert not set(rows.trajectory[held]) & set(rows.trajectory[np.concatenate(parts.train)])
    assert sorted(parts.held_ids) == sorted(set(rows.trajectory[held]))
    assert 0.12 <= len(held) / len(rows.x) <= 0.28
    assert {len(p) for p in parts.held} == {300, 120}, "both kinds of drive are judged"


def test_split_of_a_single_trajectory_holds_out_its_end():
    parts = split(rows_of([500]), fold=1)
    assert np.array_equal(parts.train[0], np.arange(400))
    assert np.array_equal(parts.held[0], np.arange(400, 500))


def test_windows_stay_inside_one_training_trajectory(rows):
    parts = split(rows, fold=1)
    settings = dataclasses.replace(QUICK, theta_noise_degc=0.0)
    windows = Windows(rows, parts.train, Scaling.from_rates(rows.rates_degc_s), settings)
    allowed = {row.tobytes() for p in parts.train for row in windows.u[torch.from_numpy(p)].numpy()}
    follows = {
        (a.tobytes(), b.tobytes())
        for p in parts.train
        for a, b in zip(windows.u[p[:-1]].numpy(), windows.u[p[1:]].numpy(), strict=True)
    }
    for _ in range(5):
        u, y = windows.draw()
        assert u.shape == (200, settings.batch, 4)
        assert y.shape == (200, settings.batch, 2)
        for column in u.numpy().swapaxes(0, 1):
            assert {row.tobytes() for row in column} <= allowed
            assert {(a.tobytes(), b.tobytes()) for a, b in itertools.pairwise(column)} <= follows


def test_a_share_of_the_windows_begins_where_a_trajectory_does(rows):
    settings = dataclasses.replace(QUICK, theta_noise_degc=0.0, batch=400, start_share=0.25)
    windows = Windows(rows, split(rows, fold=1).train, Scaling.from_rates(rows.rates_degc_s), settings)
    firsts = {windows.u[i].numpy().tobytes() for i in windows.firsts}
    share = np.mean([row.tobytes() in firsts for row in windows.draw()[0][0].numpy()])
    assert 0.17 <= share <= 0.33


def test_noise_touches_the_temperatures_only_and_has_the_asked_size(rows):
    settings = dataclasses.replace(QUICK, theta_noise_degc=0.5, batch=64)
    scaling = Scaling.from_rates(rows.rates_degc_s)
    parts = split(rows, fold=1)
    noisy = Windows(rows, parts.train, scaling, settings)
    clean = Windows(rows, parts.train, scaling, dataclasses.replace(settings, theta_noise_degc=0.0))
    difference = (noisy.draw()[0] - clean.draw()[0]).numpy() * scaling.in_scale
    assert np.all(difference[:, :, :2] == 0.0)
    assert 0.35 <= difference[:, :, 2:].std() <= 0.55


def test_early_rows_count_less():
    weights = row_weights(200, QUICK).flatten()
    assert weights[0] == pytest.approx(QUICK.early_weight)
    assert torch.all(weights.diff() >= 0)
    assert torch.all(weights[50:] == 1.0)


def test_loss_weighs_rows_and_the_rotor():
    error = torch.zeros(200, 4, 2)
    error[0, :, 0], error[-1, :, 1] = 1.0, 2.0
    weights = row_weights(200, QUICK)
    expected = (QUICK.early_weight * 1.0 + 3.0 * 4.0) * 4 / error.numel()
    assert loss_of(error, weights, rotor_weight=3.0).item() == pytest.approx(expected)


def test_cells_start_with_spread_time_constants():
    net = LstmRates(6)
    spread_time_constants(net, dt_s=0.1, shortest_s=1.0, longest_s=100.0)
    forget = torch.sigmoid(net.lstm.bias_ih_l0 + net.lstm.bias_hh_l0)[6:12]
    tau_s = 0.1 / (1.0 - forget.detach().double().numpy())
    np.testing.assert_allclose(tau_s, np.logspace(0, 2, 6), rtol=1e-3)


# ---- that it learns ---------------------------------------------------------------------------------------


def test_training_lowers_the_error_and_keeps_the_best(rows):
    seen: list[train.Progress] = []
    result = train.fit(rows, QUICK, report=seen.append)
    assert result.ended == "complete"
    assert [p.epoch for p in seen] == list(range(0, 101, 20))
    assert result.best.score < 0.4 * seen[0].score
    assert result.best.score == min(p.score for p in seen)
    assert result.best.score == seen[-1].best_score
    parts = split(rows, QUICK.fold)
    windows = Windows(rows, parts.train, result.scaling, QUICK)
    again = Validation.of(windows, parts.held, QUICK).errors(result.net)
    assert again == pytest.approx((result.best.val_w, result.best.val_r), rel=1e-6), "the kept net is the best one"


def test_the_same_seed_gives_the_same_file_and_another_seed_another(rows):
    def text(seed: int) -> str:
        settings = dataclasses.replace(QUICK, epochs=10, seed=seed)
        return format_document(train.document_of(train.fit(rows, settings), rows, None, settings))

    assert text(1) == text(1)
    assert text(1) != text(2)


def test_going_on_from_a_net_starts_where_it_ended(rows, tmp_path):
    first = train.fit(rows, QUICK)
    write_document(tmp_path / "net.json", train.document_of(first, rows, None, QUICK))
    seen: list[train.Progress] = []
    train.fit(rows, dataclasses.replace(QUICK, epochs=0), report=seen.append, start=load_weights(tmp_path / "net.json"))
    assert seen[0].score == pytest.approx(first.best.score, rel=1e-5)


# ---- what it writes ---------------------------------------------------------------------------------------


def test_export_is_the_same_net_in_numpy_and_torch(rows, tmp_path):
    result = train.fit(rows, dataclasses.replace(QUICK, epochs=20, hidden=8))
    write_document(tmp_path / "net.json", train.document_of(result, rows, rows_of([300]), QUICK))
    weights = load_weights(tmp_path / "net.json")
    x = rows.x[:600]
    in_numpy = lstm_sequence(weights, x)[0]

    trained = result.net.double()  # float32 values, exact in float64
    s = result.scaling
    u = torch.from_numpy((x - s.in_offset) / s.in_scale)[:, None, :]
    in_torch = s.out_offset + s.out_scale * trained(u).detach().numpy()[:, 0]
    np.testing.assert_allclose(in_numpy, in_torch, rtol=0.0, atol=1e-12)

    twin, scaling = net_from_weights(weights)
    assert np.array_equal(scaling.out_scale, s.out_scale)
    np.testing.assert_allclose(
        s.out_offset + s.out_scale * twin(u).detach().numpy()[:, 0], in_numpy, rtol=0, atol=1e-12
    )


def test_weights_file_is_stable_text_with_one_row_per_line(rows, tmp_path):
    settings = dataclasses.replace(QUICK, epochs=0)
    document = train.document_of(train.fit(rows, settings), rows, rows_of([300]), settings)
    text = format_document(document)
    assert json.loads(text) == document
    assert format_document(json.loads(text)) == text, "reading and writing again gives the same bytes"
    lines = text.splitlines()
    assert sum(line.startswith("  [") for line in lines) == 4 * 4 + 4 * 4 + 2
    assert max(map(len, lines)) < 250
    assert document["data_sha256"] == rows.sha256
    assert document["training"]["torch"] == torch.__version__
    assert document["training"]["seed"] == settings.seed
    assert set(document["metrics"]) == {"validation", "lap", "lap_sha256"}
    write_document(tmp_path / "net.json", document)
    assert [p.name for p in tmp_path.iterdir()] == ["net.json"], "no half-written file stays behind"


def test_a_net_that_is_not_finite_is_never_written():
    document = weights_document(LstmRates(2), Scaling.from_rates(np.eye(2)), 0.1)
    document["b_y"] = [math.nan, 0.0]
    with pytest.raises(ValueError, match="not JSON compliant"):
        format_document(document)


# ---- how it ends ------------------------------------------------------------------------------------------


def test_interrupt_keeps_the_best_so_far(rows):
    def stop_at_60(p: train.Progress) -> None:
        if p.epoch == 60:
            raise KeyboardInterrupt

    result = train.fit(rows, QUICK, report=stop_at_60)
    assert result.ended == "interrupted"
    assert 0 < result.best.epoch <= 60
    full = train.fit(rows, dataclasses.replace(QUICK, epochs=0))
    assert result.best.score < 0.6 * full.best.score


def test_budget_ends_the_run(rows):
    result = train.fit(rows, dataclasses.replace(QUICK, epochs=100_000), budget_s=1.0)
    assert result.ended == "budget"
    assert 1.0 < result.elapsed_s < 30.0


def test_ctrl_c_on_the_command_line_writes_a_valid_net(rows, tmp_path):
    data, out = save(tmp_path / "R.npz", rows), tmp_path / "net.json"
    command = [sys.executable, "-m", "tools.train", "--data", data, "--lap", data, "--out", out, "--epochs", "1000000"]
    command += ["--validate-every", "1", "--window-s", "10"]
    process = subprocess.Popen(
        list(map(str, command)), cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        first = process.stdout.readline()
        assert first.startswith("epoch 0/1000000"), first
        time.sleep(1.5)  # it is in the middle of its work
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert "\r" not in first + rest, "a file or pipe gets plain lines"
    assert (process.returncode, errors) == (0, "")
    assert "interrupted" in rest
    assert load_weights(out).hidden == 8
    assert json.loads(out.read_text())["training"]["ended"] == "interrupted"


@pytest.mark.parametrize("tool", [train.main, evaluate_main])
def test_missing_data_is_one_clear_line(tool, tmp_path, capsys, rows):
    settings = dataclasses.replace(QUICK, epochs=0)
    write_document(tmp_path / "net.json", train.document_of(train.fit(rows, settings), rows, None, settings))
    missing = str(tmp_path / "none.npz")
    arguments = {
        train.main: ["--data", missing, "--out", str(tmp_path / "out.json")],
        evaluate_main: ["--weights", str(tmp_path / "net.json"), "--lap", missing],
    }
    assert tool(arguments[tool]) == 1
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "none.npz" in message
    assert "python -m tools.dataset" in message
    assert not (tmp_path / "out.json").exists()


def test_corrupt_weights_are_one_clear_line(tmp_path, capsys, rows):
    (tmp_path / "net.json").write_text('{"format": "other"}')
    data = save(tmp_path / "lap.npz", rows)
    assert evaluate_main(["--weights", str(tmp_path / "net.json"), "--lap", str(data)]) == 1
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "net.json" in message


def test_bad_rows_are_refused(tmp_path, rows):
    broken = dataclasses.replace(rows, x=np.where(np.arange(4) == 2, np.nan, rows.x))
    with pytest.raises(DataError, match="not finite"):
        load_rows(save(tmp_path / "nan.npz", broken))
    np.savez(tmp_path / "short.npz", n_rpm=rows.x[:, 0])
    with pytest.raises(DataError, match="torque_nm"):
        load_rows(tmp_path / "short.npz")
    (tmp_path / "text.npz").write_text("n_rpm,torque_nm\n")
    with pytest.raises(DataError, match=r"text\.npz"):
        load_rows(tmp_path / "text.npz")


# ---- the judge --------------------------------------------------------------------------------------------


def test_evaluation_against_figures_by_hand(rows, tmp_path):
    """A net whose output layer is constant: every figure has a closed form."""
    document = weights_document(LstmRates(2), Scaling.from_rates(np.eye(2)), 0.1)
    document["W_y"] = [[0.0, 0.0], [0.0, 0.0]]
    document["b_y"] = [0.0, 0.0]
    for port, value in zip(document["outputs"], (0.2, -0.1), strict=True):
        port["offset"] = value
    write_document(tmp_path / "net.json", document)
    lap = rows_of([600], seed=5)
    figures = evaluate(load_weights(tmp_path / "net.json"), lap)
    error = np.array([0.2, -0.1]) - lap.rates_degc_s
    for i, channel in enumerate("wr"):
        rms = math.sqrt(np.mean(error[:, i] ** 2))
        late = math.sqrt(np.mean(error[200:, i] ** 2))
        assert figures[f"mae_degc_s_{channel}"] == pytest.approx(np.abs(error[:, i]).mean())
        assert figures[f"rmse_degc_s_{channel}"] == pytest.approx(rms)
        assert figures[f"mean_error_degc_s_{channel}"] == pytest.approx(error[:, i].mean())
        assert figures[f"nrmse_{channel}"] == pytest.approx(rms / np.ptp(lap.rates_degc_s[:, i]))
        assert figures[f"nrmse_after_launch_{channel}"] == pytest.approx(late / np.ptp(lap.rates_degc_s[200:, i]))
    drift = lap.x[0, 2:] + 0.1 * np.arange(600)[:, None] * [0.2, -0.1] - lap.x[:, 2:]
    assert figures["open_loop_max_degc_w"] == pytest.approx(np.abs(drift[:, 0]).max())
    assert figures["open_loop_rmse_degc_r"] == pytest.approx(math.sqrt(np.mean(drift[:, 1] ** 2)))


def test_open_loop_of_a_perfect_rate_follows_the_drive(tmp_path, rows):
    """Started on the drive and fed its own temperatures, a trained net stays near it."""
    result = train.fit(rows, dataclasses.replace(QUICK, epochs=150, hidden=6))
    write_document(tmp_path / "net.json", train.document_of(result, rows, None, QUICK))
    lap = rows_of([600], seed=77)
    drift = open_loop(load_weights(tmp_path / "net.json"), lap.x) - lap.x[:, 2:]
    still = np.abs(lap.x[0, 2:] - lap.x[:, 2:]).max(axis=0)
    assert np.all(np.abs(drift).max(axis=0) < 0.5 * still)
