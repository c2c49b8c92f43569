"""The Python codec: round trips, limits, not-available, damage, and cantools as the second opinion."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rt_runner.codec import CodecError, Decoder, Encoder
from rt_runner.dbc import load_dbc
from rt_runner.e2e import E2eStatus
from tests.support.frames import GOLDEN

DBC = load_dbc()
MOTOR = {"derating_active": 0, "torque_nm": 10.0, "speed_rpm": 3000.0, "tick": 5}
messages = st.sampled_from(DBC.messages)
anything = st.floats(allow_nan=False)


@st.composite
def message_and_values(draw, physical=anything):
    message = draw(messages)
    return message, {s.name: draw(physical) for s in message.payload}


@pytest.mark.parametrize(("name", "values", "golden"), GOLDEN)
def test_golden_bytes(name, values, golden):
    frame = Encoder(DBC, DBC[name].sender).encode(name, values)
    assert frame.data.hex() == golden
    assert (frame.arbitration_id, frame.is_extended_id, frame.dlc) == (DBC[name].frame_id, False, 8)


def test_every_message_has_golden_bytes():
    assert {name for name, *_ in GOLDEN} == {m.name for m in DBC}


@given(message_and_values())
def test_round_trip_gives_the_nearest_valid_value(case):
    message, values = case
    frame = Encoder(DBC, message.sender).encode(message.name, values)
    decoded = Decoder(DBC).decode(frame.arbitration_id, frame.data)
    assert decoded is not None
    assert (decoded.name, decoded.e2e) == (message.name, E2eStatus.OK)
    for s in message.payload:
        low, high = s.to_physical(s.raw_min), s.to_physical(s.raw_max)
        wanted = min(max(values[s.name], low), high)
        assert abs(decoded.values[s.name] - wanted) <= s.factor * 0.5000001, s.name


@given(message_and_values(st.none() | st.just(math.nan)))
def test_absent_values_come_back_as_none(case):
    message, absent = case
    values = {s.name: absent[s.name] if s.raw_na is not None else 0.0 for s in message.payload}
    frame = Encoder(DBC, message.sender).encode(message.name, values)
    decoded = Decoder(DBC).decode(frame.arbitration_id, frame.data)
    assert {n: v for n, v in decoded.values.items() if n != "counter"} == {
        s.name: None if s.raw_na is not None else 0.0 for s in message.payload
    }


@given(messages, st.binary(min_size=7, max_size=7))
def test_any_payload_decodes_as_in_cantools(message, body):
    encoder = Encoder(DBC, message.sender)
    frame = bytearray(encoder.encode(message.name, {s.name: 0.0 for s in message.payload}).data)
    frame[1:] = body  # any payload, then protected again
    from rt_runner.e2e import crc8h2f

    frame[0] = crc8h2f(bytes(frame[1:]) + bytes([message.data_id_list[frame[1] & 15]]))
    decoded = Decoder(DBC).decode(message.frame_id, bytes(frame))
    cantools_values = message.codec.decode(bytes(frame), decode_choices=True)
    for name, value in decoded.values.items():
        if value is None:
            assert str(cantools_values[name]) == "not_available"
        else:
            theirs = cantools_values[name]
            assert value == pytest.approx(float(getattr(theirs, "value", theirs)), rel=1e-12)


def test_infinities_and_overflow_become_the_last_valid_code():
    encoder, decoder = Encoder(DBC, "PLANT"), Decoder(DBC)
    for torque, wanted in ((math.inf, 327.67), (-math.inf, -327.67), (1e308, 327.67), (-327.68, -327.67)):
        frame = encoder.encode("MotorState", MOTOR | {"torque_nm": torque})
        assert decoder.decode(frame.arbitration_id, frame.data).values["torque_nm"] == pytest.approx(wanted)


def test_ties_go_away_from_zero_as_in_c():
    torque = DBC["MotorState"].payload[1]
    innovation = next(s for s in DBC["EstimateInnov"].payload if s.name == "innov_w_degc")
    assert torque.name == "torque_nm"
    assert [innovation.to_raw(x / 512) for x in (1, 3, 5, -1, -3, -5)] == [1, 2, 3, -1, -2, -3]


def test_counter_is_decoded_and_gapless():
    encoder, decoder = Encoder(DBC, "PLANT"), Decoder(DBC)
    frames = [encoder.encode("MotorState", MOTOR) for _ in range(40)]
    decoded = [decoder.decode(f.arbitration_id, f.data) for f in frames]
    assert [d.values["counter"] for d in decoded] == [(i + 1) % 16 for i in range(40)]
    assert all(d.e2e is E2eStatus.OK for d in decoded)


def test_messages_count_on_their_own():
    encoder = Encoder(DBC, "PLANT")
    encoder.encode("MotorState", MOTOR)
    other = encoder.encode("Reference", speed_demand_mps=1.0, slope_rad=0.0, tick=0)
    assert other.data[1] & 0xF == 1


def test_a_damaged_frame_has_no_values():
    frame = Encoder(DBC, "PLANT").encode("MotorState", MOTOR)
    data = bytearray(frame.data)
    data[4] ^= 0x10
    decoded = Decoder(DBC).decode(frame.arbitration_id, data)
    assert decoded.e2e is E2eStatus.WRONG_CRC
    assert set(decoded.values) == {"counter", *MOTOR}
    assert set(decoded.values.values()) == {None}


@given(st.integers(0, 0x1FFFFFFF), st.binary(max_size=64))
def test_garbage_never_raises(can_id, data):
    decoder = Decoder(DBC)
    decoded = decoder.decode(can_id, data)
    if can_id not in DBC.by_id:
        assert decoded is None
        assert decoder.unknown == 1


@pytest.mark.parametrize(
    ("name", "values", "says"),
    [
        ("Estimate", {}, "does not send 'Estimate'"),
        ("Nonsense", {}, "does not send"),
        ("MotorState", {"tick": 1}, "no value for"),
        ("MotorState", MOTOR | {"torque": 1.0}, "no signal torque"),
        ("MotorState", MOTOR | {"tick": None}, "tick is None"),
        ("MotorState", MOTOR | {"tick": math.nan}, "tick is nan"),
    ],
)
def test_a_program_s_mistake_is_named(name, values, says):
    with pytest.raises(CodecError, match=says):
        Encoder(DBC, "PLANT").encode(name, values)


def test_unknown_sender_names_the_known_ones():
    with pytest.raises(CodecError, match="ESTIMATOR, PLANT"):
        Encoder(DBC, "TOASTER")
