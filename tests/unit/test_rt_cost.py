"""The runtime's own cost: instructions per job, which no neighbour can change, and none of them grow with time."""

from __future__ import annotations

import os
import shutil

import pytest

from tools import bench_rt

BUDGET = 1_800  # per job with two wake-ups of the canary, gcc -O2: 0.6 µs at one a cycle and 3 GHz


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    if shutil.which("valgrind") is None:
        message = "valgrind is not installed: the instruction count of a job's accounting is NOT checked"
        if os.environ.get("CI") == "true":
            pytest.fail(message)
        pytest.skip(message)
    return bench_rt.build(tmp_path_factory.mktemp("rt_cost"))


def test_accounting_is_bounded_and_does_not_grow(program, tmp_path):
    short, long = (bench_rt.instructions(program, tmp_path, jobs) for jobs in (300, 3000))
    assert short is not None
    assert long is not None
    assert long < BUDGET
    assert abs(long - short) < 0.05 * long


def test_bench_measures_what_it_says(program):
    cost = bench_rt.measure(program, "counted", 0, 500, 3)
    assert 0 < cost.median_ns <= cost.p99_ns
    assert cost.median_ns < bench_rt.measure(program, "system", 0, 500, 3).median_ns
