"""The MHE's step on an emulated Cortex-M7: the host's answers to the last bit, and within its budget.

Needs gcc-arm-none-eabi and qemu-system-arm; without them these tests skip, and fail where RT_REQUIRE_ECU=1 (CI).
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.nets import random_net
from tools import bench_ecu, ecu_image
from tools.ecu_image import Image, ToolError, build_image
from tools.ecu_replay import Replay, differing_steps, fixed_sweeps, replay_ecu, replay_host
from tools.libest import WEIGHTS
from tools.solver_backends.stream import Segment, Situation, record_all

SWEEPS = 2
SITUATIONS = (
    Situation("level moved", "faults", 420.0, 500.0, 0, ("offset:-20@430-490",)),
    Situation("noise", "faults", 420.0, 450.0, 1, ("noise:5@430-520/r",)),
    Situation("box met", "bounds", 440.0, 480.0, 2, changes={"hard_bounds": True, "upper_degc": 150.0}),
    Situation("penalty met", "bounds", 440.0, 470.0, 3, changes={"upper_degc": 150.0, "bound_weight": 300.0}),
    Situation("quadratic", "quadratic", 420.0, 460.0, 4, changes={"loss": 0}),
)


@dataclass(frozen=True)
class Bench:
    """What the module's tests share: both images' answers to the same calls."""

    image: Image
    segments: list[Segment]
    calls: np.ndarray
    ecu: Replay
    host: Replay
    folder: Path


@pytest.fixture(scope="module", autouse=True)
def _tools() -> None:
    if absent := ecu_image.missing_tools():
        reason = f"{', '.join(absent)} not found (tools/apt-install {' '.join(ecu_image.PACKAGES)}): ECU NOT tested"
        if os.environ.get("RT_REQUIRE_ECU") == "1" or os.environ.get("CI") == "true":
            pytest.fail(reason)
        pytest.skip(reason)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    folder = tmp_path_factory.mktemp("ecu")
    image = build_image(WEIGHTS, folder)
    segments = record_all(WEIGHTS, chosen=SITUATIONS)
    calls = fixed_sweeps(np.concatenate([segment.data for segment in segments]), SWEEPS)
    return Bench(image, segments, calls, replay_ecu(image, calls, folder), replay_host(image, calls, folder), folder)


def test_the_counter_counts_instructions(bench: Bench) -> None:
    assert bench.ecu.counter_slope == 2.0  # two instructions a round, exactly


def test_every_answer_is_the_hosts_bit_for_bit(bench: Bench) -> None:
    answers = bench.ecu.answers
    assert len(answers) == sum(len(segment) for segment in bench.segments) > 1500
    assert differing_steps(bench.ecu, bench.host) == 0
    assert bench.ecu.state == bench.host.state
    # ... and they are answers: solved, finite, with bounds met where the situations say so.
    assert (answers["sweeps"] == SWEEPS).all()
    assert (answers["status"] == 1).all()  # MHE_MAX_SWEEPS: fixed
    assert np.isfinite(answers["theta"]).all()
    assert len(np.unique(answers["window_hash"])) > 0.99 * len(answers)
    kinds = np.repeat([s.situation.kind for s in bench.segments], [len(s) for s in bench.segments])
    assert (answers["active"][kinds == "bounds"] > 0).any()
    assert (answers["active"][kinds == "quadratic"] == 0).all()


def test_one_bit_is_a_difference(bench: Bench) -> None:
    answers = bench.host.answers.copy()
    answers["window_hash"][7] ^= 1
    answers["theta"][11, 1] = np.nextafter(answers["theta"][11, 1], np.float32(1e3))
    assert differing_steps(bench.ecu, replace(bench.host, answers=answers)) == 2
    assert differing_steps(bench.ecu, replace(bench.host, answers=answers[:-1])) == len(answers)


def test_other_arithmetic_is_noticed(bench: Bench, tmp_path: Path) -> None:
    """Fused multiply-adds round once: the comparison has to see it."""
    head = bench.segments[-1].head(60).data
    fused = build_image(WEIGHTS, tmp_path, (ecu_image.OPTIMISE, "-ffp-contract=fast"))
    calls = fixed_sweeps(head, SWEEPS)
    assert differing_steps(replay_ecu(fused, calls, tmp_path), replay_host(fused, calls, tmp_path)) > 30


def test_other_optimisation_is_not_other_arithmetic(bench: Bench, tmp_path: Path) -> None:
    calls = fixed_sweeps(bench.segments[-1].head(60).data, SWEEPS)
    fast = build_image(WEIGHTS, tmp_path, ("-O2",))
    assert differing_steps(replay_ecu(fast, calls, tmp_path), replay_host(fast, calls, tmp_path)) == 0


def test_another_kind_of_net(tmp_path: Path) -> None:
    weights = random_net(tmp_path, 5, cell="gru")
    image = build_image(weights, tmp_path)
    (segment,) = record_all(weights, chosen=[Situation("stretch", "nominal", 420.0, 430.0, 5)])
    calls = fixed_sweeps(segment.data, SWEEPS)
    ecu = replay_ecu(image, calls, tmp_path)
    assert len(ecu.answers) == len(segment) > 50
    assert np.isfinite(ecu.answers["theta"]).all()
    assert differing_steps(ecu, replay_host(image, calls, tmp_path)) == 0


def test_the_step_keeps_its_budget(bench: Bench) -> None:
    cost = bench_ecu.measure(bench.image, bench.segments, SWEEPS, bench.folder)
    assert cost.targets_met, bench_ecu.table(cost)
    assert cost.instructions_max <= 250_000
    assert cost.flash_bytes <= 32 * 1024
    assert cost.ram_bytes <= 12 * 1024
    assert cost.state_bytes <= 8 * 1024
    assert 0 < cost.step_flash_bytes < cost.flash_bytes
    assert cost.ram_bytes >= cost.state_bytes + cost.stack_bytes
    assert 0 < cost.instructions_to_estimate < 0.5 * cost.instructions_plain
    # No branch on data without a bound, a level to move or a memory to fill: the count hardly moves.
    solve = bench.ecu.instructions()[:, -2:].sum(1)
    plain = (bench.ecu.answers["active"] == 0) & (bench.ecu.answers["count"] == 16)
    assert np.ptp(solve[plain]) < 0.05 * solve[plain].mean()


def test_the_stack_seen_is_the_stack_reserved(bench: Bench) -> None:
    """Measured by paint, known to the compiler: at least the largest frame, at most all of them at once."""
    seen = int(bench.ecu.answers["stack"].max())
    assert max(bench.image.frames.values()) <= seen <= sum(bench.image.frames.values()) + 128


@pytest.mark.parametrize("body", ["return a * (double)b > 1.0 ? a : b;", "return __builtin_expf(a) + b;"])
def test_double_arithmetic_and_libraries_are_refused(tmp_path: Path, body: str) -> None:
    source = tmp_path / "step.c"
    source.write_text(f"float step(float a, float b);\nfloat step(float a, float b)\n{{\n    {body}\n}}\n")
    command = ["arm-none-eabi-gcc", *ecu_image.ECU_FLAGS, "-O2"]
    (item,) = ecu_image._compile(command, [source], tmp_path)
    with pytest.raises(ToolError, match=r"the step calls (__aeabi_d|expf)"):
        ecu_image._refuse_calls(item)


def test_a_broken_stream_is_refused(bench: Bench, tmp_path: Path) -> None:
    for broken in ([99.0, 0.0], [5.0, 4.0, 0.0, 7.0, 1.0, 1.0], [3.0, 1e6]):  # op, channel, length
        with pytest.raises(ToolError, match="record of the stream"):
            replay_ecu(bench.image, np.array([*bench.segments[0].head(2).data, *broken]), tmp_path)


def test_absent_tools_are_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(ecu_image, "TOOLS", ("arm-none-eabi-none",))
    assert bench_ecu.main([]) == 1
    assert "arm-none-eabi-none not found: run tools/apt-install gcc-arm-none-eabi" in capsys.readouterr().err
