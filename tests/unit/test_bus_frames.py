"""Frames as bytes: golden ones, and ours against python-can's own packing of the kernel's structures."""

import struct

import can
import pytest
from can.interfaces.socketcan.socketcan import build_can_frame, dissect_can_frame
from hypothesis import example, given
from hypothesis import strategies as st

from rt_runner.fd_bus import CANFD_FDF, CLASSIC, FD, pack_frame, unpack_frame

GOLDEN = {
    "23010000 05 000000 68656c6c6f000000": can.Message(arbitration_id=0x123, data=b"hello", is_extended_id=False),
    "ffffff9f 00 000000 0000000000000000": can.Message(arbitration_id=0x1FFFFFFF),
    "05000040 04 000000 0000000000000000": can.Message(
        arbitration_id=5, is_remote_frame=True, dlc=4, is_extended_id=False
    ),
    "00070000 02 05 0000 abcd" + 62 * "00": can.Message(
        arbitration_id=0x700, data=b"\xab\xcd", is_fd=True, bitrate_switch=True, is_extended_id=False
    ),
}


@pytest.mark.parametrize(("raw", "message"), GOLDEN.items())
def test_golden_bytes(raw, message):
    assert pack_frame(message).hex() == raw.replace(" ", "")


@st.composite
def messages(draw) -> can.Message:
    extended, fd = draw(st.booleans()), draw(st.booleans())
    remote = not fd and draw(st.booleans())
    data = b"" if remote else draw(st.binary(max_size=8))
    if fd:
        data = bytes(draw(st.sampled_from([*range(9), 12, 16, 20, 24, 32, 48, 64])))
    return can.Message(
        arbitration_id=draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF)),
        is_extended_id=extended,
        is_remote_frame=remote,
        is_fd=fd,
        bitrate_switch=fd and draw(st.booleans()),
        error_state_indicator=fd and draw(st.booleans()),
        data=data,
        dlc=draw(st.integers(0, 8)) if remote else len(data),
        check=True,
    )


@given(messages())
def test_same_bytes_as_python_can_and_back(message):
    raw = pack_frame(message)
    theirs = bytearray(build_can_frame(message))
    theirs[7] = 0  # python-can writes the length there once more: len8_dlc, reserved in an FD frame; we leave it 0
    assert raw == bytes(theirs)
    can_id, flags, data = unpack_frame(raw)
    their_id, their_length, their_flags, their_data = dissect_can_frame(raw)
    assert (can_id, len(data)) == (their_id, their_length)
    assert flags & 3 == their_flags & 3
    assert bool(flags & CANFD_FDF) == message.is_fd
    assert message.is_remote_frame or data == their_data == bytes(message.data)


@given(st.binary(max_size=100) | st.binary(min_size=16, max_size=16) | st.binary(min_size=72, max_size=72))
@example(struct.pack("=IB", 0x800, 0) + bytes(11))
@example(struct.pack("=IB", 1, 9) + bytes(11))
@example(struct.pack("=IB", 0x20000800, 8) + bytes(11))
def test_any_bytes_are_a_frame_or_none(raw):
    frame = unpack_frame(raw)
    if len(raw) not in (CLASSIC.size, FD.size):
        assert frame is None
        return
    can_id, length = struct.unpack_from("=IB", raw)
    carried = length <= (8 if len(raw) == 16 else 64) and (can_id & 0xA0000000 or can_id & 0x1FFFFFFF <= 0x7FF)
    assert (frame is not None) == bool(carried)
    if frame is not None:
        assert frame[0] == can_id
        assert frame[2] == raw[8 : 8 + length]
