"""Run the bench's program: times of all backends in turns, and instructions by callgrind."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from estimator_c.formulation.real import FLOAT as FLOAT_TYPE
from tools.solver_backends.build import build_hpipm, build_mhe, build_runner
from tools.solver_backends.configs import DOUBLE, FLOAT, HPIPM, Config
from tools.solver_backends.figures import Measured, read_measured
from tools.solver_backends.stream import Segment

COUNTED_FROM, COUNTED_TO = 100, 130  # steps of a segment whose instructions are counted: after the fault has begun
MHE_PARTS = ("timed_calls", "timed_solve")  # without the run forward
COUNTED = ("lap, seed 0", "fault offset", "fault noise", "soft bound met", "quadratic loss")


class MeasureError(Exception):
    """The bench's program failed; the message says how."""


class Bench:
    """Everything compiled into `folder`; each configuration has a copy of its library, so a state of its own."""

    def __init__(self, weights: Path, folder: Path, configs: Sequence[Config]) -> None:
        self._folder, self.configs = folder, tuple(configs)
        self._program = build_runner(folder)
        built: dict[str, Path] = {}
        self._words: list[str] = []
        for place, config in enumerate(self.configs):
            if config.build not in built:
                built[config.build] = {
                    DOUBLE: lambda: build_mhe(weights, folder),
                    FLOAT: lambda: build_mhe(weights, folder, FLOAT_TYPE),
                    HPIPM: lambda: build_hpipm(weights, folder),
                }[config.build]()
            own = folder / f"{place}-{config.name}.so"
            shutil.copy(built[config.build], own)
            self._words.append(config.words(str(own)))

    def runs(self, place: int) -> bool:
        """Whether this machine has what the configuration needs (a kernel, say)."""
        stream = self._write([], "empty.bin")
        return (
            self._run([str(self._program), str(stream), str(self._folder / "empty.out"), self._words[place]]).returncode
            == 0
        )

    def time(self, places: Sequence[int], segments: Sequence[Segment], repeats: int, every: int, core: int) -> Measured:
        """All chosen configurations in turns over all segments; every `every`-th step with window and problem."""
        out = self._folder / "out.bin"
        command = [str(self._program), str(self._write(segments, "stream.bin")), str(out), "-r", str(repeats)]
        command += ["-w", str(every), "-c", str(core), *(self._words[place] for place in places)]
        done = self._run(command)
        if done.returncode != 0:
            raise MeasureError(done.stderr.strip() or f"bench_solver ended with status {done.returncode}")
        return read_measured(np.fromfile(out), done.stdout.split())

    def count(self, place: int, segments: Sequence[Segment], functions: Sequence[str] = ("timed_*",)) -> int | None:
        """Mean instructions of a step in these functions; None where callgrind is missing or cannot run the code."""
        if shutil.which("valgrind") is None:
            return None
        heads, steps = _counted_heads(segments), counted_steps(segments)
        if steps == 0:
            return None
        stream = self._write(heads, "counted.bin")
        done = self._run([
            "valgrind", "--tool=callgrind", *(f"--toggle-collect={name}" for name in functions),
            f"--callgrind-out-file={self._folder / 'callgrind.out'}", str(self._program), str(stream),
            str(self._folder / "counted.out"), "-s", str(COUNTED_FROM), self._words[place],
        ])  # fmt: skip
        found = re.search(r"Collected : (\d+)", done.stderr)
        return round(int(found.group(1)) / steps) if found and done.returncode == 0 else None

    def _write(self, segments: Sequence[Segment], name: str) -> Path:
        path = self._folder / name
        np.concatenate([np.empty(0), *(segment.data for segment in segments)]).tofile(path)
        return path

    @staticmethod
    def _run(command: list[str]) -> subprocess.CompletedProcess[str]:
        return subprocess.run(command, capture_output=True, text=True, check=False)


def counted_steps(segments: Sequence[Segment]) -> int:
    """Number of steps whose instructions are counted."""
    return sum(max(0, len(head) - COUNTED_FROM) for head in _counted_heads(segments))


def _counted_heads(segments: Sequence[Segment]) -> list[Segment]:
    return [s.head(COUNTED_TO) for s in segments if s.situation.name in COUNTED]


def pinned_core() -> int:
    """The last core this process may use: the first ones have the interrupts."""
    return max(os.sched_getaffinity(0))
