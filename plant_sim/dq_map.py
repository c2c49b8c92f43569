"""Stator current and flux of the machine at every (magnet temperature, torque, speed).

Minimum current that meets torque and voltage limit: torque-per-ampere, field weakening and the
magnet-temperature coupling come out of one search over i_d.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from plant_sim.params import MachineParams

THETA_GRID = np.array([20.0, 80.0, 140.0, 200.0])
TORQUE_STEP_NM, TORQUE_MAX_NM = 5.0, 165.0
SPEED_STEP_RPM, SPEED_MAX_RPM = 200.0, 11200.0
_N_ID = 681


@dataclass(frozen=True, eq=False)
class DqMap:
    """Tabulated operating points.

    Attributes
    ----------
    table
        (4, 34, 57, 3): phase current peak in A, flux linkage in Vs, -i_d in A, over (theta_m, |T|, n).
    feasible
        (4, 34, 57): whether the voltage limit could be met; elsewhere the entry is the point of least
        voltage.
    """

    table: NDArray[np.float64]
    feasible: NDArray[np.bool_]

    def lookup(self, theta_m_degc: float, torque_nm: float, speed_rpm: float) -> tuple[float, float, float]:
        """Trilinear look-up of (|i| A, psi Vs, -i_d A); the sign of torque is ignored, edges are held."""
        i, u = _position((theta_m_degc - THETA_GRID[0]) / 60.0, 4)
        j, v = _position(abs(torque_nm) / TORQUE_STEP_NM, self.table.shape[1])
        k, w = _position(abs(speed_rpm) / SPEED_STEP_RPM, self.table.shape[2])
        cell = self.table[i : i + 2, j : j + 2, k : k + 2]
        plane = cell[0] * (1.0 - u) + cell[1] * u
        line = plane[0] * (1.0 - v) + plane[1] * v
        current, psi, minus_id = line[0] * (1.0 - w) + line[1] * w
        return float(current), float(psi), float(minus_id)


def _position(x: float, count: int) -> tuple[int, float]:
    x = min(max(x, 0.0), count - 1.0)
    i = min(int(x), count - 2)
    return i, x - i


@lru_cache(maxsize=8)
def build_dq_map(m: MachineParams) -> DqMap:
    """Search the operating points (about 0.5 s; cached by parameters)."""
    torque = np.arange(0.0, TORQUE_MAX_NM + 1.0, TORQUE_STEP_NM)
    speed = np.arange(0.0, SPEED_MAX_RPM + 1.0, SPEED_STEP_RPM)
    i_d = np.linspace(-m.i_max_a, 0.0, _N_ID)
    u_max = m.u_use * m.u_dc_v / np.sqrt(3.0)
    omega_e = np.maximum(speed * np.pi / 30.0 * m.pole_pairs, 1e-9)
    table = np.empty((len(THETA_GRID), len(torque), len(speed), 3))
    feasible = np.empty(table.shape[:3], dtype=bool)
    for a, theta in enumerate(THETA_GRID):
        psi_m = m.psi_m20_vs * (1.0 + m.alpha_psi_1_k * (theta - 20.0))
        i_q = torque[:, None] / (1.5 * m.pole_pairs * (psi_m + (m.l_d_h - m.l_q_h) * i_d))
        current = np.hypot(i_d, i_q)
        psi = np.hypot(psi_m + m.l_d_h * i_d, m.l_q_h * i_q)
        for k in range(len(speed)):
            ok = psi * omega_e[k] <= u_max
            any_ok = ok.any(axis=1)
            best = np.where(any_ok, np.argmin(np.where(ok, current, np.inf), axis=1), np.argmin(psi, axis=1))
            rows = np.arange(len(torque))
            table[a, :, k] = np.stack([current[rows, best], psi[rows, best], -i_d[best]], axis=-1)
            feasible[a, :, k] = any_ok
    return DqMap(table, feasible)
