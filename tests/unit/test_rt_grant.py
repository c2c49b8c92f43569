"""Real-time set-up of a thread, in a process of its own (tests/c/test_rt_grant.c), plain and under the sanitizers."""

from __future__ import annotations

import os
import subprocess

import pytest

from rt_runner import paths


@pytest.mark.parametrize("kind", ["bin", "asan/bin"])
def test_set_up_of_a_thread(kind):
    program = paths.build_dir() / kind / "tests" / "test_rt_grant"
    if not program.exists():
        assert os.environ.get("CI") != "true", f"{program} is missing"
        pytest.skip(f"{program} is missing; run 'make build build-asan'")
    done = subprocess.run([program], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "ok\n", "")
