"""How old an estimate is when it is on the bus: from the plant's sample to the estimate's stamp, and of what parts.

    sample ─send▸ handed to the bus ─bus▸ received ─wait▸ job starts ─compute▸ stepped ─publish▸ published
                                                                                                     │
    e2e = send + bus + wait + compute + publish + rest                         estimate's stamp ◂rest┘

Each part but the last is measured by who knows it best: the plant its own sending, the stamps the bus, the estimator
its waiting, computing and publishing. ``rest`` is what is left to the stamp of the Estimate; so the parts add up to the
whole exactly, and ``rest`` shows how well they do. It is negative where the estimate is stamped before all frames of
the job are handed over (SocketCAN), and holds the hub's way to the logger where there is a hub.

Which sample: ``Estimate.tick`` is the tick of the newest MotorState the estimator has heard. Clocks: stamps and the
plant's sample are CLOCK_REALTIME, the estimator's durations are differences on CLOCK_MONOTONIC.
"""

from array import array
from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass

from rt_runner.result import TICK_BITS, Unwrapper
from rt_runner.timing.columns import LogColumns
from rt_runner.timing.jobs import NO_NS, Jobs

PARTS = ("send", "bus", "wait", "compute", "publish", "rest")
SAMPLE_MODULUS_US = 1 << 24
SENSOR_MATCH_NS = 20_000_000  # a stamp further off than this is another frame's; the sensor comes every 100 ms
WANTED = {
    "MotorState": ("tick",),
    "PlantSample": ("tick", "sample_us", "send_us"),
    "TempMeas": (),
    "Estimate": ("tick", "status"),
}


@dataclass
class Age:
    """One element per job; integer ns, `NO_NS` where not available.

    Jobs that use the plant's last sample once more have none, the plant had ended. ``parts`` of jobs that put out what
    they computed. ``sensor`` is TempMeas' stamp to Estimate's stamp, of the first
    job that used each TempMeas.
    """

    e2e: array
    parts: dict[str, array]
    sensor: array

    def times(self) -> dict[str, array]:
        """All of them under the names of the results."""
        return {
            "e2e": self.e2e,
            **{f"e2e_{name}": values for name, values in self.parts.items()},
            "sensor_to_estimate": self.sensor,
        }


def age_of(log: LogColumns, jobs: Jobs) -> Age:
    """Age of every job's output; the jobs' times are derived already.

    All `NO_NS` where the plant does not say when it sampled (lock-step, older logs).
    """
    count = len(jobs)
    age = Age(_blank(count), {p: _blank(count) for p in PARTS}, _blank(count))
    estimate, places = log["Estimate"], jobs.position.get("Estimate")
    motor = _motor_frames(log)
    if places is None or not motor:
        return age
    samples = _samples(log, motor)
    stamps = log["TempMeas"].t_ns
    times = jobs.times
    wait, temp_age = times.get("in_age_motor"), times.get("in_age_temp")
    compute, publish = times["exec_wall"], times["publish"]
    ticks, status = estimate.signal("tick"), estimate.signal("status")
    near, last_sensor, last_tick, ended = min(motor), -1, max(motor), False
    for k in range(count):
        i = places[k]
        if i < 0 or ticks[i] != ticks[i] or status[i] == 0:
            continue  # its frame is missing, or it has heard nothing yet and its tick means nothing
        tick = _nearest(near, int(ticks[i]))
        received_ns = motor.get(tick)
        if received_ns is None or (ended and tick == last_tick):
            continue  # the plant has sent its last sample: from its second use on nothing newer can have come
        ended = tick == last_tick
        near, stamp_ns = tick, estimate.t_ns[i]
        sampled = samples.get(tick)
        if sampled is not None:
            age.e2e[k] = stamp_ns - sampled[0]
        if wait is None or wait[k] == NO_NS or jobs.output[k] != 0:
            continue
        start_ns = received_ns + wait[k]
        if sampled is not None and NO_NS not in (sampled[1], compute[k], publish[k]):
            values = sampled[1], received_ns - sampled[0] - sampled[1], wait[k], compute[k], publish[k]
            for name, value in zip(PARTS, (*values, age.e2e[k] - sum(values)), strict=True):
                age.parts[name][k] = value
        if temp_age is not None and temp_age[k] != NO_NS:
            used = _nearest_stamp(stamps, start_ns - temp_age[k])
            if used is not None and used > last_sensor:
                age.sensor[k], last_sensor = stamp_ns - stamps[used], used
    return age


def _blank(count: int) -> array:
    return array("q", [NO_NS]) * count


def _motor_frames(log: LogColumns) -> Mapping[int, int]:
    """Unwrapped tick -> stamp of the first MotorState with it."""
    column, unwrap = log["MotorState"], Unwrapper(TICK_BITS)
    found: dict[int, int] = {}
    for tick, t_ns in zip(column.signal("tick"), column.t_ns, strict=True):
        if tick == tick:
            found.setdefault(unwrap(tick), t_ns)
    return found


def _samples(log: LogColumns, motor: Mapping[int, int]) -> dict[int, tuple[int, int]]:
    """Unwrapped tick -> (time of the sample, time until MotorState was handed over)."""
    column = log["PlantSample"]
    near, found = min(motor), {}
    signals = (column.signal(s) for s in ("tick", "sample_us", "send_us"))
    for tick16, sample_us, send_us in zip(*signals, strict=True):
        if tick16 != tick16 or sample_us != sample_us:
            continue
        tick = near = _nearest(near, int(tick16))
        stamp_ns = motor.get(tick)
        if stamp_ns is None:
            continue
        # Only the lower 24 bits were sent: the sample lies within 8 s of its frame's stamp.
        stamp_us = stamp_ns // 1000
        half = SAMPLE_MODULUS_US // 2
        ahead_us = (int(sample_us) - stamp_us + half) % SAMPLE_MODULUS_US - half
        found[tick] = ((stamp_us + ahead_us) * 1000, NO_NS if send_us != send_us else int(send_us) * 1000)
    return found


def _nearest(near: int, wrapped: int) -> int:
    """The count with these lower bits that lies nearest."""
    half = 1 << (TICK_BITS - 1)
    return near + (wrapped - near + half) % (1 << TICK_BITS) - half


def _nearest_stamp(stamps: array, t_ns: int) -> int | None:
    i = bisect_left(stamps, t_ns)
    candidates = [j for j in (i - 1, i) if 0 <= j < len(stamps) and abs(stamps[j] - t_ns) < SENSOR_MATCH_NS]
    return min(candidates, key=lambda j: abs(stamps[j] - t_ns), default=None)
