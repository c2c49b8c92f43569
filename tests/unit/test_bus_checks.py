"""`assert_cycle_times` and `assert_no_timeouts` over every format of log, and the words they fail with."""

import can
import cantools
import pytest

from rt_runner.any_log import raw_frames
from rt_runner.dbc import load_dbc
from rt_runner.errors import UsageError
from rt_runner.log_reader import LogError
from rt_runner.mcap_log import LogWriter
from rt_runner.testing import assert_cycle_times, assert_no_timeouts
from tests.unit.test_timing_cycles import FOREIGN

DBC = load_dbc()
T0_NS = 1_790_000_000_000_000_000
MS = 1_000_000
PLANT = [m for m in DBC if m.sender == "PLANT"]
SUFFIXES = (".mcap", ".log", ".asc", ".blf", ".csv", ".log.gz")


def drive(seconds: float = 6.0, slow: str = "", gap: str = "") -> list[tuple[int, int]]:
    """(stamp, id) of all the plant sends: one message 8 % too slow, or silent from 2 s to 4 s."""
    stamped = []
    for m in PLANT:
        cycle_ns = round(m.cycle_ms * MS * (1.08 if m.name == slow else 1.0))
        for t in range(0, round(seconds * 1e9), cycle_ns):
            if m.name != gap or not 2000 * MS < t < 4000 * MS:
                stamped.append((T0_NS + t, m.frame_id))
    return sorted(stamped)


def messages(stamped: list[tuple[int, int]]) -> list[can.Message]:
    return [can.Message(t / 1e9, i, is_extended_id=False, data=bytes(8)) for t, i in stamped]


def written(path, stamped, period_s=0.1):
    if path.suffix == ".mcap":
        with LogWriter(path, DBC, {"period_s": period_s}) as log:
            for t_ns, frame_id in stamped:
                log.write(t_ns, frame_id, bytes(8))
        return path
    with can.Logger(path) as log:
        for m in messages(stamped):
            log(m)
    return path


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_gives_the_same_figures(tmp_path, suffix):
    stamped = drive(gap="Reference")
    log = written(tmp_path / f"log{suffix}", stamped)
    frames = list(raw_frames(log))
    assert [f.can_id for f in frames] == [i for _, i in stamped]
    coarse_ns = 1 if suffix == ".mcap" else 1500
    for frame, (t_ns, _) in zip(frames, stamped, strict=True):
        assert abs((frame.t_ns - frames[0].t_ns) - (t_ns - T0_NS)) <= coarse_ns
    rows = {r.name: r for r in assert_cycle_times(log, DBC, "PLANT")}
    assert set(rows) == {m.name for m in PLANT}
    assert rows["MotorState"].frames == 600
    assert rows["MotorState"].max_ms == pytest.approx(10.0, abs=0.002)
    with pytest.raises(AssertionError, match=r"1 of \d+ cyclic messages of PLANT timed out") as failure:
        assert_no_timeouts(log, DBC, "PLANT")
    assert "Reference 0x1B0: 1 time silent for longer than 350 ms, longest 2000 ms from 2.000 s of the log on" in str(
        failure.value
    )


def test_messages_at_hand_do_as_well_and_so_do_all_kinds_of_dbc(tmp_path):
    log = messages(drive())
    for dbc in (DBC, DBC.database, DBC.path):
        rows = assert_cycle_times(log, dbc)
        assert {r.sender for r in rows} == {"PLANT"}, "who did not speak is not judged unless named"
        assert assert_no_timeouts(log, dbc) == rows


def test_a_wrong_rate_names_message_expectation_measurement_and_gap(tmp_path):
    log = written(tmp_path / "run.mcap", drive(slow="TempMeas"))
    with pytest.raises(AssertionError) as failure:
        assert_cycle_times(log, DBC, "PLANT")
    head, *lines = str(failure.value).splitlines()
    assert head == f"1 of {len(PLANT)} cyclic messages of PLANT are off their cycle time (tolerance 0.05) in run.mcap:"
    assert lines == [
        "  TempMeas 0x1A0: every 100 ms expected, 108 ms measured (+8.0%), 56 frames; "
        "longest gap 108 ms from 0.000 s of the log on (2026-09-21 14:13:20.000000 UTC)"
    ]
    assert_cycle_times(log, DBC, "PLANT", tolerance=0.09)
    assert_cycle_times(log, DBC, "PLANT", ignore=["TempMeas"])
    assert_no_timeouts(log, DBC, "PLANT")


def test_one_interruption_is_a_gap_and_no_rate():
    log = messages(drive(gap="MotorState"))
    assert_cycle_times(log, DBC, "PLANT")
    with pytest.raises(AssertionError, match=r"MotorState 0x0A0: every 10 ms.*longest gap 2000 ms from 2\.000 s"):
        assert_cycle_times(log, DBC, "PLANT", max_gap=10)
    with pytest.raises(AssertionError, match="MotorState"):
        assert_no_timeouts(log, DBC)


def test_a_message_that_never_came_and_a_node_that_never_spoke():
    log = [m for m in messages(drive()) if m.arbitration_id != DBC["Coolant"].frame_id]
    with pytest.raises(AssertionError, match=r"Coolant 0x1C0: every 1000 ms expected, never came in 6\.0 s"):
        assert_cycle_times(log, DBC)
    with pytest.raises(AssertionError, match="Coolant"):
        assert_no_timeouts(log, DBC)
    for check in (assert_cycle_times, assert_no_timeouts):
        with pytest.raises(AssertionError, match="no cyclic message of node ESTIMATOR is in the messages given"):
            check(log, DBC, "ESTIMATOR")
        with pytest.raises(AssertionError, match="no cyclic message of any node"):
            check([], DBC)


def test_frames_per_job_are_judged_by_the_period_that_the_log_names(tmp_path):
    per_job = [m.frame_id for m in DBC if m.per_job]
    stamped = [(T0_NS + k * 20 * MS, i) for k in range(100) for i in per_job]
    others = [m.name for m in DBC if m.sender == "ESTIMATOR" and not m.per_job]
    log = written(tmp_path / "fast.mcap", stamped, period_s=0.02)
    assert {r.cycle_ms for r in assert_cycle_times(log, DBC, "ESTIMATOR", ignore=others)} == {20.0}
    log = written(tmp_path / "fast.log", stamped)
    with pytest.raises(AssertionError, match="every 100 ms expected, 20 ms measured"):
        assert_cycle_times(log, DBC, "ESTIMATOR", ignore=others)
    assert_cycle_times(log, DBC, "ESTIMATOR", ignore=others, job_period_s=0.02)


def test_somebody_elses_dbc_and_long_ids():
    database = cantools.database.load_string(FOREIGN, "dbc")
    log = [can.Message(k * 0.02, 0x100, is_extended_id=False) for k in range(100)]
    door = 2566844672 & 0x1FFFFFFF
    log += [can.Message(k * 0.5, door, is_extended_id=True) for k in range(5)]
    log.sort(key=lambda m: m.timestamp)
    rows = {r.name: r.frames for r in assert_cycle_times(log, database, "GATEWAY")}
    assert rows == {"Wheel": 100, "Door": 5}


def test_names_that_do_not_exist_are_refused():
    log = messages(drive(0.5))
    with pytest.raises(UsageError, match=r"no node 'PLNT'.*PLANT"):
        assert_cycle_times(log, DBC, "PLNT")
    with pytest.raises(UsageError, match="no message Motor"):
        assert_no_timeouts(log, DBC, ignore=["Motor"])
    with pytest.raises(UsageError, match="not a usable DBC"):
        assert_no_timeouts(log, __file__)


@pytest.mark.parametrize("name", ["none.mcap", "none.log", "none.blf", "text.blf", "text.mcap", "text.xyz", "text"])
def test_what_is_no_log_is_one_line(tmp_path, name):
    if name.startswith("text"):
        (tmp_path / name).write_text("this is no log, whatever it is called\n")
    with pytest.raises(LogError) as error:
        list(raw_frames(tmp_path / name))
    assert str(error.value).startswith(f"{tmp_path / name}: ")
    assert len(str(error.value).splitlines()) == 1
