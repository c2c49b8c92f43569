"""Finished drives of a data set in a folder beside it, so that an interrupted build goes on where it stopped.

Every drive is one file, written whole or not at all, and marked with a fingerprint of everything its rows depend on
(recipe, seed, parameters, source code of plant and recipe): a drive of another build is never taken for one's own.
"""

from __future__ import annotations

import dataclasses
import fcntl
import hashlib
import io
import json
import os
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

import plant_sim
from plant_sim.params import PlantParams
from tools import dataset_recipe
from tools.dataset_recipe import Chain, Recipe
from tools.files import write_whole
from tools.rows import DataError


def fingerprint(params: PlantParams, recipe: Recipe, seed: int) -> str:
    """SHA-256 of all that decides the rows of a set."""
    digest = hashlib.sha256(repr((seed, dataclasses.astuple(recipe), params, np.__version__)).encode())
    sources = [*sorted(Path(plant_sim.__file__).parent.glob("*.py")), Path(dataset_recipe.__file__)]
    for path in sources:
        digest.update(path.read_bytes())
    return digest.hexdigest()


class DriveStore:
    """The folder of finished drives, locked for one build at a time.

    Parameters
    ----------
    folder : made if absent
    key : fingerprint of the build; a drive with another one counts as absent

    Raises
    ------
    DataError
        Another build uses the folder.
    OSError
        It cannot be made.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self.folder, self.key = folder, key
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = os.open(folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._lock)
            raise DataError(f"{folder}: another build writes here; wait for it, or give another --out") from None

    def load(self, number: int) -> tuple[NDArray[np.float64], Chain] | None:
        """Rows and end state of a finished drive; None if it is absent, damaged or of another build."""
        try:
            with np.load(self._path(number), allow_pickle=False) as file:
                if str(file["key"]) != self.key:
                    return None
                return file["rows"], Chain(file["theta_end_degc"], json.loads(str(file["random"])))
        except Exception:  # whatever numpy and zip make of half a file: the drive is simulated again
            return None

    def save(self, number: int, rows: NDArray[np.float64], end: Chain) -> None:
        """Keep a finished drive."""
        buffer = io.BytesIO()
        random = np.array(json.dumps(end.random))
        np.savez(buffer, key=np.array(self.key), rows=rows, theta_end_degc=end.theta_degc, random=random)
        write_whole(self._path(number), buffer.getvalue())

    def remove(self) -> None:
        """Delete what this class made, and the folder unless somebody keeps something else there."""
        for path in (*self.folder.glob("drive-*.npz"), *self.folder.glob(".drive-*.part"), self.folder / "lock"):
            path.unlink(missing_ok=True)
        try:
            self.folder.rmdir()
        except OSError:
            return

    def _path(self, number: int) -> Path:
        return self.folder / f"drive-{number:02d}.npz"

    def __enter__(self) -> DriveStore:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._lock)
