"""Scenario table [timing]: what cannot be is one line before anything starts; the options are the estimator's."""

import subprocess

import pytest

from rt_runner.config import load_scenario
from rt_runner.errors import UsageError
from rt_runner.timing_config import TimingConfig, grace_releases, timing_options
from tests.timing.estimator_process import binary

LAP = 'duration_s = 5.0\n[cycle]\nkind = "lap"\n'


def scenario(tmp_path, timing: str, estimator: str = ""):
    path = tmp_path / "s.toml"
    path.write_text(f"{LAP}[estimator]\nperiod_s = 0.05\n{estimator}\n[timing]\n{timing}\n")
    return load_scenario(str(path))


def test_all_of_it_is_read(tmp_path):
    text = 'policy = "queue:3"\non_miss = "predict"\ngrace_s = 2\nmk = [2, 20]\ncanary = false\ninject = ["sleep:5@9"]'
    assert scenario(tmp_path, text).timing == TimingConfig("queue:3", "predict", 2.0, (2, 20), False, ("sleep:5@9",))
    assert scenario(tmp_path, "").timing == TimingConfig()


@pytest.mark.parametrize(
    ("timing", "estimator", "says"),
    [
        ('policy = "wait"', "", "is none of skip, queue:N"),
        ('policy = "queue:65"', "", "65 is more than 64"),
        ('policy = "queue:0"', "", "is none of"),
        ('policy = "cut:50001"', "", "50001 is more than 50000, the deadline"),
        ('policy = "cut:20001"\ndeadline_s = 0.02', "", "20001 is more than 20000, the deadline"),
        ("deadline_s = 0.0501", "", "deadline_s = 0.0501 must lie in"),
        ("deadline_s = 0", "", "deadline_s = 0 must lie in"),
        ("deadline_s = nan", "", "deadline_s = nan must lie in"),
        ('deadline_s = "soon"', "", "must be a number"),
        ('policy = "rebase"', 'trigger = "frame"', "is for the time grid"),
        ("", 'trigger = "event"', "trigger = 'event' is none of time, frame"),
        ('on_miss = "guess"', "", "on_miss = 'guess'"),
        ("grace_s = -1", "", "grace_s = -1 must lie in"),
        ("mk = [3, 3]", "", "0 <= m < K <= 100"),
        ("mk = [1, 101]", "", "0 <= m < K <= 100"),
        ("mk = [1.0, 5]", "", "two whole numbers"),
        ("canary = 1", "", "true or false"),
        ('inject = ["compute:1@0"]', "", "inject 'compute:1@0'"),
        ('inject = ["compute:60000001@1"]', "", "inject 'compute:60000001@1'"),
        ('inject = "compute:1@1"', "", "a list of texts"),
        ("speed = 3", "", "unknown key 'speed'"),
    ],
)
def test_what_cannot_be_is_one_line(tmp_path, timing, estimator, says):
    with pytest.raises(UsageError) as refused:
        scenario(tmp_path, timing, estimator)
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("grace_s", "period_s", "releases"),
    [(None, 0.1, 10), (None, 1.0, 5), (None, 0.003, 334), (0.0, 0.1, 0), (0.25, 0.1, 3), (0.3, 0.1, 3)],
)
def test_grace_in_releases(grace_s, period_s, releases):
    assert grace_releases(grace_s, period_s) == releases


def test_lock_step_has_no_time_to_make_faults_in():
    with pytest.raises(UsageError, match="rt-runner run"):
        timing_options(TimingConfig(inject=("compute:1@1",)), 0.1, "time", lockstep=True)
    with pytest.raises(UsageError, match="rt-runner run"):
        timing_options(TimingConfig(), 0.1, "frame", lockstep=True)


@pytest.mark.parametrize(
    ("timing", "trigger"),
    [
        (TimingConfig(), "time"),
        (TimingConfig("queue:64", "hold", 0.0, (0, 1), False, ("compute:60000000@1",)), "time"),
        (TimingConfig("cut:50000", "predict", 3.3, (99, 100), True, ("sleep:1@999999999999999999",)), "frame"),
        (TimingConfig("stop:total:1000000000", "invalid"), "time"),
        (TimingConfig("stop:row:1"), "frame"),
        (TimingConfig("rebase"), "time"),
        (TimingConfig("cut:20000", deadline_s=0.02), "time"),
        (TimingConfig(deadline_s=0.05), "frame"),
    ],
)
def test_the_estimator_takes_what_passes_here(timing, trigger):
    """It goes on to the bus, which is none: the options were not the trouble."""
    options = timing_options(timing, 0.05, trigger)
    done = subprocess.run(
        [binary("release"), "--bus", "rt_hub:/nowhere", "--period-us", "50000", *options],
        capture_output=True, text=True, timeout=20, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert "/nowhere" in done.stderr
