"""The account of a log's timing frames against sums done another way."""

from hypothesis import given
from hypothesis import strategies as st

from rt_runner.timing_account import CAUSES, MACHINE_CAUSES, TimingAccount

JOB = st.tuples(st.integers(0, 3), st.booleans(), st.integers(0, len(CAUSES) - 1), st.integers(0, 3))
JOBS = st.lists(JOB, max_size=60)


def account_of(jobs, warmup: int) -> tuple[TimingAccount, dict[int, bool]]:
    """Feeds (skipped before it, late, cause, output) jobs; also whether each judged release was missed."""
    account, missed, release = TimingAccount(), {}, 0
    for n, (skipped, late, cause, output) in enumerate(jobs):
        skipped = skipped if n else 0
        for _ in range(skipped):
            release += 1
            missed[release] = True
        release += 1
        missed[release] = late
        # The frames say of a job whether it is judged; what was skipped before it goes with it.
        judged = release > warmup
        account.job_a({"release_index": release, "miss_late": late, "warmup": not judged, "after_skip": skipped > 0,
                       "stale_input": 0, "wake_lat_us": 1.0})  # fmt: skip
        account.job_b({"miss_cause": cause, "exec_wall_us": 2.0, "resp_us": 3.0})
        account.job_c({"output": output, "cut": 0, "queued": 0, "in_age_motor_us": None, "in_age_temp_us": 5.0})
        account.job_d({"exec_cpu_us": 1.5, "canary_us": None})
        if not judged:
            missed.clear()
    return account, missed


@given(JOBS, st.integers(0, 5), st.integers(1, 100))
def test_worst_window_and_totals(jobs, warmup, k):
    account, missed = account_of(jobs, warmup)
    indices = sorted(missed)
    windows = [sum(missed[i] for i in indices[j : j + k]) for j in range(len(indices))]
    assert account.worst_of(k) == max(windows, default=0)
    assert account.judged().misses == sum(missed.values())
    assert account.judged().releases == len(missed)
    figures = account.figures()
    assert figures["jobs"] == len(jobs) == sum(figures["outputs"].values())
    assert figures["releases"] == figures["jobs"] + figures["miss_skipped"]
    assert sum(figures["causes"].values()) == figures["miss_late"] + figures["miss_skipped"]


@given(JOBS, st.integers(0, 30), st.integers(1, 100))
def test_what_a_job_of_warm_up_ran_over_is_judged_from_the_end_of_grace_on(jobs, grace, k):
    account, _ = account_of(jobs, grace)
    missed, cause_before = [], 0
    for n, (skipped, late, cause, _) in enumerate(jobs):
        missed += [(True, cause_before)] * (skipped if n else 0) + [(late, cause)]
        cause_before = cause
    judged = missed[grace:]
    by_machine = sum(miss and CAUSES[cause] in MACHINE_CAUSES for miss, cause in judged)
    found = account.judged(grace)
    assert (found.releases, found.misses, found.by_machine) == (len(judged), sum(m for m, _ in judged), by_machine)
    windows = [sum(m for m, _ in judged[j : j + k]) for j in range(len(judged))]
    assert account.worst_of(k, grace) == max(windows, default=0)


def test_the_verdict_on_m_in_k():
    account, _ = account_of([(0, n in (10, 12, 40), 3, 0) for n in range(60)], 5)
    assert account.judge_mk((2, 10), 0).verdict == "pass"
    assert account.judge_mk((1, 10), 0).verdict == "fail"
    assert account.judge_mk((1, 10), 4).verdict == "inconclusive", "a frame that is missing may be what it hangs on"
    assert account.judge_mk((2, 60), 0).verdict == "fail"
    assert account.judge_mk((3, 60), 0).verdict == "inconclusive", "there were not so many releases"
