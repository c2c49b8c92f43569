"""Conductances of the machine, derived from geometry and material.

A plane wall gives k A / d, a cylinder shell 2 pi k L / ln(r_o / r_i); resistances in series add. Convection
follows Gnielinski (jacket), Becker and Kaye (air gap) and Schubert (end space).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from plant_sim.capacities import (
    capacities_j_k,
    copper_area_m2,
    copper_volumes_m3,
    end_lengths_m,
    ring_m2,
    yoke_split_m,
)
from plant_sim.errors import ParameterError
from plant_sim.nodes import AMBIENT, COOLANT, GEARBOX, INDEX, N_NODES, SIDES, SLICES
from plant_sim.params import PlantParams

Link = tuple[str, str, float]


@dataclass(frozen=True)
class Network:
    """The thermal network at every speed: C dtheta/dt = -L(n) theta + P + B(n) theta_b."""

    params: PlantParams
    capacity_j_k: NDArray[np.float64]
    copper_m3: NDArray[np.float64]
    static: tuple[Link, ...]
    advection_w_k: float

    def matrices(self, speed_rpm: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return L (70, 70) and B (70, 3), both W/K, at one rotor speed."""
        laplacian = np.zeros((N_NODES, N_NODES))
        boundary = np.zeros((N_NODES, 3))
        for a, b, g in (*self.static, *speed_links(self.params, speed_rpm)):
            i, j = INDEX[a], INDEX[b]
            laplacian[i, i] += g
            laplacian[j, j] += g
            laplacian[i, j] -= g
            laplacian[j, i] -= g
        # Coolant flows NDE -> M -> DE: each cell is cooled by the one upstream, never the other way round.
        upstream = None
        for s in ("NDE", "M", "DE"):
            i = INDEX[f"CO_{s}"]
            laplacian[i, i] += self.advection_w_k
            if upstream is None:
                boundary[i, COOLANT] += self.advection_w_k
            else:
                laplacian[i, upstream] -= self.advection_w_k
            upstream = i
        for name, column, g in boundary_links(self.params, speed_rpm):
            i = INDEX[name]
            laplacian[i, i] += g
            boundary[i, column] += g
        return laplacian, boundary


def build_network(params: PlantParams) -> Network:
    """Derive capacities and speed-independent conductances from the parameters."""
    return Network(
        params,
        capacities_j_k(params),
        copper_volumes_m3(params),
        static_links(params),
        params.coolant.rho * params.coolant.flow_lpm / 60e3 * params.coolant.cp,
    )


def jacket_h(params: PlantParams) -> float:
    """Heat transfer coefficient of the coolant jacket in W/(m2 K) (Gnielinski; laminar floor Nu = 4.36)."""
    c = params.coolant
    if not c.flow_lpm > 0.0:
        raise ParameterError(
            f"coolant.flow_lpm = {c.flow_lpm} must be positive; for a dead pump use 0.1 L/min"
        )
    area, wetted = c.duct_width_m * c.duct_height_m, 2.0 * (c.duct_width_m + c.duct_height_m)
    d_h = 4.0 * area / wetted
    reynolds = c.rho * (c.flow_lpm / 60e3 / area) * d_h / c.mu_pa_s
    prandtl = c.cp * c.mu_pa_s / c.k
    nusselt = 4.36
    if reynolds > 1000.0:
        f8 = (0.79 * log(reynolds) - 1.64) ** -2 / 8.0
        turbulent = f8 * (reynolds - 1000.0) * prandtl / (1.0 + 12.7 * sqrt(f8) * (prandtl ** (2 / 3) - 1.0))
        nusselt = max(nusselt, turbulent)
    return c.enhancement * nusselt * c.k / d_h


def gap_h(params: PlantParams, speed_rpm: float) -> float:
    """Air-gap heat transfer coefficient in W/(m2 K) from the Taylor number (Becker and Kaye)."""
    g, omega = params.geometry, speed_rpm * pi / 30.0
    taylor = omega**2 * g.r_rotor_m * g.gap_m**3 / params.material.nu_air_m2_s**2
    if taylor < 1700.0:
        nusselt = 2.0
    elif taylor < 1e4:
        nusselt = 0.128 * taylor**0.367
    else:
        nusselt = 0.409 * taylor**0.241
    return max(nusselt, 2.0) * params.material.k_air / (2.0 * g.gap_m)


def end_space_h(params: PlantParams, speed_rpm: float) -> float:
    """End-space heat transfer coefficient in W/(m2 K) (Schubert form, fan speed = share of the rim speed)."""
    c = params.convection
    v = c.end_speed_share * speed_rpm * pi / 30.0 * params.geometry.r_rotor_m
    return c.end_h0_w_m2k * (1.0 + c.end_slope * v**c.end_exp)


def static_links(params: PlantParams) -> tuple[Link, ...]:
    """All conductances (W/K) that do not depend on speed."""
    links: list[Link] = []
    for s in SLICES:
        links += [(f"{a}_{s}", f"{b}_{s}", g) for a, b, g in _slice_links(params)]
        links.append((f"RC_{s}", "SHF_M", _core_to_shaft(params)))
    for s, t in (("DE", "M"), ("M", "NDE")):
        links += [(f"{name}_{s}", f"{name}_{t}", g) for name, g in _axial_links(params)]
    for s in SIDES:
        links += [(f"{a}_{s}", f"{b}_{s}", g) for a, b, g in _side_links(params)]
    return tuple(links)


def speed_links(params: PlantParams, speed_rpm: float) -> list[Link]:
    """Conductances (W/K) of the air gap and the end spaces at one rotor speed."""
    g, c = params.geometry, params.convection
    ls = g.stack_m / 3.0
    h_gap, h_end = gap_h(params, speed_rpm), end_space_h(params, speed_rpm)
    rotor = 2.0 * h_gap * 2.0 * pi * g.r_rotor_m * ls
    bore = 2.0 * h_gap * c.bore_share * 2.0 * pi * g.r_bore_m * ls
    mixing = c.mix_g0_w_k + c.mix_slope_w_k * speed_rpm / 1e4
    links: list[Link] = []
    for s in SLICES:
        links += [(f"AG_{s}", f"RS_{s}", rotor), (f"AG_{s}", f"T2_{s}", bore)]
    links += [("AG_DE", "AG_M", mixing), ("AG_M", "AG_NDE", mixing)]
    areas = {
        "ERO": c.area_root_outer_m2,
        "ERI": c.area_root_inner_m2,
        "ECO": c.area_crown_outer_m2,
        "ECI": c.area_crown_inner_m2,
        "SF": c.area_flange_m2,
        "OH": c.area_overhang_m2,
        "RP": c.area_end_plate_m2 * c.rotating_gain,
        "SHF": c.area_shaft_m2 * c.rotating_gain,
        "SH": c.area_hub_m2,
    }
    for s in SIDES:
        links.append((f"AG_{s}", f"EA_{s}", mixing))
        links += [(f"EA_{s}", f"{name}_{s}", h_end * area) for name, area in areas.items()]
    return links


def boundary_links(params: PlantParams, speed_rpm: float) -> list[tuple[str, int, float]]:
    """Conductances (W/K) from nodes to ambient and gearbox; the airstream follows the vehicle speed."""
    g, c, v = params.geometry, params.convection, params.vehicle
    v_mps = speed_rpm * pi / 30.0 * v.wheel_radius_m / v.gear_ratio
    h = c.ambient_h0_w_m2k + c.ambient_slope * v_mps**c.ambient_exp
    r_out = g.r_stator_m + g.t_housing_inner_m + g.jacket_height_m + g.t_housing_outer_m
    links = [(f"HO_{s}", AMBIENT, h * 2.0 * pi * r_out * g.stack_m / 3.0) for s in SLICES]
    links += [(f"OH_{s}", AMBIENT, h * 2.0 * pi * r_out * g.overhang_m) for s in SIDES]
    links.append(("SF_NDE", AMBIENT, h * c.flange_outer_area_m2))
    links += [
        ("SF_DE", GEARBOX, params.contact.g_flange_gear_w_k),
        ("SHF_DE", GEARBOX, params.contact.g_shaft_gear_w_k),
    ]
    return links


def _series(*conductances: float) -> float:
    return 1.0 / sum(1.0 / g for g in conductances)


def _shell(k: float, length: float, r_in: float, r_out: float) -> float:
    return 2.0 * pi * k * length / log(r_out / r_in)


def _slice_links(params: PlantParams) -> list[Link]:
    g, m, c = params.geometry, params.material, params.contact
    ls = g.stack_m / 3.0
    r_hi, split = g.r_stator_m + g.t_housing_inner_m, yoke_split_m(params)
    r_jacket = r_hi + g.jacket_height_m
    r_hi_mid, r_yo, r_yi = (
        g.r_stator_m + g.t_housing_inner_m / 2,
        (split + g.r_stator_m) / 2,
        (split + g.r_slot_bottom_m) / 2,
    )
    h_c = jacket_h(params) * params.coolant.cover
    tooth_area = g.slots * g.tooth_width_m * ls * g.stack_factor
    half_tooth = (g.r_slot_bottom_m - g.r_bore_m) / 2
    side = 2.0 * (g.slot_height_m / 2) * ls * g.slots
    half_slot = g.slots * g.slot_width_m / 2 * ls
    liner = c.t_liner_m / c.k_liner + c.t_liner_gap_m / m.k_air
    quarter = g.slot_height_m / 4 / m.k_winding
    to_tooth = side / (g.slot_width_m / 8 / m.k_winding + liner)
    to_yoke = half_slot / (quarter + liner)
    to_gap = half_slot / (quarter + c.r_wedge_m2k_w + 1.0 / c.h_wedge_w_m2k)
    layers = m.k_winding * half_slot / (g.slot_height_m / 2)
    core_periphery = m.k_winding * side / (g.slot_width_m / 4)
    magnet = (
        g.magnet_count * g.magnet_width_m * ls / (c.t_glue_m / c.k_glue + g.magnet_half_path_m / m.k_magnet)
    )
    return [
        ("CO", "HI", _series(h_c * 2 * pi * r_hi * ls, _shell(m.k_al, ls, r_hi_mid, r_hi))),
        ("CO", "HO", h_c * 2 * pi * r_jacket * ls),
        (
            "HI",
            "YO",
            _series(
                m.k_air / c.g_stack_housing_m * 2 * pi * g.r_stator_m * ls,
                _shell(m.k_al, ls, g.r_stator_m, r_hi_mid),
                _shell(m.k_fe_radial, ls, r_yo, g.r_stator_m),
            ),
        ),
        ("YO", "YI", _shell(m.k_fe_radial, ls, r_yi, r_yo)),
        (
            "YI",
            "T1",
            _series(
                m.k_fe_radial * tooth_area / (half_tooth / 2),
                _shell(m.k_fe_radial, ls, g.r_slot_bottom_m, r_yi),
            ),
        ),
        ("T1", "T2", m.k_fe_radial * tooth_area / half_tooth),
        ("WOc", "WOp", core_periphery),
        ("WIc", "WIp", core_periphery),
        ("WOp", "T1", to_tooth),
        ("WIp", "T2", to_tooth),
        ("WOp", "WIp", layers),
        ("WOc", "WIc", layers),
        ("WOp", "YI", to_yoke),
        ("WOc", "YI", to_yoke),
        ("WIp", "AG", to_gap),
        ("WIc", "AG", to_gap),
        ("RS", "MG", magnet),
        ("MG", "RC", magnet),
        ("RS", "RC", g.rim_core_share * _shell(m.k_fe_radial, ls, g.r_core_mid_m, g.r_rim_mid_m)),
    ]


def _core_to_shaft(params: PlantParams) -> float:
    g, ls = params.geometry, params.geometry.stack_m / 3.0
    return _series(
        params.contact.h_core_shaft_w_m2k * 2 * pi * g.r_shaft_m * ls,
        g.core_shaft_share * _shell(params.material.k_fe_radial, ls, g.r_shaft_m, g.r_core_to_shaft_m),
    )


def _axial_links(params: PlantParams) -> list[tuple[str, float]]:
    g, m = params.geometry, params.material
    ls, split = g.stack_m / 3.0, yoke_split_m(params)
    r_hi = g.r_stator_m + g.t_housing_inner_m
    r_jacket = r_hi + g.jacket_height_m
    tooth = g.slots * g.tooth_width_m * (g.r_slot_bottom_m - g.r_bore_m) / 2
    copper = m.k_cu * copper_area_m2(params) / 4 / ls
    return [
        ("HI", m.k_al * ring_m2(g.r_stator_m, r_hi) / ls),
        ("HO", m.k_al * ring_m2(r_jacket, r_jacket + g.t_housing_outer_m) / ls),
        ("YO", m.k_fe_axial * ring_m2(split, g.r_stator_m) / ls),
        ("YI", m.k_fe_axial * ring_m2(g.r_slot_bottom_m, split) / ls),
        ("T1", m.k_fe_axial * tooth / ls),
        ("T2", m.k_fe_axial * tooth / ls),
        ("WOp", copper),
        ("WOc", copper),
        ("WIp", copper),
        ("WIc", copper),
        ("RS", m.k_fe_axial * ring_m2(g.r_rim_m, g.r_rotor_m) / ls),
        ("MG", m.k_magnet * g.magnet_count * g.magnet_width_m * g.magnet_thickness_m / ls),
        ("RC", m.k_fe_axial * g.rotor_solid * ring_m2(g.r_shaft_m, g.r_rim_m) / ls),
        ("SHF", m.k_steel * pi * g.r_shaft_m**2 / ((g.shaft_end_m + g.stack_m) / 2)),
    ]


def _side_links(params: PlantParams) -> list[Link]:
    g, m, c = params.geometry, params.material, params.contact
    layer = copper_area_m2(params) / 2
    ls = g.stack_m / 3.0
    root, crown = end_lengths_m(params)
    to_root = m.k_cu * layer / 2 / (ls / 2 + root / 2)
    to_crown = m.k_cu * layer / (root / 2 + crown / 2)
    r_hi = g.r_stator_m + g.t_housing_inner_m
    r_jacket = r_hi + g.jacket_height_m
    overlap = (ls + g.overhang_m) / 2
    return [
        ("WOp", "ERO", to_root),
        ("WOc", "ERO", to_root),
        ("WIp", "ERI", to_root),
        ("WIc", "ERI", to_root),
        ("ERO", "ECO", to_crown),
        ("ERI", "ECI", to_crown),
        ("ERO", "ERI", c.g_root_layers_w_k),
        ("ECO", "ECI", c.g_crown_layers_w_k),
        ("ECO", "OH", c.g_crown_overhang_w_k),
        ("ERO", "OH", c.g_root_overhang_w_k),
        ("SH", "SF", c.g_hub_flange_w_k),
        ("SF", "OH", c.g_flange_overhang_w_k),
        ("BO", "SH", c.g_outer_race_hub_w_k),
        ("BI", "BO", c.g_bearing_w_k),
        ("BI", "SHF", c.g_inner_race_shaft_w_k),
        ("OH", "HI", m.k_al * ring_m2(g.r_stator_m, r_hi) / overlap),
        ("OH", "HO", m.k_al * ring_m2(r_jacket, r_jacket + g.t_housing_outer_m) / overlap),
        ("CO", "OH", jacket_h(params) * 2 * pi * r_hi * g.overhang_jacket_m),
        ("RP", "RC", c.g_end_plate_core_w_k),
        ("RP", "RS", c.g_end_plate_rim_w_k),
        ("RP", "MG", c.g_end_plate_magnet_w_k),
    ]
