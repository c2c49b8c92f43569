"""numba with a cache that knows about the other files.

numba's own cache looks at the file a function stands in. A loop that calls functions of other files, or takes constants
from them, would go on with the old ones after a change there: wrong figures, or memory written over. So the cache lies
under a hash of the package's sources.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import config as numba_config

Compile = Callable[[Callable[..., Any]], Callable[..., Any]]


def cache_folder(package: Path) -> Path:
    """Where what is compiled of the package in that folder is kept; another place after any change of its sources."""
    sources = b"\0".join(path.read_bytes() for path in sorted(package.glob("*.py")))
    return package / "__pycache__" / f"compiled-{hashlib.sha256(sources).hexdigest()[:16]}"


def compiler(package: Path) -> Compile:
    """`numba.njit` for functions of the package in that folder; kept on disk until a source of the package changes."""
    folder = str(cache_folder(package))

    def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
        config: Any = numba_config
        before = config.CACHE_DIR
        config.CACHE_DIR = folder
        try:
            return numba.njit(cache=True)(function)
        finally:
            config.CACHE_DIR = before

    return compiled


compiled = compiler(Path(__file__).resolve().parent)
