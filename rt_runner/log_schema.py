"""The log's protobuf messages, made from the DBC: one per frame, one optional double per signal.

Serialising is done here with `struct`, because it runs for every frame: the layout is fixed once the signals are
known. Any protobuf library reads it; a test compares the bytes with google.protobuf's own.
"""

import struct

from google.protobuf import descriptor_pb2

from rt_runner.dbc import MessageInfo

PACKAGE = "rt"
RAW_SCHEMA = f"{PACKAGE}.CanFrame"
RAW_TOPIC = "can/raw"
TOPIC_PREFIX = "signals/"
FLAG_EXTENDED, FLAG_REMOTE, FLAG_ERROR, FLAG_FD, FLAG_BRS, FLAG_ESI = (1 << i for i in range(6))

_E2E_FIELD = 1
_FIRST_SIGNAL_FIELD = 2
_VARINT, _FIXED64, _BYTES = 0, 1, 2  # protobuf wire types
_MAX_SIGNALS = 14  # field numbers up to 15 have a one-byte tag; eight bytes hold fewer signals than that in practice
_Field = descriptor_pb2.FieldDescriptorProto


def schema_name(message: str) -> str:
    """Full protobuf name of a DBC message."""
    return f"{PACKAGE}.{message}"


def raw_schema() -> bytes:
    """Serialised FileDescriptorSet of ``rt.CanFrame``."""
    message = descriptor_pb2.DescriptorProto(name="CanFrame")
    kinds = (("id", _Field.TYPE_UINT32), ("data", _Field.TYPE_BYTES), ("dlc", _Field.TYPE_UINT32),
             ("flags", _Field.TYPE_UINT32))  # fmt: skip
    for number, (name, kind) in enumerate(kinds, start=1):
        message.field.add(name=name, number=number, type=kind, label=_Field.LABEL_OPTIONAL)
    return _file_set("rt_can_frame.proto", message)


def message_schema(info: MessageInfo) -> bytes:
    """Serialised FileDescriptorSet of one DBC message: ``uint32 e2e``, then ``optional double`` per signal."""
    message = descriptor_pb2.DescriptorProto(name=info.name)
    message.field.add(name="e2e", number=_E2E_FIELD, type=_Field.TYPE_UINT32, label=_Field.LABEL_OPTIONAL)
    for i, name in enumerate(logged_signals(info)):
        message.field.add(
            name=name, number=_FIRST_SIGNAL_FIELD + i, type=_Field.TYPE_DOUBLE, label=_Field.LABEL_OPTIONAL,
            proto3_optional=True, oneof_index=i,
        )  # fmt: skip
        message.oneof_decl.add(name=f"_{name}")  # how proto3 spells "optional"
    return _file_set(f"rt_{info.name}.proto", message)


def logged_signals(info: MessageInfo) -> list[str]:
    """Signals of a frame that are logged decoded: all but the CRC, in bit order."""
    return [s.name for s in info.signals if s.name != info.crc_signal]


def _file_set(name: str, message: descriptor_pb2.DescriptorProto) -> bytes:
    file = descriptor_pb2.FileDescriptorProto(name=name, package=PACKAGE, syntax="proto3", message_type=[message])
    return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString(deterministic=True)


def _tag(number: int, wire_type: int) -> int:
    return number << 3 | wire_type


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


class FrameSerializer:
    """Serialises the decoded values of one DBC message."""

    def __init__(self, info: MessageInfo) -> None:
        names = logged_signals(info)
        if len(names) > _MAX_SIGNALS:
            raise ValueError(f"{info.name} has more than {_MAX_SIGNALS} signals: split the frame")
        self._fields = [(n, _tag(_FIRST_SIGNAL_FIELD + i, _FIXED64)) for i, n in enumerate(names)]
        self._one = struct.Struct("<Bd")
        self._all = struct.Struct("<" + "Bd" * len(names))

    def __call__(self, values: dict[str, float | None], e2e: int) -> bytes:
        """Bytes of one message; a signal that is None is left out, as is e2e 0 (proto3's default)."""
        head = bytes((_tag(_E2E_FIELD, _VARINT), e2e)) if e2e else b""
        flat: list[int | float] = []
        for name, tag in self._fields:
            value = values[name]
            if value is not None:
                flat += (tag, value)
        if len(flat) == 2 * len(self._fields):
            return head + self._all.pack(*flat)
        return head + b"".join(self._one.pack(flat[i], flat[i + 1]) for i in range(0, len(flat), 2))


def serialize_raw(can_id: int, data: bytes, dlc: int, flags: int) -> bytes:
    """Bytes of one ``rt.CanFrame``; zeros and empty data are left out, as proto3 does."""
    out = b""
    if can_id:
        out = b"\x08" + _varint(can_id)
    if data:
        out += bytes((_tag(2, _BYTES), len(data))) + data
    if dlc:
        out += bytes((_tag(3, _VARINT), dlc))
    if flags:
        out += bytes((_tag(4, _VARINT), flags))
    return out


def channel_metadata(info: MessageInfo) -> dict[str, str]:
    """What a reader without the DBC wants to know about a channel."""
    return {
        "can_id": f"0x{info.frame_id:03X}",
        "sender": info.sender,
        "cycle_ms": str(info.cycle_ms),
        "timeout_ms": str(info.timeout_ms),
        "per_job": str(int(info.per_job)),
        "simulation_only": str(int(info.simulation_only)),
        "units": ",".join(f"{s.name}={s.unit}" for s in info.signals if s.unit),
    }
