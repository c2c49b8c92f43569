"""All runs of a comparison, in as many processes as there are cores; the same figures whatever their number."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from tools.compare_cases import CHANNELS, Case, Variant
from tools.compare_drives import Lap, drive_lap, sense
from tools.compare_judge import Figures, judge, pooled
from tools.estimators.drive import run, run_each
from tools.estimators.registry import make

PR_SET_PDEATHSIG = 1
Done = Callable[[int, int, str], None]  # finished runs, all runs, what was finished last
_laps: dict[str | None, Lap] = {}  # filled before the processes are forked, so that none has to drive or receive one


@dataclass(frozen=True)
class Task:
    """One estimator, one seed, one plant: all variants on it, computed together as far as they are alike."""

    estimator: str
    seed: int
    channel: str
    variants: tuple[Variant, ...]


def compare(
    estimators: Sequence[str], cases: Sequence[Case], seeds: int, channel: str, done: Done, workers: int | None = None
) -> dict[str, dict[str, dict[str, Any]]]:
    """{estimator: {case: figures of `pooled`}} over seeds 0 .. seeds - 1.

    Parameters
    ----------
    channel
        Which of CHANNELS has the faults and is judged.
    workers
        Processes; None: one per core this process may use; 0: in this process.
    """
    variants = list(dict.fromkeys(v for case in cases for v in case.variants))
    plants = list(dict.fromkeys(v.mismatch for v in variants))
    groups = [tuple(v for v in variants if v.mismatch == plant) for plant in plants]
    for plant in plants:
        if plant not in _laps:
            _laps[plant] = drive_lap(plant)
    tasks = [Task(name, seed, channel, group) for seed in range(seeds) for name in estimators for group in groups]
    tasks.sort(key=lambda t: len(t.variants), reverse=True)  # short ones last: they fill the gaps

    found: dict[tuple[str, int, str], Figures] = {}
    total = sum(len(t.variants) for t in tasks)
    for task, figures in _work(tasks, _cores() if workers is None else workers):
        found.update({(task.estimator, task.seed, v.label): f for v, f in zip(task.variants, figures, strict=True)})
        done(len(found), total, f"{task.estimator}, seed {task.seed}")
    return {
        name: {
            case.name: pooled([[found[name, seed, v.label] for v in case.variants] for seed in range(seeds)])
            for case in cases
        }
        for name in estimators
    }


def _work(tasks: Sequence[Task], workers: int) -> Iterator[tuple[Task, list[Figures]]]:
    if workers == 0:
        yield from ((task, perform(task)) for task in tasks)
        return
    with _pool(min(workers, len(tasks))) as pool:
        # Whoever warms an estimator up compiles its loops, once in a checkout; the others then find them on disk.
        names = dict.fromkeys(task.estimator for task in tasks)
        under_way: dict[Future[list[Figures]], Task | str] = {pool.submit(_warm_up, name): name for name in names}
        while under_way:
            for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                what, figures = under_way.pop(future), future.result()
                if isinstance(what, Task):
                    yield what, figures
                else:
                    under_way |= {pool.submit(perform, task): task for task in tasks if task.estimator == what}


def _warm_up(name: str) -> list[Figures]:
    run(make(name), sense(next(iter(_laps.values())), 0).cut(0, 40))
    return []


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Forked workers that end with us: at once when we are interrupted, by the kernel when we are killed."""
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("fork"), initializer=_in_worker)
    try:
        yield pool
    finally:
        # What has begun is finished (seconds), what has not is dropped.
        pool.shutdown(wait=True, cancel_futures=True)


def _in_worker() -> None:
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all of us: the parent decides
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _cores() -> int:
    return len(os.sched_getaffinity(0))


def perform(task: Task) -> list[Figures]:
    """Figures of a task's variants, in their order."""
    lap = _laps[task.variants[0].mismatch]
    column = CHANNELS.index(task.channel)
    drives = [sense(lap, task.seed, variant.on(task.channel)) for variant in task.variants]
    found = run_each(make(task.estimator), drives)
    return [
        judge(estimates, lap.truth_degc, column, variant.window_s)
        for variant, estimates in zip(task.variants, found, strict=True)
    ]
