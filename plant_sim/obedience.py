"""Whom the plant obeys: a controller's commands while they are good and fresh, else the driver under the rule.

Frames in, one decision per tick out. Knows no clock and no socket: age counts in ticks of the plant, so that lock-step
and real time decide alike.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from plant_sim.driver import TorqueCommand, linear_share
from rt_runner.codec import Decoded, Decoder
from rt_runner.dbc import Dbc
from rt_runner.e2e import E2eStatus

TICK_MS = 10
PERIODS = 2  # of the command's cycle: without a good one for so long, the plant falls back
OLD_TICKS = 50  # a command that rests on a state older than this is refused, however fresh the frame
RULE_W_DEGC = (150.0, 155.0)
RULE_R_DEGC = (145.0, 160.0)
BLIND_SHARE = 0.5  # of the envelope where no temperature is known: half the torque cools a winding at its limit
SENSOR_MAX_TICKS = 100
PLAUSIBLE_DEGC = (-30.0, 190.0)  # an open or shorted sensor reads -40 or 200
ESTIMATES = (2, 3, 6, 7)  # Estimate.status: ok, predicting, open_loop, fallback
LISTENED = ("TorqueCommand", "Estimate", "EstWinding", "EstRotor")


class Obeys(IntEnum):
    """PlantControl.obeys."""

    DRIVER = 0
    COMMAND = 1
    FALLBACK = 2


@dataclass(frozen=True)
class Decision:
    """How the plant takes its next step."""

    obeys: Obeys
    derate: float = 1.0
    command: TorqueCommand | None = None
    derating: bool = False


FREE = Decision(Obeys.DRIVER)


class Obedience:
    """Judges what the plant hears and decides whom it obeys; every counter only grows.

    Parameters
    ----------
    dbc : the contract; cycle times and timeouts are from there
    tick : the plant's before its first step
    """

    def __init__(self, dbc: Dbc, tick: int = 0) -> None:
        self.ids = frozenset(dbc[name].frame_id for name in LISTENED)
        self._decoder = Decoder(dbc)
        self._patience = PERIODS * dbc["TorqueCommand"].cycle_ms // TICK_MS
        self._timeout = {name: dbc[name].timeout_ms // TICK_MS for name in LISTENED}
        self._command: TorqueCommand | None = None
        self._derating = False
        self._command_tick = 0
        self._newest: dict[str, tuple[int, dict[str, float | None]]] = {}
        self._sensor = tick, -math.inf, -math.inf  # nothing to fear before the first readings are due
        self.commands = self.refused = self.fallback_ticks = 0

    def hear(self, arbitration_id: int, data: bytes, tick: int) -> None:
        """Take a frame that arrived before the step that follows ``tick``; other nodes' frames are left aside."""
        if arbitration_id not in self.ids:
            return
        decoded = self._decoder.decode(arbitration_id, data)
        assert decoded is not None
        good = decoded.e2e in (E2eStatus.OK, E2eStatus.LOST)
        if decoded.name != "TorqueCommand":
            if good or decoded.e2e is E2eStatus.WRONG_SEQUENCE:
                self._newest[decoded.name] = tick, decoded.values
            return
        command = _torques(decoded) if good and _recent(decoded.values, tick) else None
        if command is None:
            self.refused += 1
            return
        self.commands += 1
        self._command, self._command_tick = command, tick
        self._derating = bool(decoded.values["derating"])

    def measured(self, tick: int, theta_w_degc: float | None, theta_r_degc: float | None) -> None:
        """Take the sensors' readings; what is no temperature of a motor is none."""
        pair = [math.nan if t is None or not PLAUSIBLE_DEGC[0] < t < PLAUSIBLE_DEGC[1] else t
                for t in (theta_w_degc, theta_r_degc)]  # fmt: skip
        if not all(math.isnan(t) for t in pair):
            self._sensor = tick, pair[0], pair[1]

    def decide(self, tick: int) -> Decision:
        """How to take the step that follows ``tick``."""
        if self._command is not None and tick - self._command_tick < self._patience:
            return Decision(Obeys.COMMAND, 1.0, self._command, self._derating)
        self.fallback_ticks += 1
        share = self._share(tick)
        return Decision(Obeys.FALLBACK, share, None, share < 1.0)

    def _share(self, tick: int) -> float:
        theta_w, theta_r = self._believed(tick)
        known = [linear_share(theta_w, *RULE_W_DEGC)] if not math.isnan(theta_w) else [BLIND_SHARE]
        if not math.isnan(theta_r):
            known.append(linear_share(theta_r, *RULE_R_DEGC))
        return min(known)

    def _believed(self, tick: int) -> tuple[float, float]:
        """Winding and rotor: upper bounds where the estimator gives an estimate, else the sensors; NaN: unknown."""
        estimate = self._fresh("Estimate", tick)
        if estimate is not None and estimate["status"] in ESTIMATES:
            bounds = (self._fresh("EstWinding", tick), "upper_w_degc"), (self._fresh("EstRotor", tick), "upper_r_degc")
            believed = [_largest((estimate[name], None if bound is None else bound[upper]))
                        for name, (bound, upper) in zip(("theta_w_est_degc", "theta_r_est_degc"), bounds, strict=True)
                        ]  # fmt: skip
            if not math.isnan(believed[0]):
                return believed[0], believed[1]
        if tick - self._sensor[0] <= SENSOR_MAX_TICKS:
            return self._sensor[1], self._sensor[2]
        return math.nan, math.nan

    def _fresh(self, name: str, tick: int) -> dict[str, float | None] | None:
        at, values = self._newest.get(name, (None, {}))
        return values if at is not None and tick - at <= self._timeout[name] else None


def _torques(decoded: Decoded) -> TorqueCommand | None:
    """The command of a frame; None where a torque is not available. Brakes count positive on the bus."""
    v = decoded.values
    acc, brk, fric = v["torque_acc_nm"], v["torque_brk_nm"], v["torque_fric_nm"]
    return None if acc is None or brk is None or fric is None else TorqueCommand(acc, -brk, -fric)


def _recent(values: dict[str, float | None], tick: int) -> bool:
    said = values["tick"]
    return said is not None and (tick - int(said)) % 65536 <= OLD_TICKS


def _largest(values: Sequence[float | None]) -> float:
    return max((v for v in values if v is not None), default=math.nan)
