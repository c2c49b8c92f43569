"""numba with a cache that knows about the other files.

numba's own cache looks at the file a function stands in. A loop here calls functions of other files (the net's step,
the start), and would go on with the old ones after a change there: wrong figures, or memory written over. So the cache
lies under a hash of this package's sources.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import config as numba_config

_HERE = Path(__file__).resolve().parent
_SOURCES = hashlib.sha256(b"\0".join(path.read_bytes() for path in sorted(_HERE.glob("*.py")))).hexdigest()[:16]
_FOLDER = _HERE / "__pycache__" / f"compiled-{_SOURCES}"


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """`numba.njit` of a function of this package; kept on disk until a source of the package changes."""
    config: Any = numba_config
    before = config.CACHE_DIR
    config.CACHE_DIR = str(_FOLDER)
    try:
        return numba.njit(cache=True)(function)
    finally:
        config.CACHE_DIR = before
