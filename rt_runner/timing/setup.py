"""What a run was set to, as far as its timing goes, out of what the log carries beside its frames."""

import json
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from rt_runner.log_reader import LogReader
from rt_runner.log_summary import result_of
from rt_runner.result import RunFacts

DEFAULT_PERIOD_S = 0.1


@dataclass(frozen=True)
class TimingSetup:
    """Period T, deadline D, policy and monitor of a run; ``sealed`` says that it ended in order and wrote its facts."""

    facts: RunFacts
    sealed: bool
    started_by_runner: bool
    period_ns: int
    deadline_ns: int
    policy: str = "skip"
    on_miss: str = "late"
    trigger: str = "time"
    mk: tuple[int, int] | None = None
    grace_s: float | None = None  # of start-up; None: the process's own rule
    logged: int | None = None  # frames of the DBC, by the logger's own count

    def with_period(self, period_ns: int) -> "TimingSetup":
        """The same for a process with another period; a deadline of one period stays one."""
        deadline_ns = period_ns if self.deadline_ns == self.period_ns else self.deadline_ns
        return replace(self, period_ns=period_ns, deadline_ns=deadline_ns)

    def with_drops(self, log_dropped: int) -> "TimingSetup":
        """The same with so many frames dropped by the logger."""
        return replace(self, facts=replace(self.facts, log_dropped=log_dropped))

    @property
    def queue(self) -> int:
        """Releases that may wait."""
        word, _, number = self.policy.partition(":")
        return int(number) if word == "queue" and number.isdigit() else 0


def setup_of(reader: LogReader) -> TimingSetup:
    """Read it; defaults stand in for what an older log does not say."""
    run = reader.metadata.get("run", {})
    facts, sealed = RunFacts(), False
    with suppress(KeyError, ValueError, TypeError, AttributeError):
        facts, sealed = RunFacts.from_dict(json.loads(reader.metadata["facts"]["json"])), True
    scenario = _scenario(reader)
    if not sealed:
        known = {"bus": run.get("bus"), "scenario": run.get("scenario"), "limits": _table(scenario, "limits")}
        with suppress(TypeError):
            facts = RunFacts.from_dict({k: v for k, v in known.items() if v})
    timing, estimator = (_table(scenario, name) for name in ("timing", "estimator"))
    period_s = facts.period_s if sealed else _number(run.get("period_s")) or DEFAULT_PERIOD_S
    mk = timing.get("mk")
    period_ns = round(period_s * 1e9)
    return TimingSetup(
        facts=facts,
        sealed=sealed,
        started_by_runner="scenario" in run,
        period_ns=period_ns,
        deadline_ns=round((_number(timing.get("deadline_s")) or 0) * 1e9) or period_ns,
        policy=str(timing.get("policy", "skip")),
        on_miss=str(timing.get("on_miss", "late")),
        trigger=str(estimator.get("trigger", "time")),
        mk=(int(mk[0]), int(mk[1])) if isinstance(mk, list | tuple) and len(mk) == 2 else None,
        grace_s=_number(timing.get("grace_s")),
        logged=_logged(reader),
    )


def _logged(reader: LogReader) -> int | None:
    with suppress(KeyError, ValueError, TypeError):
        return int((result_of(reader.metadata) or {})["log"]["frames"])
    return None


def final_of(reader: LogReader, name: str | None) -> dict[str, Any] | None:
    """Last words of a process, None where the log has none."""
    with suppress(KeyError, ValueError):
        if name is None:
            return None
        words = json.loads(reader.attachments[name])
        return words if isinstance(words, dict) else None
    return None


def _scenario(reader: LogReader) -> dict[str, Any]:
    """The scenario as it was run, else the file it came from."""
    for name, parse in (("scenario_as_run.json", json.loads), ("scenario.toml", tomllib.loads)):
        with suppress(KeyError, ValueError):
            tree = parse(reader.attachments[name].decode())
            if isinstance(tree, dict):
                return tree
    return {}


def _table(tree: Mapping[str, Any], name: str) -> dict[str, Any]:
    table = tree.get(name)
    return table if isinstance(table, dict) else {}


def _number(value: object) -> float | None:
    with suppress(TypeError, ValueError):
        return float(value)  # type: ignore[arg-type]
    return None
