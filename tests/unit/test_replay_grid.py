"""Replay finds out what each job had read although the grid moved under it (policy rebase) and no output says it."""

import random
from collections.abc import Sequence

import pytest

from rt_runner.replay.cuts import Evidence
from rt_runner.replay.session import Input, Job, Session

MS = 1_000_000
PERIOD_NS = 100 * MS
JOBS = 60


def session_with(steps_ms: dict[int, int], lag_ms: Sequence[int] = (0,)) -> tuple[Session, list[int]]:
    """A motor frame every 10 ms; the grid moves by ``steps_ms`` behind the jobs named; and what each job had read.

    The jobs before a step put out nothing computed. ``lag_ms``: how late Estimates are stamped, drawn by chance.
    """
    rng = random.Random(1)
    phase_ns, session, read = 0, Session(), []
    session.inputs = [
        Input(k * 10 * MS + rng.randrange(-MS, MS), 0x0A0, bytes(8), "MotorState", k)
        for k in range((JOBS * 100 + sum(steps_ms.values())) // 10 + 20)
    ]
    for n in range(1, JOBS + 1):
        late_ns = PERIOD_NS + steps_ms[n] * MS if n in steps_ms else MS
        wake_ns = rng.randrange(20_000, 90_000)
        start_ns = phase_ns + n * PERIOD_NS + wake_ns
        upto = sum(f.t_ns <= start_ns for f in session.inputs)
        stamp_ns = start_ns - wake_ns + late_ns + rng.choice(lag_ms) * MS
        job = Job(
            {"Estimate": (stamp_ns, bytes(8))}, sum(f.t_ns <= stamp_ns for f in session.inputs), n, wake_ns, late_ns
        )
        job.age_motor_ns = start_ns - session.inputs[upto - 1].t_ns
        job.output = 3 if n in steps_ms else 0
        job.tick, job.indexed = session.inputs[upto - 1].tick, True
        session.jobs.append(job)
        read.append(upto)
        phase_ns += steps_ms.get(n, 0) * MS
    return session, read


@pytest.mark.parametrize(
    "steps_ms",
    [{}, {30: 210}, {1: 15}, {60: 400}, {20: 210, 25: 35, 26: 80}, {n: 15 + n for n in range(10, 50)}],
    ids=["none", "once", "first", "last", "close together", "every job"],
)
def test_a_job_that_moved_the_grid_is_found_where_it_was(steps_ms):
    session, read = session_with(steps_ms)
    evidence, done = Evidence(session, PERIOD_NS), 0
    for k, upto in enumerate(read):
        cut = evidence.cut(k, done)
        assert cut.options[0] == upto, f"release {k + 1}"
        done = upto


def test_estimates_stamped_late_move_no_grid():
    """A hub that is held up stamps some Estimates 30 ms late: that is no step."""
    session, read = session_with({30: 210}, lag_ms=[0, 0, 0, 30])
    evidence = Evidence(session, PERIOD_NS)
    assert [evidence.cut(k, 0).options[0] for k in range(JOBS)] == read
