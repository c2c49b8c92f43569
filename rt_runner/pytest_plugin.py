"""The pytest plugin: fixtures for tests of what is on a CAN bus. See ``docs/pytest-plugin.md``.

Loaded by every pytest of an environment that has this package, so nothing heavy is imported before a fixture is used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from pathlib import Path

    from rt_runner.testing.scenario_run import RunningScenario, ScenarioRun
    from rt_runner.testing.virtual_bus import VirtualBus

_CHOICES = "auto (vcan0 where there is one, else the user-space hub), hub, or a CAN interface"


def pytest_addoption(parser: pytest.Parser) -> None:
    """The bus by option or ini file."""
    group = parser.getgroup("rt-runner", "tests on a CAN bus (rt-runner)")
    group.addoption("--rt-bus", metavar="BUS", default=None, help=f"bus of the tests: {_CHOICES}")
    parser.addini("rt_bus", f"bus of the tests: {_CHOICES}", default="auto")


def pytest_configure(config: pytest.Config) -> None:
    """The bus by marker."""
    config.addinivalue_line("markers", f"rt_bus(name): bus of this test: {_CHOICES}")


@pytest.fixture
def virtual_bus(request: pytest.FixtureRequest) -> Iterator[VirtualBus]:
    """A CAN bus for this test: ``.open()`` gives python-can buses on it, ``.interface`` and ``.channel`` name it.

    Which: marker ``rt_bus``, else option ``--rt-bus``, else ini ``rt_bus``, else auto. An interface that is not there
    skips the test with its reason, and fails it where RT_REQUIRE_VCAN=1.
    """
    from rt_runner.errors import RtError
    from rt_runner.testing.virtual_bus import NoBus, must_exist
    from rt_runner.testing.virtual_bus import virtual_bus as serve

    try:
        with serve(_wanted(request)) as bus:
            yield bus
        return
    except NoBus as e:
        trouble, skip = str(e), not must_exist()
    except RtError as e:
        trouble, skip = str(e), False
    if skip:
        pytest.skip(trouble)
    pytest.fail(trouble, pytrace=False)


def _wanted(request: pytest.FixtureRequest) -> str:
    marker = request.node.get_closest_marker("rt_bus")
    if marker is not None:
        if len(marker.args) != 1 or not isinstance(marker.args[0], str) or marker.kwargs:
            pytest.fail(f'@pytest.mark.rt_bus needs one name, rt_bus("hub"), not {marker.args!r}', pytrace=False)
        return marker.args[0]
    return request.config.getoption("--rt-bus") or str(request.config.getini("rt_bus"))


class RunScenario:
    """The fixture ``run_scenario``: call it to run a scenario to its end, ``.start(…)`` to go on meanwhile."""

    def __init__(self, request: pytest.FixtureRequest, folder: Path) -> None:
        self._request, self._folder = request, folder
        self._started: list[RunningScenario] = []

    def __call__(
        self, scenario: Any = "hot-lap", changes: Any = None, *, lockstep: bool = False, **options: Any
    ) -> ScenarioRun:
        """Run it to its end, on the test's ``virtual_bus`` in real time, or in lock-step without a bus.

        Parameters
        ----------
        scenario, changes, options : see `rt_runner.testing.scenario_run.start_run`
        lockstep : as fast as it goes, the same log for the same seed
        """
        __tracebackhide__ = True
        from rt_runner.testing.scenario_run import RunFailed

        try:
            return self.start(scenario, changes, lockstep=lockstep, **options).wait()
        except RunFailed as e:
            trouble = str(e)
        pytest.fail(trouble, pytrace=False)  # here: an exception that is being handled would be shown, too

    def start(
        self, scenario: Any = "hot-lap", changes: Any = None, *, lockstep: bool = False, **options: Any
    ) -> RunningScenario:
        """Start it and return; ``.wait()`` gives the run. What is still running at the test's end is stopped."""
        __tracebackhide__ = True
        from rt_runner.errors import UsageError
        from rt_runner.testing.scenario_run import start_run

        bus = None if lockstep else self._request.getfixturevalue("virtual_bus")
        try:
            self._started.append(start_run(self._folder, bus, scenario, changes, **options))
            return self._started[-1]
        except UsageError as e:
            trouble = str(e)
        pytest.fail(trouble, pytrace=False)

    def end(self) -> None:
        """Nothing is left running."""
        for run in self._started:
            run.end()


@pytest.fixture
def run_scenario(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[RunScenario]:
    """Runs scenarios: ``run = run_scenario("hot-lap", duration_s=5)``, then ``run.log``, ``.frames``, ``.result``."""
    runs = RunScenario(request, tmp_path)
    try:
        yield runs
    finally:
        runs.end()


@pytest.fixture(name="assert_cycle_times")
def _assert_cycle_times() -> Callable[..., Any]:
    """`rt_runner.testing.assert_cycle_times`: every cyclic message of a node came at its cycle time."""
    from rt_runner.testing import assert_cycle_times

    return assert_cycle_times


@pytest.fixture(name="assert_no_timeouts")
def _assert_no_timeouts() -> Callable[..., Any]:
    """`rt_runner.testing.assert_no_timeouts`: no cyclic message was silent for longer than its receivers wait."""
    from rt_runner.testing import assert_no_timeouts

    return assert_no_timeouts
