"""Tables of anybody's drives: CSV, Parquet and our own log give the rows that the plant's own file gives."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plant_sim.cycles import CycleSpec
from plant_sim.params import load_params
from plant_sim.plant import Plant
from plant_sim.simulate import Run, simulate
from plant_sim.state import ROW_SPEED, ROW_THETA_R, ROW_THETA_W, ROW_TORQUE
from rt_runner.codec import Encoder
from rt_runner.dbc import load_dbc
from rt_runner.mcap_log import LogWriter
from tools.dataset import DataSet, write_npz
from tools.dataset_recipe import rows_of
from tools.resample import Drive, _smoothed, resolution, to_rows
from tools.rows import COLUMNS, DataError, Rows
from tools.tables_io import QUANTITIES, load_rows

PARAMS = load_params()
LAP = CycleSpec("lap")
HEADER = "t_s,n_rpm,torque_nm,theta_w_degc,theta_r_degc"


@pytest.fixture(scope="module")
def run() -> Run:
    return simulate(PARAMS, LAP, 60.0)


@pytest.fixture(scope="module")
def fine() -> Run:
    """The same minute at 100 Hz."""
    return simulate(PARAMS, LAP, 60.0, rate_hz=100)


def inputs_of(run: Run) -> np.ndarray:
    return np.column_stack([run.t_s, rows_of(run)[:, :4]])


def write_csv(path: Path, table: np.ndarray, header: str = HEADER, delimiter: str = ",", digits: int = 17) -> Path:
    lines = [delimiter.join(f"{value:.{digits}g}" for value in row) for row in table]
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
    return path


def arrow():
    """pyarrow, or a loud skip of what needs it; a failure where the extra `train` must be there."""
    if os.environ.get("RT_REQUIRE_TORCH") != "1":
        pytest.importorskip("pyarrow", reason="pyarrow is absent (extra `train`): Parquet is NOT tested here")
    import pyarrow
    import pyarrow.parquet

    return pyarrow


def save_parquet(path: Path, columns: dict) -> Path:
    pa = arrow()
    pa.parquet.write_table(pa.table(columns), path)
    return path


def write_parquet(path: Path, table: np.ndarray, header: str = HEADER) -> Path:
    return save_parquet(path, dict(zip(header.split(","), table.T, strict=True)))


# ---- the same drive in every format -----------------------------------------------------------------------


@pytest.mark.parametrize("write", [write_csv, write_parquet])
def test_table_gives_the_rows_of_the_plants_own_file(tmp_path, run, write):
    rows = load_rows(write(tmp_path / f"drive.{write.__name__[6:]}", inputs_of(run)))
    own = rows_of(run)
    assert rows.x.tobytes() == own[:-1, :4].tobytes(), "the last sample has no successor, so no rate"
    np.testing.assert_allclose(rows.rates_degc_s, own[:-1, 4:], rtol=0, atol=1e-9)
    assert (rows.notes, np.unique(rows.trajectory).tolist()) == ((), [0])


def test_rates_of_the_table_are_taken_where_it_has_them(tmp_path, run):
    table = np.column_stack([run.t_s, rows_of(run)])
    path = write_csv(tmp_path / "lap.csv", table, "t_s,n_rpm,T_em_Nm,theta_w_C,theta_r_C,dtheta_w_Cps,dtheta_r_Cps")
    rows = load_rows(path)
    own = rows_of(run)
    assert np.column_stack([rows.x, rows.rates_degc_s]).tobytes() == own.tobytes()
    write_npz(tmp_path / "lap.npz", DataSet(own, np.zeros(len(own), dtype=np.int32)))
    assert load_rows(tmp_path / "lap.npz").sha256 == rows.sha256, "same rows, same hash, whatever the file"


def test_100_hz_is_averaged_to_the_plants_own_10_hz_rows(tmp_path, run, fine):
    rows = load_rows(write_csv(tmp_path / "fine.csv", inputs_of(fine)))
    np.testing.assert_allclose(rows.x[:599], rows_of(run)[:599, :4], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(rows.rates_degc_s[:598], rows_of(run)[:598, 4:], rtol=0, atol=1e-7)
    assert rows.notes == ("resampled from 0.01 s to 0.1 s",)


def test_coarser_samples_follow_the_truth_between_them(tmp_path):
    long = simulate(PARAMS, LAP, 300.0)
    own = rows_of(long)
    rows = load_rows(write_csv(tmp_path / "coarse.csv", inputs_of(long)[::10]))
    truth = own[: len(rows.x)]
    assert len(rows.x) == 2990
    assert np.abs(rows.x[:, 2:] - truth[:, 2:4]).max() < 0.2  # where full power begins or ends between two samples
    assert np.sqrt(np.mean((rows.x[:, 2:] - truth[:, 2:4]) ** 2)) < 0.02
    error = (rows.rates_degc_s - truth[:, 4:]).std(axis=0)
    assert (error < [0.1, 0.01]).all()
    assert rows.notes == ("resampled from 1 s to 0.1 s",)


def test_own_log_gives_the_rows_of_the_same_drive(tmp_path, run):
    rows = load_rows(write_log(tmp_path / "drive.mcap", ticks=6000))
    own = rows_of(run)[1 : len(rows.x) + 1]  # the first truth on the bus is that of tick 10
    assert len(rows.x) >= 590
    assert np.abs(rows.x[:, 0] - own[:, 0]).max() <= 0.125 + 1e-9  # mean of ten codes of 0.25 rpm
    assert np.abs(rows.x[:, 1] - own[:, 1]).max() <= 0.005 + 1e-9
    assert np.abs(rows.x[20:-20, 2:] - own[20:-20, 2:4]).max() < 0.02  # codes of 1/512 degC, smoothed
    assert (np.abs(rows.rates_degc_s - own[:, 4:])[20:-20].std(axis=0) < [0.03, 0.004]).all()
    assert any("smoothed over 0.5 s" in note for note in rows.notes)


def test_ticks_of_a_log_wrap_and_lost_frames_leave_gaps(tmp_path):
    whole = load_rows(write_log(tmp_path / "a.mcap", ticks=4000), smooth_s=0.0)
    wrapped = load_rows(write_log(tmp_path / "b.mcap", ticks=4000, first_tick=65536 - 2000), smooth_s=0.0)
    assert wrapped.x.tobytes() == whole.x.tobytes()
    np.testing.assert_allclose(wrapped.rates_degc_s, whole.rates_degc_s, atol=1e-9)
    cut = load_rows(write_log(tmp_path / "c.mcap", ticks=4000, lost=range(1500, 1700)), smooth_s=0.0)
    assert np.unique(cut.trajectory).tolist() == [0, 1]
    assert any("gaps" in note for note in cut.notes)
    assert 360 <= len(cut.x) < len(whole.x) - 20
    few = load_rows(write_log(tmp_path / "d.mcap", ticks=4000, lost=range(0, 4000, 50)), smooth_s=0.0)
    assert few.x.shape == whole.x.shape, "nine of ten frames stand for all"


def write_log(path: Path, ticks: int, first_tick: int = 0, lost=()) -> Path:
    """A log of the plant's frames as the plant process sends them; `lost` ticks miss their frames."""
    dbc = load_dbc()
    encoder = Encoder(dbc, "PLANT")
    plant = Plant(PARAMS, LAP)
    rows = plant.record(ticks)
    with LogWriter(path, dbc) as log:
        for k, row in enumerate(rows):
            tick = k + 1
            t_ns = 1_700_000_000_000_000_000 + (first_tick + tick) * 10_000_000
            sent = [
                encoder.encode(
                    "MotorState", speed_rpm=row[ROW_SPEED], torque_nm=row[ROW_TORQUE], derating_active=0.0,
                    tick=(first_tick - first_tick % 10 + tick) % 65536,
                )
            ]  # fmt: skip
            if tick % 10 == 0:
                theta = {"theta_w_true_degc": row[ROW_THETA_W], "theta_r_true_degc": row[ROW_THETA_R]}
                sent.append(encoder.encode("TruthTemp", theta, tick=(first_tick - first_tick % 10 + tick) % 65536))
            for frame in sent if tick not in lost else ():
                log.write(t_ns, frame.arbitration_id, frame.data)
    return path


# ---- names, separators, drives ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "header",
    [
        "time,speed,torque,winding,rotor",
        "Time [s],Speed [rpm],Torque (Nm),theta_w [°C],theta_r [°C]",
        "t,motor_speed,motor_torque,stator_winding,pm",
        "t_s,N_RPM,T_em_Nm,THETA_W_DEGC,theta_r_c",
    ],
)
def test_usual_names_are_understood(tmp_path, run, header):
    table = inputs_of(run)
    assert load_rows(write_csv(tmp_path / "a.csv", table, header)).x.tobytes() == rows_of(run)[:-1, :4].tobytes()


def test_units_in_names_are_converted(tmp_path, run):
    table = inputs_of(run)
    table[:, 0] *= 1000.0
    table[:, 1] *= np.pi / 30.0
    table[:, 3:] += 273.15
    rows = load_rows(write_csv(tmp_path / "a.csv", table, "t_ms,omega_rad_s,torque,theta_w_K,theta_r_K"))
    np.testing.assert_allclose(rows.x, rows_of(run)[:-1, :4], rtol=1e-12, atol=1e-9)


def test_every_name_we_list_is_one_we_find():
    for names in QUANTITIES.values():
        assert all(re.fullmatch(r"[a-z0-9]+(_[a-z0-9]+)*", name) for name in names)
    known = [name for names in QUANTITIES.values() for name in names]
    assert len(known) == len(set(known)), "a name must mean one thing"
    assert set(COLUMNS[:4]) < set(known)


def test_semicolons_with_decimal_commas_other_columns_and_byte_order_mark(tmp_path, run):
    path = write_csv(tmp_path / "a.csv", np.column_stack([inputs_of(run), run.v_mps]), HEADER + ",note", ";")
    lines = path.read_text().replace(".", ",").splitlines()
    lines[0] = HEADER.replace(",", ";") + ";note"
    text = "\n".join([lines[0], "", *[line.rsplit(";", 1)[0] + ";anything" for line in lines[1:]]])
    path.write_text(text, encoding="utf-8-sig")
    assert load_rows(path).x.tobytes() == rows_of(run)[:-1, :4].tobytes()


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_column_of_numbers_separates_drives(tmp_path, run, kind):
    table = inputs_of(run)
    both = np.concatenate([np.column_stack([table, np.full(600, 4)]), np.column_stack([table, np.full(600, 9)])])
    write = write_csv if kind == "csv" else write_parquet
    rows = load_rows(write(tmp_path / f"two.{kind}", both, HEADER + ",profile_id"))
    assert [len(piece) for piece in rows.pieces()] == [599, 599]


def test_a_gap_begins_a_new_drive_and_short_ones_are_left_out(tmp_path, run):
    table = inputs_of(run)
    table[300:, 0] += 7.0
    table[550:, 0] += 7.0
    rows = load_rows(write_csv(tmp_path / "gap.csv", table))
    assert [len(piece) for piece in rows.pieces()] == [299, 249]
    assert any("new drive" in note for note in rows.notes)
    assert any("left out" in note for note in rows.notes)


def test_timestamps_of_a_parquet_table(tmp_path, run):
    table = inputs_of(run)
    pa = arrow()
    ns = np.round(table[:, 0] * 1e9).astype("int64") + 1_700_000_000_000_000_000
    names = HEADER.split(",")[1:]
    columns = {"timestamp": pa.array(ns).cast(pa.timestamp("ns")), **dict(zip(names, table[:, 1:].T, strict=True))}
    save_parquet(tmp_path / "t.parquet", columns)
    np.testing.assert_allclose(load_rows(tmp_path / "t.parquet").x, rows_of(run)[:-1, :4], rtol=1e-12)


# ---- what is refused --------------------------------------------------------------------------------------


def broken(run: Run, change) -> np.ndarray:
    table = inputs_of(run)
    change(table)
    return table


BAD = {
    "not a number": (lambda t: t.__setitem__((10, 3), np.nan), r":(12|row 11): .*theta_w_degc.* delete"),
    "infinite": (lambda t: t.__setitem__((0, 1), np.inf), r":(2|row 1): .*n_rpm"),
    "kelvin": (lambda t: t.__setitem__((slice(None), 4), t[:, 4] + 400.0), r":(2|row 1): .*rotor.*kelvin"),
    "time stands": (lambda t: t.__setitem__((20, 0), t[19, 0]), r":(22|row 21): time does not rise; sort"),
    "too coarse": (lambda t: t.__setitem__((slice(None), 0), t[:, 0] * 60.0), r"6 s apart.* every 5 s"),
    "too short": (lambda t: t.__setitem__((slice(None), 0), t[:, 0] * 0.1), r"10 s or more"),
}


@pytest.mark.parametrize("kind", ["csv", "parquet"])
@pytest.mark.parametrize("what", BAD)
def test_bad_values_are_one_line_with_the_place(tmp_path, run, what, kind):
    change, message = BAD[what]
    write = write_csv if kind == "csv" else write_parquet
    path = write(tmp_path / f"bad.{kind}", broken(run, change))
    with pytest.raises(DataError, match=message) as caught:
        load_rows(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "", "no data below a header"),
        ("a.csv", HEADER + "\n", "no data below a header"),
        ("a.csv", "t_s,n_rpm,torque_nm,theta_w_degc\n0,1,2,3\n", "no column for rotor temperature; name one theta_r"),
        ("a.csv", HEADER + ",winding\n0,1,2,3,4,5\n", "'theta_w_degc', 'winding' all name the winding"),
        ("a.csv", HEADER + "\n0,1,2,3,4\n0.1,1,2,3\n", "a.csv:3: 4 cells but 5 columns"),
        ("a.csv", HEADER + "\n0,1,zwei,3,4\n", "a.csv:2: column 'torque_nm' holds no finite number"),
        ("a.csv", b"\xff\xfe\x00", "not UTF-8"),
        ("a.parquet", "no parquet", "not a readable Parquet file"),
        ("a.mcap", "no log", "not an MCAP log"),
        ("a.npz", "no archive", "rt-runner dataset"),
        ("a.xlsx", "x", "unknown kind of file; give one of .npz, .csv, .parquet, .mcap"),
    ],
)
def test_bad_files_are_one_line(tmp_path, name, text, message):
    if name.endswith("parquet"):
        arrow()
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(DataError, match=re.escape(message)) as caught:
        load_rows(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["npz", "csv", "parquet", "mcap"])
def test_missing_files_are_one_line(tmp_path, kind):
    if kind == "parquet":
        arrow()
    with pytest.raises(DataError, match=rf"none\.{kind}") as caught:
        load_rows(tmp_path / f"none.{kind}")
    assert "\n" not in str(caught.value)


def test_text_columns_and_nulls_of_parquet(tmp_path, run):
    columns: dict = dict(zip(HEADER.split(","), inputs_of(run).T, strict=True))
    save_parquet(tmp_path / "text.parquet", {**columns, "n_rpm": ["fast"] * 600})
    with pytest.raises(DataError, match=r"column 'n_rpm' holds string, not numbers"):
        load_rows(tmp_path / "text.parquet")
    holes = [None if i == 7 else 5.0 for i in range(600)]
    save_parquet(tmp_path / "null.parquet", {**columns, "torque_nm": holes})
    with pytest.raises(DataError, match=r"row 8: column 'torque_nm' holds no finite number"):
        load_rows(tmp_path / "null.parquet")


def test_missing_pyarrow_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(DataError, match=r"pyarrow.*pip install -e '\.\[train\]'"):
        load_rows(tmp_path / "a.parquet")


def test_a_log_without_truth_says_so(tmp_path):
    path = tmp_path / "motor.mcap"
    dbc = load_dbc()
    with LogWriter(path, dbc) as log:
        values = {"speed_rpm": 1.0, "torque_nm": 1.0, "derating_active": 0.0, "tick": 1.0}
        frame = Encoder(dbc, "PLANT").encode("MotorState", values)
        log.write(1, frame.arbitration_id, frame.data)
    with pytest.raises(DataError, match="no frame TruthTemp"):
        load_rows(path)


# ---- resampling -------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(
    steps=st.lists(st.sampled_from([0.03, 0.05, 0.1, 0.25, 0.4]), min_size=150, max_size=400),
    start=st.floats(-1e4, 1e6),
    slope=st.floats(-2.0, 2.0),
    seed=st.integers(0, 1000),
)
def test_resampling_keeps_what_must_be_kept(steps, start, slope, seed):
    """Whatever the times: inputs stay in range, a straight temperature stays straight, rates integrate to it."""
    rng = np.random.default_rng(seed)
    t = np.concatenate([[0.0], np.cumsum(steps)])
    n, torque = rng.uniform(0.0, 11000.0, len(t)), rng.uniform(-80.0, 160.0, len(t))
    x = np.column_stack([n, torque, 60.0 + slope * t, 80.0 - 0.1 * slope * t])
    if t[-1] < 12.0:
        with pytest.raises(DataError):
            to_rows([Drive(np.linspace(0.0, 9.0, 90), x[:90])], "short")
        return
    rows = to_rows([Drive(t + start - start, x)], "any", smooth_s=0.0)
    grid = 0.1 * np.arange(len(rows.x))
    assert grid[-1] + 0.1 <= t[-1] + 2e-3
    assert n.min() - 1e-6 <= rows.x[:, 0].min() <= rows.x[:, 0].max() <= n.max() + 1e-6
    np.testing.assert_allclose(rows.x[:, 2], 60.0 + slope * grid, atol=1e-6)
    np.testing.assert_allclose(rows.rates_degc_s, np.broadcast_to([slope, -0.1 * slope], (len(grid), 2)), atol=1e-5)
    theta = rows.x[0, 2:] + 0.1 * np.cumsum(rows.rates_degc_s, axis=0)[:-1]
    np.testing.assert_allclose(theta, rows.x[1:, 2:], atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(window_s=st.floats(0.0, 30.0), n=st.integers(5, 300), a=st.floats(-1, 1), b=st.floats(-1, 1))
def test_smoothing_keeps_parabolas_to_the_very_ends(window_s, n, a, b):
    k = np.arange(n) * 0.1
    theta = 60.0 + a * k + b * k**2
    if round(0.5 * window_s / 0.1) != 1:  # three samples take their mean
        np.testing.assert_allclose(_smoothed(theta, window_s), theta, atol=1e-6)


@settings(max_examples=50, deadline=None)
@given(quantum=st.sampled_from([0.5, 0.1, 0.01, 1 / 256, 1 / 512]), seed=st.integers(0, 100))
def test_resolution_of_a_sensor_is_found(quantum, seed):
    rng = np.random.default_rng(seed)
    truth = 60.0 + np.cumsum(rng.normal(0.0, 5.0 * quantum, 500))
    assert resolution(np.round(truth / quantum) * quantum) == pytest.approx(quantum, rel=1e-6)
    assert resolution(truth) == 0.0


def test_a_coarse_sensor_does_not_make_rates_of_its_steps(tmp_path, run):
    table = inputs_of(run)
    table[:, 3:] = np.round(table[:, 3:] / 0.1) * 0.1
    path = write_csv(tmp_path / "coarse.csv", table)
    smooth, raw = load_rows(path), load_rows(path, smooth_s=0.0)
    truth = rows_of(run)[:-1, 4:]
    error = [(rows.rates_degc_s - truth)[100:].std(axis=0) for rows in (smooth, raw)]
    assert (error[1] > 0.2).all()
    assert (error[0] < [0.2, 0.03]).all()
    assert any("smoothed over" in note for note in smooth.notes)
    assert raw.notes == ()


def test_rows_are_what_the_trainer_takes(tmp_path, run):
    rows = load_rows(write_csv(tmp_path / "a.csv", inputs_of(run)))
    assert isinstance(rows, Rows)
    assert rows.x.dtype == rows.rates_degc_s.dtype == np.float64
    assert rows.x.shape == (599, 4)
    assert len(rows.sha256) == 64
