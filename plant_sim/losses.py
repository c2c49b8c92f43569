"""Loss components of the machine and where their heat goes."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sqrt, tanh

import numpy as np
from numpy.typing import NDArray

from plant_sim.dq_map import DqMap
from plant_sim.network import Network
from plant_sim.nodes import INDEX, N_NODES, SIDES, SLICES, THETA_R
from plant_sim.params import PlantParams

SPLIT_COLUMNS = ("teeth", "yoke", "rotor_fe", "magnet", "bearing", "windage")


@dataclass(frozen=True)
class Losses:
    """Total of each loss component in W."""

    copper_dc_w: float
    copper_ac_w: float
    teeth_w: float
    yoke_w: float
    rotor_fe_w: float
    magnet_w: float
    bearing_w: float
    windage_w: float

    @property
    def mechanical_w(self) -> float:
        """Bearings and windage."""
        return self.bearing_w + self.windage_w

    @property
    def total_w(self) -> float:
        """Sum of all components."""
        return (
            self.copper_dc_w
            + self.copper_ac_w
            + self.teeth_w
            + self.yoke_w
            + self.rotor_fe_w
            + self.magnet_w
            + self.mechanical_w
        )


class LossModel:
    """Losses at one operating point as heat into the nodes.

    Parameters
    ----------
    params, network, dq_map
        The machine; copper volumes come from the network so that losses and capacities share one geometry.
    """

    def __init__(self, params: PlantParams, network: Network, dq_map: DqMap) -> None:
        self.params, self.dq_map, self.copper_m3 = params, dq_map, network.copper_m3
        g, m = params.geometry, params.material
        iron = m.rho_fe * g.stack_factor
        self.teeth_kg = iron * g.slots * g.tooth_width_m * (g.r_slot_bottom_m - g.r_bore_m) * g.stack_m
        self.yoke_kg = iron * pi * (g.r_stator_m**2 - g.r_slot_bottom_m**2) * g.stack_m
        slot_copper = g.slot_fill * g.slot_area_m2
        self.j_per_a = params.machine.turns_series * 6.0 / (g.slots * slot_copper) / sqrt(2.0)
        self.ac_volume_m3 = g.slots * slot_copper * g.stack_m
        self.ac_share = _ac_share(params.loss.ac_inner)
        self.split = heat_split()

    def heat(
        self, theta_degc: NDArray[np.float64], torque_nm: float, speed_rpm: float
    ) -> tuple[NDArray[np.float64], Losses]:
        """Return heat per node in W (70,) and the component totals.

        Parameters
        ----------
        theta_degc
            Node temperatures (70,): copper uses its local temperature, the flux map the magnet mean.
        torque_nm, speed_rpm
            Held over the step; the sign of torque does not matter.
        """
        p, c, m = self.params, self.params.loss, self.params.material
        theta_r = (theta_degc[THETA_R[0]] + theta_degc[THETA_R[1]] + theta_degc[THETA_R[2]]) / 3.0
        current, psi, minus_id = self.dq_map.lookup(theta_r, torque_nm, speed_rpm)
        n = abs(speed_rpm)
        f_hz, nu, omega = p.machine.pole_pairs * n / 60.0, n / c.n_base_rpm, n * pi / 30.0
        load = (current / p.machine.i_max_a) ** 2
        density2 = (self.j_per_a * current) ** 2
        resist = 1.0 + m.alpha_cu_1_k * (theta_degc - 20.0)
        dc = m.rho_el20_ohm_m * density2 * self.copper_m3 * resist
        ac = (
            m.rho_el20_ohm_m
            * density2
            * self.ac_volume_m3
            * c.k_ac
            * (f_hz / c.f_ac_hz) ** 2
            * self.ac_share
            / resist
        )
        harmonic = 1.0 + c.harmonics * (minus_id / p.machine.i_max_a) * nu
        b_tooth = c.b_tooth_t * tanh(c.b_tooth_slope * psi / c.psi_base_vs)
        b_yoke = c.b_yoke_t * tanh(c.b_yoke_slope * psi / c.psi_base_vs)
        teeth = self._iron(f_hz, b_tooth) * self.teeth_kg * c.kb_fe * harmonic
        yoke = self._iron(f_hz, b_yoke) * self.yoke_kg * c.kb_fe
        rotor = (c.rotor_fe0_w + c.rotor_fe1_w * load) * nu**c.rotor_fe_exp
        magnet = (c.magnet0_w + c.magnet1_w * load) * nu**c.magnet_exp
        bearing = 2.0 * (c.bearing0_nm + c.bearing1_nms * omega) * omega
        windage = (
            c.windage_cf * pi * m.rho_air_kg_m3 * omega**3 * p.geometry.r_rotor_m**4 * p.geometry.stack_m
        )
        heat = dc + ac + self.split @ np.array([teeth, yoke, rotor, magnet, bearing, windage])
        return heat, Losses(float(dc.sum()), float(ac.sum()), teeth, yoke, rotor, magnet, bearing, windage)

    def _iron(self, f_hz: float, b_t: float) -> float:
        """Specific iron loss in W/kg (hysteresis, eddy, excess)."""
        c = self.params.loss
        return c.kh * f_hz * b_t**2 + c.kc * (f_hz * b_t) ** 2 + c.ke * (f_hz * b_t) ** 1.5


def heat_split() -> NDArray[np.float64]:
    """Share of each non-copper component that enters each node, (70, 6) in the order of SPLIT_COLUMNS."""
    split = np.zeros((N_NODES, len(SPLIT_COLUMNS)))
    for s in SLICES:
        for name, column, share in (
            ("T1", 0, 0.40),
            ("T2", 0, 0.60),
            ("YO", 1, 0.45),
            ("YI", 1, 0.55),
            ("RS", 2, 0.85),
            ("RC", 2, 0.15),
            ("MG", 3, 1.0),
            ("AG", 5, 1.0),
        ):
            split[INDEX[f"{name}_{s}"], column] = share / 3.0
    for s in SIDES:
        split[INDEX[f"BI_{s}"], 4] = split[INDEX[f"BO_{s}"], 4] = 0.25
    return split


def _ac_share(inner: float) -> NDArray[np.float64]:
    """Share of the proximity loss in each node (70,): slot winding only, inner layer first."""
    share = np.zeros(N_NODES)
    for s in SLICES:
        for name in ("WIp", "WIc"):
            share[INDEX[f"{name}_{s}"]] = inner / 6.0
        for name in ("WOp", "WOc"):
            share[INDEX[f"{name}_{s}"]] = (1.0 - inner) / 6.0
    return share
