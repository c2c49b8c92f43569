"""Finds what cantools' strict mode lets through: ``python -m rt_runner.lint_dbc dbc/drive.dbc``.

Each rule is a function from a database to findings; a DBC is good if no rule has anything to say.
"""

import argparse
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import cantools
from cantools.database.can import Database, Message, Signal
from cantools.database.can.c_source import camel_to_snake_case

from rt_runner.dbc import COUNTER_STATES, NOT_AVAILABLE, DbcError, raw_limits
from rt_runner.e2e import crc8h2f

_KEYWORDS = """
    auto break case char const continue default do double else enum extern float for goto if inline int long
    register restrict return short signed sizeof static struct switch typedef union unsigned void volatile while
    bool true false asm class new delete this template namespace private public protected virtual
"""
C_KEYWORDS = frozenset(_KEYWORDS.split())  # and C++'s, for whoever includes the header there
UNIT_OF_SUFFIX = {
    "nm": "Nm", "rpm": "rpm", "degc": "degC", "mps": "m/s", "rad": "rad",
    "us": "us", "ms": "ms", "m": "m", "s": "s",
}  # fmt: skip
CLASSIC_BYTES = 8
STANDARD_IDS = 0x800
NO_NODE = "Vector__XXX"
LOGGER = "LOGGER"


class Finding(NamedTuple):
    """One complaint: the rule, the place, the sentence."""

    rule: str
    where: str
    text: str

    def __str__(self) -> str:
        return f"{self.rule}: {self.where}: {self.text}"


Rule = Callable[[Database], Iterator[Finding]]
RULES: dict[str, Rule] = {}


def _rule(function: Callable[[Database], Iterator[tuple[str, str]]]) -> Rule:
    """Register a rule; it yields (where, text) and is named after its function."""

    def named(db: Database) -> Iterator[Finding]:
        return (Finding(function.__name__, where, text) for where, text in function(db))

    RULES[function.__name__] = named
    return named


def lint(text: bytes) -> list[Finding]:
    """All findings in a DBC.

    Raises
    ------
    DbcError : the text is not a DBC at all
    """
    try:
        db = cantools.database.load_string(text.decode("cp1252"), database_format="dbc", strict=False)
    except Exception as e:  # the parser's errors have many types
        raise DbcError(f"not a DBC: {' '.join(str(e).split())}") from None
    if not isinstance(db, Database):
        raise DbcError("not a DBC of CAN messages")
    return [finding for rule in RULES.values() for finding in rule(db)]


def _signals(db: Database) -> Iterator[tuple[str, Message, Signal]]:
    return ((f"{m.name}.{s.name}", m, s) for m in db.messages for s in m.signals)


def _attribute(message: Message, name: str) -> str | int | float | None:
    attributes = message.dbc.attributes if message.dbc is not None else {}
    return attributes[name].value if name in attributes else None


def _bits(signal: Signal) -> range:
    return range(signal.start, signal.start + signal.length)


def _na(signal: Signal) -> int | None:
    return next((int(c) for c, label in (signal.choices or {}).items() if str(label) == NOT_AVAILABLE), None)


def _scalable(signal: Signal) -> bool:
    return not signal.conversion.is_float and signal.scale != 0


@_rule
def encoding(db: Database) -> Iterator[tuple[str, str]]:
    for where, _, s in _signals(db):
        if s.byte_order != "little_endian" or s.conversion.is_float or s.is_multiplexer or s.multiplexer_ids:
            yield where, "must be a little-endian integer, not multiplexed"


@_rule
def factor(db: Database) -> Iterator[tuple[str, str]]:
    for where, _, s in _signals(db):
        if s.scale <= 0:
            yield where, f"factor {s.scale:g}: the code cannot be scaled back, use one above 0"


@_rule
def c_name(db: Database) -> Iterator[tuple[str, str]]:
    names = [(m.name, m.name) for m in db.messages] + [(w, s.name) for w, _, s in _signals(db)]
    for where, name in names:
        if camel_to_snake_case(name) in C_KEYWORDS:
            yield where, "its name in C is a keyword, choose another"


@_rule
def snake_case(db: Database) -> Iterator[tuple[str, str]]:
    groups = [("messages", [m.name for m in db.messages])]
    groups += [(m.name, [s.name for s in m.signals]) for m in db.messages]
    for where, names in groups:
        by_snake = defaultdict(list)
        for name in names:
            by_snake[camel_to_snake_case(name)].append(name)
        for snake, same in by_snake.items():
            if len(same) > 1:
                yield where, f"{' and '.join(same)} have the same name in C ({snake})"


@_rule
def limits(db: Database) -> Iterator[tuple[str, str]]:
    for where, _, s in _signals(db):
        if not _scalable(s):
            continue
        low, high = sorted(float(raw * s.scale + s.offset) for raw in raw_limits(s))
        slack = abs(s.scale) / 2
        for limit in (s.minimum, s.maximum):
            if limit is not None and not low - slack <= limit <= high + slack:
                yield where, f"limit {limit:g} is beyond what its bits can hold, {low:g} .. {high:g}"
        if s.minimum is not None and s.maximum is not None and s.minimum > s.maximum:
            yield where, f"minimum {s.minimum:g} is above maximum {s.maximum:g}"
        na = _na(s)
        if na is None or s.minimum is None or s.maximum is None:
            continue
        if s.minimum - slack < na * s.scale + s.offset < s.maximum + slack:
            yield where, "the not-available code lies between minimum and maximum, it would be a valid value"


@_rule
def labels(db: Database) -> Iterator[tuple[str, str]]:
    for where, _, s in _signals(db):
        low, high = raw_limits(s)
        for code in s.choices or {}:
            if not low <= code <= high:
                yield where, f"label on code {code}, its bits hold {low} .. {high}"


@_rule
def not_available(db: Database) -> Iterator[tuple[str, str]]:
    for where, _, s in _signals(db):
        na = _na(s)
        low, high = raw_limits(s)
        wanted = low if s.is_signed else high
        if na is None and s.length >= 8 and s.unit:
            yield where, f'a physical signal ({s.unit}) needs VAL_ {wanted} "{NOT_AVAILABLE}"'
        elif na is not None and na != wanted:
            yield where, f"{NOT_AVAILABLE} is code {na}, the rule is {wanted}"


@_rule
def start_value(db: Database) -> Iterator[tuple[str, str]]:
    for where, _, s in _signals(db):
        start = s.raw_initial
        if start is None:
            yield where, "no start value, add BA_ GenSigStartValue"
            continue
        low, high = raw_limits(s)
        physical = start * s.scale + s.offset
        slack = abs(s.scale) / 2
        too_low = s.minimum is not None and physical < s.minimum - slack
        too_high = s.maximum is not None and physical > s.maximum + slack
        if start != _na(s) and (not low <= start <= high or too_low or too_high):
            yield where, f"start value {start} (raw) is out of range"


@_rule
def cycle_time(db: Database) -> Iterator[tuple[str, str]]:
    for m in db.messages:
        cycle, timeout = _attribute(m, "GenMsgCycleTime"), _attribute(m, "HilTimeoutMs")
        for name, value in (("GenMsgCycleTime", cycle), ("HilTimeoutMs", timeout)):
            if not value:
                yield m.name, f"{name} is missing or 0"
        if cycle and timeout and int(timeout) < int(cycle):
            yield m.name, f"timeout {timeout} ms is shorter than the cycle of {cycle} ms: always stale"


@_rule
def frame_id(db: Database) -> Iterator[tuple[str, str]]:
    by_id = defaultdict(list)
    for m in db.messages:
        by_id[m.frame_id].append(m.name)
        if m.is_extended_frame or m.frame_id >= STANDARD_IDS:
            yield m.name, "id must be a standard one, below 0x800"
    for can_id, names in by_id.items():
        if len(names) > 1:
            yield " and ".join(names), f"same id 0x{can_id:X}"


@_rule
def length(db: Database) -> Iterator[tuple[str, str]]:
    for m in db.messages:
        if m.length > CLASSIC_BYTES:
            yield m.name, f"{m.length} bytes, classic CAN carries {CLASSIC_BYTES}"
        for s in m.signals:
            if s.start + s.length > 8 * m.length:
                yield f"{m.name}.{s.name}", f"ends at bit {s.start + s.length}, the frame has {8 * m.length}"


@_rule
def overlap(db: Database) -> Iterator[tuple[str, str]]:
    for m in db.messages:
        for a, b in combinations(m.signals, 2):
            if set(_bits(a)) & set(_bits(b)):
                yield m.name, f"{a.name} and {b.name} share bits"


@_rule
def node(db: Database) -> Iterator[tuple[str, str]]:
    nodes = {n.name for n in db.nodes}
    for m in db.messages:
        if not m.senders or not set(m.senders) <= nodes:
            yield m.name, f"sender {', '.join(m.senders) or NO_NODE} is not a node of BU_"
    for where, _, s in _signals(db):
        for receiver in s.receivers:
            if receiver not in nodes:
                yield where, f"receiver {receiver} is not a node of BU_"


@_rule
def comment(db: Database) -> Iterator[tuple[str, str]]:
    for m in db.messages:
        if not m.comment or "Source:" not in m.comment:
            yield m.name, "needs a comment that says what it is and ends with its Source:"
    for where, _, s in _signals(db):
        if not s.comment or "Unit:" not in s.comment:
            yield where, "needs a comment that says what it is and ends with its Unit:"


@_rule
def unit(db: Database) -> Iterator[tuple[str, str]]:
    for where, _, s in _signals(db):
        wanted = UNIT_OF_SUFFIX.get(s.name.rsplit("_", 1)[-1], "") if "_" in s.name else ""
        if (s.unit or "") != wanted:
            yield where, f"unit is {s.unit or ''!r}, its name says {wanted!r}"


@_rule
def protection(db: Database) -> Iterator[tuple[str, str]]:
    for m in db.messages:
        for attribute, start, bits in (("HilCrcSignal", 0, 8), ("HilCounterSignal", 8, 4)):
            name = _attribute(m, attribute)
            found = next((s for s in m.signals if s.name == name), None)
            if found is None:
                yield m.name, f"{attribute} is missing or names no signal of the frame"
            elif (found.start, found.length, found.is_signed) != (start, bits, False):
                yield m.name, f"{attribute} {name} must be {bits} unsigned bits at bit {start} (profile 2)"


@_rule
def data_ids(db: Database) -> Iterator[tuple[str, str]]:
    lists: dict[str, bytes] = {}
    for m in db.messages:
        text = str(_attribute(m, "HilDataIdList") or "")
        try:
            ids = bytes.fromhex(text)
        except ValueError:
            ids = b""
        if len(ids) != COUNTER_STATES:
            yield m.name, f"HilDataIdList must be {COUNTER_STATES} bytes in hexadecimal"
        else:
            lists[m.name] = ids
            # The counter picks the data id, so damage to the counter can cancel itself out of the CRC.
            crcs = [crc8h2f(bytes((c, *bytes(m.length - 2), ids[c]))) for c in range(COUNTER_STATES)]
            if len(set(crcs)) < COUNTER_STATES:
                yield m.name, "HilDataIdList lets one counter value turn into another without a wrong CRC"
    for (a, ids_a), (b, ids_b) in combinations(lists.items(), 2):
        same = [c for c in range(COUNTER_STATES) if ids_a[c] == ids_b[c]]
        if same:
            at = f"at counter {', '.join(map(str, same))}"
            yield f"{a} and {b}", f"same data id {at}: one could pass as the other"


@_rule
def truth(db: Database) -> Iterator[tuple[str, str]]:
    for m in db.messages:
        simulation_only = bool(_attribute(m, "HilSimulationOnly"))
        if m.name.startswith("Truth") and not simulation_only:
            yield m.name, "its name starts with Truth: set HilSimulationOnly"
        if simulation_only and {r for s in m.signals for r in s.receivers} - {LOGGER}:
            yield m.name, f"HilSimulationOnly: nobody but {LOGGER} may receive it"


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="rt_runner.lint_dbc", description="Check a DBC beyond cantools' own.")
    parser.add_argument("dbc", type=Path, metavar="FILE")
    path = parser.parse_args(argv).dbc
    try:
        findings = lint(path.read_bytes())
    except OSError as e:
        print(f"lint_dbc: {path}: cannot read it ({e.strerror}); give a DBC file", file=sys.stderr)
        return 1
    except DbcError as e:
        print(f"lint_dbc: {path}: {e}", file=sys.stderr)
        return 1
    for finding in findings:
        print(f"{path}: {finding}")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
