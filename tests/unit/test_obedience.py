"""Whom the plant obeys: only whole, new, recent commands count, and without them the rule takes over in time."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plant_sim.driver import TorqueCommand
from plant_sim.obedience import BLIND_SHARE, OLD_TICKS, Obedience, Obeys
from rt_runner.codec import Encoder
from rt_runner.dbc import load_dbc
from rt_runner.e2e import crc8h2f

DBC = load_dbc()
PATIENCE = 20  # ticks: two periods of the command
COMMAND = DBC["TorqueCommand"]
GOOD = {"derating": 1, "origin": 1, "clamped": 0, "torque_acc_nm": 50.0, "torque_brk_nm": 0.0, "torque_fric_nm": 0.0}


class Bus:
    """A plant's ear and the nodes it listens to."""

    def __init__(self) -> None:
        self.ear = Obedience(DBC)
        self._nodes = {name: Encoder(DBC, name) for name in ("CONTROLLER", "ESTIMATOR")}

    def command(self, tick: int, **changes: float | None) -> bytes:
        values = {**GOOD, "tick": tick % 65536, **changes}
        return bytes(self._nodes["CONTROLLER"].encode("TorqueCommand", values).data)

    def say(self, tick: int, name: str, **values: float | None) -> None:
        message = self._nodes["ESTIMATOR"].encode(name, {**values, "tick": tick % 65536})
        self.ear.hear(message.arbitration_id, bytes(message.data), tick)

    def hear(self, data: bytes, tick: int) -> None:
        self.ear.hear(COMMAND.frame_id, data, tick)


def test_a_command_is_obeyed_for_exactly_two_periods():
    bus = Bus()
    assert bus.ear.decide(0).obeys is Obeys.FALLBACK
    bus.hear(bus.command(0), 0)
    decisions = [bus.ear.decide(tick) for tick in range(PATIENCE + 3)]
    assert [d.obeys for d in decisions] == [Obeys.COMMAND] * PATIENCE + [Obeys.FALLBACK] * 3
    assert decisions[0].command == TorqueCommand(50.0, 0.0, 0.0)
    assert decisions[0].derating
    bus.hear(bus.command(40), 40)
    assert bus.ear.decide(40).obeys is Obeys.COMMAND, "back when commands are good again"
    assert (bus.ear.commands, bus.ear.refused, bus.ear.fallback_ticks) == (2, 0, 4)


def test_brakes_count_positive_on_the_bus():
    bus = Bus()
    bus.hear(bus.command(0, torque_acc_nm=0.0, torque_brk_nm=33.0, torque_fric_nm=100.0), 0)
    assert bus.ear.decide(0).command == TorqueCommand(0.0, -33.0, -100.0)


@settings(max_examples=300, deadline=None)
@given(st.integers(0, 63), st.integers(0, 63), st.integers(0, 63), st.integers(1, 14))
def test_no_damage_of_up_to_three_bits_is_obeyed(a, b, c, counter):
    bus = Bus()
    for _ in range(counter - 1):
        bus.command(0)
    data = bytearray(bus.command(0))
    for bit in {a, b, c}:
        data[bit // 8] ^= 1 << bit % 8
    bus.hear(bytes(data), 0)
    assert bus.ear.decide(0).obeys is Obeys.FALLBACK
    assert bus.ear.refused == 1


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=12))
def test_noise_is_never_obeyed(data):
    bus = Bus()
    for tick in range(3):
        bus.hear(data, tick)
    genuine = len(data) == 8 and data[0] == crc8h2f(data[1:] + bytes([COMMAND.data_id_list[data[1] & 15]]))
    assert genuine or bus.ear.decide(3).obeys is Obeys.FALLBACK


def test_another_message_s_frame_under_this_id_is_refused():
    bus = Bus()
    other = bytes(Encoder(DBC, "CONTROLLER").encode("CtlSolve", {"sweeps": 1, "slack_degc": 0.0, "margin_degc": 1.0,
                                                               "tick": 0}).data)  # fmt: skip
    bus.hear(other, 0)
    assert bus.ear.decide(0).obeys is Obeys.FALLBACK


def test_a_repeated_command_does_not_live_longer():
    bus = Bus()
    data = bus.command(0)
    for tick in range(PATIENCE + 5):
        bus.hear(data, tick)
    assert bus.ear.decide(PATIENCE).obeys is Obeys.FALLBACK
    assert (bus.ear.commands, bus.ear.refused) == (1, PATIENCE + 4)


@pytest.mark.parametrize("lost", range(15))
def test_lost_commands_up_to_the_timeout_do_not_matter_beyond_it_one_is_refused(lost):
    bus = Bus()
    bus.hear(bus.command(0), 0)
    for _ in range(lost):
        bus.command(0)
    bus.hear(bus.command(5), 5)
    accepted = lost + 1 <= COMMAND.max_delta
    assert bus.ear.commands == 1 + accepted
    bus.hear(bus.command(6), 6)
    assert bus.ear.commands == 2 + accepted, "the sequence goes on from there"


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 200_000), st.integers(0, 65535))
def test_a_command_that_rests_on_an_old_state_is_refused(tick, age):
    bus = Bus()
    bus.hear(bus.command(tick - age), tick)
    assert (bus.ear.decide(tick).obeys is Obeys.COMMAND) == (age <= OLD_TICKS)


@pytest.mark.parametrize("absent", ["torque_acc_nm", "torque_brk_nm", "torque_fric_nm"])
def test_a_command_without_torque_is_none(absent):
    bus = Bus()
    bus.hear(bus.command(0, **{absent: None}), 0)
    assert bus.ear.decide(0).obeys is Obeys.FALLBACK
    assert bus.ear.refused == 1


def estimate(bus: Bus, tick: int, theta_w: float, upper_w: float | None = None, status: int = 2) -> None:
    bus.say(tick, "Estimate", status=status, theta_w_est_degc=theta_w, theta_r_est_degc=100.0)
    bus.say(tick, "EstWinding", sensor_w_fault=0, sensor_w_trusted=1, sigma_w_degc=0.2, upper_w_degc=upper_w)


def test_the_rule_follows_the_estimate_s_upper_bound_then_the_sensor_then_nothing():
    bus = Bus()
    bus.ear.measured(0, 120.0, 90.0)
    assert bus.ear.decide(0).derate == 1.0
    estimate(bus, 0, 151.0, 152.0)
    assert bus.ear.decide(0).derate == pytest.approx(0.6)
    estimate(bus, 1, 153.0)
    assert bus.ear.decide(1).derate == pytest.approx(0.4), "no bound is known: the estimate itself"
    silent = DBC["Estimate"].timeout_ms // 10
    bus.ear.measured(silent, 154.0, 90.0)
    assert bus.ear.decide(1 + silent).derate == pytest.approx(0.4)
    assert bus.ear.decide(2 + silent).derate == pytest.approx(0.2), "the estimator is silent: the sensor"
    assert bus.ear.decide(2 + silent).derating
    assert bus.ear.decide(silent + 101).derate == BLIND_SHARE, "nobody knows a temperature"


@pytest.mark.parametrize("status", [0, 1, 4, 5])
def test_an_estimate_that_is_none_counts_for_nothing(status):
    bus = Bus()
    bus.ear.measured(0, 120.0, 90.0)
    estimate(bus, 0, 160.0, 160.0, status)
    assert bus.ear.decide(0).derate == 1.0


def test_broken_sensors_are_no_temperature_and_a_hot_rotor_derates_too():
    bus = Bus()
    bus.ear.measured(0, 120.0, 152.5)
    assert bus.ear.decide(0).derate == pytest.approx(0.5)
    for reading in (None, math.nan, -40.0, 200.0):
        other = Bus()
        other.ear.measured(0, reading, 90.0)
        assert other.ear.decide(0).derate == BLIND_SHARE


def test_before_the_first_reading_is_due_nothing_is_feared():
    bus = Bus()
    assert bus.ear.decide(5).derate == 1.0
    assert bus.ear.decide(101).derate == BLIND_SHARE
