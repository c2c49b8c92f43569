"""Two nodes, one account: the controller's loop is judged as the estimator's is, and only where there is one."""

import pytest

from rt_runner.present import summary
from rt_runner.result import Limits, ResultAccumulator, RunFacts

JOBS = 300
WORDS = {"Est": "estimator", "Ctl": "controller"}
NAMES = {"Est": "{}", "Ctl": "controller {}"}


def put(acc: ResultAccumulator, k: int, name: str, **values) -> None:
    acc.feed(k * 100_000_000, name, {"counter": None, **values})


def drive(acc: ResultAccumulator, prefix: str, late=(), skipped=(), cause=3, claims=0, counted=True) -> None:
    """A node's loop of `JOBS` jobs; ``claims``: releases it counts beyond what it did."""
    release = 0
    for k in range(JOBS):
        release += 1 + (k in skipped)
        miss = k in late or k + 1 in skipped
        put(acc, k, f"{prefix}TimingA", release_index=release, miss_late=k in late, warmup=k < 5, stale_input=0,
            after_skip=k in skipped, wake_lat_us=20.0)  # fmt: skip
        put(acc, k, f"{prefix}TimingB", miss_cause=cause if miss else 0, exec_wall_us=40.0, resp_us=70.0)
    if counted:
        put(acc, JOBS, f"{prefix}Releases", releases=release + claims, jobs=JOBS)
        put(acc, JOBS, f"{prefix}Misses", miss_late=len(late), miss_skipped=len(skipped), overrun=2)


def result_of(acc: ResultAccumulator, **facts) -> dict:
    return acc.result(RunFacts(**{"bus": "hub", "scenario": "x", "limits": Limits(), **facts}))


def verdicts(result: dict) -> dict[str, str]:
    return {f["what"]: f["verdict"] for f in result["findings"]}


@pytest.mark.parametrize("prefix", ["Est", "Ctl"])
@pytest.mark.parametrize(
    ("loop", "miss_rate", "conservation"),
    [
        ({}, "pass", "pass"),
        ({"late": range(50, 150)}, "fail", "pass"),
        ({"late": range(50, 150), "cause": 2}, "inconclusive", "pass"),
        ({"skipped": range(100, 160)}, "fail", "pass"),
        ({"late": range(20)}, "inconclusive", "pass"),
        ({"claims": 1}, "pass", "fail"),
        ({"counted": False}, "pass", None),
    ],
)
def test_both_nodes_are_judged_alike(prefix, loop, miss_rate, conservation):
    acc = ResultAccumulator()
    for each in WORDS:
        drive(acc, each, **(loop if each == prefix else {}))
    result = result_of(acc)
    found, name = verdicts(result), NAMES[prefix]
    assert (found[name.format("miss rate")], found.get(name.format("conservation"))) == (miss_rate, conservation)
    other = NAMES["Ctl" if prefix == "Est" else "Est"]
    assert (found[other.format("miss rate")], found[other.format("conservation")]) == ("pass", "pass")
    figures = result["timing"][WORDS[prefix]]
    skipped = len(loop.get("skipped", ()))
    assert (figures["jobs"], figures["releases"], figures["miss_skipped"]) == (JOBS, JOBS + skipped, skipped)
    assert figures["miss_late"] == len(loop.get("late", ()))
    assert sum(figures["causes"].values()) == figures["miss_late"] + skipped
    if miss_rate == "fail" or conservation == "fail":
        assert result["verdict"] == "fail"


def test_the_same_frames_give_the_same_figures():
    acc = ResultAccumulator()
    for prefix in WORDS:
        drive(acc, prefix, late={7, 90}, skipped={33})
    put(acc, JOBS, "CtlGranted", period_us=100_000)
    timing = result_of(acc)["timing"]
    assert timing["controller"] == timing["estimator"]
    assert timing["controller"]["overrun"] == 2


def test_without_a_controller_nothing_is_said_of_one():
    acc = ResultAccumulator()
    drive(acc, "Est")
    result = result_of(acc)
    assert list(result["timing"]) == ["estimator"]
    assert "controller" not in result
    assert not any("controller" in f["what"] for f in result["findings"])
    assert "controller" not in summary(result, None)


def test_a_controller_that_never_said_a_word_is_not_passed_over():
    acc = ResultAccumulator()
    drive(acc, "Est")
    result = result_of(acc, controller="mpc-M")
    assert verdicts(result)["controller miss rate"] == "inconclusive"
    assert result["timing"]["controller"]["jobs"] == 0
    assert "controller mpc-M:" in summary(result, None)


def test_what_became_of_it_is_in_the_result_and_on_the_terminal():
    acc = ResultAccumulator()
    for prefix in WORDS:
        drive(acc, prefix)
    put(acc, JOBS, "CtlFallbacks", mute=3, shifted=2, by_rule=1, clamped=0)
    put(acc, JOBS, "CtlInputFaults", crc_errors=4, seq_errors=0, stale_inputs=5)
    put(acc, JOBS, "CtlMachine", run_delay_ms=1.5, steal_ms=20.0, migrations=0)
    put(acc, JOBS, "CtlCanary", canary_p99_us=100.0, canary_max_us=900.0)
    result = result_of(acc, controller="mpc-S")
    controller = result["controller"]
    assert (controller["name"], controller["mute"], controller["by_rule"]) == ("mpc-S", 3, 1)
    assert controller["input_faults"] == {"crc_errors": 4, "seq_errors": 0, "stale_inputs": 5}
    assert (controller["environment"]["steal_ms"], controller["environment"]["canary_max_us"]) == (20.0, 900.0)
    assert result["input_faults"]["crc_errors"] == 0, "the estimator's are its own"
    assert "3 commands not available, 2 by the shifted plan, 1 by the rule" in summary(result, None)


def test_in_lock_step_nobody_is_judged_by_time():
    acc = ResultAccumulator()
    for prefix in WORDS:
        drive(acc, prefix, late=range(50, 150))
    found = verdicts(result_of(acc, lockstep=True))
    assert "controller miss rate" not in found
    assert found["controller conservation"] == "pass"
