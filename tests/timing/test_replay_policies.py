"""Replay of runs in which time decided: late outputs held, predicted, invalid; a cut solver; other releases."""

import pytest

from rt_runner.bus import HubProcess, choose_bus
from rt_runner.dbc import load_dbc
from rt_runner.log_reader import RawFrame
from rt_runner.replay.search import replay_frames
from tests.timing.estimator_process import OnBus, binary, lap

DBC = load_dbc()
PERIOD = ("--period-us", "50000", "--no-rt")
LATE = ("--inject", "sleep:70000@55", "--inject", "sleep:120000@62")


class Witness(OnBus):
    """Keeps what was on the bus as a log would."""

    def log(self) -> list[RawFrame]:
        """All frames received, in their order; after `finish`."""
        return [
            RawFrame(round(m.timestamp * 1e9), m.arbitration_id, bytes(m.data), m.dlc, 0)
            for m in self._messages
            if not m.is_extended_id
        ]


@pytest.mark.parametrize(
    ("options", "outputs"),
    [
        ((*PERIOD, "--on-miss", "hold", *LATE), {0.0, 1.0}),
        ((*PERIOD, "--on-miss", "predict", *LATE), {0.0, 2.0}),
        ((*PERIOD, "--on-miss", "invalid", *LATE), {0.0, 3.0}),
        ((*PERIOD, "--policy", "cut:30000", "--inject", "compute:60000@55", "--inject", "compute:60000@57"), {0.0}),
        ((*PERIOD, "--policy", "queue:2", *LATE), {0.0}),
        ((*PERIOD, "--policy", "rebase", "--on-miss", "invalid", *LATE), {0.0, 3.0}),
        (("--no-rt", "--trigger", "frame", "--inject", "sleep:30000@25"), {0.0}),
    ],
    ids=["hold", "predict", "invalid", "cut", "queue", "rebase", "frame"],
)
def test_what_time_decided_is_taken_from_the_log(options, outputs):
    """The log says that an output was late or a solver cut; what went out then follows again, and what came after."""
    lap()  # what the plant sends is computed before the clock runs
    with HubProcess.serving(choose_bus("hub")) as bus:
        witness = Witness(bus, binary("release"), *options)
        run = witness.wait(4.2).finish()
    assert run.status == 0, run.errors
    session, outcome, *_ = replay_frames(witness.log(), DBC, None, 0.1 if "frame" in options else None)
    assert outcome.verdict == "identical", (outcome.difference, outcome.notes)
    assert len(session.jobs) >= 35
    assert {f.values["output"] for f in run.named("EstTimingC")} >= outputs
    cut = sum(f.values["cut"] for f in run.named("EstTimingC"))
    assert (cut > 0) is ("cut:30000" in options)
    assert max(f.values["sweeps"] for f in run.named("EstimateInnov")) >= 1.0
