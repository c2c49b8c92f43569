"""Frames of a run that never was, with known figures: input for the report's tests and for looking at the page.

A slow temperature ramp, a sensor that is 1 K low, noisy and 1.5 s late, an estimate that closes in on the truth.
"""

from collections.abc import Iterator
from math import exp, sin

import numpy as np

from rt_runner.dbc import load_dbc
from rt_runner.result import ResultAccumulator, RunFacts
from tools.report.collect import Collector, signals_of
from tools.report.data import ReportData

Frame = tuple[int, str, dict[str, float | None], int]
T0_NS = 1_790_000_000_000_000_000


def truth_degc(t_s: float) -> tuple[float, float]:
    """Winding and rotor."""
    return 110 + 40 * (1 - exp(-t_s / 150)) + 6 * sin(t_s / 9), 80 + 30 * (1 - exp(-t_s / 400)) + 1.5 * sin(t_s / 25)


def frames(duration_s: float = 60.0, seed: int = 1, lockstep: bool = False, late_every: int = 0, skip_every: int = 0,
           truth: bool = True, start_tick: int = 40000, lost_sensor: tuple[float, float] = (0.0, 0.0)) -> Iterator[Frame]:
    """Decoded frames in log order, as the log reader gives them."""
    rng = np.random.default_rng(seed)
    release = 0
    for k in range(round(duration_s * 100)):
        t_s = k * 0.01
        t_ns = (0 if lockstep else T0_NS + int(rng.exponential(30e3))) + round(t_s * 1e9)
        tick = (start_tick + k) % 65536
        yield t_ns, "MotorState", {"counter": k % 16, "tick": tick, "torque_nm": 150 * sin(t_s / 3), "derating_active": 0,
                                   "speed_rpm": 9000 + 5000 * sin(t_s / 7)}, 0
        if k % 10 == 0:
            w, r = truth_degc(t_s)
            if truth:
                yield t_ns, "TruthTemp", {"counter": k // 10 % 16, "tick": tick, "theta_w_true_degc": w, "theta_r_true_degc": r}, 0
            if not lost_sensor[0] <= t_s < lost_sensor[1]:
                late_w, late_r = truth_degc(t_s - 1.5)
                noise = rng.normal(-1, 0.316, 2)
                yield t_ns, "TempMeas", {"counter": k // 10 % 16, "tick": tick, "theta_w_meas_degc": late_w + noise[0],
                                         "theta_r_meas_degc": late_r + noise[1]}, 0
        if k % 10 == 7:
            release += 1
            if skip_every and release % skip_every == 0:
                continue
            yield from _job(t_ns, t_s, tick, release, rng, lockstep, bool(late_every) and release % late_every == 0)
        if k % 100 == 99:
            yield t_ns, "EstInputFaults", {"counter": k // 100 % 16, "crc_errors": 0, "seq_errors": 0, "stale_inputs": 0}, 0
        if k % 1000 == 0:
            yield t_ns, "EstIdentity", {"counter": k // 1000 % 16, "dbc_hash": 0xABCDEF, "weights_hash": 0x00BEEF}, 0


def _job(t_ns: int, t_s: float, tick: int, release: int, rng: np.random.Generator, lockstep: bool, late: bool) -> Iterator[Frame]:
    w, r = truth_degc(t_s)
    starting = t_s < 1.5
    off = 1.5 * exp(-t_s / 4)
    noise = rng.normal(0, 0.05, 2)
    wake = float(rng.lognormal(3.4, 0.5) + (rng.random() < 0.01) * 900)
    step = float(rng.lognormal(5.6, 0.12))
    resp = 112_000.0 if late else wake + step + 14
    counter = release % 16
    dt_ns = 0 if lockstep else round(resp * 1e3)
    t = t_ns + dt_ns
    yield t, "Estimate", {"counter": counter, "status": 1 if starting else 2, "tick": tick,
                          "theta_w_est_degc": None if starting else w - off + noise[0],
                          "theta_r_est_degc": None if starting else r + off + noise[1]}, 0
    yield t, "EstTimingA", {"counter": counter, "miss_late": int(late), "warmup": int(release < 5), "stale_input": 0, "after_skip": 0,
                            "release_index": release, "wake_lat_us": None if lockstep else wake}, 0
    yield t + (0 if lockstep else 20_000), "EstTimingB", {
        "counter": counter, "miss_cause": 2 if late else 0, "exec_wall_us": step, "resp_us": step if lockstep else resp}, 0


def report_data(title: str = "Hot part of the lap", lockstep: bool = False, notices: tuple[str, ...] = (), **options) -> ReportData:
    """Those frames through the report's own collector and the runner's own judge."""
    collector, judge = Collector(), ResultAccumulator()
    for frame in frames(lockstep=lockstep, **options):
        collector.feed(*frame)
        judge.feed(*frame)
    granted = {} if lockstep else {"policy": "fifo", "core": 1, "mlock": True, "warnings": []}
    result = judge.result(RunFacts(bus="lockstep" if lockstep else "hub", scenario="hot-lap", lockstep=lockstep, seed=1, granted=granted))
    dbc = load_dbc()
    signals = signals_of(collector.columns(), lockstep)

    def describe(name: str) -> tuple[int, str, float, bool]:
        message = dbc[name]
        return message.frame_id, message.sender, message.cycle_ms, message.per_job

    return ReportData(
        source="hot-lap.mcap", title=title, started="2026-09-21 14:13:20 UTC", lockstep=lockstep, result=result, result_from_log=True,
        duration_s=(collector.last_ns - collector.first_ns) / 1e9, cycle_start_s=signals.cycle_start_s, winding=signals.winding,
        rotor=signals.rotor, torque=signals.torque, speed=signals.speed, jobs=signals.jobs, period_s=0.1,
        frames=collector.frame_stats(describe, 0.1), spans=signals.spans, notices=notices,
        identity=(("DBC", "abcdef"), ("weights", "00beef")), environment=(("kernel", "6.1.0"), ("cpu", "two of them")),
    )
