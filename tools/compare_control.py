"""Every controller on every feedback: lap time, energy, heat, speed, solver time; one table, one figure of the lap.

    rt-runner compare-control [--controllers none,mpc-M] [--feedback ideal,default] [--cases nominal,offset]
                              [--json FILE] [--doc FILE.md] [--figures DIR]

A closed loop cannot be driven once and measured many times: each figure is a lap of its own, with plant, estimator and
controller in one process. No clock, no bus: a test shows that commands and temperatures are those of `rt-runner mil`.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from plant_sim.errors import PlantError
from plant_sim.faults import parse_fault
from rt_runner.errors import RtError
from tools import compare_control_table as table
from tools.compare_control_run import FEEDBACKS, LAP_MAX_S, drive, figures
from tools.files import write_json, write_whole
from tools.rows import DataError

CONTROLLERS = ("none", "rule-150-155", "rule-145-160", "paper", "mpc-S", "mpc-M")
CASES: dict[str, tuple[str, ...]] = {
    "nominal": (),
    "offset": ("offset:-20@430-550",),
    "noise": ("noise:5@430-550",),
    "stuck": ("stuck@430-490",),
    "dropout": ("dropout:nan@430-490",),
}
USUAL = ("nominal", "offset", "noise")
Task = tuple[str, str, str, float, int]  # controller, feedback, case, seconds, seed


def main(argv: Sequence[str] | None = None) -> int:
    """Command line entry."""
    args = _parse(argv)
    shown = sys.stderr if args.json == "-" else sys.stdout
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # asked to end: as by Ctrl-C, workers and all
    try:
        controllers = _names(args.controllers, CONTROLLERS, "--controllers", CONTROLLERS)
        feedback = _names(args.feedback, tuple(FEEDBACKS), "--feedback", tuple(FEEDBACKS))
        cases = _names(args.cases, tuple(CASES), "--cases", USUAL)
        _check(args)
        begun = time.monotonic()
        tasks: list[Task] = [(c, f, k, args.seconds, args.seed) for c in controllers for f in feedback for k in cases]
        found = compare(tasks, args.workers, lambda text: print(text, file=shown, flush=True))
        print(table.plain(found), file=shown)
        print(f"{time.monotonic() - begun:.0f} s", file=shown)
        write_json(args.json, found)
        if args.doc is not None:
            write_whole(args.doc, table.inserted(args.doc, table.markdown(found)).encode())
            print(f"{args.doc}: table rewritten", file=shown)
        if args.figures is not None:
            from tools.compare_control_figure import draw

            print(draw(args.figures, controllers, args.seconds, args.seed), file=shown)
    except (DataError, PlantError, RtError, ValueError) as error:
        print(f"compare-control: {error}", file=sys.stderr)
        return 1
    except BrokenProcessPool:
        print("compare-control: a worker process was killed; --workers 1 needs the least memory", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"compare-control: {error.filename}: {error.strerror}; choose another file", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("compare-control: stopped, nothing is written", file=sys.stderr)
        return 128 + signal.SIGINT
    return 0


def compare(tasks: Sequence[Task], workers: int | None, done: Any) -> table.Found:
    """{controller: {feedback: {case: figures}}}; the figures but for solver times do not depend on ``workers``."""
    results: dict[Task, dict[str, Any]] = {}
    laps = list(dict.fromkeys(_lap_of(task) for task in tasks))
    if workers == 0:
        results = {lap: perform(lap) for lap in laps}
    else:
        context = multiprocessing.get_context("fork")
        count = workers or len(os.sched_getaffinity(0))
        with ProcessPoolExecutor(min(count, len(laps)), context) as pool:
            waiting = {pool.submit(perform, lap): lap for lap in laps}
            try:
                for future in as_completed(waiting):
                    lap = waiting[future]
                    results[lap] = future.result()
                    done(f"{len(results)} of {len(laps)}: {' / '.join(lap[:3])}")
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    found: table.Found = {}
    for task in tasks:
        found.setdefault(task[0], {}).setdefault(task[1], {})[task[2]] = results[_lap_of(task)]
    return found


def _lap_of(task: Task) -> Task:
    """The lap whose figures a task's are: who hears nothing, or the truth, drives the same whatever the sensors do."""
    controller, feedback, _, seconds, _ = task
    if controller == "none":
        return controller, "ideal", "nominal", seconds, 0
    if feedback == "ideal":
        return controller, feedback, "nominal", seconds, 0
    return task


def perform(task: Task) -> dict[str, Any]:
    """Figures of one lap."""
    controller, feedback, case, seconds, seed = task
    return figures(drive(controller, feedback, tuple(parse_fault(text) for text in CASES[case]), seconds, seed))


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="rt-runner compare-control", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--controllers", help=f"names with commas between (default: {','.join(CONTROLLERS)})")
    parser.add_argument("--feedback", help=f"names with commas between (default: {','.join(FEEDBACKS)})")
    parser.add_argument("--cases", help=f"of {','.join(CASES)} (default: {','.join(USUAL)})")
    parser.add_argument("--seconds", type=float, default=LAP_MAX_S, help="drive no longer than this (default: the lap)")
    parser.add_argument("--seed", type=int, default=1, help="of the sensors' noise (default: %(default)s)")
    parser.add_argument("--json", metavar="FILE", help="write the figures as JSON (-: standard output)")
    parser.add_argument("--doc", type=Path, metavar="FILE", help="rewrite the table between the file's markers")
    parser.add_argument("--figures", type=Path, metavar="DIR", help="write control_lap.svg there")
    parser.add_argument("--workers", type=int, help="processes (default: one per core; 0: this one)")
    return parser.parse_args(argv)


def _check(args: argparse.Namespace) -> None:
    if not 0.1 <= args.seconds <= LAP_MAX_S:
        raise DataError(f"--seconds {args.seconds:g}: give 0.1 to {LAP_MAX_S:g}")
    if args.seed < 0 or (args.workers is not None and args.workers < 0):
        raise DataError("--seed and --workers: give 0 or more")
    if args.doc is not None:
        table.inserted(args.doc, "")
    if args.figures is not None:
        from tools.plots import check_plot

        check_plot(args.figures / "control_lap.svg")


def _names(text: str | None, known: Sequence[str], what: str, usual: Sequence[str]) -> list[str]:
    """Names of a list with commas, each once."""
    if text is None:
        return list(usual)
    names = list(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise DataError(f"{what} {text}: choose from {', '.join(known)}")
    return names


if __name__ == "__main__":
    sys.exit(main())
