"""The cases of a comparison: what is wrong with the sensor or with the plant, and what is asked of `default`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from plant_sim.faults import Fault, load_catalogue, parse_fault

CHANNELS = ("winding", "rotor")
FAULT_WINDOW = "430-550"  # s of the lap: 140 to 168 degC


@dataclass(frozen=True)
class Variant:
    """One run: sensor faults in text form (for the winding), or a plant that is not the net's."""

    label: str
    faults: tuple[str, ...] = ()
    mismatch: str | None = None

    def on(self, channel: str) -> tuple[Fault, ...]:
        """The faults on a channel of CHANNELS."""
        suffix = "" if channel == CHANNELS[0] else "/r"
        return tuple(parse_fault(text + suffix) for text in self.faults)

    @property
    def window_s(self) -> tuple[float, float] | None:
        """From the first fault's start to the last one's end; None without a fault."""
        faults = self.on(CHANNELS[0])
        return (min(f.start_s for f in faults), max(f.end_s for f in faults)) if faults else None


@dataclass(frozen=True)
class Target:
    """Largest RMSE and largest error in °C asked of the default estimator's winding temperature."""

    rmse_degc: float
    max_degc: float
    in_window: bool = False  # judged in the fault's window only


@dataclass(frozen=True)
class Case:
    """One row of the table: its variants are judged together."""

    name: str
    title: str
    variants: tuple[Variant, ...]
    target: Target | None = None


def _faults(*texts: str) -> tuple[Variant, ...]:
    return tuple(Variant(text, (text,)) for text in texts)


def cases() -> tuple[Case, ...]:
    """All cases in the order of the table."""
    both = tuple(str(fault) for fault in load_catalogue()["F10"]["paper"])
    return (
        Case("nominal", "nothing wrong", (Variant("nominal"),), Target(0.12, 0.5)),
        Case(
            "offset", "offset −20 °C for 120 s; −30 °C for 60 s",
            _faults(f"offset:-20@{FAULT_WINDOW}", "offset:-30@430-490"), Target(0.35, 1.0, in_window=True),
        ),
        Case("noise", "noise × 15 (σ 5 °C) for 120 s", _faults(f"noise:5@{FAULT_WINDOW}"), Target(0.25, 0.8)),
        Case("stuck", "stuck for 60 s", _faults("stuck@430-490"), Target(0.6, 1.5)),
        Case(
            "dropout", "60 s: no value; open; short circuit",
            _faults("dropout:nan@430-490", "dropout:open@430-490", "dropout:short@430-490"), Target(0.5, 1.2),
        ),
        Case("spike", "2 % of the samples off by 10 to 40 °C, 120 s", _faults(f"spike:2%@{FAULT_WINDOW}"),
             Target(0.15, 0.6)),
        Case("drift", "drift −0.05 °C/s for 120 s", _faults(f"drift:-0.05@{FAULT_WINDOW}"), Target(1.0, 2.5)),
        Case("slow", "detached: first-order lag of 15 s, 120 s", _faults(f"slow:15@{FAULT_WINDOW}"), Target(0.5, 1.5)),
        Case("delay", "3 s later than it should be, 120 s", _faults(f"delay:3@{FAULT_WINDOW}"), Target(0.5, 1.5)),
        Case("gain", "gain −5 % about 25 °C, 120 s", _faults(f"gain:-5%@{FAULT_WINDOW}")),
        Case("combined", "offset −20 °C and noise σ 5 °C, 120 s", (Variant("F10", both),)),
        Case(
            "mismatch", "another plant: coolant 50 °C; half the flow; R + 5 %",
            tuple(Variant(name, mismatch=name) for name in ("coolant-50", "flow-half", "resistance-1.05")),
            Target(0.5, 1.5),
        ),
    )  # fmt: skip


class UnknownCase(Exception):
    """No case of that name; the message says which there are."""


def chosen(names: Sequence[str] | None) -> tuple[Case, ...]:
    """The cases of these names, in the order of the table; all without names."""
    every = cases()
    if names is None:
        return every
    for name in names:
        if name not in {case.name for case in every}:
            raise UnknownCase(f"no case '{name}': choose from {', '.join(case.name for case in every)}")
    return tuple(case for case in every if case.name in names)
