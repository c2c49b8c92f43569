"""Lock-step records: a CAN frame and its time, 24 bytes, over a pipe. The same bytes as in C (rt_record.h)."""

import struct
from collections.abc import Iterator
from typing import IO, NamedTuple

RECORD = struct.Struct("=qIB3x8s")  # t_ns, then struct can_frame: id, length, padding, data
CONTROL_ID = 0x20000000  # CAN_ERR_FLAG: no data frame can have it
TICK, END, JOB = 1, 2, 3


class Record(NamedTuple):
    """One frame at one time; ``data`` is cut to the frame's length."""

    t_ns: int
    can_id: int
    data: bytes


def pack(t_ns: int, can_id: int, data: bytes) -> bytes:
    """One record as bytes; ``data`` of at most 8 bytes."""
    return RECORD.pack(t_ns, can_id, len(data), data.ljust(8, b"\0"))


def control(t_ns: int, code: int) -> bytes:
    """A control record: ``TICK`` (time has advanced to ``t_ns``) or ``END``."""
    return pack(t_ns, CONTROL_ID, bytes([code]))


def job(t_ns: int, release: int, output: int = 0, sweep_limit: int = 0) -> bytes:
    """The control record of replay: the job of release number ``release`` read its inputs at ``t_ns``.

    ``output`` is what it put out, as the signal of that name; its solver's time was up after ``sweep_limit`` sweeps
    (0: it was not).
    """
    return pack(t_ns, CONTROL_ID, bytes([JOB]) + release.to_bytes(4, "little") + bytes([output, sweep_limit]))


def read_until_control(stream: IO[bytes]) -> Iterator[Record]:
    """Records up to and including the next control record.

    Raises
    ------
    EOFError
        The other side closed before it.
    """
    while True:
        raw = stream.read(RECORD.size)
        if len(raw) != RECORD.size:
            raise EOFError
        t_ns, can_id, length, data = RECORD.unpack(raw)
        yield Record(t_ns, can_id, data[:length])
        if can_id == CONTROL_ID:
            return
