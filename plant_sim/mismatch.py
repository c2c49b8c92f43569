"""Plants that differ from the one the estimator's net was trained on: what differs, and names for campaigns."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from plant_sim.errors import ParameterError
from plant_sim.params import PlantParams


@dataclass(frozen=True)
class Mismatch:
    """How a plant differs from the nominal one; the defaults change nothing.

    Attributes
    ----------
    coolant_flow_share
        Coolant flow over nominal.
    coolant_degc
        Inlet temperature of the coolant from the start on; None: nominal. The nodes still start where they are told to.
    ac_loss_scale
        Proximity losses of the winding over nominal.
    resistance_scale
        Resistivity of the copper over nominal; scales the proximity losses, too.
    liner_contact_scale
        Thickness of the imperfect contact between slot liner and tooth over nominal: an aged liner has more.
    """

    coolant_flow_share: float = 1.0
    coolant_degc: float | None = None
    ac_loss_scale: float = 1.0
    resistance_scale: float = 1.0
    liner_contact_scale: float = 1.0

    def apply(self, params: PlantParams) -> PlantParams:
        """Return the parameters of the differing plant.

        Raises
        ------
        ParameterError
            If a scale is not positive, or the coolant is not liquid.
        """
        for name in ("coolant_flow_share", "ac_loss_scale", "resistance_scale", "liner_contact_scale"):
            if not 0.0 < getattr(self, name) <= 10.0:
                raise ParameterError(f"plant mismatch {name} = {getattr(self, name):g} must be above 0 and at most 10")
        if self.coolant_degc is not None and not -40.0 <= self.coolant_degc <= 120.0:
            raise ParameterError(f"plant mismatch coolant_degc = {self.coolant_degc:g} must lie in -40 to 120 degC")
        changes = {
            "coolant__flow_lpm": params.coolant.flow_lpm * self.coolant_flow_share,
            "loss__k_ac": params.loss.k_ac * self.ac_loss_scale,
            "material__rho_el20_ohm_m": params.material.rho_el20_ohm_m * self.resistance_scale,
            "contact__t_liner_gap_m": params.contact.t_liner_gap_m * self.liner_contact_scale,
        }
        if self.coolant_degc is not None:
            changes["boundary__coolant_degc"] = self.coolant_degc
        return params.varied(**changes)


def load_mismatches() -> dict[str, Mismatch]:
    """The mismatches that campaigns use, by name."""
    path = Path(__file__).with_name("mismatch.json")
    return {name: Mismatch(**values) for name, values in json.loads(path.read_text(encoding="utf-8")).items()}


def mismatched(params: PlantParams, name: str) -> PlantParams:
    """Return the parameters of a plant from the list, e.g. ``coolant-50``.

    Raises
    ------
    ParameterError
        If no mismatch has this name.
    """
    known = load_mismatches()
    if name not in known:
        raise ParameterError(f"plant mismatch '{name}' does not exist: use one of {', '.join(known)}")
    return known[name].apply(params)
