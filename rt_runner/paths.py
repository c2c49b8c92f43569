"""Where things are: the project's root and what was built."""

import os
from pathlib import Path

from rt_runner.errors import SetupError

ROOT = Path(__file__).resolve().parent.parent


def build_dir() -> Path:
    """The build folder: ``RT_BUILD_DIR`` if set (a sanitizer build, say), else ``build`` in the project."""
    return Path(os.environ.get("RT_BUILD_DIR") or ROOT / "build")


def setting_names() -> list[str]:
    """Names of the estimator's settings, as the build compiles them in."""
    return sorted(p.stem for p in (ROOT / "estimator_c" / "settings").glob("*.toml"))


def binary(name: str) -> Path:
    """Path of a built program.

    Raises
    ------
    SetupError
        It has not been built.
    """
    path = build_dir() / "bin" / name
    if not os.access(path, os.X_OK):
        raise SetupError(f"{path} is missing: run 'make build' in {ROOT}")
    return path
