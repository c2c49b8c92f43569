"""The size study: every net with the same budget, kept in a cache, judged on the lap."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest

import estimator_c.formulation.weights as formats
from tools.evaluate import COLUMNS

if os.environ.get("RT_REQUIRE_TORCH") == "1":
    import torch  # noqa: F401
else:
    pytest.importorskip("torch", reason="torch is absent (extra `train`): the size study is NOT tested here")
pytest.importorskip("matplotlib", reason="matplotlib is absent (extra `train`): the size study is NOT tested here")

from tools import size_study
from tools.size_study import SHAPES, Shape

ANY_NET = hasattr(formats, "FORMAT_STACK")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Six drives; the rate follows the torque through one hidden lag."""
    rng = np.random.default_rng(0)
    values, number = [], []
    for k in range(6):
        torque = np.repeat(rng.uniform(0.0, 160.0, 60), 30)
        theta, lag = 60.0, 0.0
        for nm in torque:
            lag += 0.1 / 8.0 * (nm / 160.0 - lag)
            rate = 0.8 * lag - (theta - 60.0) / 100.0
            values.append((4000.0, nm, theta, 60.0 + 0.1 * (theta - 60.0), rate, 0.1 * rate))
            number.append(k)
            theta += 0.1 * rate
    path = tmp_path_factory.mktemp("data") / "set.npz"
    columns = dict(zip(COLUMNS, np.array(values).T, strict=True))
    np.savez(path, **columns, trajectory=np.array(number), sha256=np.array("ab" * 32))
    lap = {name: column[:900] for name, column in columns.items()}
    np.savez(path.with_name("lap.npz"), **lap, trajectory=np.zeros(900, int), sha256=np.array("cd" * 32))
    return path


def test_shapes_are_those_of_the_study_and_their_products_are_counted():
    assert {s.name for s in SHAPES} == {"LSTM 4", "LSTM 8", "LSTM 16", "LSTM 32", "LSTM 2x8", "GRU 8"}
    assert Shape("lstm", 8).multiply_adds == 32 * 12 + 16
    assert Shape("lstm", 8, 2).multiply_adds == 32 * 12 + 32 * 16 + 16
    assert Shape("gru", 8).multiply_adds == 24 * 12 + 16


@pytest.fixture(scope="module")
def study(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    names = "LSTM 4,LSTM 8" + (",GRU 8,LSTM 2x8" if ANY_NET else "")
    command = [
        "--data",
        str(data),
        "--lap",
        str(data.with_name("lap.npz")),
        "--cache",
        str(folder / "cache"),
        "--epochs",
        "2",
    ]
    command += ["--out", str(folder / "study"), "--only", names, "--no-bench"]
    return folder, command, names.split(",")


def test_one_command_gives_table_plot_and_figures_and_takes_the_second_time_from_the_cache(study, capsys):
    folder, command, names = study
    assert size_study.main(command) == 0
    first = capsys.readouterr().out
    figures = json.loads((folder / "study.json").read_text())
    assert sorted(net["name"] for net in figures["nets"]) == sorted(names)
    for net in figures["nets"]:
        assert 0.0 < net["nrmse_w"] < 100.0
        assert 0.0 < net["nrmse_r"] < 100.0
        assert net["step_instructions"] is None
        assert f"| {net['name']} | {net['multiply_adds']} |" in first
    plot = (folder / "study.svg").read_bytes()
    assert b"<svg" in plot
    made = {path.name: path.read_bytes() for path in (folder / "cache").iterdir()}
    assert size_study.main(command) == 0
    second = capsys.readouterr().out
    assert second.count("taken from") == len(names)
    assert {path.name: path.read_bytes() for path in (folder / "cache").iterdir()} == made
    assert (folder / "study.svg").read_bytes() == plot
    assert json.loads((folder / "study.json").read_text()) == figures


def test_a_net_of_other_data_is_not_taken_from_the_cache(study, data, capsys):
    folder, command, _ = study
    command = [*command, "--only", "LSTM 4"]
    path = folder / "cache" / "lstm1x4-2-1.json"
    assert size_study.main(command) == 0
    document = json.loads(path.read_text())
    path.write_text(json.dumps(document | {"data_sha256": "cd" * 32}))
    capsys.readouterr()
    assert size_study.main(command) == 0
    assert "taken from" not in capsys.readouterr().out
    assert json.loads(path.read_text()) == document, "trained again, with the same outcome"


def test_unknown_net_is_one_line(study, capsys):
    assert size_study.main([*study[1], "--only", "LSTM 5"]) == 1
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "LSTM 5" in message
    assert "LSTM 2x8" in message


def test_instructions_are_read_from_the_benchmark(study, monkeypatch):
    """The names that tools.bench_net writes are those that the study reads."""
    import dataclasses

    from tools import bench_net

    costs = [c for c in vars(bench_net).values() if dataclasses.is_dataclass(c) and isinstance(c, type)]
    names = {f.name for c in costs for f in dataclasses.fields(c)}
    assert {"forward_instructions", "mhe_step_instructions"} <= names
    assert size_study._count({"forward_instructions": 3854.0}, "forward_instructions") == 3854
