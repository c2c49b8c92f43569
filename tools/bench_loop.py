"""Our loop against the plainest there is: wake-up against cyclictest, frame in to frame out against a bare C echo.

    rt-runner bench loop [--bus auto|hub|vcan0] [--seconds S] [--periods 100,10,1] [--core N] [--json FILE] [--doc FILE]

Everything is measured on one core with one priority, in slices of seconds in turns (A B C D, D C B A, …), so that a
change of the machine meets all alike; ratios come with an interval from a bootstrap over slices: docs/bench-loop.md.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

from rt_runner import machine
from rt_runner.bus import HUB_PRIORITY, HubProcess, choose_bus
from rt_runner.errors import RtError
from tools.bench_loop_figures import lines, markdown, of_period, targets
from tools.bench_loop_slices import PRIORITY, Bench, Kind, Slice, SliceError
from tools.files import write_json, write_whole
from tools.solver_backends.table import DocumentError, inserted

BEGIN, END = "<!-- bench loop: begin -->", "<!-- bench loop: end -->"
SLICE_S = 4.0
PERIODS_MS = (100.0, 10.0, 1.0)


def main(argv: Sequence[str] | None = None) -> int:
    """Command line entry."""
    args = _parse(argv)
    shown = sys.stderr if args.json == "-" else sys.stdout
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        if args.doc is not None:
            inserted(args.doc, "", BEGIN, END)
        figures = bench(args, shown)
    except (RtError, SliceError, DocumentError) as error:
        print(f"bench_loop: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("bench_loop: stopped, nothing is written", file=sys.stderr)
        return 128 + signal.SIGINT
    for line in lines(figures):
        print(line, file=shown)
    write_json(args.json, figures)
    if args.doc is not None:
        write_whole(args.doc, inserted(args.doc, markdown(figures), BEGIN, END).encode())
        print(f"table written into {args.doc}", file=shown)
    return 0


def bench(args: argparse.Namespace, shown: TextIO) -> dict[str, Any]:
    """Everything that is measured, ready for JSON."""
    choice = choose_bus(args.bus)
    core, others = machine.split_cores(args.core)
    slice_s = min(SLICE_S, max(args.seconds, 2.0))
    rounds = max(1, round(args.seconds / slice_s))
    print(f"bus: {choice.name}, {choice.reason}", file=shown)
    load_before = os.getloadavg()[0]
    found: dict[str, dict[Kind, list[Slice]]] = {}
    with HubProcess.serving(choice, lambda text: print(text, file=sys.stderr), others, HUB_PRIORITY) as bus:
        bench = Bench(bus, core, others, slice_s)
        if Kind.FRAME not in bench.kinds:
            print("this rt_estimator has no --trigger frame: not measured", file=shown)
        for k in range(rounds):
            for period_ms in args.periods:
                slices = found.setdefault(f"{period_ms:g}", {kind: [] for kind in bench.kinds})
                for kind in bench.kinds if k % 2 == 0 else reversed(bench.kinds):
                    slices[kind].append(bench.run(kind, period_ms))
            print(f"round {k + 1} of {rounds}", file=shown, flush=True)
        policy = bench.granted.get("policy")
    periods = {name: of_period(slices) for name, slices in found.items()}
    return {
        "machine": {
            "bus": choice.name,
            "core": core,
            "cores": len(os.sched_getaffinity(0)),
            "policy": policy,
            "priority": PRIORITY if policy == "fifo" else 0,
            "seconds": rounds * slice_s,
            "slice_s": slice_s,
            "load_before": round(load_before, 1),
            "load_after": round(os.getloadavg()[0], 1),
            "kernel": machine.describe()["kernel"],
        },
        "periods": periods,
        "targets": targets(periods),
    }


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="rt-runner bench loop", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--bus", default="auto", help="auto, hub or a CAN interface (default: auto)")
    parser.add_argument("--seconds", type=_seconds, default=24.0, help="of each kind and period (default: 24)")
    parser.add_argument("--periods", type=_periods, default=PERIODS_MS, help="in ms (default: 100,10,1)")
    parser.add_argument("--core", type=int, help="where to run (default: the last one)")
    parser.add_argument("--json", metavar="FILE", help="write the figures as JSON (-: standard output)")
    parser.add_argument("--doc", type=Path, metavar="FILE", help="rewrite the table between the file's markers")
    return parser.parse_args(argv)


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 1.5 <= value <= 3600.0:
        raise argparse.ArgumentTypeError(f"'{text}' must be 1.5 to 3600 s: the first second is warm-up")
    return value


def _periods(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if not values or not all(1.0 <= v <= 100.0 for v in values):
        raise argparse.ArgumentTypeError(f"'{text}' must be periods from 1 to 100 ms with commas between")
    return values


if __name__ == "__main__":
    sys.exit(main())
