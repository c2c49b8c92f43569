"""The audit: true books balance, and one frame, one count or one bucket that is wrong is found and named."""

import copy
import json
import random
from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rt_runner.cli import main
from rt_runner.codec import Encoder
from rt_runner.log_reader import LogReader
from rt_runner.mcap_log import LogWriter
from rt_runner.timing.analyse import TimingReport, analyse
from tests.support import timing_logs as logs

SLOW_JOBS = {20: 31_000_000, 33: 9_990_000, 47: 12_000_000}  # release -> wall time


def script() -> list[logs.Job]:
    """Sixty releases, three of them run over by a job of 3.1 periods, one by a job of 1.2."""
    out, free_ns = [], 0
    for job in logs.regular(60):
        if job.release * logs.PERIOD_NS < free_ns:
            continue
        wall = SLOW_JOBS.get(job.release, job.wall_ns)
        job = replace(job, wall_ns=wall, cpu_ns=wall - 500)
        job = replace(job, cause="long_compute" if job.late else "stale_input" if job.release == 40 else "none",
                      stale=job.release == 40, output=1 if job.late else 0)  # fmt: skip
        free_ns = job.release * logs.PERIOD_NS + job.resp_ns
        out.append(job)
    return out


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A log whose books balance, its frames and the last words in it."""
    frames = logs.job_frames(script())
    rng = random.Random(1)
    final = logs.final_words(script(), frames, lambda: rng.randint(-49, 49))
    path = logs.write(tmp_path_factory.mktemp("whole") / "whole.mcap", frames, final, facts={})
    return path, frames, final


def checks(report: TimingReport) -> dict[str, bool | None]:
    return {c.name: c.ok for c in report.processes[0].audit.checks}


def failed(report: TimingReport) -> set[str]:
    return {c.name for c in report.processes[0].audit.failed}


def test_true_books_balance(whole):
    report = analyse(whole[0])
    assert all(checks(report).values()), report.processes[0].audit.failed
    assert set(checks(report)) >= {"file", "frames", "releases", "executed", "sent", "frames sent", "skipped", "counts",
                                   "clusters", "histograms", "extremes", "monotonic"}  # fmt: skip
    judged = report.processes[0].account.judged
    assert (judged.late["long_compute"], judged.skipped["long_compute"]) == (3, 5)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_one_frame_removed_fails_it(whole, tmp_path_factory, data):
    """Whichever frame it is, first and last of its message too; one between two others is named."""
    path, frames, _ = whole
    number = data.draw(st.integers(0, len(frames) - 1))
    name = frames[number][1]
    before = sum(1 for f in frames[:number] if f[1] == name)
    after = sum(1 for f in frames[number + 1 :] if f[1] == name)
    target = tmp_path_factory.mktemp("cut") / "cut.mcap"
    report = analyse(logs.copy_without(path, target, lambda i, _: i == number))
    found = report.processes[0].audit
    assert not found.ok
    assert report.verdict == "fail"
    if after and len(report.processes[0].jobs):
        assert [(m.message, m.count) for m in found.missing] == [(name, 1)]
        assert found.missing[0].after_counter == (before % 16 if before else None)
        assert name in next(c.evidence for c in found.checks if c.name == "frames")


@pytest.mark.parametrize("name", ["Estimate", "EstTimingB", "MotorState", "EstReleases"])
def test_a_frame_removed_in_place_leaves_its_number_behind(whole, tmp_path, name, monkeypatch):
    """Somebody who cuts a frame out of the file, and does not number the others anew, is found by the numbers."""
    _, frames, final = whole
    number = next(i for i, f in enumerate(frames) if f[1] == name and i > 30)
    write, told = LogWriter.write, {"n": -1}

    def skipping(self, *args, **kwargs):
        told["n"] += 1
        if told["n"] == number:
            self.frames += 1  # it counts, but does not write
            return None
        return write(self, *args, **kwargs)

    monkeypatch.setattr(LogWriter, "write", skipping)
    report = analyse(logs.write(tmp_path / "x.mcap", frames, final, facts={}))
    assert "file" in failed(report)
    evidence = next(c.evidence for c in report.processes[0].audit.checks if c.name == "file")
    assert f"after frame number {number} " in evidence


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(count=st.integers(1, 5), seed=st.integers(0, 10_000))
def test_drops_that_were_counted_pass_and_are_named(whole, tmp_path_factory, count, seed):
    _, frames, final = whole
    middle = [(f[1], sum(1 for g in frames[:i] if g[1] == f[1])) for i, f in enumerate(frames) if 60 < i < 500]
    gone = set(random.Random(seed).sample(middle, count))

    def lost(name: str, n: int) -> bool:
        return (name, n) in gone

    folder = tmp_path_factory.mktemp("drops")
    report = analyse(logs.write(folder / "a.mcap", frames, final, lost, facts={"log_dropped": count}))
    found = report.processes[0].audit
    assert found.ok, found.failed
    assert found.drops["logger"] == count
    assert sum(m.count for m in found.missing) == count
    assert f"{count} logger" in next(c.evidence for c in found.checks if c.name == "frames")
    report = analyse(logs.write(folder / "b.mcap", frames, final, lost, facts={"log_dropped": count - 1}))
    assert "frames" in failed(report)


def test_frames_the_bus_refused_are_counted_by_the_process(whole, tmp_path):
    _, frames, final = whole
    told = {**final, "tx_drops": 2, "frames_sent": final["frames_sent"] - 2, "estimates_lost": 1,
            "estimates_sent": final["estimates_sent"] - 1}  # fmt: skip
    gone = {("Estimate", 12), ("EstTimingD", 30)}
    report = analyse(logs.write(tmp_path / "a.mcap", frames, told, lambda n, i: (n, i) in gone, facts={}))
    assert report.processes[0].audit.ok, report.processes[0].audit.failed
    assert report.processes[0].audit.drops == {"estimator_tx": 2, "logger": 0}
    gone.add(("MotorState", 12))  # that one is the plant's: the estimator's drops do not excuse it
    report = analyse(logs.write(tmp_path / "b.mcap", frames, told, lambda n, i: (n, i) in gone, facts={}))
    assert failed(report) == {"frames"}


def _more(key: str) -> Callable[[dict], None]:
    def change(final: dict) -> None:
        final[key] += 1

    return change


def _bucket(final: dict) -> None:
    buckets = final["histograms"]["judged"]["resp_us"]["buckets"]
    buckets[0][2] += 1
    buckets[-1][2] -= 1


def _histogram(key: str, by: int) -> Callable[[dict], None]:
    def change(final: dict) -> None:
        final["histograms"]["judged"]["wake_lat_us"][key] += by

    return change


def _total(final: dict) -> None:
    final["histograms"]["warmup"]["exec_cpu_us"]["count"] += 1
    final["histograms"]["warmup"]["exec_cpu_us"]["overflow"] += 1


@pytest.mark.parametrize(
    ("change", "found_by"),
    [
        (_more("releases"), {"releases"}),
        (_more("miss_skipped"), {"releases", "skipped"}),
        (_more("jobs"), {"releases", "executed"}),
        (_more("estimates_sent"), {"executed", "sent"}),
        (_more("frames_sent"), {"frames sent"}),
        (_more("miss_late"), {"counts"}),
        (lambda final: final["causes"].update(long_compute=99), {"counts"}),
        (_bucket, {"histograms"}),
        (_total, {"histograms"}),
        (_histogram("max_ns", 500), {"extremes"}),
        (_histogram("min_ns", -500), {"extremes"}),
        (_histogram("max_index", 1), {"extremes"}),
    ],
)
def test_a_wrong_count_is_found(whole, tmp_path, change, found_by):
    _, frames, final = whole
    wrong = copy.deepcopy(final)
    change(wrong)
    report = analyse(logs.write(tmp_path / "x.mcap", frames, wrong, facts={}))
    assert failed(report) == found_by


@pytest.mark.parametrize(
    ("message", "signal", "by", "found_by"),
    [
        ("EstMissRun", "consec_miss_max", 1, {"clusters"}),
        ("EstMissRun", "mk_worst", -1, {"clusters"}),
        ("EstInputFaults", "stale_inputs", 1, {"counts"}),
        ("EstOutputs", "held", 1, {"counts"}),
        ("EstMisses", "miss_skipped", 1, {"releases"}),
    ],
)
def test_a_wrong_counter_frame_is_found(whole, tmp_path, message, signal, by, found_by):
    _, frames, final = whole
    wrong = [(t, n, {**v, signal: v[signal] + by} if n == message else v) for t, n, v in frames]
    assert failed(analyse(logs.write(tmp_path / "x.mcap", wrong, final, facts={}))) == found_by


def test_a_counter_that_falls_is_found(whole, tmp_path):
    _, frames, final = whole
    first = (frames[-1][0] - 10_000_000, "EstOverload", logs.filler("EstOverload", queued=0.0, cut=3.0, rebased=0.0))
    told = {**final, "frames_sent": final["frames_sent"] + 1}
    report = analyse(logs.write(tmp_path / "x.mcap", [*frames[:-9], first, *frames[-9:]], told, facts={}))
    assert failed(report) == {"monotonic"}


def test_a_frame_too_many_is_found(whole, tmp_path):
    """The same frame logged twice: more in the log than was sent."""
    reader = LogReader(whole[0])
    files = {"estimator_final.json": reader.attachments["estimator_final.json"]}
    twice = next(i for i, f in enumerate(whole[1]) if f[1] == "EstTimingB" and i > 100)
    with LogWriter(tmp_path / "x.mcap", logs.dbc(), reader.metadata["run"], files) as writer:
        for i, f in enumerate(reader.raw()):
            for _ in range(2 if i == twice else 1):
                writer.write(f.t_ns, f.can_id, f.data)
        writer.metadata("facts", reader.metadata["facts"])
    assert failed(analyse(tmp_path / "x.mcap")) == {"frames sent"}


def test_exit_status_and_json(whole, tmp_path, capsys):
    path, frames, final = whole
    out = tmp_path / "x.json"
    easy = {"limits": {"miss_rate_max": 0.3}}
    log = logs.write(tmp_path / "a.mcap", frames, final, facts=easy)
    assert main(["timing", str(log), "--json", str(out), "--csv", str(tmp_path / "x.csv")]) == 0
    figures = json.loads(out.read_text())
    assert figures["audit"]["ok"] is True
    assert figures["audit"]["missing"] == []
    assert figures["verdict"] == "pass"
    assert "verdict: pass" in capsys.readouterr().out
    assert len((tmp_path / "x.csv").read_text().splitlines()) == 1 + len(script())
    gone = next(i for i, f in enumerate(frames) if f[1] == "Estimate" and i > 200)
    cut = logs.copy_without(log, tmp_path / "cut.mcap", lambda i, _: i == gone)
    assert main(["timing", str(cut), "--json", str(out)]) == 2
    figures = json.loads(out.read_text())
    assert figures["audit"]["ok"] is False
    assert figures["audit"]["missing"][0]["message"] == "Estimate"
    assert "FAILS" in capsys.readouterr().out
    open_ended = logs.write(tmp_path / "open.mcap", logs.job_frames(logs.regular(60)))
    assert main(["timing", str(open_ended)]) == 3
    strict = logs.write(tmp_path / "strict.mcap", frames, final, facts={"limits": {"miss_rate_max": 0.001}})
    assert main(["timing", str(strict)]) == 2
    assert main(["timing", str(tmp_path / "none.mcap")]) == 1
    assert main(["timing", str(path), "--json", str(tmp_path / "no" / "x.json")]) == 1


def test_a_process_that_was_started_again_has_two_lives(whole, tmp_path):
    """Killed in the middle of a second, started again: both lives balance, and a frame of either is missed."""
    _, frames, final = whole
    first = [f for f in logs.job_frames(logs.regular(37), plant=False) if f[1] in logs.PER_JOB]
    ahead_ns = 2_000_000_000
    second = [(t + ahead_ns, n, v) for t, n, v in frames if logs.dbc()[n].sender == "ESTIMATOR"]

    def written(name: str, gone: tuple[int, int] = (-1, -1)) -> TimingReport:
        """As two processes would: each counts its frames from the start."""
        encoders = [Encoder(logs.dbc(), "ESTIMATOR") for _ in range(2)]
        files = {"estimator_final.json": json.dumps(final).encode()}
        run = {"scenario": "x", "period_s": logs.PERIOD_NS / 1e9}
        with LogWriter(tmp_path / name, logs.dbc(), run, files) as writer:
            for life, part in enumerate((first, second)):
                for i, (t_ns, message, values) in enumerate(part):
                    frame = encoders[life].encode(message, values)
                    if (life, i) != gone:
                        writer.write(t_ns, frame.arbitration_id, bytes(frame.data))
            writer.seal({"bus": "hub", "period_s": logs.PERIOD_NS / 1e9}, {})
        return analyse(tmp_path / name)

    report = written("a.mcap")
    assert [p.process.name for p in report.processes] == ["estimator_1", "estimator"]
    assert [len(p.jobs) for p in report.processes] == [37, len(script())]
    assert [p.audit.ok for p in report.processes] == [True, True], [p.audit.failed for p in report.processes]
    assert [(f.what, f.verdict) for f in report.findings if "life" in f.what] == [("estimator_1 life", "fail")]
    assert [p.audit.ok for p in written("b.mcap", (0, 100)).processes] == [False, True]
    assert [p.audit.ok for p in written("c.mcap", (1, 100)).processes] == [True, False]
