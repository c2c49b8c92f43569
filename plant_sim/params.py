"""Physical parameters of vehicle, machine, thermal network and sensor as frozen dataclasses.

The figures live in ``params.json`` beside this file; units are in the names, SI where a name carries none.
A mismatch variant (hot coolant, half flow, aged liner) is a changed figure, see `PlantParams.varied`.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from plant_sim.errors import ParameterError


@dataclass(frozen=True)
class VehicleParams:
    """Longitudinal vehicle (mass, drag, wheel, gear)."""

    mass_kg: float
    drag_coeff: float
    frontal_area_m2: float
    roll_coeff: float
    wheel_radius_m: float
    gear_ratio: float
    v_max_mps: float
    rho_air_kg_m3: float
    gravity_mps2: float


@dataclass(frozen=True)
class MachineParams:
    """Electric machine: torque envelope and dq parameters (peak-phase values)."""

    torque_max_nm: float
    power_max_w: float
    regen_torque_max_nm: float
    regen_power_max_w: float
    regen_v_lo_mps: float
    regen_v_hi_mps: float
    torque_lag_s: float
    pole_pairs: int
    psi_m20_vs: float
    alpha_psi_1_k: float
    l_d_h: float
    l_q_h: float
    u_dc_v: float
    u_use: float
    i_max_a: float
    turns_series: int


@dataclass(frozen=True)
class DriverParams:
    """PI driver; torques at the machine shaft."""

    kp_nm_per_mps: float
    ki_nm_per_m: float
    u_min_nm: float
    u_max_nm: float
    integral_max_nm: float
    lookahead_m: float


@dataclass(frozen=True)
class GeometryParams:
    """Machine geometry; radii grow outwards from the shaft."""

    slots: int
    stack_m: float
    r_shaft_m: float
    r_rim_m: float
    r_rotor_m: float
    gap_m: float
    r_bore_m: float
    r_slot_bottom_m: float
    r_stator_m: float
    tooth_width_m: float
    slot_height_m: float
    slot_width_m: float
    slot_fill: float
    slot_area_m2: float
    end_turn_m: float
    root_share: float
    t_housing_inner_m: float
    jacket_height_m: float
    t_housing_outer_m: float
    overhang_m: float
    stack_factor: float
    rotor_solid: float
    rim_solid: float
    magnet_mass_kg: float
    magnet_count: int
    magnet_width_m: float
    magnet_thickness_m: float
    magnet_half_path_m: float
    r_rim_mid_m: float
    r_core_mid_m: float
    r_core_to_shaft_m: float
    rim_core_share: float
    core_shaft_share: float
    shaft_end_m: float
    overhang_solid: float
    overhang_jacket_m: float
    end_plate_mass_kg: float
    flange_mass_kg: float
    hub_mass_kg: float
    bearing_inner_mass_kg: float
    bearing_outer_mass_kg: float
    end_air_volume_m3: float
    gap_capacity_j_k: float


@dataclass(frozen=True)
class MaterialParams:
    """Thermal and electrical material constants; k in W/(m K), rho in kg/m3, c in J/(kg K)."""

    k_cu: float
    rho_cu: float
    c_cu: float
    k_fe_radial: float
    k_fe_axial: float
    rho_fe: float
    c_fe: float
    k_al: float
    rho_al: float
    c_al: float
    k_magnet: float
    rho_magnet: float
    c_magnet: float
    k_steel: float
    rho_steel: float
    c_steel: float
    k_air: float
    nu_air_m2_s: float
    rho_air_kg_m3: float
    c_air: float
    k_winding: float
    rho_resin: float
    c_resin: float
    resin_share_slot: float
    resin_share_end: float
    rho_el20_ohm_m: float
    alpha_cu_1_k: float


@dataclass(frozen=True)
class ContactParams:
    """Interface resistances and conductances that no formula gives."""

    g_stack_housing_m: float
    h_core_shaft_w_m2k: float
    t_glue_m: float
    k_glue: float
    t_liner_m: float
    k_liner: float
    t_liner_gap_m: float
    r_wedge_m2k_w: float
    h_wedge_w_m2k: float
    g_bearing_w_k: float
    g_shaft_gear_w_k: float
    g_flange_gear_w_k: float
    g_crown_overhang_w_k: float
    g_root_overhang_w_k: float
    g_root_layers_w_k: float
    g_crown_layers_w_k: float
    g_hub_flange_w_k: float
    g_flange_overhang_w_k: float
    g_outer_race_hub_w_k: float
    g_inner_race_shaft_w_k: float
    g_end_plate_core_w_k: float
    g_end_plate_rim_w_k: float
    g_end_plate_magnet_w_k: float


@dataclass(frozen=True)
class CoolantParams:
    """Glycol jacket: helical duct, 50/50 water-glycol."""

    flow_lpm: float
    rho: float
    cp: float
    k: float
    mu_pa_s: float
    duct_width_m: float
    duct_height_m: float
    cover: float
    enhancement: float


@dataclass(frozen=True)
class ConvectionParams:
    """End-space, air-gap and ambient convection."""

    end_h0_w_m2k: float
    end_slope: float
    end_exp: float
    end_speed_share: float
    area_root_outer_m2: float
    area_root_inner_m2: float
    area_crown_outer_m2: float
    area_crown_inner_m2: float
    area_flange_m2: float
    area_overhang_m2: float
    area_end_plate_m2: float
    area_shaft_m2: float
    area_hub_m2: float
    rotating_gain: float
    bore_share: float
    mix_g0_w_k: float
    mix_slope_w_k: float
    ambient_h0_w_m2k: float
    ambient_slope: float
    ambient_exp: float
    flange_outer_area_m2: float


@dataclass(frozen=True)
class BoundaryParams:
    """Temperatures that the surroundings impose."""

    coolant_degc: float
    ambient_degc: float
    gearbox_degc: float


@dataclass(frozen=True)
class LossParams:
    """Loss model coefficients."""

    k_ac: float
    f_ac_hz: float
    ac_inner: float
    kb_fe: float
    kh: float
    kc: float
    ke: float
    b_tooth_t: float
    b_tooth_slope: float
    b_yoke_t: float
    b_yoke_slope: float
    psi_base_vs: float
    harmonics: float
    n_base_rpm: float
    rotor_fe0_w: float
    rotor_fe1_w: float
    rotor_fe_exp: float
    magnet0_w: float
    magnet1_w: float
    magnet_exp: float
    bearing0_nm: float
    bearing1_nms: float
    windage_cf: float


@dataclass(frozen=True)
class SensorParams:
    """Nominal temperature sensor."""

    delay_s: float
    mean_k: float
    variance_k2: float
    period_s: float


@dataclass(frozen=True)
class PlantParams:
    """Everything physical that the plant needs; hashable, so derived tables can be cached by it."""

    vehicle: VehicleParams
    machine: MachineParams
    driver: DriverParams
    geometry: GeometryParams
    material: MaterialParams
    contact: ContactParams
    coolant: CoolantParams
    convection: ConvectionParams
    boundary: BoundaryParams
    loss: LossParams
    sensor: SensorParams

    def varied(self, **changes: float) -> PlantParams:
        """Return a copy with some figures replaced.

        Parameters
        ----------
        **changes
            ``group__name=value``, e.g. ``coolant__flow_lpm=3.0`` or ``loss__k_ac=1.65``.

        Raises
        ------
        ParameterError
            If a name does not exist or a value is not a finite number.
        """
        grouped: dict[str, dict[str, float]] = {}
        for key, value in changes.items():
            group, _, name = key.partition("__")
            known = (
                {f.name for f in dataclasses.fields(getattr(self, group))} if hasattr(self, group) else set()
            )
            if name not in known:
                raise ParameterError(
                    f"plant parameter '{key}' does not exist: use group__name with a group of "
                    f"{', '.join(f.name for f in dataclasses.fields(self))}"
                )
            _require_finite(key, value)
            grouped.setdefault(group, {})[name] = value
        groups: dict[str, Any] = {g: dataclasses.replace(getattr(self, g), **c) for g, c in grouped.items()}
        return dataclasses.replace(self, **groups)


def load_params(path: str | Path | None = None) -> PlantParams:
    """Read the parameter file (default: the one shipped with the package).

    Raises
    ------
    ParameterError
        If the file is missing, is no JSON, or lacks or adds a figure.
    """
    source = Path(path) if path is not None else Path(__file__).with_name("params.json")
    try:
        raw = json.loads(source.read_text(encoding="utf-8"))
    except OSError as error:
        raise ParameterError(
            f"{source}: cannot read plant parameters ({error.strerror}); check the path"
        ) from error
    except json.JSONDecodeError as error:
        raise ParameterError(
            f"{source}:{error.lineno}: not valid JSON ({error.msg}); repair the file"
        ) from error
    if not isinstance(raw, dict):
        raise ParameterError(f"{source}: top level must be an object of parameter groups")
    groups = {}
    for group, cls in _GROUPS.items():
        groups[group] = _build(source, group, cls, raw.get(group))
    unknown = set(raw) - set(_GROUPS)
    if unknown:
        raise ParameterError(f"{source}: unknown groups {sorted(unknown)}; remove or rename them")
    return PlantParams(**groups)


def _build(source: Path, group: str, cls: type, values: object) -> Any:
    """Make one parameter group from its JSON object."""
    names = {f.name for f in dataclasses.fields(cls)}
    if not isinstance(values, dict):
        raise ParameterError(f"{source}: group '{group}' is missing; it needs {sorted(names)}")
    if set(values) != names:
        raise ParameterError(
            f"{source}: group '{group}': missing {sorted(names - set(values))}, "
            f"unknown {sorted(set(values) - names)}"
        )
    for name, value in values.items():
        _require_finite(f"{source}: {group}.{name}", value)
    return cls(**values)


def _require_finite(where: str, value: object) -> None:
    """Refuse anything but a finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e12:
        raise ParameterError(f"{where} = {value!r} is not a finite number")


_GROUPS = {
    "vehicle": VehicleParams,
    "machine": MachineParams,
    "driver": DriverParams,
    "geometry": GeometryParams,
    "material": MaterialParams,
    "contact": ContactParams,
    "coolant": CoolantParams,
    "convection": ConvectionParams,
    "boundary": BoundaryParams,
    "loss": LossParams,
    "sensor": SensorParams,
}
