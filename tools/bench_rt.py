"""What the real-time runtime adds to a job: ns, and instructions by callgrind (which noise cannot touch).

    python -m tools.bench_rt [--jobs 5000] [--repeats 10] [--json FILE]

`accounting`: clocks that cost nothing; `with clocks`: four looks at the monotonic clock, two at the thread's processor
clock (a system call each), one at the core. `work`: memory the job walks through between the calls, so that the
accounting's data have left the nearest caches. Of `repeats` runs the one with the smallest median counts: the others
tell of the neighbours. Needs gcc; valgrind for the instructions.
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

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("task", "tally", "stats", "clock", "cause", "canary", "backlog", "theft", "reaction", "grant")
CALLS = ("rt_task_wait", "rt_task_stepped", "rt_task_published", "rt_task_done")
CASES = (("counted", 0), ("counted", 256), ("counted", 1024), ("system", 0), ("system", 256), ("system", 1024))
LABELS = {"counted": "accounting", "system": "with clocks"}


@dataclass(frozen=True)
class Cost:
    """One row; times of the quietest run."""

    clock: str
    work_kb: int
    median_ns: int
    p99_ns: int


def build(folder: Path) -> Path:
    """Compile the bench with the runtime, -O2 as the product is."""
    source, program = ROOT / "estimator_c" / "src", folder / "bench_rt"
    command = ["gcc", "-std=c11", "-D_GNU_SOURCE", "-O2", "-g", f"-I{source}", str(ROOT / "tools" / "bench_rt.c")]
    command += [*(str(source / f"rt_{name}.c") for name in SOURCES), "-o", str(program), "-lm", "-lpthread"]
    subprocess.run(command, check=True)
    return program


def measure(program: Path, clock: str, work_kb: int, jobs: int, repeats: int) -> Cost:
    """The quietest of `repeats` runs."""
    runs = []
    for _ in range(repeats):
        command = [str(program), clock, str(work_kb), str(jobs)]
        done = subprocess.run(command, capture_output=True, check=True, text=True)
        runs.append([int(word) for word in done.stdout.split()])
    _, median_ns, p99_ns = min(runs, key=lambda run: run[1])
    return Cost(clock, work_kb, median_ns, p99_ns)


def instructions(program: Path, folder: Path, jobs: int = 2000) -> int | None:
    """Of the four calls of a job, clocks left out; None without valgrind."""
    if not shutil.which("valgrind"):
        return None
    grind = ["valgrind", "--tool=callgrind", *(f"--toggle-collect={name}" for name in CALLS)]
    grind += [f"--callgrind-out-file={folder / 'callgrind.out'}", str(program), "counted", "0", str(jobs)]
    found = re.search(rb"Collected : (\d+)", subprocess.run(grind, capture_output=True, check=True).stderr)
    return int(found.group(1)) // jobs if found else None


def main(argv: Sequence[str] | None = None) -> int:
    """Command line: a table, and --json with all figures."""
    parser = argparse.ArgumentParser(prog="tools.bench_rt", description="cost of the real-time runtime per job")
    parser.add_argument("--jobs", type=int, default=5000, help="jobs a run (at most 100000)")
    parser.add_argument("--repeats", type=int, default=10, help="runs of each case")
    parser.add_argument("--json", type=Path, help="write all figures here")
    args = parser.parse_args(argv)
    if not 1 <= args.jobs <= 100_000 or args.repeats < 1:
        print("bench_rt: give --jobs 1 to 100000 and --repeats of at least 1", file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory() as name:
        program = build(Path(name))
        count = instructions(program, Path(name))
        print(f"{'per job':<14}{'work kB':>8}{'median ns':>11}{'p99 ns':>9}")
        costs = []
        for clock, work_kb in CASES:
            cost = measure(program, clock, work_kb, args.jobs, args.repeats)
            costs.append(cost)
            print(f"{LABELS[clock]:<14}{work_kb:>8}{cost.median_ns:>11}{cost.p99_ns:>9}")
    print("instructions: no valgrind" if count is None else f"instructions of the accounting: {count}")
    if args.json:
        result = {"instructions": count, "costs": [asdict(cost) for cost in costs]}
        args.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
