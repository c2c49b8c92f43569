"""The real process with a job of 3.1 periods: three overruns, and under every policy the reaction that it promises.

The counters are exact; all that a busy machine can add is a further miss of its own: then the run is made again.
"""

from __future__ import annotations

import pytest

from rt_runner.bus import HubProcess
from tests.timing.estimator_process import OnBus, Run, binary, per_job

PERIOD_US = 50_000
GRACE = 5
LONG = 12  # the release of the long job
INJECT = ("--inject", f"compute:{round(3.1 * PERIOD_US)}@{LONG}")
TRIES = 3  # a machine that is taken from us for a period adds a miss that is none of ours


def run(*args: str, period_us: int = PERIOD_US, until: int = LONG + 8, signal_number: int | None = 15) -> Run:
    """A run on a hub, up to about release `until`."""
    hub = HubProcess()
    try:
        talk = OnBus(hub.bus, binary("release"), "--period-us", str(period_us), "--grace-releases", str(GRACE), *args)
        if signal_number is not None:
            talk.wait(until * period_us * 1e-6)
        return talk.finish(signal_number)
    finally:
        hub.stop()


def undisturbed(late: set[int], *args: str, **how) -> Run:
    """A run in which only the `late` releases are late: what the machine does to us is not the question here."""
    for _ in range(TRIES):
        result = run(*args, **how)
        if {int(a.values["release_index"]) for *_, a, _, _, _ in per_job(result) if a.values["miss_late"]} <= late:
            return result
    pytest.fail(f"in {TRIES} runs the machine never left us alone for a second")


def final_of(result: Run) -> dict:
    assert result.final is not None
    return result.final


def jobs_of(result: Run) -> dict[int, dict]:
    """Release -> the signals of its timing frames."""
    out = {}
    for *_, a, b, c, d in per_job(result):
        out[int(a.values["release_index"])] = {**a.values, **b.values, **c.values, **d.values}
    return out


def counts(result: Run) -> dict[str, int]:
    names = ("overrun", "miss_late", "miss_skipped", "queued", "cut", "rebased", "consec_miss_max")
    return {name: final_of(result)[name] for name in names}


def conserved(result: Run) -> None:
    final = final_of(result)
    assert final["releases"] == final["jobs"] + final["miss_skipped"] + final["queued_now"]
    assert final["jobs"] == final["estimates_sent"] == len(result.named("Estimate"))
    releases, misses = result.named("EstReleases")[-1].values, result.named("EstMisses")[-1].values
    overload, run_of = result.named("EstOverload")[-1].values, result.named("EstMissRun")[-1].values
    assert releases["releases"] == final["releases"] - final["queued_now"] == releases["jobs"] + misses["miss_skipped"]
    shown = {**misses, **overload, **run_of}
    for name, count in counts(result).items():
        assert shown[name] == count, name
    assert run_of["phase_us"] == pytest.approx(final["phase_us"], abs=0.5)


def test_skip_leaves_out_whole_periods():
    result = undisturbed({LONG}, *INJECT)
    conserved(result)
    assert counts(result) == {
        "overrun": 3, "miss_late": 1, "miss_skipped": 3, "queued": 0, "cut": 0, "rebased": 0, "consec_miss_max": 4,
    }  # fmt: skip
    jobs = jobs_of(result)
    assert not {LONG + 1, LONG + 2, LONG + 3} & set(jobs)
    assert jobs[LONG]["miss_cause"] == 3, "long_compute"
    assert jobs[LONG]["exec_cpu_us"] > 2 * PERIOD_US
    assert jobs[LONG + 4]["after_skip"] == 1
    assert final_of(result)["judged_causes"]["long_compute"] == 4
    assert final_of(result)["skipped_causes"]["long_compute"] == 3


def test_a_deadline_before_the_next_release_is_missed_without_an_overrun():
    deadline = ("--deadline-us", str(PERIOD_US // 2), "--on-miss", "invalid")
    result = undisturbed({LONG}, *deadline, "--inject", f"compute:{PERIOD_US * 3 // 4}@{LONG}")
    conserved(result)
    assert counts(result) == {
        "overrun": 0, "miss_late": 1, "miss_skipped": 0, "queued": 0, "cut": 0, "rebased": 0, "consec_miss_max": 1,
    }  # fmt: skip
    job = jobs_of(result)[LONG]
    assert (job["miss_cause"], job["output"]) == (3, 3), "long compute, put out as invalid"
    slack = final_of(result)["slack_us"]
    assert slack["min_index"] == LONG
    assert PERIOD_US / 2 - slack["min"] == pytest.approx(job["resp_us"], abs=0.2)


def test_queue_runs_what_fits_late_and_in_order():
    result = undisturbed({LONG, LONG + 1, LONG + 2}, *INJECT, "--policy", "queue:2")
    conserved(result)
    assert counts(result) == {
        "overrun": 3, "miss_late": 3, "miss_skipped": 1, "queued": 2, "cut": 0, "rebased": 0, "consec_miss_max": 4,
    }  # fmt: skip
    jobs = jobs_of(result)
    assert [n for n, job in jobs.items() if job["queued"]] == [LONG + 1, LONG + 2]
    assert LONG + 3 not in jobs
    for n in (LONG + 1, LONG + 2):
        assert jobs[n]["miss_cause"] == 3, "a release that waited is late for the job's reason it waited for"
        assert jobs[n]["resp_us"] > (LONG + 3.1 - n) * PERIOD_US


def test_rebase_moves_the_grid_and_loses_nothing():
    result = undisturbed({LONG}, *INJECT, "--policy", "rebase")
    conserved(result)
    assert counts(result) == {
        "overrun": 3, "miss_late": 1, "miss_skipped": 0, "queued": 0, "cut": 0, "rebased": 1, "consec_miss_max": 1,
    }  # fmt: skip
    assert 2.1 * PERIOD_US < final_of(result)["phase_us"] < 3.1 * PERIOD_US
    assert sorted(jobs_of(result)) == list(range(1, final_of(result)["jobs"] + 1))


def test_cut_ends_the_work_at_its_budget():
    budget_us = PERIOD_US // 2
    result = undisturbed(set(), *INJECT, "--policy", f"cut:{budget_us}")
    conserved(result)
    assert counts(result) == {
        "overrun": 0, "miss_late": 0, "miss_skipped": 0, "queued": 0, "cut": 1, "rebased": 0, "consec_miss_max": 0,
    }  # fmt: skip
    jobs = jobs_of(result)
    assert [n for n, job in jobs.items() if job["cut"]] == [LONG]
    assert budget_us < jobs[LONG]["resp_us"] < PERIOD_US


@pytest.mark.parametrize("policy", ["stop:total:4", "stop:row:2"])
def test_stop_ends_the_process_with_its_figures(policy):
    result = undisturbed({LONG}, *INJECT, "--policy", policy, signal_number=None)
    conserved(result)
    assert result.status == 2
    assert final_of(result)["stopped_by"] == "misses"
    assert result.errors == [
        "rt_estimator: stopped by its policy: 1 late and 3 skipped releases after warm-up, 4 misses in a row at most"
    ]
    assert max(jobs_of(result)) == LONG, "nothing runs after it"


def test_misses_in_the_grace_never_stop_it():
    early = ("--inject", f"compute:{round(3.1 * PERIOD_US)}@2")  # releases 2 to 5 are missed; 5 ends the grace
    result = undisturbed({2}, *early, "--policy", "stop:total:1", until=12)
    assert (result.status, final_of(result)["stopped_by"]) == (0, "signal")
    assert (final_of(result)["overrun"], final_of(result)["warmup"]["miss_skipped"]) == (3, 3)
    assert final_of(result)["judged"]["miss_late"] == final_of(result)["judged"]["miss_skipped"] == 0


def test_a_job_off_the_processor_is_called_preempted():
    result = undisturbed({LONG}, "--inject", f"sleep:{round(1.5 * PERIOD_US)}@{LONG}", "--mk", "1,10")
    assert jobs_of(result)[LONG]["miss_cause"] == 2
    assert (final_of(result)["overrun"], final_of(result)["miss_skipped"]) == (1, 1)
    assert final_of(result)["mk"] == {"m": 1, "k": 10, "worst": 2, "violations": final_of(result)["mk"]["violations"]}
    assert final_of(result)["mk"]["violations"] >= 5


OUTPUTS = {"late": 0, "hold": 1, "predict": 2, "invalid": 3}


@pytest.mark.parametrize("on_miss", OUTPUTS)
def test_what_a_late_job_puts_out(on_miss):
    """After three seconds, when there are estimates to hold and to predict from."""
    period_us, late = 100_000, 32
    inject = ("--inject", f"compute:{round(1.5 * period_us)}@{late}")
    result = undisturbed({late}, *inject, "--on-miss", on_miss, period_us=period_us, until=36)
    by_release = {int(a.values["release_index"]): (e.values, w.values, c.values)
                  for e, _, _, w, _, a, _, c, _ in per_job(result)}  # fmt: skip
    estimate, winding, timing = by_release[late]
    before = by_release[late - 1][0]
    assert before["status"] == 2, "it runs by then"
    assert timing["output"] == OUTPUTS[on_miss]
    assert {c["output"] for n, (_, _, c) in by_release.items() if n != late} == {0}
    shown = result.named("EstOutputs")[-1].values
    for reaction, name in (("hold", "held"), ("predict", "predicted"), ("invalid", "invalidated")):
        assert shown[name] == (on_miss == reaction), name
    if on_miss == "hold":
        kept = ("status", "theta_w_est_degc", "theta_r_est_degc", "tick")
        assert {k: estimate[k] for k in kept} == {k: before[k] for k in kept}
        return
    assert 9 <= estimate["tick"] - before["tick"] <= 11, "the inputs are the job's own"
    if on_miss == "invalid":
        assert (estimate["status"], estimate["theta_w_est_degc"], winding["upper_w_degc"]) == (5, None, None)
        return
    assert estimate["status"] == (3 if on_miss == "predict" else 2)
    assert estimate["theta_w_est_degc"] == pytest.approx(before["theta_w_est_degc"], abs=0.5)
    assert winding["upper_w_degc"] > estimate["theta_w_est_degc"]


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("--policy", "queue:0"), "--policy: 'queue:0'"),
        (("--policy", "cut:60000"), "must not be longer than the deadline of 50000 us"),
        (("--deadline-us", "50001"), "behind the period of 50000 us"),
        (("--deadline-us", "0"), "--deadline-us: '0'"),
        (("--deadline-us", "20000", "--policy", "cut:20001"), "the deadline of 20000 us"),
        (("--policy", "rebase", "--trigger", "frame"), "are for the time grid"),
        (("--on-miss", "guess"), "--on-miss: 'guess'"),
        (("--mk", "3,3"), "--mk: '3,3'"),
        (("--inject", "compute:-1@3"), "--inject: 'compute:-1@3'"),
        (("--grace-releases", "-1"), "--grace-releases: '-1'"),
        (("--trigger", "event"), "--trigger: 'event'"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_starts(args, says):
    with pytest.raises(AssertionError) as refused:
        run(*args)
    text = str(refused.value)
    assert says in text
    assert text.count("\n") == 1
