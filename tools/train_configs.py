"""What a training run depends on beside its data, and the named configurations of it.

`paper` is Algorithm 1 and the table of hyperparameters of the paper (Energies 18(14):3813), with MATLAB's meaning where
the paper names only a number; `tuned` is what made the committed net.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """Settings of a run, written into the weights file. The defaults are the configuration `tuned`."""

    config: str = "tuned"  # the configuration that the others started from
    cell: str = "lstm"  # or "gru"
    hidden: int = 8
    layers: int = 1
    seed: int = 1
    fold: int = 1  # which fifth of the trajectories is held out, 0..4
    epochs: int = 3000
    lr: float = 0.02
    schedule: str = "cosine"  # over the whole run from lr to lr_end; or "steps": times lr_drop every drop_epochs
    lr_end: float = 2e-5
    lr_drop: float = 0.75
    drop_epochs: int = 500
    batch: int = 12  # sequences
    window_s: float = 160.0
    sequences: str = "random"  # windows cut anew at random; or "fixed": the trajectories cut once, the ends padded
    start_share: float = 0.05  # of random windows begin where a trajectory does: few rows, but every drive has them
    early_weight: float = 0.1  # of a window's first row in the loss: the memory is still empty there
    early_s: float = 30.0  # ... growing to 1 over this time
    theta_noise_degc: float = 0.1  # slow noise on the temperature inputs, as from an estimator
    theta_noise_s: float = 5.0  # its correlation time
    rotor_weight: float = 1.0  # of the rotor's normalised squared error beside the winding's
    integral_weight: float = 0.0  # of the squared integral of the rate error over a window (an error in temperature)
    clip: float = 1.0
    clip_each: bool = False  # clip the norm of each parameter's gradient (MATLAB's default), not that of all together
    l2: float = 0.0  # l2 * weight is added to the gradient of every weight, not of the biases (MATLAB)
    initial: str = "spread"  # memory times from 1 s to 300 s; or "matlab": its initial weights
    trained: str = "all"  # weights; or "head": the output layer only, to fine-tune a net on few data
    dt_s: float = 0.1
    validate_every: int = 20  # epochs; or, with validate_unit "iteration", steps of the optimiser
    validate_unit: str = "epoch"


CHOICES = {
    "cell": ("lstm", "gru"),
    "layers": (1, 2),
    "schedule": ("cosine", "steps"),
    "sequences": ("random", "fixed"),
    "initial": ("spread", "matlab"),
    "trained": ("all", "head"),
    "validate_unit": ("epoch", "iteration"),
}
TUNED = Settings()
PAPER = Settings(
    config="paper",
    epochs=10_000,
    lr=0.02,
    schedule="steps",
    lr_drop=0.75,
    drop_epochs=500,
    batch=512,
    window_s=160.0,
    sequences="fixed",
    early_weight=1.0,
    early_s=0.0,
    theta_noise_degc=0.0,
    clip=1.0,
    clip_each=True,
    l2=0.1,
    initial="matlab",
    validate_every=10,
    validate_unit="iteration",
)
CONFIGS = {"paper": PAPER, "tuned": TUNED}
