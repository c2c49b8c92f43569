"""A lap under each controller with ideal feedback, in one process: what it gains and what its steps cost.

    python -m tools.bench_mpc [NAME ...] [--kernel portable|avx2|avx512] [--json FILE]

Every 0.1 s the controller's C gets the true temperatures and solves; the plant obeys. Times are processor time of
the step, the call from Python included (about 3 us).
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from plant_sim.driver import TorqueCommand
from tests.support.mpc_drives import hot_plant
from tools.libctl import Controller, Lib, load

NAMES = ("none", "rule-150-155", "rule-145-160", "paper", "mpc-S", "mpc-M")
LIMIT_DEGC, LONGEST_S = 155.0, 1200.0


def lap(lib: Lib, name: str) -> dict[str, float]:
    """The figures of one lap from 60 degC."""
    plant = hot_plant(0.0, 60.0)
    cycle = plant.cycle
    controller = Controller(lib, name, cycle.v_ref_mps, cycle.slope_rad, cycle.step)
    if controller.error:
        raise SystemExit(f"bench_mpc: {name}: no such controller; give some of {', '.join(NAMES)}")
    rows, last = [], np.zeros((1, 8))
    last[0, 6:] = 60.0
    took_us, iterations = [], []
    while not plant.done and len(rows) < 10 * LONGEST_S:
        controller.estimate(float(last[-1, 6]), float(last[-1, 7]))
        controller.motion(float(last[-1, 3]), float(last[-1, 2]))
        for row in last:
            controller.motor(float(row[0]), float(row[1]))
        start = time.thread_time_ns()
        out = controller.step()
        took_us.append((time.thread_time_ns() - start) * 1e-3)
        iterations.append(out.iterations)
        last = plant.drive(10, 1.0, TorqueCommand(out.drive_nm, out.regen_nm, out.friction_nm))[0]
        rows.append(last)
    table, counters = np.concatenate(rows), controller.counters

    return {
        "lap_s": 0.1 * len(rows),
        "theta_w_max_degc": float(table[:, 6].max()),
        "ks_above_155": float(0.01 * np.maximum(table[:, 6] - LIMIT_DEGC, 0.0).sum()),
        "energy_kwh": float((table[:, 0] * table[:, 1]).sum() * np.pi / 30.0 * 0.01 / 3.6e6),
        "v_rms": float(np.sqrt(np.mean((table[:, 2] - table[:, 4]) ** 2))),
        "solve_median_us": float(np.median(took_us)),
        "solve_mean_us": float(np.mean(took_us)),
        "solve_p99_us": float(np.percentile(took_us, 99)),
        "solve_max_us": float(np.max(took_us)),
        "iterations": float(np.mean(iterations)),
        "unconverged": float(counters.unconverged),
        "failed": float(counters.failed),
    }


def main(argv: list[str] | None = None) -> int:
    """Command line entry; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tools.bench_mpc", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", default=list(NAMES), metavar="NAME", help=", ".join(NAMES))
    parser.add_argument("--kernel", help="kernels of net and solver (default: the best this processor has)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures as JSON")
    args = parser.parse_args(argv)
    lib = load()
    if not lib.select(args.kernel):
        print(f"bench_mpc: this processor has no kernel '{args.kernel}'", file=sys.stderr)
        return 1
    found = {}
    heads = ("lap s", "max °C", "K·s above", "kWh", "v rms", "median µs", "mean", "p99", "max", "iterations", "open")
    print("| controller | " + " | ".join(heads) + " |\n|---|" + "---:|" * len(heads))
    for name in args.names:
        f = found[name] = lap(lib, name)
        digits = (1, 2, 2, 2, 2, 0, 0, 0, 0, 2, 0)
        cells = (f"{value:.{count}f}" for value, count in zip(list(f.values())[: len(heads)], digits, strict=True))
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)
    if args.json is not None:
        args.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
