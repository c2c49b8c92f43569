"""What the plant says on the bus at each tick: samples in, CAN frames out. Knows no clock and no socket."""

import can

from plant_sim.obedience import FREE, Decision, Obedience
from plant_sim.plant import PlantSample
from rt_runner.codec import Encoder
from rt_runner.dbc import Dbc

SAMPLE_MODULUS_US = 1 << 24
SAMPLE_LAST_US = SAMPLE_MODULUS_US - 2  # the last code says "not available": there the time reads 1 us early
SEND_LAST_US = (1 << 12) - 2


class Publisher:
    """Turns plant samples into frames at the DBC's cycle times.

    Parameters
    ----------
    dbc : the contract
    params_sha256, scenario_sha256 : hex digests; their first 24 bits go out as PlantIdentity
    """

    def __init__(self, dbc: Dbc, params_sha256: str, scenario_sha256: str) -> None:
        self._encode = Encoder(dbc, "PLANT").encode
        self._identity = {"params_hash": int(params_sha256[:6], 16), "scenario_hash": int(scenario_sha256[:6], 16)}
        self._first_tick: int | None = None
        self.ticks_late = 0
        self.late_max_ms = 0.0
        self.tx_retries = 0

    def frames(
        self, s: PlantSample, decision: Decision = FREE, obedience: Obedience | None = None
    ) -> list[can.Message]:
        """Frames due at this tick, in the order they are to be sent.

        ``decision`` is how the step was taken; ``obedience`` makes it, where a controller is on the bus.
        """
        tick = s.tick % 65536
        motor = {"torque_nm": s.torque_nm, "speed_rpm": s.speed_rpm, "derating_active": decision.derating, "tick": tick}
        out = [self._encode("MotorState", motor)]
        first, self._first_tick = self._first_tick is None, self._first_tick or s.tick
        if s.tick % 10 == 0:
            out += [
                self._encode(
                    "TempMeas",
                    {"theta_w_meas_degc": s.theta_w_meas_degc, "theta_r_meas_degc": s.theta_r_meas_degc, "tick": tick},
                ),
                self._encode("Reference", {"speed_demand_mps": s.v_ref_mps, "slope_rad": s.slope_rad, "tick": tick}),
                self._encode(
                    "TruthTemp",
                    {"theta_w_true_degc": s.theta_w_degc, "theta_r_true_degc": s.theta_r_degc, "tick": tick},
                ),
                self._encode("TruthVehicle", {"v_true_mps": s.v_mps, "distance_m": s.x_m, "tick": tick}),
                self._encode("TruthFault", {"fault_w": s.fault_w, "fault_r": s.fault_r, "tick": tick}),
            ]
            if obedience is not None:
                out.append(self._encode("VehicleState", {"v_mps": s.v_mps, "distance_m": s.x_m, "tick": tick}))
        if obedience is not None and s.tick % 100 == 50:
            counts = {k: getattr(obedience, k) for k in ("commands", "refused", "fallback_ticks")}
            out.append(self._encode("PlantControl", {"obeys": decision.obeys, **counts}))
        if s.tick % 100 == 0:
            out.append(
                self._encode(
                    "Coolant",
                    {"soaked": s.soaked, "coolant_degc": s.coolant_degc, "ambient_degc": s.ambient_degc, "tick": tick},
                )
            )
        if (s.tick - self._first_tick) % 100 == 0:
            out.append(
                self._encode(
                    "PlantStatus",
                    {"ticks_late": self.ticks_late, "late_max_ms": self.late_max_ms, "tx_retries": self.tx_retries},
                )
            )
        if first or (s.tick - self._first_tick) % 1000 == 0:
            out.append(self._encode("PlantIdentity", self._identity))
        return out

    def sampled(self, tick: int, sample_ns: int, send_ns: int) -> can.Message:
        """PlantSample, the last frame of a tick in real time.

        Parameters
        ----------
        tick : of the sample
        sample_ns : CLOCK_REALTIME when the sample was taken
        send_ns : from then until MotorState was handed to the bus
        """
        send_us = send_ns // 1000
        return self._encode(
            "PlantSample",
            {
                "sample_us": min(sample_ns // 1000 % SAMPLE_MODULUS_US, SAMPLE_LAST_US),
                "send_us": send_us if 0 <= send_us <= SEND_LAST_US else None,
                "tick": tick % 65536,
            },
        )
