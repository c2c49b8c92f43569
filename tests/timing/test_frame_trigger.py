"""Jobs released by the arrival of TempMeas instead of a grid: every frame has its job, its stamp is the release."""

from __future__ import annotations

import time

import can
import pytest

from rt_runner.bus import HubProcess, open_bus
from tests.timing.estimator_process import DBC, OnBus, Plant, Run, binary, per_job

TRIES, LATE_MAX_S = 4, 0.05
TEMP_ID = DBC["TempMeas"].frame_id
TIMEOUT_S = DBC["TempMeas"].timeout_ms / 1000
FIRST, QUIET_S, SECOND = range(1, 151), 0.75, range(151, 252)  # ticks sent, silence, ticks sent
SILENT_S = QUIET_S + 0.1  # between the last TempMeas before and the first after


class Scripted(OnBus):
    """The plant of `OnBus`, silent until told to send."""

    late_s = 0.0  # how late it was itself at most

    def _send(self) -> None:
        return

    def drive(self, plant: Plant, ticks: range) -> list[int]:
        """Send these ticks in real time; the ticks of the temperature frames among them."""
        start, temps = time.monotonic(), []
        for n, tick in enumerate(ticks):
            ahead_s = start + n * 0.01 - time.monotonic()
            self.late_s = max(self.late_s, -ahead_s)
            time.sleep(max(0.0, ahead_s))
            for can_id, data in plant.frames(tick):
                self.send(can_id, data)
                temps += [tick] if can_id == TEMP_ID else []
        return temps


def scripted_run() -> tuple[Run, list[int], float]:
    """Fifteen frames, silence, ten frames: what came of them, the ticks of the frames, by how much anybody was late."""
    hub = HubProcess()
    try:
        talk = Scripted(hub.bus, binary("release"), "--trigger", "frame", "--grace-releases", "0")
        plant = Plant()
        temps = talk.drive(plant, FIRST)
        time.sleep(QUIET_S)
        temps += talk.drive(plant, SECOND)
        time.sleep(0.05)
        result = talk.finish()
    finally:
        hub.stop()
    assert result.final is not None
    return result, temps, max(talk.late_s, result.final["wake_lat_us"]["max"] * 1e-6)


@pytest.fixture(scope="module")
def run():
    """A run in which nobody was held up: what the machine does to us is not the question here."""
    for _ in range(TRIES):
        result, temps, late_s = scripted_run()
        if late_s < LATE_MAX_S:
            return result, temps
    pytest.fail(f"in {TRIES} runs the machine never left us alone for four seconds")


def stale(job) -> bool:
    return bool(job[5].values["stale_input"])


def test_every_frame_has_its_job_and_silence_has_one_a_timeout(run):
    result, temps = run
    final = result.final
    jobs = list(per_job(result))
    assert final["releases"] == final["jobs"] + final["miss_skipped"]
    assert len(jobs) == final["jobs"]
    fresh = [job for job in jobs if not stale(job) and job[7].values["in_age_temp_us"] is not None]
    skipped = final["miss_skipped"]  # frames that found another one waiting with them: a machine that was held up
    assert len(fresh) + skipped == len(temps)
    silent = [job for job in jobs if stale(job)]
    assert len(silent) == int(SILENT_S / TIMEOUT_S) == 2, "one for each timeout that passed in silence"
    assert final["rx"]["TempMeas"]["ok"] + final["rx"]["TempMeas"]["lost"] == len(temps)


def test_the_release_is_the_frame_s_arrival(run):
    """Between arrival and start lies the wake-up, and that is how old the frame is."""
    for *_, a, _, c, _ in per_job(run[0]):
        if not a.values["stale_input"] and c.values["in_age_temp_us"] is not None:
            assert c.values["in_age_temp_us"] == pytest.approx(a.values["wake_lat_us"], abs=0.2)


def test_the_estimate_is_for_the_frame_s_tick(run):
    """MotorState of a tick leaves before its TempMeas, so the job has it."""
    result, temps = run
    ticks = [int(e.values["tick"]) for e, *_, a, _, c, _ in per_job(result)
             if not a.values["stale_input"] and c.values["in_age_temp_us"] is not None]  # fmt: skip
    assert set(ticks) <= set(temps) | {t + 1 for t in temps}, "one tick later where the machine held us up"


def test_a_silent_sensor_is_stale_after_its_timeout_and_fresh_with_the_next_frame(run):
    jobs = list(per_job(run[0]))
    flags = [stale(job) for job in jobs]
    first = flags.index(True)
    gap_s = (jobs[first][0].t_ns - jobs[first - 1][0].t_ns) * 1e-9
    assert TIMEOUT_S - 0.01 < gap_s < TIMEOUT_S + 0.1
    assert all(flags[first : first + 2])
    assert not any(flags[first + 2 :])
    assert jobs[first][6].values["miss_cause"] == 4, "stale_input"


def test_what_makes_no_sense_without_a_grid_is_not_available(run):
    final = run[0].final
    assert final["period_dev_us"]["count"] == final["period_dev_abs_us"]["count"] == 0
    assert final["period_dev_us"]["p50"] is None


def test_a_frame_that_is_no_good_releases_nothing():
    hub = HubProcess()
    try:
        talk = Scripted(hub.bus, binary("release"), "--trigger", "frame")
        plant = Plant()
        with open_bus(hub.bus, receive=False) as stranger:
            for tick in (10, 20, 30):
                data = bytearray(plant.temp(tick))
                data[3] ^= 1
                stranger.send(can.Message(arbitration_id=TEMP_ID, data=bytes(data), is_extended_id=False))
            time.sleep(0.1)
        result = talk.finish()
    finally:
        hub.stop()
    assert result.final is not None
    assert result.final["crc_errors"] == 3
    assert result.final["jobs"] == 0
