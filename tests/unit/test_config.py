"""Scenarios: the ones we ship load, and each thing that cannot be is refused in one line that says where."""

import dataclasses

import pytest

from plant_sim.mismatch import Mismatch
from rt_runner.config import (
    PlantConfig,
    check_faults,
    check_period,
    load_scenario,
    scenario_names,
    with_duration,
    with_faults,
)
from rt_runner.errors import UsageError


@pytest.mark.parametrize("name", scenario_names())
def test_shipped_scenarios_load(name):
    s = load_scenario(name)
    assert s.name == name
    assert s.title
    assert len(s.sha256) == 64
    check_faults(s)


def test_the_main_job_is_a_minute_of_the_hot_lap():
    s = load_scenario("hot-lap")
    assert (s.duration_s, s.cycle.kind, s.cycle.start_s) == (60.0, "lap", 400.0)
    assert (s.sensor.offset_degc, s.sensor.variance, s.sensor.delay_s) == (-1.0, 0.1, 1.5)


def test_a_file_of_ones_own(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('duration_s = 5\n[cycle]\nkind = "class3"\n')
    s = load_scenario(str(path))
    assert (s.name, s.duration_s, s.cycle.kind) == ("mine", 5.0, "class3")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("duration_s = ", "not valid TOML"),
        ("durations = 5", "unknown key 'durations'"),
        ('duration_s = "long"', "must be a number"),
        ("duration_s = -1", "0.01 s or more"),
        ("duration_s = nan", "0.01 s or more"),
        ("duration_s = 0.004", "0.01 s or more"),
        ("[cycle]\nstart_s = 1e5", "0 … 10800"),
        ("[cycle]\nkey_on_s = 1e3", "0 … 600"),
        ("[cycle]\nkey_on_s = 0.005", "steps of 0.01"),
        ("[cycle]\nkey_on_s = 15\nstart_s = 400", "needs start_s = 0"),
        ('faults = "offset:-20@430-550"', "list of texts"),
        ("faults = [20]", "list of texts"),
        ("[plant]\ncoolant = 50", "unknown key 'coolant'"),
        ("[plant]\ncoolant_flow_share = 0", "above 0"),
        ("[plant]\nresistance_scale = nan", "above 0"),
        ("[plant]\ncoolant_degc = 150", "-40 … 120"),
        ('[cycle]\nkind = "csv"\npath = "gone.csv"', "no file"),
        ("cycle = 5", "must be a table"),
        ('[cycle]\nkind = "moon"', "none of lap, class3, csv"),
        ('[cycle]\nkind = "csv"', "needs it"),
        ("[cycle]\nspeed = 1", "unknown key 'speed'"),
        ("[sensor]\nvariance = -0.1", "variance >= 0"),
        ("[sensor]\nvariance = true", "must be a number"),
        ("[estimator]\nperiod_s = 0.0001", "0.001"),
        ("[estimator]\nperiod_s = 0.0010005", "whole microseconds"),
        ("[limits]\nmiss_rate_max = 0", "between 0 and 1"),
        ("[limits]\ntheta_w_rmse_max_degc = 0", "positive"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, text, says):
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(UsageError) as e:
        load_scenario(str(path))
    assert says in str(e.value)
    assert str(path) in str(e.value)
    assert "\n" not in str(e.value)


def test_unknown_scenario_names_the_known_ones():
    with pytest.raises(UsageError, match=r"unknown scenario 'nope': choose one of .*hot-lap"):
        load_scenario("nope")


def test_missing_file_is_named():
    with pytest.raises(UsageError, match=r"cannot read scenario gone\.toml"):
        load_scenario("./gone.toml")


def test_duration_option():
    s = load_scenario("hot-lap")
    assert with_duration(s, None) is s
    assert with_duration(s, 12.0) == dataclasses.replace(s, duration_s=12.0)
    for bad in (0.0, -3.0, 0.004, float("inf"), float("nan")):
        with pytest.raises(UsageError, match=r"must be 0\.01 s or more"):
            with_duration(s, bad)


def test_periods():
    for good in (0.001, 0.0025, 0.1, 1.0):
        check_period(good, "x")
    for bad in (0.0, 0.0009, 1.1, float("nan")):
        with pytest.raises(UsageError):
            check_period(bad, "x")


def test_a_plant_can_differ_in_what_the_plant_knows():
    """The runner knows no physics, so the two tables are written twice; they must not drift apart."""
    assert dataclasses.asdict(PlantConfig()) == dataclasses.asdict(Mismatch())


def test_faults_of_the_command_line_come_on_top():
    s = load_scenario("lap-offset")
    assert s.all_faults == s.faults == ("offset:-20@430-550",)
    more = with_faults(s, ["stuck@1-2/r"])
    assert (more.faults, more.all_faults) == (s.faults, ("offset:-20@430-550", "stuck@1-2/r"))
    assert with_faults(s, None) is s
    assert more.sha256 == with_faults(s, ["stuck@1-2/r"]).sha256 != s.sha256, "another scenario, and known as such"
    assert more.sha256 != with_faults(s, ["stuck@1-2/w"]).sha256
    assert with_faults(more, ["drift:1@3-4"]) == with_faults(s, ["stuck@1-2/r", "drift:1@3-4"])
    check_faults(more)


@pytest.mark.parametrize(
    ("name", "fault", "says"),
    [
        ("hot-lap", "wobble:1@410-420", "fault 'wobble:1@410-420': kind 'wobble' does not exist"),
        ("hot-lap", "offset:5@0-400", "lies outside the run, which goes from 400 s to 460 s"),
        ("hot-lap", "offset:5@460-500", "lies outside the run"),
        ("lap-offset", "offset:5@500-600", "overlap"),
        ("hot-lap", "--help", "not understood"),
    ],
)
def test_faults_that_cannot_be_are_refused_before_anything_starts(name, fault, says):
    with pytest.raises(UsageError) as e:
        check_faults(with_faults(load_scenario(name), [fault]))
    assert says in str(e.value)
    assert "\n" not in str(e.value)
    check_faults(with_faults(load_scenario("hot-lap"), ["offset:5@0-400.01", "noise:5@459.99-500"]))
