"""The 70-node thermal network as an exact zero-order-hold step on a speed grid.

theta+ = A_d(n) theta + B_d(n) P + B_b(n) theta_b, with the matrices of the two neighbouring grid speeds
blended. The step is positive and contractive by construction and stays stable for the 5 ms air-gap nodes at
any step length.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from plant_sim.expm import expm_integral
from plant_sim.network import build_network
from plant_sim.params import PlantParams

GRID_RPM = 100.0
GRID_MAX_RPM = 11200.0
DT_S = 0.01


@dataclass(frozen=True, eq=False)
class Lptn:
    """Discrete thermal model.

    Attributes
    ----------
    a_d, b_d
        (113, 70, 70) state and heat matrices; b_d in K/W.
    b_b
        (113, 70, 3) response to coolant, ambient and gearbox temperature; kept apart so that they may vary
        in time.
    dt_s
        Step length.
    """

    a_d: NDArray[np.float64]
    b_d: NDArray[np.float64]
    b_b: NDArray[np.float64]
    dt_s: float
    grid_rpm: float

    def step(
        self,
        theta_degc: NDArray[np.float64],
        heat_w: NDArray[np.float64],
        speed_rpm: float,
        boundary_degc: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return the 70 node temperatures one step later.

        Parameters
        ----------
        theta_degc, heat_w
            Node temperatures and heat injections, (70,).
        speed_rpm
            Rotor speed held over the step; clipped to the grid (0..11200 rpm).
        boundary_degc
            Coolant inlet, ambient, gearbox temperature (3,).
        """
        j, w = grid_position(speed_rpm, self.grid_rpm, self.a_d.shape[0])
        out = np.zeros_like(theta_degc)
        for k, share in ((j, 1.0 - w), (j + 1, w)):
            out += share * (self.a_d[k] @ theta_degc + self.b_d[k] @ heat_w + self.b_b[k] @ boundary_degc)
        return out


def grid_position(speed_rpm: float, grid_rpm: float, count: int) -> tuple[int, float]:
    """Return lower grid index and weight of the upper neighbour."""
    x = min(max(abs(speed_rpm) / grid_rpm, 0.0), count - 1.0)
    j = min(int(x), count - 2)
    return j, x - j


@lru_cache(maxsize=8)
def build_lptn(params: PlantParams, dt_s: float = DT_S, grid_rpm: float = GRID_RPM) -> Lptn:
    """Discretise the network at every grid speed (about 0.5 s; cached by parameters)."""
    network = build_network(params)
    speeds = np.arange(0.0, GRID_MAX_RPM + 0.5 * grid_rpm, grid_rpm)
    pairs = [network.matrices(float(n)) for n in speeds]
    laplacian = np.array([p[0] for p in pairs])
    boundary = np.array([p[1] for p in pairs])
    inverse_c = 1.0 / network.capacity_j_k
    a_d, integral = expm_integral(-inverse_c[None, :, None] * laplacian * dt_s)
    b_d = integral * (dt_s * inverse_c)[None, None, :]
    return Lptn(a_d, b_d, b_d @ boundary, dt_s, grid_rpm)
