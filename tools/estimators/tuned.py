"""What `tune.py` found on training-type drives, kept as data."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from tools.estimators.lptn import Lptn

FILE = Path(__file__).with_name("tuned.json")


@dataclass(frozen=True)
class Tuned:
    """Figures of the baselines.

    Attributes
    ----------
    network
        The four-node network.
    lptn_q_k2
        Its process noise per interval: winding, teeth, yoke, rotor, in K².
    gain
        Of the fixed-gain observer, winding and rotor.
    innovation_std_degc
        Standard deviation of that observer's innovations: its gate is a multiple of it.
    """

    network: Lptn
    lptn_q_k2: tuple[float, ...]
    gain: tuple[float, float]
    innovation_std_degc: tuple[float, float]


@cache
def load_tuned() -> Tuned:
    """The committed figures."""
    raw = json.loads(FILE.read_text(encoding="utf-8"))
    gain, std = raw["gain"], raw["innovation_std_degc"]
    return Tuned(Lptn(**raw["network"]), tuple(raw["lptn_q_k2"]), (gain[0], gain[1]), (std[0], std[1]))
