"""Sensor faults as data: one line of text each, and the catalogue F1 to F10 they come from.

    KIND[:AMPLITUDE]@START-END[/CHANNEL]      offset:-20@430-550   noise:5@430-550/r   stuck@430-490/wr

What a fault does to a reading is in `plant_sim.sensors`.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from plant_sim.errors import FaultError
from plant_sim.mismatch import load_mismatches, mismatched

__all__ = [
    "KINDS",
    "Fault",
    "active_faults",
    "check_faults",
    "check_run",
    "load_catalogue",
    "load_mismatches",
    "mismatched",
    "parse_fault",
]

# The order is the order of the bits in TruthFault and in `active_faults`.
KINDS = ("offset", "noise", "stuck", "dropout", "spike", "drift", "slow", "delay", "gain")
CHANNELS = ("w", "r", "wr")
OPEN_DEGC, SHORT_DEGC = -40.0, 200.0  # what an open and a shorted NTC read
_DROPOUTS = {"nan": None, "open": OPEN_DEGC, "short": SHORT_DEGC}
_SLACK_S = 1e-6  # times are decimal fractions of a second, ticks are 10 ms

# kind -> what the amplitude is, its smallest and its largest value. Percentages are kept as such.
_RANGES = {
    "offset": ("K", -300.0, 300.0),
    "noise": ("K (standard deviation)", 0.0, 300.0),
    "spike": ("% of the samples", 0.0, 100.0),
    "drift": ("K/s", -100.0, 100.0),
    "slow": ("s (time constant)", 1e-3, 3600.0),
    "delay": ("s more than nominal", 0.0, 60.0),
    "gain": ("% of the distance to 25 degC", -100.0, 100.0),
}
_PERCENT = ("spike", "gain")
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_FORM = re.compile(
    rf"(?P<kind>[a-z]+)(?::(?P<amplitude>[^@]*))?@(?P<start>{_NUMBER})-(?P<end>{_NUMBER})(?:/(?P<channel>[a-z]+))?"
)
_EXAMPLE = "write KIND[:AMPLITUDE]@START-END[/CHANNEL], for example offset:-20@430-550 or stuck@430-490/r"


@dataclass(frozen=True)
class Fault:
    """One fault of one temperature sensor, or of both.

    Attributes
    ----------
    kind
        One of `KINDS`.
    amplitude
        ``offset`` K; ``noise`` standard deviation in K, in place of the nominal one; ``spike`` per cent of the
        samples, each off by U(10, 40) K up or down; ``drift`` K/s, up to 20 K; ``slow`` time constant in s; ``delay`` s
        more than nominal; ``gain`` per cent of the distance to 25 degC; ``dropout`` the reading in degC, None: no
        value; ``stuck`` None.
    start_s, end_s
        Window [start, end) in seconds since the start of the plant.
    channel
        ``w`` winding, ``r`` rotor, ``wr`` both.

    Raises
    ------
    FaultError
        If it cannot be.
    """

    kind: str
    amplitude: float | None
    start_s: float
    end_s: float
    channel: str = "w"

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise FaultError(f"fault kind '{self.kind}' does not exist: use one of {', '.join(KINDS)}")
        if self.channel not in CHANNELS:
            raise FaultError(f"fault {self.kind}: channel '{self.channel}' is none of w (winding), r (rotor), wr")
        if not 0.0 <= self.start_s < self.end_s < math.inf:
            raise FaultError(
                f"fault {self.kind}: {self.start_s:g}-{self.end_s:g} s is no window; it starts at 0 s or later and "
                f"ends after its start"
            )
        if self.kind == "stuck":
            if self.amplitude is not None:
                raise FaultError("fault stuck has no amplitude: it holds the last reading")
        elif self.kind == "dropout":
            if self.amplitude not in _DROPOUTS.values():
                raise FaultError("fault dropout: use dropout:nan, dropout:open or dropout:short")
        else:
            unit, low, high = _RANGES[self.kind]
            if self.amplitude is None or not low <= self.amplitude <= high:
                raise FaultError(f"fault {self.kind}: amplitude {self.amplitude} must be {low:g} to {high:g} {unit}")

    def __str__(self) -> str:
        amplitude = ""
        if self.kind == "dropout":
            amplitude = ":" + next(name for name, value in _DROPOUTS.items() if value == self.amplitude)
        elif self.amplitude is not None:
            amplitude = f":{_plain(self.amplitude)}{'%' if self.kind in _PERCENT else ''}"
        channel = "" if self.channel == "w" else f"/{self.channel}"
        return f"{self.kind}{amplitude}@{_plain(self.start_s)}-{_plain(self.end_s)}{channel}"

    @property
    def size(self) -> float:
        """The amplitude as a number, 0 where the kind has none."""
        return 0.0 if self.amplitude is None else self.amplitude

    @property
    def columns(self) -> tuple[int, ...]:
        """Columns of the readings it concerns: 0 winding, 1 rotor."""
        return tuple("wr".index(c) for c in self.channel)

    def samples(self, period_s: float) -> tuple[int, int]:
        """First sample in the window and first one after it; sample k is taken at ``k * period_s``."""
        first, end = (math.ceil((t - _SLACK_S) / period_s) for t in (self.start_s, self.end_s))
        return first, end

    def active(self, t_s: float) -> bool:
        """Whether a reading taken at ``t_s`` (s) lies in the window."""
        return self.start_s - _SLACK_S <= t_s < self.end_s - _SLACK_S


def _plain(x: float) -> str:
    return repr(float(x)).removesuffix(".0")


def parse_fault(text: str) -> Fault:
    """Read one fault from its text form; the inverse of ``str(fault)``.

    Raises
    ------
    FaultError
        With the text and how to write it, in one line.
    """
    found = _FORM.fullmatch(text.strip())
    if found is None:
        raise FaultError(f"fault '{text}' is not understood: {_EXAMPLE}")
    kind, raw = found["kind"], found["amplitude"]
    try:
        amplitude = _amplitude(kind, raw)
        return Fault(kind, amplitude, float(found["start"]), float(found["end"]), found["channel"] or "w")
    except FaultError as error:
        raise FaultError(f"fault '{text}': {str(error).removeprefix('fault ')}") from None


def _amplitude(kind: str, raw: str | None) -> float | None:
    if kind not in KINDS or raw is None:
        return None  # `Fault` says what is wrong with that, if anything
    if kind == "dropout":
        if raw not in _DROPOUTS:
            raise FaultError(f"dropout:{raw} does not exist: use dropout:nan, dropout:open or dropout:short")
        return _DROPOUTS[raw]
    if kind == "stuck":
        raise FaultError("stuck has no amplitude: it holds the last reading")
    wanted = "%" if kind in _PERCENT else ""
    if not re.fullmatch(_NUMBER + wanted, raw):
        raise FaultError(f"{kind}: amplitude '{raw}' is no number{' in %' if wanted else ''}, {_RANGES[kind][0]}")
    return float(raw.removesuffix("%"))


def check_faults(faults: Iterable[Fault]) -> tuple[Fault, ...]:
    """Return the faults, in order of time, if they can act together.

    Raises
    ------
    FaultError
        If two of one kind overlap on one channel: which of them counts would be a guess.
    """
    ordered = tuple(sorted(faults, key=lambda f: (f.start_s, KINDS.index(f.kind), f.channel)))
    for i, a in enumerate(ordered):
        for b in ordered[i + 1 :]:
            if a.kind == b.kind and set(a.channel) & set(b.channel) and b.start_s < a.end_s:
                raise FaultError(f"faults '{a}' and '{b}' are of one kind and overlap: give them separate windows")
    return ordered


def check_run(faults: Iterable[Fault], start_s: float, end_s: float) -> None:
    """Refuse faults that no reading of a run from ``start_s`` to ``end_s`` (s, may be infinite) would show.

    Raises
    ------
    FaultError
        If a window lies outside the run.
    """
    for fault in check_faults(faults):
        if fault.end_s <= start_s or fault.start_s >= end_s:
            raise FaultError(
                f"fault '{fault}' lies outside the run, which goes from {start_s:g} s to "
                f"{'its cycle’s end' if end_s == math.inf else f'{end_s:g} s'}: times count from the plant's start"
            )


def active_faults(faults: Iterable[Fault], t_s: float) -> tuple[int, int]:
    """Bit masks (winding, rotor) of the faults at a time (s); bit k is ``KINDS[k]``."""
    masks = [0, 0]
    for fault in faults:
        if fault.active(t_s):
            for column in fault.columns:
                masks[column] |= 1 << KINDS.index(fault.kind)
    return masks[0], masks[1]


def load_catalogue() -> dict[str, dict[str, list[Fault]]]:
    """The catalogue: id -> severity (``mild``, ``paper``, ``severe``; not all have all) -> faults that act together.

    Windows are those of the lap's hot part, from second 430 on.
    """
    path = Path(__file__).with_name("faults.json")
    tree = json.loads(path.read_text(encoding="utf-8"))
    return {
        name: {severity: [parse_fault(t) for t in texts] for severity, texts in entry.items() if severity != "title"}
        for name, entry in tree.items()
    }


def main(argv: Sequence[str]) -> int:
    """``python -m plant_sim.faults START_S END_S FAULT…``: exit status 0 if a run can have these faults.

    Light on purpose: the runner asks before it starts anything.
    """
    try:
        check_run([parse_fault(text) for text in argv[2:]], float(argv[0]), float(argv[1]))
    except FaultError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
