"""The core under AddressSanitizer and UndefinedBehaviorSanitizer, and what its objects may call."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tools.libest import ROOT, SOURCES, WEIGHTS, compile_library

BASE = ROOT / "estimator_c"
SANITIZE = ["-g1", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined"]


@pytest.fixture(scope="module")
def generated() -> Path:
    return compile_library(WEIGHTS).parent


def compile_command(generated: Path) -> list[str]:
    includes = [f"-I{BASE / 'src'}", f"-I{BASE / 'src' / 'solver'}", f"-I{generated}"]
    return ["gcc", "-std=c11", "-D_GNU_SOURCE", *includes]


@pytest.fixture(scope="module")
def fuzz(tmp_path_factory: pytest.TempPathFactory, generated: Path) -> Path:
    program = tmp_path_factory.mktemp("fuzz") / "test_estimator_fuzz"
    sources = [str(ROOT / "tests" / "c" / "test_estimator_fuzz.c"), *(str(BASE / source) for source in SOURCES)]
    sources += [str(path) for path in sorted(generated.glob("*.c"))]
    subprocess.run([*compile_command(generated), *SANITIZE, *sources, "-o", str(program), "-lm"], check=True)
    return program


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_random_frames_under_sanitizers(fuzz: Path, seed: int) -> None:
    done = subprocess.run([str(fuzz), "60", str(seed)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_core_calls_nothing_that_allocates_prints_or_reads_a_clock(tmp_path: Path, generated: Path) -> None:
    allowed = {"memset", "memcpy", "memmove", "fmax", "fmin", "sqrt", "exp"}
    for source in SOURCES:
        target = tmp_path / "object.o"
        strict = ["-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror", "-O2", "-fno-stack-protector"]
        subprocess.run([*compile_command(generated), *strict, "-c", str(BASE / source), "-o", str(target)], check=True)
        listed = subprocess.run(["nm", "-u", str(target)], capture_output=True, text=True, check=True).stdout
        called = {name for name in listed.split() if name != "U"}
        own = ("net_", "train_envelope", "mhe_", "tridiag_", "box_qp_", "validity_", "ekf_", "fusion_",
               "sensor_monitor_", "slow_observer_", "offset_calibration_", "estimator_")
        assert {name for name in called if not name.startswith(own)} <= allowed, source
