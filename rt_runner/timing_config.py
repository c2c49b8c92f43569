"""Scenario table ``[timing]``: what happens when a job misses its deadline, and what is demanded of misses."""

import math
import re
from dataclasses import dataclass
from typing import Any

from rt_runner.errors import UsageError

POLICIES = "skip, queue:N, rebase, cut:BUDGET_US, stop:total:M, stop:row:M"
_POLICY = re.compile(r"skip|rebase|(queue|cut|stop:total|stop:row):([1-9]\d{0,9})")
_INJECTION = re.compile(r"(compute|sleep):([1-9]\d{0,7})@([1-9]\d{0,17})")
ON_MISS = ("late", "hold", "predict", "invalid")
TRIGGERS = ("time", "frame")
QUEUE_MAX, MK_MAX, MISSES_MAX, INJECTIONS_MAX, INJECTION_MAX_US = 64, 100, 10**9, 64, 60_000_000
GRACE_MAX_RELEASES = 1_000_000
GRACE_DEFAULT_S, GRACE_LEAST_RELEASES = 1.0, 5  # where the scenario says nothing


@dataclass(frozen=True)
class TimingConfig:
    """How the estimator's loop answers to overruns and misses.

    ``policy`` says what becomes of the releases that pass while a job runs, ``on_miss`` what a late job puts out,
    ``grace_s`` how long misses are not judged (None: a second, at least five releases), ``mk`` that at most m of any K
    consecutive releases may be missed, ``inject`` faults made on purpose (``compute:US@RELEASE``), ``deadline_s`` from
    the release to the output (None: the period).
    """

    policy: str = "skip"
    on_miss: str = "late"
    grace_s: float | None = None
    mk: tuple[int, int] | None = None
    canary: bool = True
    inject: tuple[str, ...] = ()
    deadline_s: float | None = None


def timing_from(values: dict, where: str) -> TimingConfig:
    """The table as read from TOML, with the types it needs; `check_timing` says whether it can be.

    Raises
    ------
    UsageError
        Unknown key, or a value of another type.
    """
    shapes = {
        "policy": (lambda v: isinstance(v, str), "a text"),
        "on_miss": (lambda v: isinstance(v, str), "a text"),
        "grace_s": (lambda v: isinstance(v, int | float) and not isinstance(v, bool), "a number"),
        "mk": (lambda v: isinstance(v, list) and [type(x) for x in v] == [int, int], "two whole numbers [m, K]"),
        "canary": (lambda v: isinstance(v, bool), "true or false"),
        "deadline_s": (lambda v: isinstance(v, int | float) and not isinstance(v, bool), "a number"),
        "inject": (lambda v: isinstance(v, list) and all(isinstance(x, str) for x in v), "a list of texts"),
    }
    for key, value in values.items():
        if key not in shapes:
            raise UsageError(f"{where}: unknown key '{key}' (known: {', '.join(shapes)})")
        fits, shape = shapes[key]
        if not fits(value):
            raise UsageError(f"{where} {key} = {value!r}: must be {shape}")
    taken: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in values.items()}
    for key in ("grace_s", "deadline_s"):
        if key in taken:
            taken[key] = float(taken[key])
    return TimingConfig(**taken)


def check_timing(t: TimingConfig, period_s: float, trigger: str, where: str) -> None:
    """Refuse what the estimator would refuse, and what does not go together.

    Raises
    ------
    UsageError
        One line: what, where, what to do.
    """
    if t.deadline_s is not None and not 1e-6 <= t.deadline_s <= period_s:
        raise UsageError(f"{where}: deadline_s = {t.deadline_s:g} must lie in 1e-06 … {period_s:g}, the period")
    _check_policy(t.policy, period_s if t.deadline_s is None else t.deadline_s, f"{where}: policy = '{t.policy}'")
    if trigger not in TRIGGERS:
        raise UsageError(f"{where}: trigger = '{trigger}' is none of {', '.join(TRIGGERS)}")
    if trigger == "frame" and t.policy.partition(":")[0] in ("queue", "rebase"):
        raise UsageError(f"{where}: policy = '{t.policy}' is for the time grid; with trigger = \"frame\" give another")
    if t.on_miss not in ON_MISS:
        raise UsageError(f"{where}: on_miss = '{t.on_miss}' is none of {', '.join(ON_MISS)}")
    if t.grace_s is not None and not 0 <= t.grace_s <= GRACE_MAX_RELEASES * period_s:
        raise UsageError(f"{where}: grace_s = {t.grace_s:g} must lie in 0 … {GRACE_MAX_RELEASES * period_s:g}")
    if t.mk is not None and not 0 <= t.mk[0] < t.mk[1] <= MK_MAX:
        raise UsageError(f"{where}: mk = {list(t.mk)}: at most m misses in any K releases, 0 <= m < K <= {MK_MAX}")
    if len(t.inject) > INJECTIONS_MAX:
        raise UsageError(f"{where}: inject has {len(t.inject)} faults, {INJECTIONS_MAX} are the most")
    for text in t.inject:
        match = _INJECTION.fullmatch(text)
        if match is None or int(match[2]) > INJECTION_MAX_US:
            known = f"compute:US@RELEASE nor sleep:US@RELEASE (US 1 … {INJECTION_MAX_US})"
            raise UsageError(f"{where}: inject '{text}' is neither {known}")


def _check_policy(policy: str, deadline_s: float, what: str) -> None:
    match = _POLICY.fullmatch(policy)
    if match is None:
        raise UsageError(f"{what} is none of {POLICIES}")
    if match[1] is None:
        return
    most = {"queue": QUEUE_MAX, "cut": round(deadline_s * 1e6)}.get(match[1], MISSES_MAX)
    if int(match[2]) > most:
        why = "the deadline" if match[1] == "cut" else "the most"
        raise UsageError(f"{what}: {match[2]} is more than {most}, {why}")


def grace_releases(grace_s: float | None, period_s: float) -> int:
    """The first so many releases are start-up grace: the loop's own rule, for who reads its log."""
    if grace_s is None:
        return max(GRACE_LEAST_RELEASES, math.ceil(GRACE_DEFAULT_S / period_s - 1e-9))
    return math.ceil(grace_s / period_s - 1e-9)


def timing_options(t: TimingConfig, period_s: float, trigger: str, *, lockstep: bool = False) -> list[str]:
    """The estimator's options for it; none for what it does by itself.

    Raises
    ------
    UsageError
        In lock-step: what needs a clock.
    """
    if lockstep and (trigger == "frame" or t.inject):
        what = 'trigger = "frame"' if trigger == "frame" else "[timing] inject"
        raise UsageError(f"{what} needs time to pass, in lock-step it does not: use rt-runner run")
    options = []
    for option, value, default in (("--policy", t.policy, "skip"), ("--on-miss", t.on_miss, "late"),
                                   ("--trigger", trigger, "time")):  # fmt: skip
        options += [option, value] if value != default else []
    if t.deadline_s is not None:
        options += ["--deadline-us", str(round(t.deadline_s * 1e6))]
    if t.grace_s is not None:
        options += ["--grace-releases", str(grace_releases(t.grace_s, period_s))]
    if t.mk is not None:
        options += ["--mk", f"{t.mk[0]},{t.mk[1]}"]
    options += [] if t.canary or lockstep else ["--no-canary"]
    for text in t.inject:
        options += ["--inject", text]
    return options
