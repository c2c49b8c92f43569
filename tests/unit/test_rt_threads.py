"""Snapshots, the canary, the machine's figures and releases by events (tests/c/test_rt_threads.c), also sanitized."""

from __future__ import annotations

import os
import subprocess

import pytest

from rt_runner import paths


@pytest.mark.parametrize("kind", ["bin", "asan/bin"])
def test_more_threads_than_one(kind):
    program = paths.build_dir() / kind / "tests" / "test_rt_threads"
    if not program.exists():
        assert os.environ.get("CI") != "true", f"{program} is missing"
        pytest.skip(f"{program} is missing; run 'make build build-asan'")
    done = subprocess.run([program], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.endswith("ok\n")
