"""One node's real-time loop as the log has it, the estimator's and the controller's alike: accounted and judged.

A node is known by the prefix of its frames: ``EstTimingA`` … ``EstCanary``, ``CtlTimingA`` … ``CtlCanary``.
"""

from dataclasses import dataclass, replace

from rt_runner.judge import Finding, judge_misses
from rt_runner.timing_account import TimingAccount

RELEASES_LAST, SKIPPED_LAST = (1 << 24) - 2, (1 << 16) - 2  # counters stop at their last valid code
# What only the loop's own counters say; null where an older log has them not.
OWN_COUNTS = {
    "Misses": ("overrun",),
    "Overload": ("queued", "cut", "rebased"),
    "MissRun": ("consec_miss_max", "mk_worst"),
    "Outputs": ("held", "predicted", "invalidated"),
}
ENVIRONMENT = {
    "Environment": ("minor_faults", "major_faults", "invol_switches"),
    "Machine": ("run_delay_ms", "migrations"),
    "Canary": ("canary_p99_us", "canary_max_us"),
}
FAULTS = {"input": ("crc_errors", "seq_errors", "stale_inputs"), "bus": ("rx_drops", "tx_drops", "rejected")}


@dataclass(frozen=True)
class Terms:
    """What a node's loop is judged by; ``steal_ms`` is what was taken from its core, where that was measured."""

    miss_rate_max: float
    mk: tuple[int, int] | None = None
    grace_releases: int | None = None  # of start-up; None: only what the jobs say of themselves
    lockstep: bool = False
    steal_ms: float | None = None
    dropped: int = 0  # frames that are missing from the log


class NodeAccount:
    """Collects the timing frames and the counters of one node.

    Parameters
    ----------
    prefix : of its frames' names
    word : how people call it
    """

    def __init__(self, prefix: str, word: str) -> None:
        self.prefix, self.word = prefix, word
        self.timing = TimingAccount()
        self._last: dict[str, dict[str, float | None]] = {}
        self._jobs = {f"{prefix}Timing{x}": getattr(self.timing, f"job_{x.lower()}") for x in "ABCD"}

    @property
    def heard(self) -> bool:
        """Whether the log has anything of it."""
        return bool(self._last)

    def feed(self, name: str, values: dict[str, float | None]) -> None:
        """Take one decoded frame; another node's is left alone."""
        if not name.startswith(self.prefix):
            return
        self._last[name] = values
        if name in self._jobs:
            self._jobs[name](values)

    def value(self, message: str, signal: str) -> float | None:
        """The newest value of a signal; ``message`` without the prefix."""
        return self._last.get(f"{self.prefix}{message}", {}).get(signal)

    def count(self, message: str, signal: str) -> int:
        """The newest value of a counter; 0 where there is none."""
        return whole(self.value(message, signal)) or 0

    # ---- figures --------------------------------------------------------------------------------------
    def figures(self, period_s: float | None, mk: tuple[int, int] | None = None, grace: int | None = None) -> dict:
        """Jobs, misses, causes, durations, and what the loop says of itself; ready for JSON."""
        return {
            "period_s": period_s,
            **self.timing.figures(),
            **{k: whole(self.value(m, k)) for m, ks in OWN_COUNTS.items() for k in ks},
            "phase_us": self.value("MissRun", "phase_us"),
            "mk": None if mk is None else {"m": mk[0], "k": mk[1], "worst": self.timing.worst_of(mk[1], grace)},
        }

    def environment(self) -> dict:
        """What the kernel and the canary say, since warm-up."""
        return {k: self.value(m, k) for m, ks in ENVIRONMENT.items() for k in ks}

    def faults(self, kind: str) -> dict[str, int]:
        """Counters of its inputs' or of its bus's trouble; ``kind``: input | bus."""
        return {k: self.count(f"{kind.capitalize()}Faults", k) for k in FAULTS[kind]}

    # ---- judging --------------------------------------------------------------------------------------
    def judge(self, terms: Terms, qualifier: str = "") -> list[Finding]:
        """Miss rate and (m, K) where there is time, and whether every release is accounted for.

        ``qualifier`` goes before the findings' names.
        """
        out = [] if terms.lockstep else self._judge_misses(terms)
        conservation = self._conservation()
        out += [conservation] if conservation else []
        return [replace(f, what=f"{qualifier} {f.what}") if qualifier else f for f in out]

    def _judge_misses(self, terms: Terms) -> list[Finding]:
        judged = self.timing.judged(terms.grace_releases)
        machine = self._machine(terms.steal_ms)
        finding = judge_misses(judged.misses, judged.by_machine, judged.releases, terms.miss_rate_max, machine)
        if finding.verdict == "fail" and terms.dropped:
            finding = replace(finding, verdict="inconclusive", evidence=f"{finding.evidence}; but the log has gaps")
        return [finding, *([self.timing.judge_mk(terms.mk, terms.dropped, terms.grace_releases)] if terms.mk else [])]

    def _conservation(self) -> Finding | None:
        releases, jobs = self.count("Releases", "releases"), self.count("Releases", "jobs")
        skipped = self.count("Misses", "miss_skipped")
        if not releases or releases >= RELEASES_LAST or skipped >= SKIPPED_LAST:
            return None  # nothing was counted yet, or a counter stands at its last code: no account to compare
        # The counters were sent once a second; jobs logged since then are the difference, never a deficit.
        if releases != jobs + skipped:
            says = f"{self.word} counted {releases} releases, but {jobs} jobs + {skipped} skipped"
            return Finding("conservation", "fail", says)
        if self.timing.jobs < jobs:
            says = f"{self.word} executed {jobs} jobs, only {self.timing.jobs} of them are in the log"
            return Finding("conservation", "inconclusive", says)
        says = f"{releases} releases = {jobs} jobs + {skipped} skipped"
        waiting = self.count("Overload", "waiting")
        says += f" (and {waiting} wait)" if waiting else ""
        return Finding("conservation", "pass", says)

    def _machine(self, steal_ms: float | None) -> str:
        """What speaks for the machine having been taken from us, in words; empty where nothing was measured."""
        shown = []
        p99, largest = (self.value("Canary", k) for k in ("canary_p99_us", "canary_max_us"))
        if largest is not None:
            shown.append(f"canary up to {largest:.0f} us late" + (f" (p99 {p99:.0f} us)" if p99 is not None else ""))
        shown += [f"{steal_ms:.0f} ms stolen"] if steal_ms is not None else []
        delay = self.value("Machine", "run_delay_ms")
        shown += [f"{delay:.1f} ms ready but not run"] if delay is not None else []
        return ", ".join(shown)


def whole(count: float | None) -> int | None:
    """A counter as an integer; None stays None."""
    return None if count is None else int(count)
