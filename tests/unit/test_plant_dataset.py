"""Data sets: size, hot share, determinism, and that the test lap stays out."""

import numpy as np
import pytest

from plant_sim.params import load_params
from tools import dataset as ds

PARAMS = load_params()


@pytest.fixture(scope="module")
def sets():
    return {name: ds.build_set(PARAMS, name, seed=1) for name in ("R", "P")}


@pytest.mark.parametrize(("name", "trajectories"), [("R", 16), ("P", 10)])
def test_size_and_hot_share(sets, name, trajectories):
    data = sets[name]
    assert data.values.shape == (180_000, 6)
    assert np.isfinite(data.values).all()
    assert ds.hot_share(data) >= 0.19
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
