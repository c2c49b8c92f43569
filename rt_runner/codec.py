"""Between physical values in SI-style units and protected frames; everything it knows comes from the DBC.

cantools packs and unpacks the bits; scaling, clamping and "not available" are done here by one stated rule,
the same the generated C follows, because cantools raises on what is out of range and rounds ties the other way.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import can

from rt_runner.dbc import Dbc, MessageInfo
from rt_runner.e2e import E2eCheck, E2eProtect, E2eStatus
from rt_runner.errors import RtError


class CodecError(RtError):
    """A program asks the codec for something the DBC does not have: its own mistake, not the bus's."""


class Decoded(NamedTuple):
    """One received frame. ``values`` has every signal but the CRC; all None if the frame is damaged."""

    name: str
    values: dict[str, float | None]
    e2e: E2eStatus


class Encoder:
    """Makes the frames of one sender; keeps the counter of each of its messages.

    Parameters
    ----------
    dbc : loaded DBC
    sender : node name as in the DBC; messages of other nodes are refused
    """

    def __init__(self, dbc: Dbc, sender: str) -> None:
        own = [m for m in dbc if m.sender == sender]
        if not own:
            nodes = ", ".join(sorted({m.sender for m in dbc}))
            raise CodecError(f"{dbc.path}: node {sender!r} sends nothing; senders are {nodes}")
        self._sender = sender
        self._messages = {m.name: (m, E2eProtect(m.data_id_list)) for m in own}

    def encode(
        self, name: str, values: Mapping[str, float | None] | None = None, /, **more: float | None
    ) -> can.Message:
        """Frame with the next counter and its CRC.

        Every payload signal must be given, by mapping or keyword. None and NaN become the not-available code;
        what is out of range becomes the nearest valid code.

        Raises
        ------
        CodecError : message of another node, signal missing or unknown, no not-available code to send
        """
        try:
            message, protect = self._messages[name]
        except KeyError:
            raise CodecError(f"{self._sender} does not send {name!r}; see its messages in the DBC") from None
        raw = _to_raw(message, {**(values or {}), **more})
        frame = bytearray(message.codec.encode(raw, scaling=False, strict=False))
        protect.protect(frame)
        return can.Message(arbitration_id=message.frame_id, is_extended_id=False, data=frame)


def _to_raw(message: MessageInfo, values: Mapping[str, float | None]) -> dict[str, int]:
    raw = {message.crc_signal: 0, message.counter_signal: 0}
    for signal in message.payload:
        try:
            value = values[signal.name]
        except KeyError:
            raise CodecError(f"{message.name}: no value for {signal.name}") from None
        if value is None or math.isnan(value):
            if signal.raw_na is None:
                raise CodecError(f"{message.name}.{signal.name} is {value} and has no not-available code")
            raw[signal.name] = signal.raw_na
        else:
            raw[signal.name] = signal.to_raw(value)
    if len(values) > len(message.payload):
        unknown = sorted(set(values) - set(raw))
        raise CodecError(f"{message.name} has no signal {', '.join(unknown) or 'of that name'} to set")
    return raw


class Decoder:
    """Reads frames of every sender; keeps the E2E state of each message."""

    def __init__(self, dbc: Dbc) -> None:
        self._messages = {
            m.frame_id: (
                m,
                tuple((s.name, s.raw_na, s.factor, s.offset) for s in m.signals if s.name != m.crc_signal),
                E2eCheck(m.data_id_list, m.max_delta, m.length),
            )
            for m in dbc
        }
        self.unknown = 0  # frames with an id the DBC does not have

    def decode(self, arbitration_id: int, data: bytes) -> Decoded | None:
        """Check and decode a frame; None if the DBC does not know its id. Never raises on frame content."""
        known = self._messages.get(arbitration_id)
        if known is None:
            self.unknown += 1
            return None
        message, signals, check = known
        data = bytes(data)
        status = check.check(data)
        if status is E2eStatus.WRONG_CRC:
            return Decoded(message.name, dict.fromkeys(s[0] for s in signals), status)
        raw: dict = message.codec.decode(data, decode_choices=False, scaling=False)  # type: ignore[assignment]
        values = {name: None if raw[name] == na else raw[name] * f + o for name, na, f, o in signals}
        return Decoded(message.name, values, status)

    def check_of(self, name: str) -> E2eCheck:
        """E2E state and counters of a message, by its name."""
        for message, _, check in self._messages.values():
            if message.name == name:
                return check
        raise CodecError(f"no message {name!r} in the DBC")
