"""End-to-end protection in Python: against cantools, by script, and by damage."""

import pytest
from cantools.autosar.end_to_end import compute_profile2_crc
from hypothesis import given
from hypothesis import strategies as st

from rt_runner.dbc import load_dbc
from rt_runner.e2e import E2eCheck, E2eProtect, E2eStatus, crc8h2f
from tests.support.frames import GOLDEN

DBC = load_dbc()
IDS = DBC["MotorState"].data_id_list
messages = st.sampled_from(DBC.messages)


def sent(protect: E2eProtect, payload: bytes = bytes(6)) -> bytes:
    frame = bytearray(2) + payload
    protect.protect(frame)
    return bytes(frame)


def at(counter: int) -> bytes:
    """A good frame with a given counter."""
    protect = E2eProtect(IDS)
    protect.counter = (counter - 1) % 16
    return sent(protect)


def test_crc_has_the_published_check_value():
    assert crc8h2f(b"123456789") == 0xDF  # AUTOSAR CRC library, CRC-8H2F


@given(st.binary(min_size=2, max_size=64), st.integers(0, 255))
def test_crc_is_that_of_cantools(frame, data_id):
    assert crc8h2f(frame[1:] + bytes([data_id])) == compute_profile2_crc(frame, data_id)


@pytest.mark.parametrize(("name", "values", "golden"), GOLDEN)
def test_golden_frames_carry_the_crc_of_cantools(name, values, golden):
    frame = bytes.fromhex(golden)
    assert frame[1] & 0xF == 1, "a sender's first frame carries counter 1"
    assert frame[0] == compute_profile2_crc(frame, DBC[name].data_id_list[1])


def test_counter_runs_through_sixteen_values():
    protect = E2eProtect(IDS)
    counters = [sent(protect)[1] & 0xF for _ in range(33)]
    assert counters == [(1 + i) % 16 for i in range(33)]


def test_protect_leaves_the_high_nibble_alone():
    frame = bytearray(b"\x00\xa0" + bytes(6))
    E2eProtect(IDS).protect(frame)
    assert frame[1] == 0xA1


OK, REP, LOST, SEQ = E2eStatus.OK, E2eStatus.REPEATED, E2eStatus.LOST, E2eStatus.WRONG_SEQUENCE


@pytest.mark.parametrize(
    ("counters", "verdicts"),
    [
        ([7], [OK]),
        ([14, 15, 0, 1], [OK, OK, OK, OK]),
        ([3, 3, 3, 4], [OK, REP, REP, OK]),
        ([1, 3, 4], [OK, LOST, OK]),
        ([1, 4, 5], [OK, LOST, OK]),
        ([1, 5, 6], [OK, SEQ, OK]),
        ([15, 2, 3], [OK, LOST, OK]),
        ([5, 4, 5], [OK, SEQ, OK]),  # swapped
    ],
)
def test_sequence_verdicts(counters, verdicts):
    check = E2eCheck(IDS, max_delta=3)
    assert check.status is E2eStatus.NO_DATA
    assert [check.check(at(c)) for c in counters] == verdicts
    assert [check.counts[v] for v in (OK, REP, LOST, SEQ)] == [verdicts.count(v) for v in (OK, REP, LOST, SEQ)]


def test_lost_frames_are_counted():
    check = E2eCheck(IDS, max_delta=5)
    for counter in (0, 1, 4, 5, 10, 11):
        check.check(at(counter))
    assert check.frames_lost == 2 + 4


def test_a_damaged_frame_does_not_move_the_sequence():
    check = E2eCheck(IDS, max_delta=3)
    check.check(at(1))
    damaged = bytes([at(2)[0] ^ 1]) + at(2)[1:]
    assert check.check(damaged) is E2eStatus.WRONG_CRC
    assert check.check(at(2)) is E2eStatus.OK
    assert check.counts[E2eStatus.WRONG_CRC] == 1


@pytest.mark.parametrize("frame", [b"", b"\x00", at(1)[:7], at(1) + b"\x00"])
def test_another_length_is_damage(frame):
    assert E2eCheck(IDS, 3, length=8).check(frame) is E2eStatus.WRONG_CRC


@pytest.mark.parametrize("max_delta", [0, 15, 16])
def test_max_delta_out_of_range_is_refused(max_delta):
    with pytest.raises(ValueError):
        E2eCheck(IDS, max_delta)


@given(messages, st.binary(min_size=6, max_size=6), st.integers(0, 15), st.data())
def test_up_to_three_flipped_bits_are_always_found(message, payload, counter, data):
    """CRC-8H2F has Hamming distance 4 at this length; the counter is left out, it picks the data id itself."""
    protect = E2eProtect(message.data_id_list)
    protect.counter = counter
    frame = bytearray(sent(protect, payload))
    bits = st.integers(0, 63).filter(lambda b: not 8 <= b < 12)
    for bit in data.draw(st.lists(bits, min_size=1, max_size=3, unique=True)):
        frame[bit // 8] ^= 1 << bit % 8
    assert E2eCheck(message.data_id_list, 3).check(bytes(frame)) is E2eStatus.WRONG_CRC


@pytest.mark.parametrize("message", DBC.messages, ids=lambda m: m.name)
def test_no_counter_turns_into_another_unnoticed(message):
    for counter in range(16):
        protect = E2eProtect(message.data_id_list)
        protect.counter = counter
        frame = sent(protect, b"\x12\x34\x56\x78\x9a\xbc")
        for damage in range(1, 16):
            other = bytes([frame[0], frame[1] ^ damage]) + frame[2:]
            assert E2eCheck(message.data_id_list, 3).check(other) is E2eStatus.WRONG_CRC


@given(messages, messages, st.binary(min_size=6, max_size=6), st.integers(0, 15))
def test_no_message_passes_as_another(message, other, payload, counter):
    protect = E2eProtect(message.data_id_list)
    protect.counter = counter
    frame = sent(protect, payload)
    status = E2eCheck(other.data_id_list, 3).check(frame)
    assert status is (E2eStatus.OK if other is message else E2eStatus.WRONG_CRC)
