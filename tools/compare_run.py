"""All runs of a comparison, in as many processes as there are cores; the same figures whatever their number."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

from tools.compare_cases import CHANNELS, Case, Variant
from tools.compare_drives import Lap, drive_lap, sense
from tools.compare_judge import Figures, judge, pooled
from tools.estimators.drive import run, run_each
from tools.estimators.registry import make

PR_SET_PDEATHSIG = 1
Done = Callable[[int, int, str], None]  # finished runs, all runs, what was finished last
_laps: dict[str | None, Lap] = {}  # driven once a process; the first one before the fork


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
    _lap(plants[0])
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
    """Figures of each task, as they get finished."""
    if workers == 0:
        yield from ((task, perform(task)) for task in tasks)
        return
    # Whoever warms an estimator up compiles its loops, once in a checkout; the others then find them on disk.
    ready: deque[Task | str] = deque(dict.fromkeys(task.estimator for task in tasks))
    waiting = {str(name): [task for task in tasks if task.estimator == name] for name in ready}
    busy: dict[Connection, Task | str] = {}
    with _pool(min(workers, len(tasks))) as links:
        idle = list(links)
        while ready or busy:
            while ready and idle:
                link = idle.pop()
                busy[link] = ready.popleft()
                _hand_out(link, busy[link])
            for link in wait(list(busy)):
                assert isinstance(link, Connection)
                what, figures = busy.pop(link), _answer(link)
                idle.append(link)
                if isinstance(what, str):
                    ready.extend(waiting[what])
                else:
                    yield what, figures


class WorkerDied(Exception):
    """A process ended in the middle of its work."""


@contextmanager
def _pool(workers: int) -> Iterator[list[Connection]]:
    """Forked processes that take a task and give its figures, and end with us whatever ends us.

    Pipes and no threads: an interrupt may come at any point and finds no lock held. (The executor of the standard
    library hangs when one comes while it waits for many results.)
    """
    context = multiprocessing.get_context("fork")
    processes, links = [], []
    try:
        for _ in range(workers):
            ours, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(theirs,), daemon=True)
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
            try:
                process.start()
                processes.append(process)
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
            theirs.close()  # so that the end of the process is the end of the pipe
            links.append(ours)
        yield links
    finally:
        for process in processes:
            process.kill()
        for process in processes:
            process.join()


def _serve(link: Connection) -> None:
    """A worker: tasks in, figures or the exception out."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all of us: the parent ends us
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
    while True:
        task: Task | str = link.recv()
        try:
            link.send(_warm_up(task) if isinstance(task, str) else perform(task))
        except Exception as error:
            link.send(error)


DIED = "a worker process was killed; --workers 1 needs the least memory"


def _hand_out(link: Connection, task: Task | str) -> None:
    try:
        link.send(task)
    except BrokenPipeError:
        raise WorkerDied(DIED) from None


def _answer(link: Connection) -> list[Figures]:
    try:
        answer = link.recv()
    except (EOFError, ConnectionResetError):
        raise WorkerDied(DIED) from None
    if isinstance(answer, Exception):
        raise answer
    return answer


def _warm_up(name: str) -> list[Figures]:
    run(make(name), sense(next(iter(_laps.values())), 0).cut(0, 40))
    return []


def _lap(plant: str | None) -> Lap:
    if plant not in _laps:
        _laps[plant] = drive_lap(plant)
    return _laps[plant]


def _cores() -> int:
    return len(os.sched_getaffinity(0))


def perform(task: Task) -> list[Figures]:
    """Figures of a task's variants, in their order."""
    lap = _lap(task.variants[0].mismatch)
    column = CHANNELS.index(task.channel)
    drives = [sense(lap, task.seed, variant.on(task.channel)) for variant in task.variants]
    found = run_each(make(task.estimator), drives)
    return [
        judge(estimates, lap.truth_degc, column, variant.window_s)
        for variant, estimates in zip(task.variants, found, strict=True)
    ]
