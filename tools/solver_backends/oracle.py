"""Recorded problems as the oracle takes them, and its answers: CasADi's ipopt, from the reference solver's solution."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator_c.formulation.mhe import LOSSES, MheOracle, MheProblem
from estimator_c.formulation.weights import NetWeights

Array = NDArray[np.float64]
NODES = 16
HEAD = 16  # doubles before the memory, as in window_problem()


@dataclass(frozen=True, eq=False)
class Answer:
    """The oracle's temperatures (nodes, 2) of one problem, and the time it took in µs with its way through Python."""

    theta_degc: Array
    took_us: float


def problem_of(values: Array, memory: int) -> MheProblem:
    """The problem that window_problem() of window.h wrote, of a net with `memory` elements."""
    head, rest = values[:HEAD], values[HEAD + memory : HEAD + memory + 6 * NODES]
    count, hard = int(head[0]), head[3] != 0.0
    u, y, weight = (rest[2 * NODES * k : 2 * NODES * (k + 1)].reshape(NODES, 2)[:count] for k in range(3))
    return MheProblem(
        u=u[: count - 1],
        y=y,
        weight=weight,
        prior=head[8:10],
        weight_arrival=head[10:12],
        weight_noise=head[12:14],
        memory=values[HEAD : HEAD + memory],
        lower=head[4],
        upper=head[5],
        bound_weight=None if hard else head[6],
        loss=LOSSES[int(head[1])],
        loss_scale=head[2],
    )


class Answers:
    """Asks the oracle; its NLPs are kept."""

    def __init__(self, weights: NetWeights) -> None:
        self._oracle, self._memory = MheOracle(weights), weights.memory

    def ask(self, values: Array, guess: Array) -> Answer:
        """Solve one recorded problem from `guess` (nodes, 2): the loss is not convex, so both mean the same valley.

        Raises
        ------
        RuntimeError
            ipopt failed.
        """
        problem = problem_of(values, self._memory)
        if problem.bound_weight is None:
            guess = np.clip(guess, problem.lower, problem.upper)
        self._oracle.prepare(problem)
        begin = time.perf_counter()
        theta = self._oracle.solve(problem, guess)
        return Answer(theta, 1e6 * (time.perf_counter() - begin))
