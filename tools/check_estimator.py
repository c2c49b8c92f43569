"""How good is the estimate? Drives the plant, feeds the C core its frames in lock-step, prints the errors.

    python -m tools.check_estimator [--setting default] [--seeds 3] [--json FILE]

The same core as in the binary, through build/lib/libestimator.so (or compiled on the spot), without bus and codec.
Errors are judged from 10 s after the first estimate; "first 10 s" shows what that leaves out.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from plant_sim.cycles import CycleSpec
from plant_sim.params import load_params
from plant_sim.plant import Plant
from tools.libest import Estimator, Lib, Setting, load

JUDGED_AFTER_TICKS = 1000
RUNNING = 2


@dataclass(frozen=True)
class Channel:
    """Errors of one temperature in degC: sensor and estimate against the truth at the same tick."""

    raw_rmse_degc: float
    est_rmse_degc: float
    est_max_degc: float
    first_10_s_rmse_degc: float
    first_10_s_max_degc: float


@dataclass(frozen=True)
class Check:
    """One run."""

    name: str
    seed: int
    theta_w: Channel
    theta_r: Channel
    sweeps_mean: float
    sweeps_max: int
    unconverged: int


def check(
    lib: Lib, setting: Setting, spec: CycleSpec, start_s: float = 0.0, duration_s: float | None = None, seed: int = 0
) -> tuple[Channel, Channel, np.ndarray, Estimator]:
    """Run the plant from start_s for duration_s (None: to the cycle's end) with the core beside it at 10 Hz.

    Returns
    -------
    theta_w, theta_r : Channel
        The errors.
    rows : (n, 8)
        tick, estimate w, r, truth w, r, measurement w, r (offset included), sweeps; from the first estimate on.
    core : Estimator
        After the last frame, for its counters.
    """
    plant = Plant(load_params(), spec, seed=seed)
    plant.advance(start_s)
    core, rows = Estimator(lib, setting), []
    last_tick = None if duration_s is None else plant.tick + round(duration_s * 100)
    while not plant.done and (last_tick is None or plant.tick < last_tick):
        s = plant.step()
        core.feed_motor(s.tick, s.torque_nm, s.speed_rpm)
        if s.theta_w_meas_degc is None or s.theta_r_meas_degc is None:
            continue
        core.feed_temp(s.tick, s.theta_w_meas_degc, s.theta_r_meas_degc)
        out = core.step()
        if out.status == RUNNING:
            estimate = (out.theta_w_degc, out.theta_r_degc)
            truth = (s.theta_w_degc, s.theta_r_degc)
            rows.append((s.tick, *estimate, *truth, s.theta_w_meas_degc, s.theta_r_meas_degc, out.sweeps))
    data = np.array(rows)
    judged = data[:, 0] >= data[0, 0] + JUDGED_AFTER_TICKS
    channels = []
    for k in range(2):
        error, raw = data[:, 1 + k] - data[:, 3 + k], data[:, 5 + k] - data[:, 3 + k]
        channels.append(
            Channel(
                raw_rmse_degc=_rms(raw[judged]),
                est_rmse_degc=_rms(error[judged]),
                est_max_degc=float(np.abs(error[judged]).max()),
                first_10_s_rmse_degc=_rms(error[~judged]),
                first_10_s_max_degc=float(np.abs(error[~judged]).max()),
            )
        )
    return channels[0], channels[1], data, core


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


CASES = (
    ("lap", CycleSpec("lap"), 0.0, None),
    ("hot lap 400-460 s", CycleSpec("lap"), 400.0, 60.0),
    ("hot lap 520-580 s", CycleSpec("lap"), 520.0, 60.0),
    ("class 3", CycleSpec("class3"), 0.0, None),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Command line: a table, and --json with all figures."""
    parser = argparse.ArgumentParser(prog="tools.check_estimator", description="accuracy of the C estimator's core")
    parser.add_argument("--setting", default="default", help="compiled-in setting: default or paper")
    parser.add_argument("--seeds", type=int, default=1, help="noise seeds per case")
    parser.add_argument("--json", type=Path, help="write all figures here")
    args = parser.parse_args(argv)
    lib = load()
    try:
        setting = lib.setting(args.setting)
    except KeyError:
        print(f"check_estimator: no setting '{args.setting}' in {lib.path}: give default or paper", file=sys.stderr)
        return 1
    print(f"{lib.path}, weights {lib.sha256[:12]}, setting {args.setting}; degC, winding / rotor")
    print(f"{'case':<20}{'seed':>5}{'raw RMSE':>16}{'RMSE':>18}{'max':>16}{'first 10 s RMSE':>19}{'max':>15}  sweeps")
    results = []
    for name, spec, start_s, duration_s in CASES:
        for seed in range(args.seeds):
            w, r, data, core = check(lib, setting, spec, start_s, duration_s, seed)
            sweeps = data[:, 7]
            results.append(
                Check(name, seed, w, r, float(sweeps.mean()), int(sweeps.max()), int(core.counters.unconverged))
            )
            print(
                f"{name:<20}{seed:>5}{w.raw_rmse_degc:>9.3f} /{r.raw_rmse_degc:.3f}{w.est_rmse_degc:>10.4f} /"
                f"{r.est_rmse_degc:.4f}{w.est_max_degc:>9.3f} /{r.est_max_degc:.3f}{w.first_10_s_rmse_degc:>12.3f} /"
                f"{r.first_10_s_rmse_degc:.3f}{w.first_10_s_max_degc:>8.3f} /{r.first_10_s_max_degc:.3f}"
                f"  {sweeps.mean():.2f}, max {sweeps.max():.0f}"
            )
    if args.json:
        args.json.write_text(json.dumps([asdict(result) for result in results], indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
