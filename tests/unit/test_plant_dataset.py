"""Data sets: size, hot share, determinism, and that the test lap stays out."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from plant_sim.params import load_params
from tools import dataset as ds
from tools.dataset_figures import describe, table
from tools.dataset_recipe import Chain, drive
from tools.dataset_store import DriveStore, fingerprint
from tools.rows import DataError

ROOT = Path(__file__).parents[2]

PARAMS = load_params()


@pytest.fixture(scope="module")
def sets():
    return {name: ds.build_set(PARAMS, name, seed=1) for name in ("R", "P")}


@pytest.mark.parametrize(("name", "trajectories", "hot"), [("R", 16, 0.27), ("P", 10, 0.30)])
def test_size_and_hot_share(sets, name, trajectories, hot):
    data = sets[name]
    assert data.values.shape == (180_000, 6)
    assert np.isfinite(data.values).all()
    assert ds.hot_share(data) >= hot
    assert np.unique(data.trajectory).tolist() == list(range(trajectories))
    assert data.column("theta_r_degc").min() < 65.0  # cold rotors occur
    assert data.column("n_rpm").max() > 10_500.0


def test_tracks_bring_fast_full_power_operation(sets):
    speed = {name: data.column("n_rpm") for name, data in sets.items()}
    power = sets["R"].column("torque_nm") * speed["R"] * np.pi / 30.0
    assert np.mean(speed["R"] > 6000.0) > 1.2 * np.mean(speed["P"] > 6000.0)
    assert np.mean((speed["R"] > 6000.0) & (power > 50e3)) > 0.15


def test_rates_are_forward_differences_within_each_trajectory(sets):
    data = sets["R"]
    theta, rate = data.column("theta_w_degc"), data.column("dtheta_w_degc_s")
    inside = np.diff(data.trajectory) == 0
    np.testing.assert_allclose((np.diff(theta) / 0.1)[inside], rate[:-1][inside], atol=1e-9)


def test_same_seed_same_rows_other_seed_other_rows(monkeypatch):
    monkeypatch.setitem(ds.RECIPES, "tiny", ds.Recipe(cycles=1, cold=(0,), laps=1))
    one, same, other = (ds.build_set(PARAMS, "tiny", seed) for seed in (4, 4, 5))
    assert one.sha256 == same.sha256
    assert one.sha256 != other.sha256


def test_hash_covers_rows_and_trajectories():
    values, trajectory = np.ones((4, 6)), np.zeros(4, dtype=np.int32)
    base = ds.DataSet(values, trajectory).sha256
    changed = values.copy()
    changed[3, 5] += 1e-12
    assert ds.DataSet(changed, trajectory).sha256 != base
    assert ds.DataSet(values, trajectory + 1).sha256 != base


def test_lap_is_not_in_the_training_set(sets):
    lap = ds.build_lap(PARAMS)
    assert 7050 <= lap.values.shape[0] <= 7250
    known = {row.tobytes() for row in sets["R"].values}
    common = sum(row.tobytes() in known for row in lap.values)
    assert common == 0


def test_file_has_the_agreed_keys_and_time_restarts(tmp_path, sets):
    path = tmp_path / "deep" / "R.npz"
    ds.write_npz(path, sets["R"])
    with np.load(path) as file:
        assert set(file) == {*ds.COLUMNS, "t_s", "trajectory", "sha256"}
        assert str(file["sha256"]) == sets["R"].sha256
        begins = np.flatnonzero(np.diff(file["trajectory"], prepend=-1))
        assert (file["t_s"][begins] == 0.0).all()
        assert file["t_s"][begins[1] - 1] == pytest.approx(1799.9)
    assert [p.name for p in path.parent.iterdir()] == ["R.npz"]


def test_command_line_reports_trouble(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(ds.RECIPES, "R", ds.Recipe(cycles=0, cold=(), laps=1))
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert ds.main(["--out", str(blocked / "R.npz")]) == 1
    assert "dataset:" in capsys.readouterr().err


# ---- a build that is interrupted --------------------------------------------------------------------------


TINY = ds.Recipe(
    cycles=1, cold=(0,), laps=2, targets_degc=((150.0, 160.0),), target_shares=(1.0,), payloads_kg=(300.0,)
)


def test_killed_build_goes_on_and_gives_the_same_bytes(tmp_path, monkeypatch):
    """kill -9 in the middle: the second run drives the rest only, and nobody can tell from the file."""
    recipe = ds.Recipe(cycles=1, cold=(0,), laps=5)
    monkeypatch.setitem(ds.RECIPES, "P", recipe)
    out, parts = tmp_path / "P.npz", tmp_path / "P.npz.parts"
    program = f"from tools import dataset as ds; ds.RECIPES['P'] = ds.{recipe}; raise SystemExit(ds.main())"
    command = [sys.executable, "-c", program, "--set", "P", "--seed", "1", "--out", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 60.0
        while len(list(parts.glob("drive-*.npz"))) < 2 and process.poll() is None:
            assert time.monotonic() < deadline, "two drives take a second, not a minute"
            time.sleep(0.005)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == -signal.SIGKILL, "it was over before it could be killed"
    kept = len(list(parts.glob("drive-*.npz")))
    assert 2 <= kept < 6
    assert not out.exists()
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count(" rows kept") == kept
    assert done.stdout.count(" rows driven") == 6 - kept
    ds.write_npz(tmp_path / "whole.npz", ds.build_set(PARAMS, "P", seed=1))
    assert out.read_bytes() == (tmp_path / "whole.npz").read_bytes()
    assert not parts.exists()


def test_every_place_to_stop_gives_the_same_rows(tmp_path, monkeypatch):
    monkeypatch.setitem(ds.RECIPES, "tiny", TINY)
    key = fingerprint(PARAMS, TINY, 4)
    with DriveStore(tmp_path, key) as store:
        whole = ds.build_set(PARAMS, "tiny", 4, store=store)
    assert ds.build_set(PARAMS, "tiny", 4).sha256 == whole.sha256
    for gone in ((1, 2), (2,), (1,)):  # stopped early, stopped late, and a hole in the middle
        with DriveStore(tmp_path, key) as store:
            for number in gone:
                (tmp_path / f"drive-{number:02d}.npz").unlink()
            assert ds.build_set(PARAMS, "tiny", 4, store=store).sha256 == whole.sha256


def test_a_damaged_or_foreign_drive_is_driven_again(tmp_path, monkeypatch):
    monkeypatch.setitem(ds.RECIPES, "tiny", TINY)
    one = ds.build_set(PARAMS, "tiny", 4)
    with DriveStore(tmp_path, fingerprint(PARAMS, TINY, 5)) as store:
        ds.build_set(PARAMS, "tiny", 5, store=store)
    first = tmp_path / "drive-00.npz"
    first.write_bytes(first.read_bytes()[:5000])
    seen = []
    with DriveStore(tmp_path, fingerprint(PARAMS, TINY, 4)) as store:
        again = ds.build_set(PARAMS, "tiny", 4, lambda done, of, text: seen.append(text), store)
    assert again.sha256 == one.sha256
    assert len(seen) == 3
    assert all("driven" in text for text in seen)


def test_fingerprint_tells_builds_apart():
    base = fingerprint(PARAMS, TINY, 4)
    assert fingerprint(PARAMS, TINY, 4) == base
    others = (
        fingerprint(PARAMS, TINY, 5),
        fingerprint(PARAMS, ds.Recipe(1, (), 2), 4),
        fingerprint(PARAMS.varied(vehicle__mass_kg=1161.0), TINY, 4),
    )
    assert len({base, *others}) == 4


def test_two_builds_of_one_file_are_refused(tmp_path):
    with DriveStore(tmp_path, "a"), pytest.raises(DataError, match="another build") as caught:
        DriveStore(tmp_path, "a")
    assert "--out" in str(caught.value)
    with DriveStore(tmp_path, "a"):
        pass


def test_a_drive_depends_on_its_chain_alone():
    """What makes resuming exact: same chain, same rows; the generator's state and temperatures go along."""
    begin = Chain.begin("track", 7)
    rows, end = drive(PARAMS, TINY, 7, "track", 0, begin)
    again, same_end = drive(PARAMS, TINY, 7, "track", 0, begin)
    assert rows.tobytes() == again.tobytes()
    assert end.random == same_end.random != begin.random
    assert end.theta_degc.tobytes() == same_end.theta_degc.tobytes()
    through_json = Chain(end.theta_degc, json.loads(json.dumps(end.random)))
    kept, fresh = (drive(PARAMS, TINY, 7, "track", 1, chain)[0] for chain in (through_json, end))
    assert kept.tobytes() == fresh.tobytes()


# ---- figures ----------------------------------------------------------------------------------------------


def test_figures_describe_every_row(sets):
    data = sets["R"]
    figures = describe(data.rows)
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    assert (figures["rows"], figures["trajectories"], figures["sha256"]) == (180_000, 16, data.sha256)
    for key in ("share_theta_w", "share_theta_r"):
        assert sum(band["share"] for band in figures[key]) == pytest.approx(1.0)
    assert np.sum(figures["coverage"]["share"]) == pytest.approx(1.0)
    hot = next(band for band in figures["share_theta_w"] if band["from"] == 150.0)
    assert hot["share"] == pytest.approx(ds.hot_share(data), abs=1e-4)
    theta = data.column("theta_w_degc")
    assert figures["range"]["theta_w_degc"]["max"] == theta.max()
    assert figures["range"]["theta_w_degc"]["p50"] == pytest.approx(np.median(theta))
    text = table(figures)
    assert f"{100 * hot['share']:.1f}" in text
    assert f"{theta.max():.1f}" in text


def test_command_writes_figures_plot_and_lap(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(ds.RECIPES, "R", ds.Recipe(cycles=0, cold=(), laps=1))
    out, plot = tmp_path / "sub" / "R.npz", tmp_path / "R.svg"
    assert ds.main(["--out", str(out), "--json", "-", "--plot", str(plot)]) == 0
    captured = capsys.readouterr()
    figures = json.loads(captured.out)
    assert (figures["set"], figures["seed"], figures["rows"]) == ("R", 1, 7200)
    assert figures["share_150_160"] <= 1.0
    assert figures["sha256"] in captured.err
    assert plot.read_text().startswith("<?xml")
    assert sorted(p.name for p in out.parent.iterdir()) == ["R.npz", "lap.npz"]
    with np.load(out.with_name("lap.npz")) as lap:
        assert lap["n_rpm"].size > 7000


def test_a_plot_nobody_can_draw_is_refused_before_the_work(tmp_path, capsys):
    assert ds.main(["--out", str(tmp_path / "R.npz"), "--plot", str(tmp_path / "R.doc")]) == 1
    assert ".svg or .png" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())
