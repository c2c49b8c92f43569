"""What is measured: backends, and the ways to run them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

DOUBLE, FLOAT, HPIPM = "double", "float", "hpipm"
QUADRATIC = 0  # EST_LOSS_QUADRATIC


@dataclass(frozen=True)
class Config:
    """One backend run in one way.

    Attributes
    ----------
    name, title : str
        Of the row.
    build, variant : str
        Which build of which solver (DOUBLE, FLOAT, HPIPM), and what backend_open() is told.
    sweeps : int
        Exactly so many linear solves a step; 0: until the setting's tolerance is met.
    tolerance_degc : float
        In place of the setting's; 0: the setting's.
    loss : int
        EST_LOSS_... for all steps; -1: the setting's.
    chief : bool
        A key of the JSON document.
    early : bool
        Its estimate is the one it gives before it has converged.
    """

    name: str
    title: str
    build: str
    variant: str
    sweeps: int = 0
    tolerance_degc: float = 0.0
    loss: int = -1
    chief: bool = False
    early: bool = False

    @property
    def converges(self) -> bool:
        """It solves the recorded problems to their tolerance, so that its error can be told."""
        return self.sweeps == 0 and self.loss < 0 and not self.early

    def words(self, library: str) -> str:
        """The runner's argument."""
        return f"{library},{self.variant},{self.sweeps},{self.tolerance_degc:g},{self.loss}"


REFERENCE = Config("reference", "portable, to 1e-10 °C", DOUBLE, "reference", tolerance_degc=1e-10)
KEYS = ("simd", "portable", "portable_f32", "hpipm_ocp", "hpipm_pcond5", "hpipm_full", "best_hpipm", "oracle")
CONFIGS = (
    Config("simd", "θ-space, vector kernel", DOUBLE, "", chief=True),
    Config("portable", "θ-space, portable C, -O2", DOUBLE, "portable", chief=True),
    Config("portable_f32", "θ-space, portable C, float", FLOAT, "", chief=True),
    Config("hpipm_ocp", "SQP + HPIPM, Riccati", HPIPM, "ocp", chief=True),
    Config("hpipm_pcond5", "SQP + HPIPM, condensed 15 → 5", HPIPM, "pcond5", chief=True),
    Config("hpipm_full", "SQP + HPIPM, fully condensed", HPIPM, "full", chief=True),
    Config("hpipm_ocp_free", "SQP + HPIPM, Riccati, bounds only where met", HPIPM, "ocp-free"),
    Config("hpipm_full_free", "SQP + HPIPM, fully condensed, bounds only where met", HPIPM, "full-free"),
    Config("simd_quadratic", "θ-space, vector kernel, quadratic loss", DOUBLE, "", loss=QUADRATIC),
    Config("hpipm_full_free_quadratic", "SQP + HPIPM, condensed, bounds where met, quadratic loss", HPIPM, "full-free",
           loss=QUADRATIC),
    Config("simd_avx2", "θ-space, AVX2 kernel", DOUBLE, "avx2"),
    Config("simd_2", "θ-space, vector kernel, two sweeps", DOUBLE, "", sweeps=2),
    Config("simd_feedback", "θ-space, vector kernel, feedback after one sweep", DOUBLE, "feedback", early=True),
    Config("portable_2", "θ-space, portable C, two sweeps", DOUBLE, "portable", sweeps=2),
    Config("f32_2", "θ-space, portable C, float, two sweeps", FLOAT, "", sweeps=2),
    Config("hpipm_rti", "one SQP iteration + HPIPM, fully condensed, bounds where met", HPIPM, "full-free", sweeps=1),
)  # fmt: skip
HPIPM_NAMES = tuple(c.name for c in CONFIGS if c.build == HPIPM and c.sweeps == 0 and c.loss < 0)


class UnknownBackend(Exception):
    """No backend of that name; the message says which there are."""


def chosen(names: Sequence[str] | None) -> tuple[tuple[Config, ...], bool]:
    """(configurations in the table's order, whether the oracle is a row of its own) of names; all without names."""
    if names is None:
        return CONFIGS, True
    known = {c.name for c in CONFIGS}
    for name in names:
        if name not in known | {"oracle", "best_hpipm"}:
            raise UnknownBackend(
                f"no backend '{name}': choose from {', '.join([*(c.name for c in CONFIGS), 'oracle'])}"
            )
    wanted = set(names) | (set(HPIPM_NAMES) if "best_hpipm" in names else set())
    return tuple(c for c in CONFIGS if c.name in wanted), "oracle" in names
