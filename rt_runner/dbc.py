"""The DBC as the project sees it: cantools' database plus what our attributes say about each frame."""

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cantools
from cantools.database.can import Database, Message, Signal

from rt_runner.errors import SetupError

# RT_DBC: another file for a test bench; the estimator must have been built from the same one, which is checked.
DEFAULT_DBC = Path(os.environ.get("RT_DBC") or Path(__file__).resolve().parent.parent / "dbc" / "drive.dbc")
NOT_AVAILABLE = "not_available"
COUNTER_STATES = 16  # profile 2: a 4-bit counter, one data id per counter value


class DbcError(SetupError):
    """The DBC cannot be read, or says something the project cannot work with."""


@dataclass(frozen=True)
class SignalInfo:
    """One signal: physical = raw * factor + offset, raw codes in ``raw_min .. raw_max`` are valid."""

    name: str
    start: int
    length: int
    is_signed: bool
    factor: float
    offset: float
    unit: str
    raw_min: int
    raw_max: int
    raw_start: int
    raw_na: int | None  # the code that says "not available", None if the signal has none
    labels: dict[int, str]
    comment: str

    def to_raw(self, physical: float) -> int:
        """Nearest valid code: rounds half away from zero (as C's ``round``), clamps to the valid range.

        NaN is the caller's business: it has no nearest code.
        """
        if physical == float("inf"):
            return self.raw_max
        if physical == float("-inf"):
            return self.raw_min
        scaled = (physical - self.offset) / self.factor
        if scaled >= self.raw_max:
            return self.raw_max
        if scaled <= self.raw_min:
            return self.raw_min
        whole = int(scaled)  # towards zero; exact, as |scaled| < 2**53 here
        rest = scaled - whole
        return whole + (1 if rest >= 0.5 else -1 if rest <= -0.5 else 0)

    def to_physical(self, raw: int) -> float | None:
        """Physical value of a code, None for "not available"."""
        return None if raw == self.raw_na else raw * self.factor + self.offset


@dataclass(frozen=True)
class MessageInfo:
    """One frame: cantools' message and our attributes, checked."""

    name: str
    frame_id: int
    sender: str
    length: int
    cycle_ms: int
    timeout_ms: int
    per_job: bool  # sent once per executed job: its true period is the loop's, cycle_ms is the default
    simulation_only: bool
    crc_signal: str
    counter_signal: str
    data_id_list: bytes  # 16 bytes, one per counter value
    signals: tuple[SignalInfo, ...]  # all of them, crc and counter too, in bit order
    codec: Message

    @property
    def max_delta(self) -> int:
        """Largest counter step still taken as "some lost": what fits into the timeout, 1 to 14."""
        return max(1, min(COUNTER_STATES - 2, self.timeout_ms // self.cycle_ms))

    @property
    def payload(self) -> tuple[SignalInfo, ...]:
        """Signals a sender sets: everything but CRC and counter."""
        return tuple(s for s in self.signals if s.name not in (self.crc_signal, self.counter_signal))


class Dbc:
    """A loaded DBC: ``dbc["Estimate"]`` by name, ``dbc.by_id`` by CAN id, iterated in the order of the file."""

    def __init__(self, database: Database, text: bytes, path: str) -> None:
        self.database = database
        self.path = path
        self.text = text
        self.sha256 = hashlib.sha256(text).hexdigest()
        self.messages = tuple(_message_info(m, path) for m in database.messages)
        self.by_name = {m.name: m for m in self.messages}
        self.by_id = {m.frame_id: m for m in self.messages}

    @property
    def hash24(self) -> int:
        """First 24 bits of the file's SHA-256, as the identity frames carry it."""
        return int(self.sha256[:6], 16)

    def __getitem__(self, name: str) -> MessageInfo:
        try:
            return self.by_name[name]
        except KeyError:
            known = ", ".join(self.by_name)
            raise DbcError(f"{self.path}: no message {name!r}; it has {known}") from None

    def __iter__(self) -> Iterator[MessageInfo]:
        return iter(self.messages)


def load_dbc(path: str | Path | None = None) -> Dbc:
    """Load a DBC strictly; without a path, the project's own ``dbc/drive.dbc``.

    Raises
    ------
    DbcError : file missing, not a DBC, or an attribute the project relies on is missing or wrong (one line)
    """
    path = DEFAULT_DBC if path is None else Path(path)
    try:
        text = path.read_bytes()
    except OSError as e:
        raise DbcError(f"{path}: cannot read the DBC ({e.strerror}); give the path of a DBC file") from None
    return parse_dbc(text, str(path))


def parse_dbc(text: bytes, path: str = "DBC") -> Dbc:
    """Like `load_dbc`, from bytes: for a DBC that comes out of a log."""
    try:
        database = cantools.database.load_string(text.decode("cp1252"), database_format="dbc", strict=True)
    except Exception as e:  # cantools lets parser, decoder and consistency errors of many types through
        reason = " ".join(str(e).split())
        raise DbcError(f"{path}: not a usable DBC ({reason}); check it with cantools dump") from None
    if not isinstance(database, Database) or not database.messages:
        raise DbcError(f"{path}: no messages in it; is it a DBC of the project?")
    return Dbc(database, text, path)


def _attribute(message: Message, name: str, path: str) -> str | int | float:
    attributes = message.dbc.attributes if message.dbc is not None else {}
    if name not in attributes:
        raise DbcError(f"{path}: message {message.name} has no attribute {name}; add a BA_ line for it")
    return attributes[name].value


def _positive(message: Message, name: str, path: str) -> int:
    value = int(_attribute(message, name, path))
    if value <= 0:
        raise DbcError(f"{path}: message {message.name}: {name} is {value}, must be above 0 ms")
    return value


def _message_info(message: Message, path: str) -> MessageInfo:
    text = str(_attribute(message, "HilDataIdList", path))
    try:
        ids = bytes.fromhex(text)
    except ValueError:
        ids = b""
    if len(ids) != COUNTER_STATES:
        raise DbcError(f"{path}: message {message.name}: HilDataIdList {text!r} is not {COUNTER_STATES} bytes in hex")
    crc, counter = (str(_attribute(message, f"Hil{s}Signal", path)) for s in ("Crc", "Counter"))
    places = {s.name: (s.start, s.length) for s in message.signals if s.byte_order == "little_endian"}
    if places.get(crc) != (0, 8) or places.get(counter) != (8, 4):
        raise DbcError(
            f"{path}: message {message.name}: E2E profile 2 needs the CRC ({crc!r}) at bit 0, 8 bits, "
            f"and the counter ({counter!r}) at bit 8, 4 bits"
        )
    return MessageInfo(
        name=message.name,
        frame_id=message.frame_id,
        sender=message.senders[0] if message.senders else "",
        length=message.length,
        cycle_ms=_positive(message, "GenMsgCycleTime", path),
        timeout_ms=_positive(message, "HilTimeoutMs", path),
        per_job=bool(_optional(message, "HilPerJob")),
        simulation_only=bool(_optional(message, "HilSimulationOnly")),
        crc_signal=crc,
        counter_signal=counter,
        data_id_list=ids,
        signals=tuple(_signal_info(s, message, path) for s in sorted(message.signals, key=lambda s: s.start)),
        codec=message,
    )


def _optional(message: Message, name: str) -> int:
    attributes = message.dbc.attributes if message.dbc is not None else {}
    return int(attributes[name].value) if name in attributes else 0


def _signal_info(signal: Signal, message: Message, path: str) -> SignalInfo:
    where = f"{path}: signal {message.name}.{signal.name}"
    if signal.byte_order != "little_endian" or signal.conversion.is_float or signal.is_multiplexer:
        raise DbcError(f"{where}: only little-endian integer signals without multiplexing are supported")
    factor, offset = float(signal.scale), float(signal.offset)
    if factor <= 0.0:
        raise DbcError(f"{where}: factor {factor:g}, must be above 0")
    low, high = raw_limits(signal)
    labels = {int(code): str(label) for code, label in (signal.choices or {}).items()}
    na = next((code for code, label in labels.items() if label == NOT_AVAILABLE), None)
    raw_min = low if signal.minimum is None else max(low, round((float(signal.minimum) - offset) / factor))
    raw_max = high if signal.maximum is None else min(high, round((float(signal.maximum) - offset) / factor))
    raw_min += na == raw_min  # never clamp a value onto the code that says there is none
    raw_max -= na == raw_max
    return SignalInfo(
        name=signal.name,
        start=signal.start,
        length=signal.length,
        is_signed=signal.is_signed,
        factor=factor,
        offset=offset,
        unit=signal.unit or "",
        raw_min=raw_min,
        raw_max=raw_max,
        raw_start=int(signal.raw_initial or 0),
        raw_na=na,
        labels=labels,
        comment=signal.comment or "",
    )


def raw_limits(signal: Signal) -> tuple[int, int]:
    """Smallest and largest code the signal's bits can hold."""
    if signal.is_signed:
        return -(1 << (signal.length - 1)), (1 << (signal.length - 1)) - 1
    return 0, (1 << signal.length) - 1
