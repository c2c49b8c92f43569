"""Lock-step: this process carries the frames between the others, so no clock is needed and none is read.

Each 0.1 s in this order: the plant moves on, the estimator's jobs, the controller's jobs; what those two said is what
the plant hears before it moves on. Who commands acts on the newest state there is, from the next interval on.
"""

import contextlib
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path

from rt_runner import paths
from rt_runner.children import spawn
from rt_runner.config import Scenario
from rt_runner.controller import PREVIEW_NAME, controller_command, preview
from rt_runner.dbc import Dbc
from rt_runner.errors import RtError, SetupError
from rt_runner.mcap_log import LogError, LogWriter
from rt_runner.provenance import Provenance
from rt_runner.records import CONTROL_ID, END, TICK, Record, control, pack, read_until_control
from rt_runner.result import ResultAccumulator, RunFacts
from rt_runner.timing_config import grace_releases, timing_options

PROGRESS_NS = 1_000_000_000


class _Peer:
    """A process that speaks records over its pipes; its standard error is kept for its last words."""

    def __init__(self, name: str, command: list[str]) -> None:
        self.name = name
        self._words: list[str] = []
        self.process = spawn(command)

    def exchange(self, chunk: bytes) -> list[Record]:
        """Send ``chunk``, which ends with a control record, and read up to the answering control record."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        try:
            self.process.stdin.write(chunk)
            self.process.stdin.flush()
            return list(read_until_control(self.process.stdout))
        except (BrokenPipeError, EOFError):
            raise RtError(self.obituary()) from None

    def json_lines(self) -> Iterator[dict]:
        """JSON lines from standard error, up to its end; other lines are its words."""
        assert self.process.stderr is not None
        for raw in self.process.stderr:
            try:
                yield json.loads(raw)
            except ValueError:
                self._words.append(raw.decode(errors="replace").strip())

    def obituary(self) -> str:
        """One line on how it ended."""
        for _ in self.json_lines():
            pass
        words = [w for w in self._words if w] or ["(it said nothing)"]
        return f"the {self.name} ended with exit status {self.process.wait()}; its last words: {words[-1]}"

    def close(self) -> None:
        """End it, whatever it is doing."""
        if self.process.poll() is None:
            self.process.terminate()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout, self.process.stderr):
            if stream is not None:
                with contextlib.suppress(BrokenPipeError):
                    stream.close()


def run_lockstep(
    scenario: Scenario, seed: int, log: Path, dbc: Dbc, provenance: Provenance, progress: Callable[[dict], None]
) -> dict:
    """Run ``scenario`` in lock-step.

    Record time starts at 0 and is simulated time, so the same scenario and seed give the same frames.
    A KeyboardInterrupt ends the run early; what there is until then is logged and judged.

    Returns
    -------
    dict
        The result as in ``ResultAccumulator.result``; wake-up latency is None (nothing sleeps).

    Raises
    ------
    SetupError
        The plant refused the scenario (there is no log then), or the log cannot be written on.
    """
    e, c = scenario.estimator, scenario.controller
    plant_command = [sys.executable, "-m", "plant_sim", "--lockstep", "--scenario", str(scenario.path)]
    plant_command += ["--seed", str(seed)]
    if scenario.duration_s:
        plant_command += ["--duration", str(scenario.duration_s)]
    plant_command += [f"--fault={fault}" for fault in scenario.added_faults]
    plant_command += ["--obey"] if c.present else []
    estimator_command = [str(paths.binary("rt_estimator")), "--lockstep", "--no-rt", "--setting", e.setting]
    estimator_command += ["--period-us", str(round(e.period_s * 1e6))]
    estimator_command += timing_options(scenario.timing, e.period_s, e.trigger, lockstep=True)
    facts = RunFacts(
        bus="lockstep",
        scenario=scenario.name,
        period_s=e.period_s,
        lockstep=True,
        seed=seed,
        limits=scenario.limits,
        faults=scenario.all_faults,
        mk=scenario.timing.mk,
        grace_releases=grace_releases(scenario.timing.grace_s, e.period_s),
        controller=c.name if c.present else None,
    )
    accumulator = ResultAccumulator()
    peers: list[_Peer] = []
    with contextlib.ExitStack() as stack:
        stack.callback(lambda: [peer.close() for peer in peers])
        commands = {"plant": plant_command, "estimator": estimator_command}
        attachments: dict[str, str | Path | bytes] = {**provenance.files}
        attachments |= {k: v.encode() for k, v in provenance.texts.items()}
        if c.present:
            road = stack.enter_context(preview(scenario))
            commands["controller"] = controller_command(c, road, ["--lockstep", "--no-rt"])
            attachments[PREVIEW_NAME] = road
        peers += [_Peer(name, command) for name, command in commands.items()]
        plant, estimator, *others = peers
        try:
            first = plant.exchange(control(0, TICK))
        except RtError as error:
            raise SetupError(str(error)) from None
        granted = next((line for line in estimator.json_lines() if "ready" in line), {})
        with LogWriter(log, dbc, provenance.run, attachments) as writer:
            try:
                _shuttle(first, plant, [estimator, *others], writer, accumulator, progress)
                for peer in (estimator, *others):
                    _keep_final(peer, writer)
            except LogError:
                raise
            except RtError as error:
                facts = replace(facts, crash=str(error), stopped_by="crash")
            except KeyboardInterrupt:
                facts = replace(facts, stopped_by="interrupt")
            facts = replace(facts, granted=granted)
            result = accumulator.result(facts)
            writer.seal(asdict(facts), result)
    return result


def _keep_final(peer: _Peer, writer: LogWriter) -> None:
    """Attach the last line of a process that has ended."""
    final = next((line for line in peer.json_lines() if "final" in line), None)
    if final is not None:
        writer.attach(f"{peer.name}_final.json", json.dumps(final).encode())


def _shuttle(
    answer: list[Record],
    plant: _Peer,
    workers: list[_Peer],
    writer: LogWriter,
    accumulator: ResultAccumulator,
    progress: Callable[[dict], None],
) -> None:
    """Carry the frames until the plant's cycle ends; ``answer`` is the plant's first."""
    newest: dict[str, float | None] = {}

    def take(records: list[Record]) -> None:
        for r in records:
            if r.can_id != CONTROL_ID:
                decoded = writer.write(r.t_ns, r.can_id, r.data)
                if decoded is not None:
                    accumulator.feed(r.t_ns, decoded.name, decoded.values, decoded.e2e)
                    newest.update(decoded.values)

    while True:
        t_ns, code = answer[-1].t_ns, answer[-1].data[0]
        take(answer)
        heard, said = list(answer[:-1]), []
        for worker in workers:  # each hears the plant, and those before it
            words = worker.exchange(b"".join(pack(*r) for r in heard) + control(t_ns, TICK))
            take(words)
            heard += words[:-1]
            said += words[:-1]
        if t_ns % PROGRESS_NS == 0:
            shown = {k: newest.get(k) for k in ("theta_w_est_degc", "theta_w_true_degc")}
            progress({"t_s": t_ns / 1e9, "frames": writer.frames, **shown})
        if code == END:
            break
        for_plant = b"".join(pack(*r) for r in said) if len(workers) > 1 else b""
        answer = plant.exchange(for_plant + control(t_ns, TICK))
    for worker in workers:
        take(worker.exchange(control(t_ns, END)))
