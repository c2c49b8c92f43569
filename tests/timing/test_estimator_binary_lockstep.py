"""The estimator binary in lock-step: every job accounted for, damaged frames without effect, bad input refused."""

from __future__ import annotations

import struct
import subprocess
from collections import Counter

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rt_runner.e2e import E2eStatus
from rt_runner.records import END, TICK, Record
from tests.timing.estimator_process import (
    CONTENT,
    COUNTERS,
    IDENTITY,
    MS,
    TICK_NS,
    Plant,
    binary,
    drive,
    lockstep,
    per_job,
    run_drive,
    tick_record,
    to_bytes,
)

KINDS = ("speed", "torque", "theta_w", "theta_r", "joint")
OK, PREDICTING, INPUT_STALE, OPEN_LOOP = 2, 3, 4, 6
DROPOUT = 4  # EstWinding.sensor_w_fault
STALE_CAUSE = 4


@pytest.fixture(scope="module", params=["release", "asan"])
def program(request):
    return binary(request.param)


@pytest.fixture(scope="module")
def release():
    return binary("release")


def check_validity_frames(said):
    """The lap is what the net was trained for."""
    assert (said[0]["scope"], said[0]["novelty"]) == (0, None), "nothing has been estimated yet"
    judged = [v for v in said if v["scope"] > 0]
    assert {v["scope"] for v in judged} == {1}, "the history is shorter than two minutes"
    for v in judged:
        assert 0 < v["novelty"] <= 1
        assert not any(v[f"outside_{kind}"] for kind in KINDS)


def housekeeping(period_ms: int, seconds: int) -> list[tuple[int, str]]:
    """When (ms) which frame must leave: rounds of counters (each second) and identity (at start, each ten seconds).

    Two frames a job, a round at a time; and the counters once more at the end.
    """
    out, queue, counters_due, identity_due = [], [], 1000, 0
    for t in range(period_ms, seconds * 1000 + 1, period_ms):
        if not queue:
            if t >= counters_due:
                queue, counters_due = list(COUNTERS), t - t % 1000 + 1000
            if t >= identity_due:
                queue, identity_due = [*queue, *IDENTITY], t - t % 10_000 + 10_000
        out += [(t, name) for name in queue[:2]]
        queue = queue[2:]
    return out + [(seconds * 1000, name) for name in COUNTERS]


def test_housekeeping_of_the_usual_period_is_what_the_documents_say():
    times = housekeeping(100, 12)
    assert [t for t, name in times if name == "EstReleases"] == [*range(1000, 12_001, 1000), 12_000]
    assert [t for t, name in times if name == "EstCalibration"] == [*range(1300, 12_000, 1000), 12_000]
    assert [t for t, name in times if name == "EstRespStat"] == [*range(1700, 12_000, 1000), 12_000]
    assert [t for t, name in times if name == "EstIdentity"] == [100, 10_800]
    assert [t for t, name in times if name == "EstGranted"] == [200, 10_900]


@pytest.mark.parametrize("period_ms", [100, 1, 10, 250, 1000])
def test_one_estimate_per_job_and_everything_accounted_for(program, period_ms):
    seconds = 4 if period_ms < 10 else 12
    run = run_drive(program, drive(range(seconds * 100 + 1)), "--period-us", str(period_ms * 1000))
    assert (run.status, run.errors) == (0, [])
    jobs = list(per_job(run))
    warmup = max(5, -(-1000 // period_ms))
    assert run.final["warmup"]["jobs"] == warmup
    assert run.final["judged"]["jobs"] == run.final["resp_us"]["count"] == len(jobs) - warmup
    assert run.final["last_second"]["resp_us"]["count"] == 1000 // period_ms
    assert run.final["wake_lat_us"]["count"] == 0
    assert len(jobs) == seconds * 1000 // period_ms == run.final["jobs"] == run.final["releases"]
    assert run.final["miss_skipped"] == 0
    assert {f.e2e for f in run.frames} == {E2eStatus.OK}, "a gap in a counter"
    assert run.controls == [*((t * TICK_NS, TICK) for t in range(seconds * 100 + 1)), (seconds * 1000 * MS, END)]
    for n, job in enumerate(jobs, start=1):
        *contents, timing_a, timing_b, timing_c, timing_d = job
        assert timing_a.values["release_index"] == n
        assert timing_a.values["wake_lat_us"] is None, "nothing sleeps in lock-step"
        assert timing_a.values["warmup"] == (n <= warmup)
        assert timing_b.values["resp_us"] >= timing_b.values["exec_wall_us"] > 0
        assert {k: timing_c.values[k] for k in ("output", "cut", "queued")} == {"output": 0, "cut": 0, "queued": 0}
        assert timing_c.values["in_age_motor_us"] == n * period_ms % 10 * 1000, "age in record time"
        assert timing_c.values["in_age_temp_us"] == n * period_ms % 100 * 1000
        assert timing_d.values["exec_cpu_us"] > 0
        assert timing_d.values["canary_us"] is None
        assert {f.t_ns for f in job} == {n * period_ms * MS}
        # Releases run at TICK, when everything before has been delivered: the newest tick is the one in use.
        assert {f.values["tick"] for f in contents} == {n * period_ms // 10}
    kept = [(f.t_ns // MS, f.name) for f in run.frames if f.name in COUNTERS + IDENTITY]
    assert kept == housekeeping(period_ms, seconds)
    for releases, misses in zip(run.named("EstReleases"), run.named("EstMisses"), strict=True):
        assert releases.values["releases"] == releases.values["jobs"] + misses.values["miss_skipped"]
    together = Counter(f.t_ns for f in run.frames if f.t_ns < seconds * 1000 * MS)
    assert max(together.values()) <= 11, "the send queue of a CAN interface and its controller"
    assert jobs[-1][0].values["status"] == OK
    check_validity_frames([job[2].values for job in jobs])
    assert run.named("EstReleases")[-1].values["jobs"] == len(jobs)
    for name, metric in (("EstRespStat", "resp_us"), ("EstExecStat", "exec_wall_us"), ("EstWakeStat", "wake_lat_us")):
        shown = run.named(name)[-1].values
        for signal, key in (("p99_us", "p99"), ("max_us", "max")):
            assert shown[signal] == pytest.approx(run.final[metric][key], abs=0.0501), (name, signal)


def test_the_estimate_follows_the_measurement(release):
    run = run_drive(release, drive(range(2001)))
    for frame in run.named("Estimate")[-50:]:
        assert frame.values["status"] == OK
        theta_w, theta_r = Plant().truth(int(frame.values["tick"]))
        assert frame.values["theta_w_est_degc"] == pytest.approx(theta_w, abs=0.5)
        assert frame.values["theta_r_est_degc"] == pytest.approx(theta_r, abs=0.5)


def test_what_the_net_was_not_trained_for_is_flagged(release):
    """Half a second beyond the speed range, then a second of more power than there is."""
    plant, records = Plant(), []
    for tick in range(1201):
        beyond = {"speed_rpm": 14_000.0} if 500 <= tick < 550 else {}
        beyond = {"torque_nm": 150.0, "speed_rpm": 9000.0} if 800 <= tick < 900 else beyond
        records.append(Record(tick * TICK_NS, 0x0A0, plant.motor(tick, **beyond)))
        if tick % 10 == 0:
            records.append(Record(tick * TICK_NS, 0x1A0, plant.temp(tick)))
        records.append(tick_record(tick * TICK_NS))
    said = {int(f.values["tick"]): f.values for f in run_drive(release, records).named("EstValidity")}
    flagged = {kind: {t for t, v in said.items() if v[f"outside_{kind}"]} for kind in KINDS}
    assert flagged["speed"] == set(range(510, 560, 10)), "the interval that ends at the job's tick"
    assert set(range(820, 910, 10)) <= flagged["joint"]
    assert all(said[t]["novelty"] > 1 for t in set().union(*flagged.values()))
    assert not any(said[t][f"outside_{kind}"] for kind in KINDS for t in range(300, 500, 10))


def test_identity_says_what_runs(release):
    run = run_drive(release, drive(range(200)), "--setting", "paper", "--period-us", "50000")
    assert run.ready["ready"] is True
    assert run.ready["setting"] == "paper"
    identity, build, granted = (run.named(name)[0].values for name in IDENTITY)
    assert f"{int(identity['dbc_hash']):06x}" == run.ready["dbc_hash"][:6]
    assert f"{int(identity['weights_hash']):06x}" == run.ready["weights_hash"][:6]
    assert f"{int(build['build_hash']):06x}" == run.ready["build_hash"][:6]
    assert build["setting_id"] == 1
    assert granted["period_us"] == 50_000
    assert granted["policy"] == 0
    assert run.ready["policy"] == "other"


def test_same_input_same_bytes(release):
    records = drive(range(500))
    first, second = run_drive(release, records), run_drive(release, records)
    assert first.payload() == second.payload()
    assert len(first.payload()) == len(CONTENT) * 49


BASE = drive(range(301))
BASE_RUN: dict = {}

noise = st.one_of(
    st.builds(lambda b, bit: ("flip", b, bit), st.integers(0, 7), st.integers(0, 7)),
    st.builds(lambda i, d: ("foreign", i, d), st.integers(0x200, 0x7FF), st.binary(max_size=8)),
    st.builds(lambda d: ("extended", 0x800000A0, d), st.binary(max_size=8)),
    st.builds(lambda d: ("remote", 0x400000A0, d), st.binary(max_size=8)),
    st.builds(lambda d: ("error", 0x20000004, d), st.binary(min_size=1, max_size=8)),
    st.builds(lambda d: ("length", 0x0A0, d), st.binary(max_size=7)),
    st.just(("long", 0x0A0, b"\0" * 8)),
    st.just(("repeat", 0, b"")),
)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.integers(1, 300), noise), max_size=40))
def test_what_is_damaged_or_foreign_changes_no_estimate(release, extras):
    """Garbage between the good frames: every Estimate keeps its very bytes, and every piece is counted once."""
    by_tick: dict[int, list] = {}
    for tick, extra in extras:
        by_tick.setdefault(tick, []).append(extra)
    raw, tick = b"", 0
    count = dict.fromkeys(("flip", "foreign", "extended", "remote", "error", "length", "long", "repeat"), 0)
    for record in BASE:
        raw += to_bytes([record])
        if record.can_id != 0x0A0:
            continue
        tick = record.t_ns // TICK_NS
        for kind, a, b in by_tick.get(tick, ()):
            count[kind] += 1
            if kind == "flip":
                data = bytearray(record.data)
                data[a] ^= 1 << b
                raw += to_bytes([Record(record.t_ns, 0x0A0, bytes(data))])
            elif kind == "repeat":
                raw += to_bytes([record])
            elif kind == "long":
                raw += struct.pack("=qIB3x8s", record.t_ns, 0x0A0, 9, b)
            else:
                raw += to_bytes([Record(record.t_ns, a, b)])
    raw += to_bytes([tick_record(3000 * MS, END)])
    run = lockstep(release, raw)
    if not BASE_RUN:
        BASE_RUN["payload"] = run_drive(release, BASE).payload()
    assert (run.status, run.errors) == (0, [])
    assert run.payload() == BASE_RUN["payload"]
    final = run.final
    # Ids that differ in the low bits of data only: a flip in the high nibble of byte 1 is under the CRC, too.
    assert final["crc_errors"] == count["flip"] + count["length"]
    assert final["seq_errors"] == count["repeat"]
    assert final["foreign"] == count["foreign"]
    assert final["rejected"] == count["extended"] + count["remote"] + count["error"] + count["long"]
    assert final["error_frames"] == count["error"]
    faults, bus_faults = run.named("EstInputFaults")[-1].values, run.named("EstBusFaults")[-1].values
    assert (faults["crc_errors"], faults["seq_errors"]) == (final["crc_errors"], final["seq_errors"])
    assert bus_faults["rejected"] == final["rejected"]


TROUBLES = {
    # What is done to k frames, and what the receiver must count for it; what is missing shows with the next frame.
    "drop": {"lost": 1, "frames_lost": 1},
    "duplicate": {"repeated": 1},
    "corrupt": {"wrong_crc": 1, "lost": 1, "frames_lost": 1},
    "reorder": {"wrong_sequence": 1, "lost": 2, "frames_lost": 2},  # B A: A is missing, back to A, B is missing
}


@pytest.mark.parametrize("trouble", TROUBLES)
@pytest.mark.parametrize("k", [1, 7])
def test_k_frames_in_trouble_are_k_in_the_counters(release, trouble, k):
    at = {100 + 20 * n for n in range(k)}
    records, held = [], []
    for record in drive(range(401)):
        tick = record.t_ns // TICK_NS
        if record.can_id != 0x0A0:
            records.append(record)
            continue
        if trouble == "reorder" and tick in at:
            held = [record]
            continue
        if tick in at:
            damaged = bytes((*record.data[:4], record.data[4] ^ 0x10, *record.data[5:]))
            records += {"drop": [], "duplicate": [record] * 2, "corrupt": [record._replace(data=damaged)]}[trouble]
            continue
        # What was held back comes behind the next frame, in that frame's time.
        records += [record, *(h._replace(t_ns=record.t_ns) for h in held)]
        held = []
    counts = run_drive(release, records).final["rx"]["MotorState"]
    expected = {name: k * n for name, n in TROUBLES[trouble].items()}
    names = ("repeated", "lost", "wrong_sequence", "wrong_crc", "frames_lost")
    assert {name: counts[name] for name in names} == {**dict.fromkeys(names, 0), **expected}


def test_what_the_core_put_up_with_is_on_the_bus(program):
    """Stray ticks, values not available, temperatures off the grid and too late, a gap, a plant that starts again."""
    plant, records = Plant(), []
    for tick in range(1001):
        t_ns = tick * TICK_NS
        if not 500 <= tick < 530:
            records.append(Record(t_ns, 0x0A0, plant.motor(tick, torque_nm=None if 600 <= tick < 605 else 50.0)))
        if tick % 10 == 0:
            records.append(Record(t_ns, 0x1A0, plant.temp(tick)))
        if tick in (300, 301, 302):
            records.append(Record(t_ns, 0x0A0, plant.motor(7)))
            records.append(Record(t_ns, 0x0A0, plant.motor(tick + 1)))
            records.append(Record(t_ns, 0x0A0, plant.motor(tick + 1)))
        if tick in (700, 720):
            records.append(Record(t_ns, 0x1A0, plant.temp(tick + 3)))
        if tick == 800:
            records.append(Record(t_ns, 0x1A0, plant.temp(400)))
        records.append(tick_record(t_ns))
    for tick in range(400):
        t_ns = (1001 + tick) * TICK_NS
        records += [Record(t_ns, i, d) for i, d in plant.frames(tick)] + [tick_record(t_ns)]
    run = run_drive(program, records)
    first, second = run.named("EstCoreFaults")[-1].values, run.named("EstCoreFaults2")[-1].values
    found = {k: v for k, v in {**first, **second}.items() if k not in ("crc", "counter")}
    assert found == run.final["estimator"]
    assert (found["restarts"], found["stray_ticks"], found["held_intervals"]) == (1, 4, 2)
    # Both channels of the frame too late, and of the new plant's first one, which comes before the restart.
    assert (found["invalid_inputs"], found["late_measurements"]) == (5, 4)
    assert found["off_grid"] >= 2
    assert found["repeated_ticks"] >= 3
    assert run.named("EstCoreFaults")[0].values["stray_ticks"] == 0, "once a second, not only at the end"


def test_lost_frames_are_counted_and_the_drive_goes_on(program):
    records = [r for r in drive(range(1001)) if not (r.can_id == 0x0A0 and r.t_ns // TICK_NS in (400, 401, 700))]
    run = run_drive(program, records)
    assert run.status == 0
    assert run.final["seq_errors"] == 2
    assert run.final["rx"]["MotorState"]["frames_lost"] == 3
    assert run.final["rx"]["MotorState"]["lost"] == 2
    assert run.final["stale_inputs"] == 0
    assert {f.values["status"] for f in run.named("Estimate")[30:]} == {OK}


def test_silent_plant_makes_stale_inputs_and_is_seen_on_the_bus(program):
    silent = range(600, 800)
    records = [r for r in drive(range(1201)) if not (r.can_id == 0x0A0 and r.t_ns // TICK_NS in silent)]
    run = run_drive(program, records)
    assert run.status == 0
    stale = [a.values["release_index"] for *_, a, _, _, _ in per_job(run) if a.values["stale_input"]]
    for estimate, *_, timing_a, timing_b, _, _ in per_job(run):
        if timing_a.values["stale_input"]:
            assert timing_b.values["miss_cause"] == STALE_CAUSE
        if 61 <= timing_a.values["release_index"] <= 79:
            assert timing_a.values["stale_input"] == 1
            assert estimate.values["status"] == INPUT_STALE
    assert stale[0] == 61, "at 6.0 s the newest frame is 10 ms old, at 6.1 s it is older than its timeout"
    assert run.final["stale_inputs"] == len(stale) == run.named("EstInputFaults")[-1].values["stale_inputs"]
    assert run.final["causes"]["stale_input"] == len(stale)
    assert run.final["rx"]["MotorState"]["timeouts"] == 1
    assert run.named("Estimate")[-1].values["status"] == OK


def test_open_loop_without_motor_frames_is_stale_input(program):
    """A winding sensor lost for good ends in open loop; when the motor falls silent, too, that counts for more."""
    plant, records = Plant(), []
    for tick in range(5001):
        t_ns = tick * TICK_NS
        if not 4600 <= tick < 4700:
            records.append(Record(t_ns, 0x0A0, plant.motor(tick)))
        if tick % 10 == 0:
            lost = {"theta_w_meas_degc": None} if tick >= 1000 else {}
            records.append(Record(t_ns, 0x1A0, plant.temp(tick, **lost)))
        records.append(tick_record(t_ns))
    run = run_drive(program, records)
    assert (run.status, run.errors) == (0, [])
    status = [f.values["status"] for f in run.named("Estimate")]
    classes = [f.values["sensor_w_fault"] for f in run.named("EstWinding")]
    upper = [f.values["upper_w_degc"] for f in run.named("EstWinding")]
    assert set(status[20:99]) == {OK}
    assert set(status[110:390]) == {PREDICTING}
    assert set(status[420:460]) == set(status[475:]) == {OPEN_LOOP}
    assert set(status[461:469]) == {INPUT_STALE}
    assert set(classes[110:]) == {DROPOUT}
    assert {f.values["sensor_w_trusted"] for f in run.named("EstWinding")[110:]} == {0}
    assert {f.values["sensor_r_trusted"] for f in run.named("EstRotor")[110:450]} == {1}
    assert all(u > f.values["theta_w_est_degc"] for u, f in zip(upper[110:], run.named("Estimate")[110:], strict=True))
    assert run.final["status_jobs"]["open_loop"] == status.count(OPEN_LOOP)


def test_coolant_frames_are_checked_and_their_absence_makes_nothing_stale(program):
    records = [r for r in drive(range(1001)) if not (r.can_id == 0x1C0 and r.t_ns // TICK_NS >= 500)]
    first = next(i for i, r in enumerate(records) if r.can_id == 0x1C0 and r.t_ns // TICK_NS == 300)
    records[first] = records[first]._replace(data=bytes([records[first].data[0] ^ 1, *records[first].data[1:]]))
    run = run_drive(program, records)
    assert (run.status, run.errors) == (0, [])
    coolant = run.final["rx"]["Coolant"]
    assert (coolant["ok"], coolant["lost"], coolant["wrong_crc"], coolant["timeouts"]) == (3, 1, 1, 1)
    assert (run.final["crc_errors"], run.final["seq_errors"], run.final["foreign"]) == (1, 1, 0)
    assert run.final["stale_inputs"] == 0
    assert not any(a.values["stale_input"] for *_, a, _, _, _ in per_job(run))
    calibration = run.named("EstCalibration")[-1].values
    assert calibration["offset_w_degc"] == calibration["offset_r_degc"] == pytest.approx(-1.0)


def test_a_plant_that_sends_but_stands_still_is_stale(program):
    """Good counters and CRCs, the same tick for two seconds: the frames keep coming, news does not."""
    plant, records = Plant(), []
    for tick in range(1001):
        frozen = 600 if 600 <= tick < 800 else tick
        records.append(Record(tick * TICK_NS, 0x0A0, plant.motor(frozen)))
        if tick % 10 == 0:
            records.append(Record(tick * TICK_NS, 0x1A0, plant.temp(frozen)))
        records.append(tick_record(tick * TICK_NS))
    run = run_drive(program, records)
    assert (run.status, run.final["seq_errors"]) == (0, 0)
    for estimate, *_, timing_a, _, _, _ in per_job(run):
        n = timing_a.values["release_index"]
        if n > 20:
            assert timing_a.values["stale_input"] == (61 <= n <= 80), n  # 80 works off the intervals without a frame
        if 61 <= n <= 79:
            assert estimate.values["status"] == INPUT_STALE
    assert run.final["rx"]["MotorState"]["timeouts"] == 1
    assert run.named("Estimate")[-1].values["status"] == OK


def test_a_lost_sensor_is_stale_too_and_the_net_predicts(program):
    records = [r for r in drive(range(1001)) if not (r.can_id == 0x1A0 and 500 <= r.t_ns // TICK_NS < 900)]
    run = run_drive(program, records)
    assert run.status == 0
    assert PREDICTING in {f.values["status"] for f in run.named("Estimate")}
    assert run.final["rx"]["TempMeas"]["timeouts"] == 1
    assert run.final["stale_inputs"] > 30
    assert run.named("Estimate")[-1].values["theta_w_est_degc"] is not None


def test_values_not_available_are_never_used_as_numbers(program):
    plant, records = Plant(), []
    for tick in range(1001):
        torque = None if 300 <= tick < 400 else 50.0
        theta = None if 500 <= tick < 700 else 79.0
        records.append(Record(tick * TICK_NS, 0x0A0, plant.motor(tick, torque_nm=torque)))
        if tick % 10 == 0:
            records.append(Record(tick * TICK_NS, 0x1A0, plant.temp(tick, theta_w_meas_degc=theta)))
        records.append(tick_record(tick * TICK_NS))
    run = run_drive(program, records)
    assert run.status == 0
    assert run.final["rx"]["MotorState"]["unavailable"] == 100
    assert run.final["rx"]["TempMeas"]["unavailable"] == 20
    for frame in run.named("Estimate")[30:]:
        assert 60 < frame.values["theta_w_est_degc"] < 100


def test_a_plant_that_floods_one_period_loses_frames_countably(program):
    plant = Plant()
    records = [Record(MS, 0x0A0, plant.motor(i)) for i in range(5000)] + [tick_record(1000 * MS)]
    run = run_drive(program, records, "--period-us", "1000000")
    assert run.final["rx_drops"] == 5000 - 4096
    assert run.final["frames_received"] == 4096


@pytest.mark.parametrize(
    ("raw", "says"),
    [
        (b"", "ended without an END record"),
        (to_bytes(drive(range(20))), "ended without an END record"),
        (to_bytes(drive(range(20)))[:-5], "inside a record"),
        (to_bytes([tick_record(5 * MS), tick_record(4 * MS)]), "goes back"),
        (to_bytes([tick_record(-1)]), "goes back"),
        (to_bytes([tick_record(2**62)]), "leaps"),
        (to_bytes([Record(2**63 - 1, 0x0A0, b"12345678")]), "leaps"),
    ],
)
def test_input_that_breaks_the_protocol_is_one_line_and_exit_1(program, raw, says):
    run = lockstep(program, raw)
    assert run.status == 1
    assert len(run.errors) == 1
    assert run.errors[0].startswith("rt_estimator: stdin: ")
    assert says in run.errors[0]
    assert run.final["releases"] == run.final["jobs"] + run.final["miss_skipped"]


any_time = st.integers(0, 50 * MS)
any_record = st.one_of(
    st.tuples(
        any_time, st.sampled_from([0x0A0, 0x1A0, 0x20000000]), st.integers(0, 255), st.binary(min_size=11, max_size=11)
    ),
    st.tuples(any_time, st.integers(0, 2**32 - 1), st.integers(0, 255), st.binary(min_size=11, max_size=11)),
)


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.one_of(any_record, st.just("good")), min_size=20, max_size=200),
    st.sampled_from(["1000", "20000", "100000"]),
    st.sampled_from(["default", "paper"]),
    st.binary(max_size=30),
)
def test_random_records_break_nothing(records, period_us, setting, tail):
    """Thousands of random records, padding bytes and lengths included, under the sanitizers."""
    plant, raw, t_ns, tick = Plant(), b"", 0, 0
    for record in records:
        if record == "good":
            tick += 1
            t_ns += TICK_NS
            raw += to_bytes([Record(t_ns, i, d) for i, d in plant.frames(tick)] + [tick_record(t_ns)])
        else:
            step, can_id, length, rest = record
            t_ns += step
            raw += struct.pack("=qIB", t_ns, can_id, length) + rest
    run = lockstep(binary("asan"), raw + tail, "--period-us", period_us, "--setting", setting)
    assert run.status in (0, 1)
    assert all(line.startswith("rt_estimator: ") for line in run.errors), run.errors
    assert run.final["releases"] == run.final["jobs"] + run.final["miss_skipped"]
    assert run.final["estimates_sent"] == run.final["jobs"] == len(run.named("Estimate"))
    assert {f.e2e for f in run.frames} <= {E2eStatus.OK}


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.tuples(
            st.integers(0, 65535), st.floats(-400, 400), st.floats(0, 20000), st.floats(-200, 1000), st.integers(0, 300)
        ),
        min_size=5,
        max_size=150,
    )
)
def test_valid_frames_with_wild_content_break_nothing(steps):
    """Good CRCs, any values, any jump of the plant's tick, any timing: finite or not available, never undefined."""
    plant, records, t_ns = Plant(), [], 0
    for tick, torque, speed, theta, wait_ms in steps:
        t_ns += wait_ms * MS
        records += [
            Record(t_ns, 0x0A0, plant.motor(tick, torque_nm=torque, speed_rpm=speed)),
            Record(t_ns, 0x1A0, plant.temp(tick, theta_w_meas_degc=theta)),
            tick_record(t_ns),
        ]
    run = run_drive(binary("asan"), records, "--period-us", "10000")
    assert (run.status, run.errors) == (0, [])
    assert run.final["estimates_sent"] == run.final["jobs"] == len(run.named("Estimate"))
    assert {f.e2e for f in run.frames} <= {E2eStatus.OK}


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["--lockstep", "--period-us", "999"], "--period-us: '999'"),
        (["--lockstep", "--period-us", "1e5"], "--period-us: '1e5'"),
        (["--lockstep", "--period-us", "1000001"], "--period-us: '1000001'"),
        (["--lockstep", "--setting", "papper"], "no setting is called 'papper'; compiled in are: default, paper"),
        (["--lockstep", "--core", "-1"], "--core: '-1'"),
        (["--lockstep", "--priority", "0"], "--priority: '0'"),
        (["--lockstep", "--bus", "socketcan:vcan0"], "give either"),
        ([], "give either"),
        (["--bogus"], "--bogus: unknown option"),
        (["--lockstep", "extra"], "'extra' is no option"),
        (["--bus", "rt_hub:/nonexistent/hub.sock"], "/nonexistent/hub.sock"),
        (["--bus", "socketcan:nope0"], "nope0"),
        (["--bus", "pigeon"], "pigeon"),
    ],
)
def test_set_up_errors_are_one_line_and_exit_1(program, args, says):
    done = subprocess.run([program, *args], input="", capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 1
    assert done.stdout == ""
    lines = done.stderr.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("rt_estimator: ")
    assert says in lines[0]
