"""Four-node thermal network of the machine: winding, teeth, yoke, rotor; what a manufacturer without the net would use.

Heat from the loss maps a manufacturer has (torque, speed), computed at a magnet temperature of 110 °C; coolant taken at
its rated 65 °C. Thirteen parameters, fitted by `tune.py` to training drives:

    C_w dw = P_cu (1 + a (w - 20)) + P_ac / (1 + a (w - 20)) - G_wt (w - t) - G_wr (w - r) - G_we (w - 65)
    C_t dt = P_teeth + G_wt (w - t) - G_ty (t - y) - G_tr (t - r)
    C_y dy = P_yoke + G_ty (t - y) - G_yc (y - 65)
    C_r dr = P_rotor + P_mech / 2 + G_tr (t - r) + G_wr (w - r) - G_rc (r - 65)

with G_wr, G_tr, G_we linear in speed. Copper losses P_cu, P_ac are referred to 20 °C.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tools.estimators.jit import compiled

Array = NDArray[np.float64]
NODES = 4  # winding, teeth, yoke, rotor
ROTOR = 3
COOLANT_DEGC = 65.0
ALPHA_1_K = 3.93e-3
DT_S = 0.1
MAP_THETA_DEGC = 110.0
TORQUE_STEP_NM, TORQUES = 5.0, 34
SPEED_STEP_RPM, SPEEDS = 200.0, 57
HEATS = 5  # copper dc and ac at 20 degC, teeth, yoke, rotor with half the mechanical losses


class Lptn(NamedTuple):
    """Capacities in J/K and conductances in W/K; *1: per 10 000 rpm."""

    c_w: float
    c_t: float
    c_y: float
    c_r: float
    g_wt: float
    g_ty: float
    g_yc: float
    g_rc: float
    g_tr0: float
    g_tr1: float
    g_wr0: float
    g_wr1: float
    g_we0: float
    g_we1: float


@cache
def loss_map() -> Array:
    """(34, 57, 5) heat in W over |torque| and speed, of the machine as designed."""
    from plant_sim.dq_map import build_dq_map
    from plant_sim.losses import LossModel
    from plant_sim.network import build_network
    from plant_sim.nodes import N_NODES
    from plant_sim.params import load_params

    params = load_params()
    model = LossModel(params, build_network(params), build_dq_map(params.machine))
    theta = np.full(N_NODES, MAP_THETA_DEGC)
    resist = 1.0 + ALPHA_1_K * (MAP_THETA_DEGC - 20.0)
    table = np.empty((TORQUES, SPEEDS, HEATS))
    for i in range(TORQUES):
        for k in range(SPEEDS):
            p = model.heat(theta, i * TORQUE_STEP_NM, k * SPEED_STEP_RPM)[1]
            rotor = p.rotor_fe_w + p.magnet_w + 0.5 * p.mechanical_w
            table[i, k] = p.copper_dc_w / resist, p.copper_ac_w * resist, p.teeth_w, p.yoke_w, rotor
    return table


def heats(u: Array) -> Array:
    """Heat (n, 5) in W for inputs u (n, 2) in rpm and Nm; bilinear, edges held, the sign of torque ignored."""
    table = loss_map()
    v = np.clip(np.abs(u[:, 0]) / SPEED_STEP_RPM, 0.0, SPEEDS - 1.0)
    t = np.clip(np.abs(u[:, 1]) / TORQUE_STEP_NM, 0.0, TORQUES - 1.0)
    i, k = np.minimum(t.astype(int), TORQUES - 2), np.minimum(v.astype(int), SPEEDS - 2)
    a, b = (t - i)[:, None], (v - k)[:, None]
    low = table[i, k] * (1.0 - b) + table[i, k + 1] * b
    high = table[i + 1, k] * (1.0 - b) + table[i + 1, k + 1] * b
    return low * (1.0 - a) + high * a


@compiled
def step(p, speed_rpm, heat, theta, slope):
    """One explicit Euler step of theta (4,) in place; slope (4, 4) becomes the Jacobian of the step."""
    x = abs(speed_rpm) / 1.0e4
    g_tr, g_wr, g_we = p.g_tr0 + p.g_tr1 * x, p.g_wr0 + p.g_wr1 * x, p.g_we0 + p.g_we1 * x
    w, t, y, r = theta[0], theta[1], theta[2], theta[3]
    resist = 1.0 + ALPHA_1_K * (w - 20.0)
    flow_wt, flow_ty, flow_tr, flow_wr = p.g_wt * (w - t), p.g_ty * (t - y), g_tr * (t - r), g_wr * (w - r)
    copper = heat[0] * resist + heat[1] / resist
    a_w, a_t, a_y, a_r = DT_S / p.c_w, DT_S / p.c_t, DT_S / p.c_y, DT_S / p.c_r
    theta[0] = w + a_w * (copper - flow_wt - flow_wr - g_we * (w - COOLANT_DEGC))
    theta[1] = t + a_t * (heat[2] + flow_wt - flow_ty - flow_tr)
    theta[2] = y + a_y * (heat[3] + flow_ty - p.g_yc * (y - COOLANT_DEGC))
    theta[3] = r + a_r * (heat[4] + flow_tr + flow_wr - p.g_rc * (r - COOLANT_DEGC))
    warming = ALPHA_1_K * (heat[0] - heat[1] / resist**2)
    slope[0] = 1.0 + a_w * (warming - p.g_wt - g_wr - g_we), a_w * p.g_wt, 0.0, a_w * g_wr
    slope[1] = a_t * p.g_wt, 1.0 - a_t * (p.g_wt + p.g_ty + g_tr), a_t * p.g_ty, a_t * g_tr
    slope[2] = 0.0, a_y * p.g_ty, 1.0 - a_y * (p.g_ty + p.g_yc), 0.0
    slope[3] = a_r * g_wr, a_r * g_tr, 0.0, 1.0 - a_r * (g_tr + g_wr + p.g_rc)
