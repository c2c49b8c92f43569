"""Measure the plant's step: ``python -m tools.bench_plant`` prints microseconds per 10-ms step."""

from __future__ import annotations

import sys
import time

import numpy as np

from plant_sim.cycles import CycleSpec, build_cycle
from plant_sim.params import load_params
from plant_sim.plant import Engine, Plant


def main() -> int:
    """Time single steps (as the process runs them) and bulk runs of both engines."""
    params = load_params()
    cycle = build_cycle(CycleSpec("lap"), params)
    counts: dict[Engine, int] = {"numba": 20_000, "numpy": 2_000}
    for engine, count in counts.items():
        plant = Plant(params, cycle, engine=engine)
        plant.step()
        single = np.empty(count)
        for k in range(count):
            start = time.perf_counter_ns()
            plant.step()
            single[k] = (time.perf_counter_ns() - start) / 1000.0
        start = time.perf_counter_ns()
        plant.record(count, stop=False)
        bulk = (time.perf_counter_ns() - start) / 1000.0 / count
        print(
            f"{engine}: single step median {np.median(single):.1f} us, p99 {np.percentile(single, 99.0):.1f} us, "
            f"max {single.max():.1f} us over {count}; bulk {bulk:.1f} us per step"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
