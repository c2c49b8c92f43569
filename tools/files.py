"""Files that are there whole or not at all, and figures as JSON."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that it is there with all of its bytes or as it was, after a kill or power failure too."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def write_json(target: str | None, figures: dict[str, Any]) -> None:
    """Write figures as JSON to a file, to standard output for ``-``, nowhere for None."""
    if target is None:
        return
    text = json.dumps(figures, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    if target == "-":
        sys.stdout.write(text)
    else:
        write_whole(Path(target), text.encode())
