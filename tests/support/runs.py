"""Run ``rt-runner`` as a user would, and find out which buses this machine has."""

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RT_RUNNER = [sys.executable, "-m", "rt_runner.cli"]


def rt_runner(*args, timeout_s: float = 300, env: dict | None = None) -> subprocess.CompletedProcess:
    """Run a verb to its end; standard output and error as text."""
    return subprocess.run(
        [*RT_RUNNER, *map(str, args)],
        capture_output=True,
        text=True,
        timeout=timeout_s,
        cwd=ROOT,
        env={**os.environ, **(env or {})},
        check=False,
    )


def start_rt_runner(*args, env: dict | None = None) -> subprocess.Popen:
    """Start a verb and return at once."""
    return subprocess.Popen(
        [*RT_RUNNER, *map(str, args)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env={**os.environ, **(env or {})},
    )


def load_result(path: Path) -> dict:
    """A result as ``--json`` wrote it."""
    return json.loads(path.read_text())


def one_line(text: str) -> str:
    """The single line an error must be; fails the test where it is not one."""
    lines = [line for line in text.splitlines() if line.strip()]
    assert "Traceback" not in text, text
    assert len(lines) == 1, text
    return lines[0]
