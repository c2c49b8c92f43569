"""A logger whose every write takes a fifth of a second: the estimator's response does not know of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rt_runner.bus import HubProcess
from rt_runner.log_reader import LogReader
from tests.timing.estimator_process import OnBus, Run, binary, lap

PERIOD_US = 10_000
WRITE_S = 0.2
SLOW_LOGGER = f"""
import os, time
real = os.write
def slow(fd, data):
    time.sleep({WRITE_S})
    slow.calls += 1
    return real(fd, data)
slow.calls = 0
os.write = slow
import sys
from rt_runner.logger import main
status = main()
print("writes", slow.calls, file=sys.stderr)
sys.exit(status)
"""


def run_on(bus: str) -> Run:
    talk = OnBus(bus, binary("release"), "--period-us", str(PERIOD_US))
    return talk.wait(4.0).finish()


def figures(result: Run) -> dict:
    assert result.final is not None
    return result.final


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> tuple[Run, Run, Path, int]:
    """A run alone, a run with the slow logger beside it, its log, and how often it wrote."""
    lap()
    log = tmp_path_factory.mktemp("slow") / "slow.mcap"
    hub = HubProcess()
    try:
        alone = run_on(hub.bus)
        logger = subprocess.Popen(
            [sys.executable, "-c", SLOW_LOGGER, "--bus", hub.bus, "--log", str(log)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=dict(os.environ),
        )  # fmt: skip
        assert logger.stdout is not None
        assert "ready" in logger.stdout.readline()
        beside = run_on(hub.bus)
        logger.send_signal(signal.SIGTERM)
        _, said = logger.communicate(timeout=60)
    finally:
        hub.stop()
    writes = next(int(line.split()[1]) for line in said.splitlines() if line.startswith("writes"))
    return alone, beside, log, writes


def test_the_disk_was_slow(runs):
    assert runs[3] * WRITE_S > 1.5, "of four seconds"


def test_no_job_waits_for_it(runs):
    alone, beside = map(figures, runs[:2])
    assert beside["causes"]["blocked_send"] == 0
    # The neighbours differ by a process that computes; ten times the undisturbed response is far below one write.
    assert beside["publish_us"]["p90"] < max(10 * alone["publish_us"]["p90"], 1000) < WRITE_S * 1e6 / 10
    assert beside["resp_us"]["p90"] < max(10 * alone["resp_us"]["p90"], 2000) < WRITE_S * 1e6 / 10


def test_every_frame_is_in_the_log_or_counted(runs):
    beside, log = figures(runs[1]), runs[2]
    in_log = sum(f.name == "Estimate" for f in LogReader(log).frames())
    assert in_log == beside["estimates_sent"]
    assert beside["estimates_lost"] + beside["estimates_sent"] == beside["jobs"]
