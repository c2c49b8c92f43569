"""What the result says of the sensors: shares, detection delay, error and upper bound, from made-up frames."""

import json

import pytest

from plant_sim.faults import KINDS
from rt_runner.dbc import load_dbc
from rt_runner.present import sensor_lines, summary
from rt_runner.result import ResultAccumulator, RunFacts
from rt_runner.sensor_account import CALIBRATION, CLASSES, TRUE_KINDS

OFFSET, DRIFT = CLASSES.index("offset"), CLASSES.index("drift")


def run(said_w=lambda t: 0, true_w=lambda t: 0, error_w=lambda t: 0.1, upper_w=lambda t: 151.0, first=40_010, jobs=600):
    """A minute at 150 / 100 degC; functions of the tick say what the winding's channel does."""
    acc = ResultAccumulator()
    for tick in range(first, first + 10 * jobs, 10):
        t_ns, wrapped = tick * 10_000_000, tick % 65536
        estimated = tick - first >= 150

        def feed(name, t_ns=t_ns, wrapped=wrapped, **values):
            acc.feed(t_ns, name, {**values, "tick": wrapped})

        feed("TruthTemp", theta_w_true_degc=150.0, theta_r_true_degc=100.0)
        feed("TruthFault", fault_w=true_w(tick), fault_r=0)
        feed("TempMeas", theta_w_meas_degc=149.0, theta_r_meas_degc=99.0)
        feed("Estimate", theta_w_est_degc=150.0 + error_w(tick) if estimated else None,
             theta_r_est_degc=100.0 if estimated else None, status=2)  # fmt: skip
        said = said_w(tick) if estimated else 0
        tick_said = wrapped if estimated else 0  # the core's tick means nothing before it has started
        upper = upper_w(tick) if estimated else None
        acc.feed(t_ns, "EstWinding", {"sensor_w_fault": said, "sensor_w_trusted": int(said == 0), "sigma_w_degc": 0.1,
                                      "upper_w_degc": upper, "tick": tick_said})  # fmt: skip
        acc.feed(t_ns, "EstRotor", {"sensor_r_fault": 0, "sensor_r_trusted": 1, "sigma_r_degc": 0.1,
                                    "upper_r_degc": None, "tick": tick_said})  # fmt: skip
    return acc


def sensors(**channel) -> dict:
    result = run(**channel).result(RunFacts(faults=("offset:-20@430-440",)))
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    return result["sensors"]


def test_names_are_those_of_the_plant_and_of_the_contract():
    assert TRUE_KINDS == KINDS
    dbc = load_dbc()

    def labels(message, signal):
        return next(s.labels for s in dbc[message].signals if s.name == signal)

    assert dict(enumerate(CLASSES)) == labels("EstWinding", "sensor_w_fault") == labels("EstRotor", "sensor_r_fault")
    assert dict(enumerate(CALIBRATION)) == labels("EstCalibration", "calibration_state")
    for bit, kind in enumerate(KINDS):
        assert f"{bit} {kind}" in (dbc["TruthFault"].codec.comment or "")


def test_a_good_sensor_is_ok_all_the_time():
    s = sensors()
    assert s["theta_w"] == {
        "class_share": {"ok": 1.0}, "trusted_share": 1.0, "true_faults": [], "fault_start_s": None,
        "detection_s": None, "max_error_degc": pytest.approx(0.1), "fault_max_error_degc": None, "above_upper_jobs": 0,
    }  # fmt: skip
    assert s["theta_r"]["above_upper_jobs"] is None, "no upper bound was published"
    assert s["calibration"]["state"] is None


@pytest.mark.parametrize("first", [40_010, 62_000], ids=["plain", "over the wrap of the tick"])
def test_a_fault_its_delay_and_the_error_in_it(first):
    start = first + 2990

    def error(t):
        return 0.5 if start <= t < start + 500 else 2.0 if t < first + 500 else -0.7 if t > start + 1500 else 0.1

    s = sensors(
        first=first,
        true_w=lambda t: 1 << OFFSET - 1 if start <= t < start + 1000 else 0,
        said_w=lambda t: OFFSET if start + 40 <= t < start + 1100 else 0,
        error_w=error,
    )["theta_w"]
    assert s["class_share"] == pytest.approx({"ok": 1 - 106 / 585, "offset": 106 / 585}, abs=1e-6)
    assert s["trusted_share"] == s["class_share"]["ok"]
    assert (s["true_faults"], s["fault_start_s"], s["detection_s"]) == (["offset"], start / 100, 0.4)
    assert s["fault_max_error_degc"] == pytest.approx(0.5)
    assert s["max_error_degc"] == pytest.approx(0.7), "the first ten seconds are not judged"


@pytest.mark.parametrize(("noticed_at", "delay"), [(43_990, 9.9), (44_000, None), (42_990, 0.0)])
def test_only_what_is_said_while_the_fault_lasts_is_a_detection(noticed_at, delay):
    s = sensors(
        true_w=lambda t: 0b101000 if 43_000 <= t < 44_000 else 0b1000 if 45_000 <= t < 45_500 else 0,
        said_w=lambda t: DRIFT if t >= noticed_at else 0,
    )["theta_w"]
    assert (s["true_faults"], s["fault_start_s"], s["detection_s"]) == (["dropout", "drift"], 430.0, delay)


def test_truth_above_the_upper_bound_is_counted():
    s = sensors(upper_w=lambda t: 149.5 if 43_000 <= t < 43_200 else 150.5)
    assert s["theta_w"]["above_upper_jobs"] == 20


def test_calibration_is_the_newest():
    acc = run()
    for state, offset in ((1, -1.0), (2, -1.48)):
        acc.feed(0, "EstCalibration", {"calibration_state": state, "offset_w_degc": offset, "offset_r_degc": -1.0,
                                       "offset_sigma_w_degc": 0.03, "offset_sigma_r_degc": None})  # fmt: skip
    result = acc.result(RunFacts())
    assert result["sensors"]["calibration"] == {
        "state": "frozen", "offset_w_degc": -1.48, "offset_r_degc": -1.0, "offset_sigma_w_degc": 0.03,
        "offset_sigma_r_degc": None,
    }  # fmt: skip
    assert "offset     frozen: winding / rotor -1.480 / -1.000 degC" in summary(result, None)


def test_what_is_shown():
    acc = run(
        true_w=lambda t: 1 if 43_000 <= t < 44_000 else 0,
        said_w=lambda t: OFFSET if 43_040 <= t < 44_000 else 0,
        upper_w=lambda t: 149.0 if t == 43_010 else 151.0,
    )
    winding, rotor = sensor_lines(acc.result(RunFacts()))
    assert winding == (
        "sensor     winding: ok 83.6%, offset 16.4%; truly offset from 430 s on, noticed after 0.4 s; "
        "error then up to 0.100 degC; truth ABOVE the upper bound in 1 jobs"
    )
    assert rotor == "sensor     rotor: ok 100.0%"
    assert sensor_lines({}) == [], "a log of before"
