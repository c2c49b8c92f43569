"""Starts, pins, watches and stops the processes of one run; what they leave behind is the log and the result."""

import contextlib
import json
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from rt_runner import machine, paths
from rt_runner.bus import HUB_PRIORITY, BusChoice, HubProcess
from rt_runner.children import Child, ChildError
from rt_runner.config import Scenario
from rt_runner.controller import PREVIEW_NAME, controller_command, preview
from rt_runner.errors import RtError, SetupError
from rt_runner.provenance import Provenance
from rt_runner.result import RunFacts
from rt_runner.timing_config import grace_releases, timing_options

LOGGER_READY_S = 30.0
READY_S = 90.0  # the plant compiles its kernel at first use and drives to the scenario's start
ESTIMATOR_DRAIN_S = 0.25
WORKER_END_S = 12.0  # on a bus that lags behind the estimator leaves only when all it sent is on it
STOPPED_BY_MISSES = 2  # how the estimator ends when its policy stops it
RESTART_PAUSE_S = 0.5  # what dies at once must not be started in a storm; the plant's own fallback is due after 0.2 s
RESTARTS_MAX = 3  # of one process, where a controller closes the loop; without one, a process that ends fails the run


@dataclass(frozen=True)
class Plan:
    """Everything a run is told before it starts."""

    scenario: Scenario
    bus: BusChoice
    log: Path
    provenance: Provenance
    seed: int = 1
    core: int | None = None
    realtime: bool = True


class Supervisor:
    """One run. ``stop()`` may be called from a signal handler; ``run()`` then ends it in order.

    Parameters
    ----------
    plan : what to run
    say : takes one line of text for the user
    progress : takes the logger's progress object about once a second
    """

    def __init__(self, plan: Plan, say: Callable[[str], None], progress: Callable[[dict], None]) -> None:
        self._plan, self._say, self._progress = plan, say, progress
        self._core, self._others = machine.split_cores(plan.core)
        self._controller_core = min(self._others)  # its own where there are three
        if plan.scenario.controller.present and len(self._others) > 1:
            self._others = self._others - {self._controller_core}
        self._stopped = False
        self._children: list[Child] = []
        self._workers: dict[str, Child] = {}
        self._restarts: list[str] = []
        self._finals: dict[str, dict] = {}  # the last line of estimator and controller
        self._road = Path()

    def stop(self) -> None:
        """Ask the run to end early."""
        self._stopped = True

    def run(self) -> dict:
        """Run to the end, to ``stop()``, or to the first process that fails.

        Returns
        -------
        dict
            The result as in ``ResultAccumulator.result``.

        Raises
        ------
        RtError
            Set-up failed, or the logger itself was lost: there is no result then.
        """
        with contextlib.ExitStack() as stack:
            if self._plan.scenario.controller.present:
                self._road = stack.enter_context(preview(self._plan.scenario))
            priority = HUB_PRIORITY if self._plan.realtime else None
            bus = stack.enter_context(HubProcess.serving(self._plan.bus, self._say, self._others, priority))
            try:
                logger = self._start_logger(bus)
                if bus.startswith("rt_hub:"):
                    self._say(f"attach to it: cantools monitor dbc/drive.dbc -i rt_hub -c {bus.partition(':')[2]}")
                return self._run_on(bus, logger)
            finally:
                for child in reversed(self._children):
                    child.stop(3.0)

    def _start(self, name: str, command: list[str], cores: set[int] | None) -> Child:
        child = Child(name, command, cores)
        self._children.append(child)
        return child

    def _start_logger(self, bus: str) -> Child:
        """Started first, and waited for even if the run is stopped meanwhile: an interrupted run has a log, too."""
        try:
            with tempfile.NamedTemporaryFile("w", prefix="rt-logger-", suffix=".json") as config:
                about = vars(self._plan.provenance)
                road = {PREVIEW_NAME: str(self._road)} if self._plan.scenario.controller.present else {}
                known = {"files": {**about["files"], **road}, "facts": asdict(self._facts())}
                json.dump({**about, **known}, config)
                config.flush()
                command = ["rt_runner.logger", "--bus", bus, "--log", str(self._plan.log), "--config", config.name]
                logger = self._start("logger", [sys.executable, "-m", *command], self._others)
                logger.wait_line("ready", LOGGER_READY_S)
        except OSError as e:
            raise SetupError(f"cannot write the logger's configuration to {tempfile.gettempdir()}: {e.strerror}") from e
        return logger

    def _facts(self) -> RunFacts:
        plan, scenario = self._plan, self._plan.scenario
        return RunFacts(
            bus=plan.bus.name,
            scenario=scenario.name,
            period_s=scenario.estimator.period_s,
            seed=plan.seed,
            limits=scenario.limits,
            faults=scenario.all_faults,
            mk=scenario.timing.mk,
            grace_releases=grace_releases(scenario.timing.grace_s, scenario.estimator.period_s),
            controller=scenario.controller.name if scenario.controller.present else None,
        )

    def _plant_command(self, bus: str) -> list[str]:
        plan, scenario = self._plan, self._plan.scenario
        command = ["plant_sim", "--scenario", str(scenario.path), "--bus", bus, "--seed", str(plan.seed)]
        if scenario.duration_s:
            command += ["--duration", str(scenario.duration_s)]
        command += [f"--fault={fault}" for fault in scenario.added_faults]
        command += ["--obey"] if scenario.controller.present else []
        return [sys.executable, "-m", *command]

    def _run_on(self, bus: str, logger: Child) -> dict:
        facts, crash = self._facts(), None
        began, steal_0 = time.monotonic(), machine.steal_ms(self._core)
        try:
            plant = self._start("plant", self._plant_command(bus), self._others)
            plant.wait_line("ready", READY_S, lambda: self._stopped)
            facts = replace(facts, granted=self._start_worker("estimator", bus))
            if self._plan.scenario.controller.present:
                self._start_worker("controller", bus)
            plant.tell("go")
            began = time.monotonic()
            self._watch(plant, bus, logger)
            if not self._stopped:
                time.sleep(ESTIMATOR_DRAIN_S)  # the last interval is estimated, too
            for name, worker in self._workers.items():
                self._end(worker)  # first: a job after the last frame would only find stale inputs
                self._keep_final(name)
            self._end(plant)
        except ChildError as e:
            if not self._stopped:
                crash = str(e)
            for child in reversed(self._children[1:]):
                child.stop()
        steal_1 = machine.steal_ms(self._core)
        facts = replace(
            facts,
            duration_s=time.monotonic() - began,
            crash=crash,
            stopped_by="crash" if crash else "interrupt" if self._stopped else self._ended_by(),
            steal_ms=None if steal_0 is None or steal_1 is None else steal_1 - steal_0,
            restarts=tuple(self._restarts),
        )
        return self._finish(logger, facts)

    def _start_worker(self, name: str, bus: str) -> dict:
        """Start estimator or controller; what it was granted."""
        command = self._estimator_command(bus) if name == "estimator" else self._controller_command(bus)
        self._workers[name] = worker = self._start(name, command, None)
        granted = worker.wait_line("ready", 10.0, lambda: self._stopped)
        for warning in granted.get("warnings", []):
            self._say(f"warning: {name}: {warning}")
        return granted

    def _restart(self, name: str, bus: str) -> None:
        """The loop is closed: who has died is started again, a few times; the plant drives by its rule meanwhile."""
        obituary = self._workers[name].obituary()
        if not self._plan.scenario.controller.present or self._restarted(name) == RESTARTS_MAX:
            raise ChildError(obituary)
        self._restarts.append(obituary)
        self._say(f"warning: {obituary}; it is started again")
        time.sleep(RESTART_PAUSE_S)
        self._start_worker(name, bus)

    def _restarted(self, name: str) -> int:
        return sum(child.name == name for child in self._children) - 1

    def _controller_command(self, bus: str) -> list[str]:
        how = ["--bus", bus, "--core", str(self._controller_core)]
        how += [] if self._plan.realtime else ["--no-rt"]
        # The estimator is above it: on the estimator's core a late canary would not be the machine's doing.
        how += ["--no-canary"] if self._controller_core == self._core else []
        return controller_command(self._plan.scenario.controller, self._road, how)

    def _estimator_command(self, bus: str) -> list[str]:
        e = self._plan.scenario.estimator
        command = [
            str(paths.binary("rt_estimator")),
            "--bus",
            bus,
            "--setting",
            e.setting,
            "--period-us",
            str(round(e.period_s * 1e6)),
            "--core",
            str(self._core),
            *timing_options(self._plan.scenario.timing, e.period_s, e.trigger),
        ]
        return command if self._plan.realtime else [*command, "--no-rt"]

    def _watch(self, plant: Child, bus: str, logger: Child) -> None:
        """Until the plant is done; a child that ends before its time is an error, or is started again."""
        while not self._stopped:
            if self._plant_done(plant):
                return
            if logger.ended():
                raise ChildError(logger.obituary())
            for name in [name for name, worker in self._workers.items() if worker.ended()]:
                if self._stopped_itself(name):
                    return
                self._restart(name, bus)
            self._drain(logger)
            time.sleep(0.05)

    @staticmethod
    def _plant_done(plant: Child) -> bool:
        """Whether the plant has sent its last frame: it says so before it takes the time to end."""
        while not plant.lines.empty():
            line = plant.lines.get()
            if line is None:
                raise ChildError(plant.obituary())
            if "final" in line:
                return True
        return False

    def _drain(self, logger: Child) -> None:
        while not logger.lines.empty():
            line = logger.lines.get()
            if line is None:
                raise ChildError(logger.obituary())
            if "progress" in line:
                self._progress(line["progress"])
            elif "error" in line:
                raise ChildError(f"the logger: {line['error']}")

    def _stopped_itself(self, name: str) -> bool:
        """Whether this process ended as its policy says, after too many misses: no crash, but the end of the run."""
        if self._workers[name].reap(1.0) != STOPPED_BY_MISSES:
            return False
        self._keep_final(name)
        return self._finals.get(name, {}).get("stopped_by") == "misses"

    def _keep_final(self, name: str) -> None:
        """Take the last line of a process that has ended."""
        lines = self._workers[name].lines
        while not lines.empty():
            line = lines.get()
            if line is not None and "final" in line:
                self._finals[name] = line

    def _ended_by(self) -> str:
        return "misses" if any(f.get("stopped_by") == "misses" for f in self._finals.values()) else "end"

    def _end(self, child: Child) -> None:
        status = child.stop(WORKER_END_S)
        if status not in (0, -15) and not (status == STOPPED_BY_MISSES and child in self._workers.values()):
            raise ChildError(child.obituary())

    def _finish(self, logger: Child, facts: RunFacts) -> dict:
        """Hand the facts to the logger, which knows every frame; it closes the log and answers with the result."""
        texts = {f"{name}_final.json": json.dumps(line) for name, line in self._finals.items()}
        logger.tell(json.dumps({"finish": {"outcome": asdict(facts), "granted": facts.granted, "texts": texts}}))
        try:
            result = logger.wait_line("result", 60.0)["result"]
        except ChildError as e:
            raise RtError(facts.crash if facts.crash and "logger" in facts.crash else str(e)) from e
        logger.reap(10.0)
        return result

