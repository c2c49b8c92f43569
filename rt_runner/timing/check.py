"""One check of an audit."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Check:
    """What was compared, whether it agrees (None: it could not be compared), and the figures."""

    name: str
    ok: bool | None
    evidence: str
