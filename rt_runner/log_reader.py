"""Reads logs, finished or not: a file that ends in the middle of a record gives everything before it."""

import struct
import zlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message as ProtoMessage
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream

from rt_runner.errors import SetupError
from rt_runner.log_schema import RAW_TOPIC, TOPIC_PREFIX

MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_Parse = Callable[[bytes], tuple[dict[str, float | None], int]]


class LogError(SetupError):
    """A log cannot be written or read."""


class LogFrame(NamedTuple):
    """One decoded frame; ``values`` is None where a signal is not available, all None if ``e2e`` is 4 (damaged)."""

    t_ns: int
    name: str
    values: dict[str, float | None]
    e2e: int


class RawFrame(NamedTuple):
    """One frame as it was on the bus; ``flags`` as in `rt_runner.log_schema`."""

    t_ns: int
    can_id: int
    data: bytes
    dlc: int
    flags: int


@dataclass
class _Registry:
    """Schemas and channels met so far."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)


class LogReader:
    """One log file. Opening reads what stands outside the chunks; frames are read when asked for.

    Attributes
    ----------
    path : the file
    metadata : name -> record; of several with one name the last
    attachments : name -> bytes
    complete : whether the log was finished
    trouble : what is wrong with the file, one sentence each; grows while frames are read

    Raises
    ------
    LogError : no such file, or not an MCAP file (one line)
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.complete = False
        self.trouble: list[str] = []
        self.size = 0
        self._chunks: list[tuple[int, int]] = []  # position, length of the record's body
        try:
            with self.path.open("rb") as file:
                self._index(file)
        except OSError as e:
            raise LogError(f"{self.path}: cannot read the log ({e.strerror}); give the path of an .mcap file") from None

    def _index(self, file: BinaryIO) -> None:
        self.size = file.seek(0, 2)
        file.seek(0)
        if file.read(len(MAGIC)) != MAGIC:
            raise LogError(f"{self.path}: not an MCAP log; give a file that rt-runner or another MCAP tool wrote")
        position = len(MAGIC)
        while head := file.read(_HEAD.size):
            body = position + _HEAD.size
            opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, self.size)
            if body + length > self.size:
                break
            self._note(file, opcode, body, length)
            position = file.seek(body + length)
            if opcode == Opcode.FOOTER:
                self.complete = file.read(len(MAGIC)) == MAGIC
                break
        if not self.complete:
            lost = self.size - position
            tail = f", the last {lost} bytes are half a record" if lost else ""
            self.trouble.append(f"the log was never finished (no footer{tail}): what was written before is shown")

    def _note(self, file: BinaryIO, opcode: int, body: int, length: int) -> None:
        if opcode == Opcode.CHUNK:
            self._chunks.append((body, length))
        elif opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
            try:
                stream = ReadDataStream(BytesIO(file.read(length)))
                if opcode == Opcode.ATTACHMENT:
                    a = Attachment.read(stream)
                    self.attachments[a.name] = a.data
                else:
                    m = Metadata.read(stream)
                    self.metadata[m.name] = m.metadata
            except Exception as e:  # damaged in place: any of struct, unicode, end of file
                self.trouble.append(f"the record at byte {body} is damaged ({type(e).__name__}), left out")

    def frames(self, names: Collection[str] | None = None) -> Iterator[LogFrame]:
        """Decoded frames in the order they were received; only the messages named, if any are."""
        parsers: dict[int, tuple[str, _Parse] | None] = {}
        for registry, channel, t_ns, payload in self._messages():
            try:
                known = parsers[channel]
            except KeyError:
                known = parsers[channel] = _parser(registry, channel, names)
            if known is not None:
                yield LogFrame(t_ns, known[0], *known[1](payload))

    def channels(self) -> dict[str, dict[str, str]]:
        """Channels of decoded frames: message name -> what the log says of it (id, sender, cycle, units)."""
        found: dict[str, dict[str, str]] = {}
        for registry, *_ in self._messages():  # our writer declares all of them before the first frame
            found = {
                c.topic.removeprefix(TOPIC_PREFIX): c.metadata
                for c in registry.channels.values()
                if c.topic.startswith(TOPIC_PREFIX)
            }
            break
        return found

    def raw(self) -> Iterator[RawFrame]:
        """Raw frames in the order they were received."""
        classes: dict[int, type[ProtoMessage] | None] = {}
        for registry, channel, t_ns, payload in self._messages():
            if channel not in classes:
                topic = registry.channels[channel].topic
                classes[channel] = _message_class(registry, channel) if topic == RAW_TOPIC else None
            kind = classes[channel]
            if kind is not None:
                f = kind.FromString(payload)
                yield RawFrame(t_ns, f.id, f.data, f.dlc, f.flags)  # type: ignore[attr-defined]

    def chunks(self) -> Iterator[bytes]:
        """Records of one chunk after the other, unpacked, for readers that decode in bulk; damaged ones are noted."""
        with self.path.open("rb") as file:
            for position, length in self._chunks:
                file.seek(position)
                try:
                    data = _chunk_records(file.read(length))
                except Exception as e:  # damaged in place: zstd, CRC, struct, …
                    note = f"the chunk at byte {position} is damaged ({type(e).__name__}), its frames are missing"
                    if note not in self.trouble:
                        self.trouble.append(note)
                    continue
                yield data

    def _messages(self) -> Iterator[tuple[_Registry, int, int, bytes]]:
        registry = _Registry()
        for data in self.chunks():
            yield from _walk(registry, data)


def read_log(path: str | Path, names: Collection[str] | None = None) -> Iterator[LogFrame]:
    """Decoded frames of a log, finished or not, in the order received: (t_ns, name, values, e2e).

    Use `LogReader` to learn whether the log is complete, and for metadata, attachments and raw frames.
    """
    return LogReader(path).frames(names)


def _chunk_records(body: bytes) -> bytes:
    chunk = Chunk.read(ReadDataStream(BytesIO(body)))
    stream, length = get_chunk_data_stream(chunk)
    data = stream.read(length)
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("CRC of the chunk")
    return data


def _walk(registry: _Registry, data: bytes) -> Iterator[tuple[_Registry, int, int, bytes]]:
    position, end = 0, len(data)
    while position < end:
        opcode, length = _HEAD.unpack_from(data, position)
        position += _HEAD.size
        if opcode == Opcode.MESSAGE:
            channel, _, t_ns, _ = _MESSAGE.unpack_from(data, position)
            if channel in registry.channels:
                yield registry, channel, t_ns, data[position + _MESSAGE.size : position + length]
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(BytesIO(data[position : position + length])))
            registry.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            found = Channel.read(ReadDataStream(BytesIO(data[position : position + length])))
            registry.channels[found.id] = found
        position += length


def _message_class(registry: _Registry, channel: int) -> type[ProtoMessage]:
    schema = registry.schemas[registry.channels[channel].schema_id]
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.AddSerializedFile(file.SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))


def _parser(registry: _Registry, channel: int, names: Collection[str] | None) -> tuple[str, _Parse] | None:
    """Name and payload parser of a channel, None if it is not one of decoded frames (or not wanted)."""
    topic = registry.channels[channel].topic
    name = topic.removeprefix(TOPIC_PREFIX)
    if name == topic or (names is not None and name not in names):
        return None
    kind = _message_class(registry, channel)
    fields = [f.name for f in kind.DESCRIPTOR.fields if f.name != "e2e"]
    tags = bytes(kind.DESCRIPTOR.fields_by_name[f].number << 3 | 1 for f in fields)
    full = struct.Struct("<" + "xd" * len(fields))

    def parse(payload: bytes) -> tuple[dict[str, float | None], int]:
        if payload[::9] == tags and len(payload) == full.size:  # the usual case: all there, nothing wrong
            return dict(zip(fields, full.unpack(payload), strict=True)), 0
        message = kind.FromString(payload)
        values = {f: getattr(message, f) if message.HasField(f) else None for f in fields}
        return values, message.e2e  # type: ignore[attr-defined]

    return name, parse
