"""A slow, plain re-statement of the estimator's core on whole recordings: what the C must publish, tick by tick.

No rings, no 16-bit ticks, no increments: frames are dictionaries by true tick. Only mhe_t is shared with the C (it
has its own oracle); binning, delay, start, prediction and publication are written again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator_c.formulation.lstm_numpy import lstm_step
from estimator_c.formulation.weights import LstmWeights
from tools.libest import Lib, Mhe, Setting


@dataclass(frozen=True)
class Recording:
    """motor[tick] = (torque Nm, speed rpm); temp[tick] = (winding, rotor) as measured, NaN where not valid."""

    motor: dict[int, tuple[float, float]]
    temp: dict[int, tuple[float, float]]
    first_tick: int  # of the grid: the first temperature frame
    last_tick: int


def twin_estimates(lib: Lib, weights: LstmWeights, setting: Setting, rec: Recording) -> dict[int, np.ndarray]:
    """Estimate [winding, rotor] at every motor tick after the start. Every frame is on time; no gap restarts."""
    d, grid = setting.delay_steps, rec.first_tick
    intervals = (rec.last_tick - grid) // 10
    inputs, held = [], np.zeros(2)
    for k in range(intervals):
        frames = [rec.motor[t] for t in range(grid + 10 * k + 1, grid + 10 * k + 11) if t in rec.motor]
        if frames:
            held = np.array([np.mean([f[1] for f in frames]), np.mean([f[0] for f in frames])])
        inputs.append(held)
    y = {
        (tick - grid) // 10 - d: np.array(values) - setting.offset_degc
        for tick, values in rec.temp.items()
        if tick >= grid
    }

    published: dict[int, np.ndarray] = {}
    mhe: Mhe | None = None
    for now in range(1, intervals + 1):
        node = now - d
        if mhe is None:
            early = np.array([y[k] for k in sorted(y) if k < max(node, 1 if d == 0 else 0)]).reshape(-1, 2)
            here = y.get(node, np.full(2, np.nan))
            if node < 0:
                continue
            prior = np.empty(2)
            for channel in range(2):
                known = early[~np.isnan(early[:, channel]), channel]
                prior[channel] = known.mean() if known.size else here[channel]
            if np.isnan(prior).any():
                continue
            c = h = np.zeros(weights.hidden)
            first = node if d > 0 else node - 1
            for _ in range(setting.spin_up_steps):
                c, h, _rate = lstm_step(weights, np.concatenate([inputs[first], prior]), c, h)
            mhe = Mhe(lib, setting)
            mhe.start(prior, c, h)
        else:
            mhe.advance(inputs[node - 1])
        for channel in range(2):
            mhe.measure(0, channel, float(y.get(node, np.full(2, np.nan))[channel]))
        mhe.solve()
        theta = mhe.theta()[-1]
        c, h = mhe.memory_of(0, weights.hidden)
        for k in range(node, now):
            c, h, rate = lstm_step(weights, np.concatenate([inputs[k], theta]), c, h)
            theta = theta + weights.dt_s * rate
        tick = grid + 10 * now
        frames = []
        for since in range(10):
            if since > 0:
                if tick + since in rec.motor:
                    frames.append(rec.motor[tick + since])
                else:
                    continue
                u = np.array([np.mean([f[1] for f in frames]), np.mean([f[0] for f in frames])], dtype=np.float64)
                rate = lstm_step(weights, np.concatenate([u, theta]), c, h)[2]
                published[tick + since] = theta + 0.01 * since * rate
            else:
                published[tick] = theta
    return published
