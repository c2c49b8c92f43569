"""The estimator's cycle on a bus port with a played other end (tests/c/test_est_port.c), plain and sanitized."""

from __future__ import annotations

import os
import subprocess

import pytest

from rt_runner import paths


@pytest.mark.parametrize("kind", ["bin", "asan/bin"])
def test_cycle_on_a_played_bus(kind):
    program = paths.build_dir() / kind / "tests" / "test_est_port"
    if not program.exists():
        assert os.environ.get("CI") != "true", f"{program} is missing"
        pytest.skip(f"{program} is missing; run 'make build build-asan'")
    done = subprocess.run([program], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "ok\n", "")
