"""AUTOSAR end-to-end protection, profile 2: CRC-8H2F over bytes 1.. and a data id, a 4-bit counter.

Layout of a protected frame: byte 0 the CRC, byte 1 low nibble the counter. The data id of a frame is the
entry of its message's 16-entry list at the frame's counter value; it is never sent. The twin in C is
`estimator_c/src/e2e.c`.

Received frames are judged like in AUTOSAR's check function, driven by arrival: the first good frame starts the
sequence, a repeat does not move it, after a jump beyond ``max_delta`` it restarts at the frame received.
"""

from enum import IntEnum

COUNTER_MASK = 0x0F
MIN_LENGTH = 2  # CRC byte and counter byte


class E2eStatus(IntEnum):
    """Verdict on one frame; the values are those of the log."""

    OK = 0
    REPEATED = 1  # same counter as the frame before: nothing new
    LOST = 2  # good, but up to max_delta - 1 frames before it are missing
    WRONG_SEQUENCE = 3  # good CRC, but the counter jumped by more than max_delta
    WRONG_CRC = 4  # damaged, truncated or sent as another message: nothing in it can be believed
    NO_DATA = 5  # no good frame yet


def _table() -> bytes:
    out = bytearray()
    for byte in range(256):
        for _ in range(8):
            byte = (byte << 1 ^ 0x2F if byte & 0x80 else byte << 1) & 0xFF
        out.append(byte)
    return bytes(out)


_CRC8H2F = _table()


def crc8h2f(data: bytes) -> int:
    """CRC-8 with polynomial 0x2F, start value 0xFF, result inverted (AUTOSAR's CRC library: CRC-8H2F)."""
    crc = 0xFF
    table = _CRC8H2F
    for byte in data:
        crc = table[crc ^ byte]
    return crc ^ 0xFF


class E2eProtect:
    """Sender's side of one message: counts frames and closes each with its CRC."""

    def __init__(self, data_id_list: bytes) -> None:
        self._ids = bytes(data_id_list)
        if len(self._ids) != COUNTER_MASK + 1:
            raise ValueError("profile 2 needs 16 data ids")
        self.counter = 0  # the profile counts up before it sends: the first frame carries 1

    def protect(self, frame: bytearray) -> None:
        """Write the next counter and the CRC into ``frame`` (at least 2 bytes)."""
        self.counter = (self.counter + 1) & COUNTER_MASK
        frame[1] = (frame[1] & 0xF0) | self.counter
        frame[0] = crc8h2f(bytes(frame[1:]) + self._ids[self.counter : self.counter + 1])


class E2eCheck:
    """Receiver's side of one message. Every counter here only grows.

    Parameters
    ----------
    data_id_list : 16 bytes
    max_delta : largest counter step reported as LOST, 1 .. 14
    length : bytes a frame must have; another length is WRONG_CRC. None takes any from 2 up.
    """

    def __init__(self, data_id_list: bytes, max_delta: int, length: int | None = None) -> None:
        self._ids = bytes(data_id_list)
        if len(self._ids) != COUNTER_MASK + 1:
            raise ValueError("profile 2 needs 16 data ids")
        if not 1 <= max_delta < COUNTER_MASK:
            raise ValueError("max_delta must be 1 .. 14")
        self._max_delta = max_delta
        self._length = length
        self._last: int | None = None
        self.status = E2eStatus.NO_DATA
        self.counts = [0] * (E2eStatus.WRONG_CRC + 1)  # frames by status OK .. WRONG_CRC
        self.frames_lost = 0  # frames missing before LOST ones; what a WRONG_SEQUENCE skipped is unknown

    def check(self, frame: bytes) -> E2eStatus:
        """Judge a received frame and remember its counter."""
        self.status = self._judge(frame)
        self.counts[self.status] += 1
        return self.status

    def _judge(self, frame: bytes) -> E2eStatus:
        if len(frame) < MIN_LENGTH or (self._length is not None and len(frame) != self._length):
            return E2eStatus.WRONG_CRC
        counter = frame[1] & COUNTER_MASK
        if crc8h2f(frame[1:] + self._ids[counter : counter + 1]) != frame[0]:
            return E2eStatus.WRONG_CRC
        last, self._last = self._last, counter
        if last is None:
            return E2eStatus.OK  # AUTOSAR's INITIAL: good data, and what came before cannot be known
        delta = (counter - last) & COUNTER_MASK
        if delta == 1:
            return E2eStatus.OK
        if delta == 0:
            return E2eStatus.REPEATED
        if delta <= self._max_delta:
            self.frames_lost += delta - 1
            return E2eStatus.LOST
        return E2eStatus.WRONG_SEQUENCE
