"""The named configurations, nets of any shape, and runs that stop and go on."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import estimator_c.formulation.weights as formats
from estimator_c.formulation.lstm_numpy import lstm_sequence
from tools.evaluate import COLUMNS, DataError, Rows

if os.environ.get("RT_REQUIRE_TORCH") == "1":
    import torch
else:
    torch = pytest.importorskip("torch", reason="torch is absent (extra `train`): the trainer is NOT tested here")

from tools import train
from tools.lstm_torch import LstmRates, Scaling, format_document, net_from_weights, start_as_matlab, write_document
from tools.train_configs import CHOICES, CONFIGS, PAPER, TUNED, Settings
from tools.train_fit import Checkpoint, Progress, _Run, fit, learning_rate
from tools.train_gru import FastGru
from tools.train_progress import ProgressLine, draw_history
from tools.train_windows import FixedSequences, integral_loss_of, split

ROOT = Path(__file__).parents[2]
QUICK = dataclasses.replace(TUNED, hidden=4, epochs=40, batch=4, window_s=20.0, early_s=5.0, validate_every=10)
PAPER_QUICK = dataclasses.replace(PAPER, hidden=4, epochs=40, window_s=20.0, batch=8)


@pytest.fixture(autouse=True)
def _one_thread():
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def rows() -> Rows:
    """Seven drives of a winding that heats with the torque squared and cools through iron nobody sees."""
    rng = np.random.default_rng(3)
    drives = []
    for length in (900, 610, 700, 800, 600, 655, 750):
        torque = np.repeat(rng.uniform(0.0, 160.0, length // 40 + 1), 40)[:length]
        theta, x, rates = np.full(3, 60.0), np.empty((length, 4)), np.empty((length, 2))
        for k in range(length):
            rate = np.array(
                [
                    2.0 * (torque[k] / 160.0) ** 2 - (theta[0] - theta[1]) / 20.0,
                    (theta[0] - theta[1]) / 60.0 - (theta[1] - 65.0) / 100.0,
                    (theta[1] - theta[2]) / 80.0,
                ]
            )
            x[k], rates[k] = (5000.0, torque[k], theta[0], theta[2]), rate[[0, 2]]
            theta = theta + 0.1 * rate
        drives.append((x, rates))
    return Rows(
        np.concatenate([x for x, _ in drives]),
        np.concatenate([r for _, r in drives]),
        np.repeat(np.arange(7), [len(x) for x, _ in drives]),
        "cd" * 32,
    )


@pytest.fixture(scope="module")
def data(rows, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("data") / "set.npz"
    columns = dict(zip(COLUMNS, np.hstack([rows.x, rows.rates_degc_s]).T, strict=True))
    np.savez(path, **columns, trajectory=rows.trajectory, sha256=np.array(rows.sha256))
    return path


# ---- the paper's table ------------------------------------------------------------------------------------


def test_paper_is_the_default_and_its_settings_are_the_papers_table(data, tmp_path):
    args, settings = train.parse(["--data", str(data), "--out", str(tmp_path / "net.json")])
    assert args.config == "paper"
    assert settings == PAPER
    table = {
        "epochs": 10_000, "lr": 0.02, "lr_drop": 0.75, "drop_epochs": 500, "batch": 512, "l2": 0.1, "clip": 1.0,
        "validate_every": 10, "validate_unit": "iteration", "cell": "lstm", "hidden": 8, "layers": 1,
        "schedule": "steps", "sequences": "fixed", "initial": "matlab", "clip_each": True,
    }  # fmt: skip
    assert {name: getattr(PAPER, name) for name in table} == table
    # A plain MSE: no row and no channel counts more than another, and the data are not changed.
    plain = (PAPER.early_weight, PAPER.rotor_weight, PAPER.integral_weight, PAPER.theta_noise_degc)
    assert plain == (1.0, 1.0, 0.0, 0.0)


def test_learning_rate_falls_by_a_quarter_every_500_epochs():
    rates = [learning_rate(epoch, PAPER) for epoch in (0, 499, 500, 999, 1000, 9999)]
    assert rates == pytest.approx([0.02, 0.02, 0.015, 0.015, 0.01125, 0.02 * 0.75**19], rel=1e-12)
    assert learning_rate(0, TUNED) == pytest.approx(0.02)
    assert learning_rate(TUNED.epochs, TUNED) == pytest.approx(TUNED.lr_end)


def test_options_replace_single_settings_of_a_configuration(data):
    base = ["--data", str(data), "--out", "net.json", "--config", "tuned"]
    _, settings = train.parse([*base, "--l2", "0.5", "--cell", "gru", "--layers", "2", "--clip-each", "true"])
    assert settings == dataclasses.replace(TUNED, l2=0.5, cell="gru", layers=2, clip_each=True)
    assert all(getattr(config, name) in CHOICES[name] for config in CONFIGS.values() for name in CHOICES)
    with pytest.raises(SystemExit):
        train.parse([*base, "--cell", "rnn"])


def test_fixed_sequences_hold_every_training_row_once_and_padding_does_not_count(rows):
    parts = split(rows, 1)
    scaling = Scaling.from_rates(rows.rates_degc_s)
    sequences = FixedSequences(rows, parts.train, scaling, PAPER_QUICK)
    seen, total = [], 0.0
    for _ in range(sequences.batches_per_epoch()):
        at = sequences.at[:, sequences.next * 8 : (sequences.next + 1) * 8]
        u, y, weights = sequences.batch()
        assert u.shape[:2] == y.shape[:2] == weights.shape[:2]
        assert u.shape[1] <= 8
        assert weights.mean().item() == pytest.approx(1.0, rel=1e-6), "the mean over the rows that count"
        assert torch.equal(u, sequences.u[at])
        seen.append(at[weights[:, :, 0] > 0].numpy())
        total += (weights == 0).sum().item()
    assert np.array_equal(np.sort(np.concatenate(seen)), np.sort(np.concatenate(parts.train)))
    assert total > 0, "pieces of unequal length are padded"
    assert sequences.length <= 200
    assert sequences.next == 0, "the next epoch begins with the first sequence"


def test_l2_pulls_the_weights_and_leaves_the_biases(rows):
    """With lots of it and one step: every weight's gradient is the weight's, every bias's is the loss's."""

    def step(l2: float) -> dict[str, torch.Tensor]:
        run = _Run(rows, dataclasses.replace(PAPER_QUICK, l2=l2, clip=1e9), None)
        run.step(0)
        return {name: p.grad.clone() for name, p in run.net.named_parameters() if p.grad is not None}

    start = dict(_Run(rows, PAPER_QUICK, None).net.named_parameters())
    none, some = step(0.0), step(0.5)
    assert {"lstm.weight_hh_l0", "lstm.bias_ih_l0", "head.weight", "head.bias"} <= set(none)
    for name in none:
        pull = 0.0 if "bias" in name else 0.5 * start[name].detach()
        torch.testing.assert_close(some[name], none[name] + pull, rtol=1e-5, atol=1e-7)


def test_clipping_each_parameter_or_all_together(rows):
    def norms(each: bool) -> np.ndarray:
        run = _Run(rows, dataclasses.replace(QUICK, clip=1e-3, clip_each=each), None)
        run.step(0)
        return np.array([p.grad.norm().item() for p in run.trained if p.grad is not None])

    np.testing.assert_allclose(norms(True), 1e-3, rtol=1e-2)
    assert np.linalg.norm(norms(False)) == pytest.approx(1e-3, rel=1e-2)


def test_matlab_start_is_glorot_orthogonal_and_one_at_the_forget_gate():
    torch.manual_seed(0)
    net = LstmRates(8)
    start_as_matlab(net)
    p = dict(net.lstm.named_parameters())
    assert p["weight_ih_l0"].abs().max() <= math.sqrt(6.0 / (4 + 32))
    torch.testing.assert_close(p["weight_hh_l0"].T @ p["weight_hh_l0"], torch.eye(8), atol=1e-5, rtol=0)
    bias = (p["bias_ih_l0"] + p["bias_hh_l0"]).detach()
    assert torch.equal(bias, torch.repeat_interleave(torch.tensor([0.0, 1.0, 0.0, 0.0]), 8))


def test_integral_loss_is_the_mean_rate_of_what_adds_up():
    error = torch.full((10, 3, 2), 0.2)
    weights = torch.ones(10, 1, 1)
    expected = np.mean([(0.2 * k / 10) ** 2 for k in range(1, 11)])
    assert integral_loss_of(error, weights, TUNED).item() == pytest.approx(expected, rel=1e-5)
    back_and_forth = error * torch.tensor([1.0, -1.0]).repeat(5)[:, None, None]
    assert integral_loss_of(back_and_forth, weights, TUNED) < 0.06 * integral_loss_of(error, weights, TUNED)


# ---- it learns --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("base", [TUNED, dataclasses.replace(PAPER, l2=0.0)], ids=["tuned", "paper without l2"])
def test_a_tiny_net_learns_in_seconds(rows, base):
    settings = dataclasses.replace(base, hidden=4, epochs=150, batch=8, window_s=30.0, early_s=5.0, validate_every=25)
    begun = time.monotonic()
    result = fit(rows, settings)
    assert result.history[0].score > 0.8, "it begins by knowing nothing"
    assert result.best.score < 0.45 * result.history[0].score
    assert result.best.score == min(p.score for p in result.history)
    assert time.monotonic() - begun < 60.0


def test_the_papers_l2_holds_the_net_back(rows):
    """0.1 as MATLAB means it: the reason why the documentation recommends the tuned configuration."""
    with_it = fit(rows, dataclasses.replace(PAPER_QUICK, epochs=100))
    without = fit(rows, dataclasses.replace(PAPER_QUICK, epochs=100, l2=0.0))
    assert with_it.best.score > 1.5 * without.best.score


# ---- any shape --------------------------------------------------------------------------------------------


def test_gru_is_torchs_there_and_back():
    torch.manual_seed(1)
    torchs = torch.nn.GRU(4, 5).double()
    ours = FastGru(4, 5).double()
    ours.load_state_dict(torchs.state_dict())
    u = torch.randn(60, 3, 4, dtype=torch.float64)
    one, two = u.clone().requires_grad_(), u.clone().requires_grad_()
    wanted = torch.randn(60, 3, 5, dtype=torch.float64)
    expected, got = torchs(one)[0], ours(two)[0]
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-13)
    (expected * wanted).sum().backward()
    (got * wanted).sum().backward()
    assert two.grad is not None
    torch.testing.assert_close(two.grad, one.grad, rtol=0, atol=1e-12)
    for (name, a), (other, b) in zip(torchs.named_parameters(), ours.named_parameters(), strict=True):
        assert name == other
        torch.testing.assert_close(b.grad, a.grad, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize(("cell", "hidden", "layers"), [("lstm", 3, 1), ("lstm", 3, 2), ("gru", 4, 1), ("gru", 3, 2)])
def test_every_shape_trains_is_written_and_reads_back_the_same_in_numpy_and_torch(rows, tmp_path, cell, hidden, layers):
    settings = dataclasses.replace(QUICK, cell=cell, hidden=hidden, layers=layers)
    result = fit(rows, settings)
    assert result.best.score < 0.9 * result.history[0].score
    document = train.document_of(result, rows, None, settings)
    text = format_document(document)
    assert json.loads(text) == document
    if (cell, layers) != ("lstm", 1) and not hasattr(formats, "FORMAT_STACK"):
        pytest.skip("the reader of this version takes one layer of LSTM cells only: reading back is NOT tested")
    write_document(tmp_path / "net.json", document)
    weights = formats.load_weights(tmp_path / "net.json")
    s, net = result.scaling, result.net.double()
    u = torch.from_numpy((rows.x[:400] - s.in_offset) / s.in_scale)[:, None, :]
    in_torch = s.out_offset + s.out_scale * net(u).detach().numpy()[:, 0]
    np.testing.assert_allclose(lstm_sequence(weights, rows.x[:400])[0], in_torch, rtol=0, atol=1e-12)
    twin, _ = net_from_weights(weights)
    torch.testing.assert_close(twin(u), net(u), rtol=0, atol=1e-12)


def test_only_the_output_layer_is_tuned_if_asked(rows, tmp_path):
    write_document(tmp_path / "net.json", train.document_of(fit(rows, QUICK), rows, None, QUICK))
    weights = formats.load_weights(tmp_path / "net.json")
    tuned = fit(rows, dataclasses.replace(QUICK, trained="head", fold=2, lr=0.05), start=weights).net
    before = net_from_weights(weights)[0].float()
    assert all(torch.equal(a, b) for a, b in zip(tuned.lstm.parameters(), before.lstm.parameters(), strict=True))
    assert not torch.equal(tuned.head.weight, before.head.weight)


# ---- stop and go on ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("settings", [QUICK, dataclasses.replace(PAPER_QUICK, l2=1e-3)], ids=["tuned", "paper"])
@pytest.mark.parametrize("stop", [10, 20, 30])
def test_a_run_that_was_stopped_and_resumed_gives_the_same_file(rows, tmp_path, settings, stop):
    def text(result: train.Fit) -> str:
        return format_document(train.document_of(result, rows, None, settings))

    def stop_at(p: Progress) -> None:
        if p.epoch >= stop:
            raise KeyboardInterrupt

    kept = tmp_path / "net.checkpoint"
    stopped = fit(rows, settings, report=stop_at, checkpoint=Checkpoint(kept))
    assert stopped.ended == "interrupted"
    assert kept.exists()
    resumed = fit(rows, settings, checkpoint=Checkpoint(kept, resume=True))
    whole = fit(rows, settings)
    assert resumed.ended == whole.ended == "complete"
    assert text(resumed) == text(whole), "bit for bit"
    assert [dataclasses.replace(p, elapsed_s=0.0) for p in resumed.history[1:]] == [
        dataclasses.replace(p, elapsed_s=0.0) for p in whole.history[1:]
    ]
    assert not kept.exists(), "a finished run leaves no checkpoint"


def test_a_run_killed_hard_is_resumed_from_its_last_checkpoint(data, tmp_path, monkeypatch):
    out = tmp_path / "net.json"
    command = ["--data", str(data), "--config", "tuned", "--window-s", "20", "--hidden", "3", "--epochs", "80"]
    command += ["--batch", "4", "--validate-every", "5", "--no-plot"]
    program = "import tools.train_fit as f, tools.train as t, sys; f.SAVE_EVERY_S = 0.0; sys.exit(t.main(sys.argv[1:]))"
    process = subprocess.Popen(
        [sys.executable, "-c", program, *command, "--out", str(out)], cwd=ROOT, stdout=subprocess.DEVNULL
    )
    kept = tmp_path / "net.json.checkpoint"
    try:
        deadline = time.monotonic() + 60.0
        while not kept.exists() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.02)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert kept.exists()
    assert not out.exists()
    assert train.main([*command, "--out", str(out), "--resume"]) == 0
    assert train.main([*command, "--out", str(tmp_path / "whole.json")]) == 0
    assert out.read_bytes() == (tmp_path / "whole.json").read_bytes()


def test_resume_refuses_what_is_not_its_own(rows, data, tmp_path, capsys):
    def stop(p: Progress) -> None:
        if p.epoch == 10:
            raise KeyboardInterrupt

    kept = tmp_path / "net.json.checkpoint"
    fit(rows, QUICK, report=stop, checkpoint=Checkpoint(kept))
    with pytest.raises(DataError, match="seed"):
        fit(rows, dataclasses.replace(QUICK, seed=9), checkpoint=Checkpoint(kept, resume=True))
    with pytest.raises(DataError, match="data_sha256"):
        fit(dataclasses.replace(rows, sha256="ee" * 32), QUICK, checkpoint=Checkpoint(kept, resume=True))
    kept.write_bytes(b"not a checkpoint")
    arguments = ["--data", str(data), "--out", str(tmp_path / "net.json"), "--resume"]
    assert train.main(arguments) == 1
    kept.unlink()
    assert train.main(arguments) == 1
    broken, missing = capsys.readouterr().err.strip().splitlines()
    assert "cannot be read" in broken
    assert "nothing to resume" in missing
    assert "--resume" in missing


# ---- what it shows ----------------------------------------------------------------------------------------


def test_the_loss_is_drawn_and_the_same_run_draws_the_same(tmp_path):
    pytest.importorskip("matplotlib", reason="matplotlib is absent (extra `train`): plots are NOT tested here")
    history = [Progress(20 * k, math.nan if k == 0 else 1.0 / k, 1.0 / (k + 1), 0.5, 0.7, 0.5, k) for k in range(9)]
    draw_history(tmp_path / "a.svg", history, "a title")
    draw_history(tmp_path / "b.svg", history, "a title")
    text = (tmp_path / "a.svg").read_text()
    assert text == (tmp_path / "b.svg").read_text()
    assert text.lstrip().startswith("<?xml")
    assert "Date" not in re.sub(r"<dc:date>.*?</dc:date>", "", text)


def test_a_terminal_gets_a_bar_with_the_loss():
    import io

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    stream = Terminal()
    line = ProgressLine(100, stream)
    line(Progress(50, 0.0123, 0.1, 0.2, 0.158, 0.15, 3.0))
    line.close()
    assert "50/100" in stream.getvalue()
    assert "0.01230" in stream.getvalue()
    assert "best 0.1500" in stream.getvalue()


def test_bad_places_are_one_line(data, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / "net.json"
    assert train.main(["--data", str(data), "--out", str(out), "--epochs", "0", "--no-plot"]) == 1
    message = capsys.readouterr().err
    assert message.startswith("train: ")
    assert message.count("\n") == 1


def test_settings_are_all_in_the_weights_file(rows):
    settings = dataclasses.replace(QUICK, epochs=0)
    training = train.document_of(fit(rows, settings), rows, None, settings)["training"]
    assert {f.name for f in dataclasses.fields(Settings)} <= set(training)
