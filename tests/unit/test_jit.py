"""Compiled loops are kept between processes, and compiled anew when a file they take something from has changed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LOOP = """
from pathlib import Path
from plant_sim.jit import compiler
from package.other import FACTOR
@compiler(Path(__file__).resolve().parent)
def times(x):
    return FACTOR * x
"""
ASK = "from package.loop import times; print(times(2.0), sum(times.stats.cache_hits.values()))"


@pytest.fixture
def package(tmp_path: Path) -> Path:
    folder = tmp_path / "package"
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "loop.py").write_text(LOOP)
    return folder


def ask(package: Path, factor: float) -> tuple[float, int]:
    """(answer, taken from the cache) of a new process."""
    (package / "other.py").write_text(f"FACTOR = {factor}\n")
    command = [sys.executable, "-B", "-c", ASK]
    done = subprocess.run(
        command,
        cwd=package.parent,
        env={"PYTHONPATH": f"{package.parent}:{ROOT}"},
        capture_output=True,
        text=True,
        check=True,
    )
    answer, hits = done.stdout.split()
    return float(answer), int(hits)


def test_a_change_in_another_file_of_the_package_counts(package: Path) -> None:
    assert ask(package, 3.0) == (6.0, 0)
    assert ask(package, 3.0) == (6.0, 1)
    assert ask(package, 5.0) == (10.0, 0)
