"""Logs of a run that never was, with known figures: input for the report's tests, and to look at the page.

A slow temperature, a sensor that is 1 K low, noisy and 1.5 s late, an estimate that closes in on the truth. The frames
go through the project's own codec, log writer and judge, so a log made here differs from a real one only in its past.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from math import exp, sin
from pathlib import Path

import numpy as np

from rt_runner.codec import Encoder
from rt_runner.dbc import load_dbc
from rt_runner.mcap_log import LogWriter
from rt_runner.result import ResultAccumulator, RunFacts

T0_NS = 1_790_000_000_000_000_000
SCENARIO = (
    b'title = "x"\n[cycle]\nstart_s = 400\n[limits]\ntheta_w_rmse_max_degc = 0.25\ntheta_r_rmse_max_degc = 0.25\n'
)
Frame = tuple[int, str, dict[str, float | None]]


@dataclass(frozen=True)
class Run:
    """What happens in the run; releases count from 1, times in s since its start."""

    duration_s: float = 60.0
    seed: int = 1
    lockstep: bool = False
    late_every: int = 0
    skip_every: int = 0
    truth: bool = True
    estimator: bool = True
    start_tick: int = 40000
    sensor_lost_s: tuple[float, float] = (0.0, 0.0)
    title: str = "Hot part of the lap"
    warnings: tuple[str, ...] = ()

    def late(self, release: int) -> bool:
        """Whether this release's job misses its deadline."""
        return bool(self.late_every) and release % self.late_every == 0

    def skipped(self, release: int) -> bool:
        """Whether this activation never runs: by order, or because the job before it was late by over a period."""
        return (bool(self.skip_every) and release % self.skip_every == 0) or (release > 1 and self.late(release - 1))


def truth_degc(t_s: float) -> tuple[float, float]:
    """Winding and rotor."""
    w = 110 + 40 * (1 - exp(-t_s / 150)) + 6 * sin(t_s / 9)
    return w, 80 + 30 * (1 - exp(-t_s / 400)) + 1.5 * sin(t_s / 25)


def frames(run: Run) -> list[Frame]:
    """Stamp, message, values, in the order of the stamps."""
    return sorted(_plant(run), key=lambda frame: frame[0])


def _plant(run: Run) -> Iterator[Frame]:
    rng = np.random.default_rng(run.seed)
    release = 0
    for k in range(round(run.duration_s * 100)):
        t_s, tick = k * 0.01, (run.start_tick + k) % 65536
        t_ns = k * 10_000_000 + (0 if run.lockstep else T0_NS + int(rng.exponential(30e3)))
        yield t_ns, "MotorState", {"tick": tick, "torque_nm": 150 * sin(t_s / 3), "derating_active": 0,
                                   "speed_rpm": 9000 + 5000 * sin(t_s / 7)}  # fmt: skip
        if k % 10 == 0:
            w, r = truth_degc(t_s)
            if run.truth:
                yield t_ns, "TruthTemp", {"tick": tick, "theta_w_true_degc": w, "theta_r_true_degc": r}
            w, r = np.add(truth_degc(t_s - 1.5), rng.normal(-1, 0.316, 2))
            if not run.sensor_lost_s[0] <= t_s < run.sensor_lost_s[1]:
                yield t_ns, "TempMeas", {"tick": tick, "theta_w_meas_degc": w, "theta_r_meas_degc": r}
        if run.estimator and k % 10 == 7:
            release += 1
            if not run.skipped(release):
                yield from _job(run, t_ns, t_s, tick, release, rng)
        if k % 1000 == 1:
            yield t_ns, "EstIdentity", {"dbc_hash": load_dbc().hash24, "weights_hash": 0x00BEEF}
            yield t_ns, "PlantIdentity", {"params_hash": 0x0C0FFE, "scenario_hash": 0x123456}


def _job(run: Run, t_ns: int, t_s: float, tick: int, release: int, rng: np.random.Generator) -> Iterator[Frame]:
    starting, off, noise = t_s < 1.5, 1.5 * exp(-t_s / 4), rng.normal(0, 0.05, 2)
    wake = float(rng.lognormal(3.4, 0.5) + (rng.random() < 0.01) * 900)
    step = float(rng.lognormal(5.6, 0.12))
    late = run.late(release)
    resp = step if run.lockstep else 112_000.0 if late else wake + step + 14
    t = t_ns if run.lockstep else t_ns + round(resp * 1e3)
    w, r = truth_degc(t_s)
    tick = 0 if t_s < 0.3 else tick  # an estimator that has heard nothing yet has no tick to tell
    yield t, "Estimate", {"status": 1 if starting else 2, "tick": tick,
                          "theta_w_est_degc": None if starting else w - off + noise[0],
                          "theta_r_est_degc": None if starting else r + off + noise[1]}  # fmt: skip
    skipped_before = int(release > 1 and run.skipped(release - 1))
    yield t, "EstTimingA", {"miss_late": int(late), "warmup": int(release < 5), "stale_input": 0,
                            "after_skip": skipped_before, "release_index": release,
                            "wake_lat_us": None if run.lockstep else wake}  # fmt: skip
    yield t, "EstTimingB", {"miss_cause": 2 if late else 0, "exec_wall_us": step, "resp_us": resp}


def write_log(path: Path, run: Run, with_result: bool = True) -> dict | None:
    """Write the run's log; returns the result that went into it."""
    dbc = load_dbc()
    encoders = {sender: Encoder(dbc, sender) for sender in ("PLANT", "ESTIMATOR")}
    bus = "lockstep" if run.lockstep else "hub"
    granted = {} if run.lockstep else {"policy": "fifo", "core": 1, "mlock": True, "warnings": list(run.warnings)}
    about = {"scenario": "hot-lap", "title": run.title, "bus": bus, "seed": run.seed, "setting": "default",
             "period_s": 0.1, "scenario_sha256": "123456" + 58 * "0", "kernel": "6.1.0", "cores": "0,1"}  # fmt: skip
    judge = ResultAccumulator()
    with LogWriter(path, dbc, about, {"scenario.toml": SCENARIO}) as writer:
        for t_ns, name, values in frames(run):
            message = encoders[dbc[name].sender].encode(name, values)
            decoded = writer.write(t_ns, message.arbitration_id, bytes(message.data))
            if decoded is not None:
                judge.feed(t_ns, decoded.name, decoded.values, decoded.e2e)
        if not with_result:
            return None
        result = judge.result(
            RunFacts(bus=bus, scenario="hot-lap", lockstep=run.lockstep, seed=run.seed, granted=granted)
        )
        writer.attach("granted.json", json.dumps(granted).encode())
        writer.metadata("result", {"json": json.dumps(result)})
    return result
