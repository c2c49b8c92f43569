"""The estimator binary under ``--replay``: the records say when each job ran, its estimates follow from the frames."""

import pytest

from rt_runner.records import END, job, pack
from tests.timing.estimator_process import (
    CONTENT,
    MS,
    PER_JOB,
    TICK_NS,
    Plant,
    binary,
    drive,
    lockstep,
    run_drive,
    tick_record,
    to_bytes,
)

PERIOD_NS = 100 * MS
TICKS = 600


@pytest.fixture(params=["release", "asan"])
def program(request):
    return binary(request.param)


def replayed(program, jobs, ticks=TICKS, late_ns=0):
    """Feed the drive with a job for each ``(release, inputs up to this tick)``, ``late_ns`` after its release."""
    plant, raw, done = Plant(), [], 0
    for release, newest in jobs:
        for tick in range(done + 1, newest + 1):
            raw += [pack(tick * TICK_NS, can_id, data) for can_id, data in plant.frames(tick)]
        done = newest
        raw.append(job(release * PERIOD_NS + late_ns, release))
    end = to_bytes([tick_record(ticks * TICK_NS, END)])
    return lockstep(program, b"".join(raw) + end, "--replay")


def content(run):
    return [(f.name, f.data) for f in run.frames if f.name in CONTENT]


def test_the_jobs_of_lock_step_named_one_by_one_give_its_bytes(program):
    stepped = run_drive(program, drive(range(1, TICKS + 1)))
    again = replayed(program, [(k, 10 * k) for k in range(1, TICKS // 10 + 1)])
    assert again.status == stepped.status == 0, again.errors
    assert len(content(again)) == len(CONTENT) * TICKS // 10
    assert content(again) == content(stepped)
    rounds = [f.data for f in stepped.frames if f.name == "EstCalibration"]
    assert [f.data for f in again.frames if f.name == "EstCalibration"] == rounds
    assert len(rounds) >= TICKS // 100


def test_a_release_left_out_has_no_job_and_the_next_one_takes_its_frames(program):
    """As in real time after a skip: the index says so, the estimate of that moment is the same."""
    whole = replayed(program, [(k, 10 * k) for k in range(1, 61)])
    skipped = replayed(program, [(k, 10 * k) for k in range(1, 61) if k not in (30, 31)])
    index = [f.values["release_index"] for f in skipped.named("EstTimingA")]
    assert index == [k for k in range(1, 61) if k not in (30, 31)]
    assert [f.values["after_skip"] for f in skipped.named("EstTimingA")].count(1.0) == 1
    assert len([f for f in skipped.frames if f.name in PER_JOB]) == 58 * len(PER_JOB)
    estimates = {f.values["tick"]: f.values for f in whole.named("Estimate")}
    last = skipped.named("Estimate")[-1].values
    assert last | {"counter": 0} == estimates[last["tick"]] | {"counter": 0}


def test_how_old_the_newest_frame_is_decides_whether_the_input_is_stale(program):
    """MotorState times out after 50 ms: the time that the job read its inputs counts, not its release."""
    jobs = [(k, 10 * k) for k in range(1, 61)]
    fresh, stale = replayed(program, jobs, late_ns=49 * MS), replayed(program, jobs, late_ns=51 * MS)
    assert {f.values["stale_input"] for f in fresh.named("EstTimingA")} == {0.0}
    assert {f.values["stale_input"] for f in stale.named("EstTimingA")} == {1.0}
    assert stale.named("Estimate")[-1].values["status"] == 4.0
    assert fresh.named("Estimate")[-1].values["status"] == 2.0


@pytest.mark.parametrize(
    ("records", "words"),
    [
        (job(PERIOD_NS, 1) + job(2 * PERIOD_NS, 1), "release 1 comes after release 1"),
        (job(PERIOD_NS, 7) + job(2 * PERIOD_NS, 6), "release 6 comes after release 7"),
        (pack(1 << 62, 0xA0, bytes(8)), "since the start of the grid"),
        (job(PERIOD_NS, 1), "without an END"),
    ],
)
def test_what_cannot_have_been_is_refused(program, records, words):
    run = lockstep(program, records, "--replay")
    assert run.status == 1
    assert words in run.errors[-1]


def test_lock_step_knows_no_such_record(program):
    """There the clock decides."""
    run = lockstep(program, job(0, 1) + to_bytes([tick_record(0, END)]))
    assert run.status == 0
    assert run.named("Estimate") == []
