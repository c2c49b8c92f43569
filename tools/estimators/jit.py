"""numba for this package's loops, which call each other across its files: see `plant_sim.jit`."""

from __future__ import annotations

from pathlib import Path

from plant_sim.jit import compiler

compiled = compiler(Path(__file__).resolve().parent)
