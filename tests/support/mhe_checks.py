"""The MHE in C against the oracle over a recorded drive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimator_c.formulation.mhe import MheOracle
from tools.mhe_recorder import Recorder


def equals_oracle(run: Recorder, oracle: MheOracle, steps: Sequence[int], within_degc: float) -> int:
    """Solve every step up to the last of `steps`, and compare the whole window at those; returns active-set changes."""
    active = 0
    for step in range(max(steps) + 1):
        if step > 0:
            run.advance()
        problem = run.problem()
        status, result = run.mhe.solve()
        assert status == 0, f"step {step}: {result.sweeps} sweeps left {result.kkt_degc} degC"
        if step in steps:
            expected = oracle.solve(problem)
            np.testing.assert_allclose(run.mhe.theta(), expected, rtol=0, atol=within_degc, err_msg=f"step {step}")
            active += result.active
    return active
