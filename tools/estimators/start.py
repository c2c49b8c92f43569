"""How every delay-aware baseline begins: the same as the C core, so that a comparison is one of corrections.

Measurements that speak for nodes before the first known input are averaged, offset removed; that mean is the start at
the first node a measurement speaks for after both channels have given one.
"""

from __future__ import annotations

import numpy as np

from tools.estimators.drive import DELAY_STEPS, OFFSET_DEGC
from tools.estimators.jit import compiled
from tools.estimators.net import step

SPIN_UP_STEPS = 5  # fill the net's empty memory with the first input
PRIOR_VARIANCE_K2 = 10.0  # of the start temperatures
EARLY = 5  # numbers kept: sum w, sum r, count w, count r, started


@compiled
def begins(early, y, row):
    """Take a row's measurement before the start; True when the estimator starts at this row (which then uses it)."""
    if row >= DELAY_STEPS and early[2] > 0.0 and early[3] > 0.0:
        early[4] = 1.0
        return True
    for ch in range(2):
        if not np.isnan(y[ch]):
            early[ch] += y[ch] - OFFSET_DEGC
            early[2 + ch] += 1.0
    return False


@compiled
def start_up(net, early, u, state, scratch):
    """Put `state` where the early measurements stood, its memory filled with the first known input."""
    for ch in range(2):
        state[ch] = early[ch] / early[2 + ch]
    start_w, start_r = state[0], state[1]
    for _ in range(SPIN_UP_STEPS):
        step(net, u, state, scratch)
        state[0], state[1] = start_w, start_r
