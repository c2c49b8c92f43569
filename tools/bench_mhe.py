"""What a step of the MHE costs: median µs, and instructions by callgrind (which noise cannot touch).

    python -m tools.bench_mhe [--weights estimator_c/weights/lstm8.json] [--json FILE]

Data: the plant's lap from second 400 with the sensor's noise. `mhe`: append a node, measure, solve. `core`: ten motor
frames, a temperature frame and estimator_step() with its 15-step prediction. The fixed sweep counts show the price of
a sweep; "converged" is the default setting. All with the portable kernel of the net. Needs gcc; valgrind for the
instruction counts.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from tools.libest import ROOT, SOURCES, WEIGHTS, compile_library

CASES = (("mhe", 0), ("mhe", 1), ("mhe", 2), ("mhe", 4), ("core", 0))


@dataclass(frozen=True)
class Cost:
    """One row: max_sweeps 0 is 'converged'; instructions None without valgrind."""

    mode: str
    max_sweeps: int
    sweeps_mean: float
    median_us: float
    p99_us: float
    instructions: int | None


def recorded_rows(steps: int) -> np.ndarray:
    """(steps, 4): speed rpm, torque Nm and noisy temperatures of the lap from second 400."""
    from plant_sim.cycles import CycleSpec
    from plant_sim.params import load_params
    from plant_sim.simulate import simulate

    run = simulate(load_params(), CycleSpec("lap"), 400.0 + steps / 10 + 1)
    rows = np.stack([run.n_rpm, run.torque_nm, run.theta_w_degc, run.theta_r_degc], 1)[4000 : 4000 + steps]
    rows[:, 2:] += np.random.default_rng(0).normal(0, np.sqrt(0.1), (steps, 2))
    return np.ascontiguousarray(rows)


def build(weights: Path, folder: Path, source: str = "bench_mhe.c") -> Path:
    """Compile a C program of this folder with the core, -O2 as the product is."""
    generated, base, program = compile_library(weights).parent, ROOT / "estimator_c", folder / Path(source).stem
    command = ["gcc", "-std=c11", "-D_GNU_SOURCE", "-O2", "-g1", "-fno-math-errno"]
    command += [f"-I{base / 'src'}", f"-I{base / 'src' / 'solver'}", f"-I{generated}"]
    command += [str(ROOT / "tools" / source), *(str(base / source) for source in SOURCES)]
    command += [str(path) for path in sorted(generated.glob("*.c"))] + ["-o", str(program), "-lm"]
    subprocess.run(command, check=True)
    return program


def measure(
    program: Path, rows: np.ndarray, mode: str, max_sweeps: int, folder: Path, kernel: str = "portable"
) -> Cost:
    """Time the whole record with that kernel of the net; count instructions over its first 300 steps."""
    command = [str(program), mode, str(max_sweeps), kernel]
    done = subprocess.run(command, input=rows.tobytes(), capture_output=True, check=True)
    _, median_us, p99_us, sweeps = (float(word) for word in done.stdout.split())
    instructions = None
    if shutil.which("valgrind"):
        short = rows[:301]
        grind = ["valgrind", "--tool=callgrind", "--toggle-collect=timed_step"]
        grind += [f"--callgrind-out-file={folder / 'callgrind.out'}", *command]
        counted = subprocess.run(grind, input=short.tobytes(), capture_output=True, check=True)
        found = re.search(rb"Collected : (\d+)", counted.stderr)
        instructions = int(found.group(1)) // (len(short) - 1) if found else None
    return Cost(mode, max_sweeps, sweeps, median_us, p99_us, instructions)


def main(argv: Sequence[str] | None = None) -> int:
    """Command line: a table, and --json with all figures."""
    parser = argparse.ArgumentParser(prog="tools.bench_mhe", description="cost of one estimator step")
    parser.add_argument("--weights", type=Path, default=WEIGHTS)
    parser.add_argument("--steps", type=int, default=3000, help="steps to time (at most 3000)")
    parser.add_argument("--json", type=Path, help="write all figures here")
    args = parser.parse_args(argv)
    if not args.weights.exists():
        print(f"bench_mhe: {args.weights}: no such file; give a weights file", file=sys.stderr)
        return 1
    rows = recorded_rows(min(args.steps, 3000))
    costs = []
    with tempfile.TemporaryDirectory() as name:
        program = build(args.weights, Path(name))
        print(f"{'step':<6}{'sweeps':>12}{'mean':>7}{'median µs':>12}{'p99 µs':>9}{'instructions':>14}")
        for mode, max_sweeps in CASES:
            cost = measure(program, rows, mode, max_sweeps, Path(name))
            costs.append(cost)
            label = "converged" if max_sweeps == 0 else str(max_sweeps)
            count = "no valgrind" if cost.instructions is None else f"{cost.instructions:,}"
            print(f"{mode:<6}{label:>12}{cost.sweeps_mean:>7.2f}{cost.median_us:>12.2f}{cost.p99_us:>9.2f}{count:>14}")
    if args.json:
        args.json.write_text(json.dumps([asdict(cost) for cost in costs], indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
