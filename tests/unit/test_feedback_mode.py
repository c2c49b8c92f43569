"""Publish after one sweep, solve on afterwards: what is published is close, the next step begins from the solution."""

from __future__ import annotations

import numpy as np

from tools.compare_drives import drive_lap, sense
from tools.libest import WEIGHTS, Estimator, Lib, compile_library


def test_feedback_publishes_nearly_the_solution_and_loses_nothing() -> None:
    lib = Lib(compile_library(WEIGHTS))
    drive = sense(drive_lap(), seed=3).cut(0, 2500)
    rows = {}
    for mode in (0, 1):
        core = Estimator(lib, lib.setting("default", mode=mode))
        rows[mode] = core.run(drive.torque_nm, drive.speed_rpm, drive.y, drive.first_tick)
        assert core.counters.unconverged == 0
        assert core.counters.restarts == 0
    settled = slice(100, None)
    difference = np.abs(rows[1][settled, :2] - rows[0][settled, :2])
    assert 0 < difference.max() < 0.02, "one sweep is not the solution, but within 0.02 degC of it"
    assert np.sqrt(np.mean(difference**2)) < 1e-3
    assert (rows[1][settled, 5] == 1).all(), "sweeps before publishing"
    assert set(rows[1][settled, 4]) == {2.0}, "status running, not the fallback"


def test_without_finishing_the_next_step_does_it() -> None:
    """A caller that forgets estimator_finish() gets the same estimates: the next interval begins with it."""
    lib = Lib(compile_library(WEIGHTS))
    drive = sense(drive_lap(), seed=3).cut(0, 400)
    with_finish = Estimator(lib, lib.setting("default", mode=1))
    rows = with_finish.run(drive.torque_nm, drive.speed_rpm, drive.y, drive.first_tick)
    without = Estimator(lib, lib.setting("default", mode=1))
    for k in range(len(drive)):
        for j in range(10):
            tick = drive.first_tick + 10 * k + j + 1
            without.feed_motor(tick, drive.torque_nm[10 * k + j], drive.speed_rpm[10 * k + j])
        without.feed_temp(drive.first_tick + 10 * (k + 1), *drive.y[k])
        out = without.step()
        if out.status == 2:
            assert (out.theta_w_degc, out.theta_r_degc) == tuple(rows[k, :2])
