"""Runs of scenarios for tests: start the runner as a user would, wait for its end, look at what it left."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rt_runner import paths
from rt_runner.errors import RtError
from rt_runner.testing.scenario_file import scenario_file
from rt_runner.testing.virtual_bus import VirtualBus

if TYPE_CHECKING:
    from rt_runner.dbc import Dbc
    from rt_runner.log_reader import LogFrame

STOP_S = 20.0
SETUP_ERROR = 1


class RunFailed(RtError):
    """The runner ended without a verdict: usage, set-up, or a process that crashed."""


@dataclass(frozen=True)
class ScenarioRun:
    """A run that has ended.

    ``status`` is the exit status: 0 pass, 1 set-up or crash, 2 limits not met, 3 inconclusive. ``result`` is its JSON,
    empty where there is none; ``text`` what it printed.
    """

    status: int
    log: Path
    result: dict[str, Any]
    text: str

    @property
    def verdict(self) -> str:
        """``pass``, ``fail``, ``inconclusive``, or ``none``."""
        return str(self.result.get("verdict", "none"))

    @cached_property
    def dbc(self) -> Dbc:
        """The DBC of the run, out of its log."""
        from rt_runner.dbc import parse_dbc
        from rt_runner.log_reader import LogReader

        return parse_dbc(LogReader(self.log).attachments["drive.dbc"], f"{self.log}: drive.dbc")

    @cached_property
    def frames(self) -> dict[str, list[LogFrame]]:
        """Decoded frames by message name, in the order received: ``t_ns``, ``name``, ``values``, ``e2e``.

        A name that did not come has an empty list.
        """
        from rt_runner.log_reader import read_log

        found: dict[str, list[LogFrame]] = defaultdict(list)
        for frame in read_log(self.log):
            found[frame.name].append(frame)
        return found


class RunningScenario:
    """A run that goes on; ``wait()`` gives the `ScenarioRun`."""

    def __init__(self, command: Sequence[str], log: Path, json_file: Path, check: bool) -> None:
        self._log, self._json, self._check = log, json_file, check
        # What lies in the user's working directory must not be taken for a package of ours.
        path = os.pathsep.join(filter(None, (str(paths.ROOT), os.environ.get("PYTHONPATH"))))
        environment = {**os.environ, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"}
        self._text = log.with_suffix(".txt").open("w+")  # a file: nobody has to empty a pipe while the test does things
        self._process = subprocess.Popen(
            [sys.executable, "-m", "rt_runner.cli", *command], env=environment, stdin=subprocess.DEVNULL,
            stdout=self._text, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip

    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self._process.poll() is None

    def stop(self) -> None:
        """Ask it to end early, with a finished log; its verdict is then inconclusive."""
        if self.running():
            self._process.terminate()

    def wait(self, timeout_s: float | None = None) -> ScenarioRun:
        """Wait for its end.

        Raises
        ------
        RunFailed
            It has no verdict (exit status 1) and the run was started with ``check``: its last line.
        TimeoutError
            It is still running; it goes on.
        """
        try:
            status = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise TimeoutError(f"the run has not ended within {timeout_s:g} s") from None
        text = self._said()
        if self._check and status not in (0, 2, 3):
            lines = [line for line in text.splitlines() if line.strip()]
            said = lines[-1].removeprefix("rt-runner: ") if lines else "it said nothing"
            raise RunFailed(f"rt-runner ended with exit status {status}: {said}")
        result = json.loads(self._json.read_text()) if self._json.exists() else {}
        return ScenarioRun(status, self._log, result, text)

    def end(self) -> None:
        """Whatever the state, nothing of it is left running."""
        self.stop()
        try:
            self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._text.close()

    def _said(self) -> str:
        self._text.seek(0)
        return self._text.read()


def start_run(
    folder: Path,
    bus: VirtualBus | None,
    scenario: str | os.PathLike[str] | Mapping[str, Any] = "hot-lap",
    changes: Mapping[str, Any] | None = None,
    *,
    duration_s: float | None = None,
    period_s: float | None = None,
    setting: str | None = None,
    seed: int | None = None,
    faults: Sequence[str] = (),
    options: Sequence[str] = (),
    check: bool = True,
) -> RunningScenario:
    """Start a run whose files go to ``folder``; without a bus in lock-step.

    Parameters
    ----------
    scenario : a name, a .toml file, or the content of one as a dict
    changes : tables of the scenario to change, ``{"estimator": {"period_s": 0.01}}``
    duration_s, period_s, setting, seed, faults : as the options of ``rt-runner run``
    options : further options of ``rt-runner run`` or ``mil``, as on the command line
    check : an end without a verdict is an error

    Raises
    ------
    UsageError
        The scenario cannot be read, or cannot be written as TOML.
    """
    number = len(list(folder.glob("run-*.txt")))
    stem = folder / f"run-{number}"
    verb = ["mil"] if bus is None else ["run", "--bus", bus.bus if bus.interface == "rt_hub" else bus.channel]
    command = [*verb, scenario_file(stem.with_suffix(".d"), scenario, changes)]
    log, json_file = stem.with_suffix(".mcap"), stem.with_suffix(".json")
    named = {"duration": duration_s, "period": period_s, "setting": setting, "seed": seed}
    command += [f"--{name}={value}" for name, value in named.items() if value is not None]
    command += [f"--fault={fault}" for fault in faults]
    command += [f"--log={log}", f"--json={json_file}", *options]
    return RunningScenario(command, log, json_file, check)
