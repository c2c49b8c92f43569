"""The controller process of a run: its command line, and the road ahead that it is given as a file."""

import contextlib
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from rt_runner import paths
from rt_runner.config import ControllerConfig, Scenario
from rt_runner.errors import SetupError

PREVIEW_NAME = "preview.txt"  # in the log: its 24-bit fingerprint is CtlBuild.preview_hash


@contextlib.contextmanager
def preview(scenario: Scenario) -> Iterator[Path]:
    """The scenario's road as a file, made by the plant's package; it exists as long as the context.

    Raises
    ------
    SetupError
        The cycle has no road over distance, or there is no room for the file.
    """
    with tempfile.TemporaryDirectory(prefix="rt-preview-") as folder:
        path = Path(folder) / f"{scenario.name}.preview"
        command = [sys.executable, "-P", "-m", "plant_sim.preview"]
        command += ["--scenario", str(scenario.path), "--out", str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            lines = done.stderr.strip().splitlines()
            raise SetupError(lines[-1] if lines else f"plant_sim.preview ended with exit status {done.returncode}")
        yield path


def controller_command(config: ControllerConfig, road: Path, how: list[str]) -> list[str]:
    """What starts the controller; ``how`` says where its frames come from and what it may ask of the system."""
    command = [str(paths.binary("rt_controller")), *how, "--preview", str(road), "--controller", config.name]
    return [*command, "--period-us", str(round(config.period_s * 1e6))]
