"""Heat capacities and copper volumes of the nodes, and the measures they share with the conductances."""

from __future__ import annotations

from math import pi

import numpy as np
from numpy.typing import NDArray

from plant_sim.nodes import INDEX, N_NODES, SIDES, SLICES
from plant_sim.params import PlantParams


def ring_m2(r_in: float, r_out: float) -> float:
    """Area of a ring in m2."""
    return pi * (r_out**2 - r_in**2)


def yoke_split_m(params: PlantParams) -> float:
    """Radius between inner and outer yoke node in m."""
    return 0.5 * (params.geometry.r_slot_bottom_m + params.geometry.r_stator_m)


def copper_area_m2(params: PlantParams) -> float:
    """Copper cross-section of all slots in m2."""
    return params.geometry.slots * params.geometry.slot_fill * params.geometry.slot_area_m2


def end_lengths_m(params: PlantParams) -> tuple[float, float]:
    """Lengths of root and crown of one layer's end winding in m."""
    half = params.geometry.end_turn_m / 2.0
    return params.geometry.root_share * half, (1.0 - params.geometry.root_share) * half


def copper_volumes_m3(params: PlantParams) -> NDArray[np.float64]:
    """Copper volume of each node in m3 (70,), zero where there is none."""
    volume = np.zeros(N_NODES)
    area, ls = copper_area_m2(params), params.geometry.stack_m / 3.0
    root, crown = end_lengths_m(params)
    for s in SLICES:
        for name in ("WOp", "WOc", "WIp", "WIc"):
            volume[INDEX[f"{name}_{s}"]] = area / 4 * ls
    for s in SIDES:
        for layer in "OI":
            volume[INDEX[f"ER{layer}_{s}"]] = area / 2 * root
            volume[INDEX[f"EC{layer}_{s}"]] = area / 2 * crown
    return volume


def capacities_j_k(params: PlantParams) -> NDArray[np.float64]:
    """Heat capacity of each node in J/K (70,)."""
    g, m = params.geometry, params.material
    ls, split = g.stack_m / 3.0, yoke_split_m(params)
    r_hi = g.r_stator_m + g.t_housing_inner_m
    r_jacket, r_out = r_hi + g.jacket_height_m, r_hi + g.jacket_height_m + g.t_housing_outer_m
    fe, al, steel = m.rho_fe * m.c_fe * g.stack_factor, m.rho_al * m.c_al, m.rho_steel * m.c_steel
    tooth = fe * g.slots * g.tooth_width_m * (g.r_slot_bottom_m - g.r_bore_m) / 2 * ls
    cap: dict[str, float] = {}
    for s in SLICES:
        cap |= {
            f"CO_{s}": params.coolant.rho
            * params.coolant.cp
            * ring_m2(r_hi, r_jacket)
            * ls
            * params.coolant.cover,
            f"HI_{s}": al * ring_m2(g.r_stator_m, r_hi) * ls,
            f"YO_{s}": fe * ring_m2(split, g.r_stator_m) * ls,
            f"YI_{s}": fe * ring_m2(g.r_slot_bottom_m, split) * ls,
            f"T1_{s}": tooth,
            f"T2_{s}": tooth,
            f"AG_{s}": g.gap_capacity_j_k,
            f"RS_{s}": fe * g.rim_solid * ring_m2(g.r_rim_m, g.r_rotor_m) * ls,
            f"MG_{s}": g.magnet_mass_kg / 3 * m.c_magnet,
            f"RC_{s}": fe * g.rotor_solid * ring_m2(g.r_shaft_m, g.r_rim_m) * ls,
            f"HO_{s}": al * ring_m2(r_jacket, r_out) * ls,
            f"SHF_{s}": steel * pi * g.r_shaft_m**2 * (g.stack_m if s == "M" else g.shaft_end_m),
        }
    for s in SIDES:
        cap |= {
            f"EA_{s}": m.rho_air_kg_m3 * m.c_air * g.end_air_volume_m3,
            f"SF_{s}": g.flange_mass_kg * m.c_al,
            f"SH_{s}": g.hub_mass_kg * m.c_al,
            f"BI_{s}": g.bearing_inner_mass_kg * m.c_steel,
            f"BO_{s}": g.bearing_outer_mass_kg * m.c_steel,
            f"RP_{s}": g.end_plate_mass_kg * m.c_al,
            f"OH_{s}": al * ring_m2(g.r_stator_m, r_out) * g.overhang_m * g.overhang_solid,
        }
    out = np.zeros(N_NODES)
    for name, value in cap.items():
        out[INDEX[name]] = value
    # Winding nodes: copper plus the wetted share of the resin in the remaining slot space.
    copper = copper_volumes_m3(params)
    for name, i in INDEX.items():
        if copper[i] > 0.0:
            share = m.resin_share_slot if name.startswith("W") else m.resin_share_end
            resin = copper[i] * (1.0 / g.slot_fill - 1.0) * share
            out[i] = copper[i] * m.rho_cu * m.c_cu + resin * m.rho_resin * m.c_resin
    return out
