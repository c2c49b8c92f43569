"""The hash that names a build: the same for the same, another for another compiler flag or generated header."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def configured(build: Path, *flags: str) -> str:
    """Configure (which generates the code) and return the build's hash."""
    cmake = shutil.which("cmake", path=Path(sys.executable).parent) or shutil.which("cmake")
    if cmake is None:
        pytest.skip("needs cmake")
    subprocess.run(
        [cmake, "-S", ROOT / "estimator_c", "-B", build, f"-DPYTHON={sys.executable}", *flags],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    found = re.search(r'BUILD_SHA256 "([0-9a-f]{64})"', (build / "gen" / "build_id.h").read_text())
    assert found is not None
    return found[1]


def test_build_hash_names_code_compiler_and_flags(tmp_path: Path) -> None:
    first = configured(tmp_path / "a")
    assert configured(tmp_path / "a") == first
    assert configured(tmp_path / "b", "-DCMAKE_C_FLAGS=-ffast-math") != first, "other flags"
    assert configured(tmp_path / "a", "-DSANITIZE=ON") != first, "sanitizers"
    assert configured(tmp_path / "a", "-DSANITIZE=OFF") == first
    header = tmp_path / "a" / "gen" / "extra.h"
    header.write_text("#define EXTRA 1\n")
    with_header = configured(tmp_path / "a")
    header.write_text("#define EXTRA 2\n")
    assert len({first, with_header, configured(tmp_path / "a")}) == 3, "a generated header counts"
