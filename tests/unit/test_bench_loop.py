"""The bench of the loop: its statistics on made-up slices, the two C programs, a short run from end to end."""

import itertools
import json
import os
import shutil
import subprocess

import numpy as np
import pytest

from rt_runner import paths
from rt_runner.bus import HubProcess
from rt_runner.cli import main as rt_runner
from rt_runner.codec import Decoder
from rt_runner.dbc import load_dbc
from rt_runner.e2e import E2eStatus
from rt_runner.records import RECORD
from tools import bench_loop
from tools.bench_loop_figures import describe, lines, markdown, of_period, quantile, ratio, targets
from tools.bench_loop_slices import ANSWER, ASK, Bench, Kind, Slice, records

INTERVALS = 30


def slices(scale: float, count: int, samples: int, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [scale * rng.gamma(9.0, 3.0, samples) for _ in range(count)]


def program(name: str) -> str:
    path = paths.build_dir() / "bin" / "bench" / name
    if not os.access(path, os.X_OK):
        if os.environ.get("CI") == "true":
            pytest.fail(f"{path} is missing; run 'make build'")
        pytest.skip(f"{path} is missing; run 'make build'")
    return str(path)


class TestFigures:
    """Quantiles, ratios, verdicts."""

    def test_a_quantile_with_too_few_samples_is_not_available(self):
        assert quantile(np.arange(99.0), 99.0) is None
        assert quantile(np.arange(100.0), 99.0) == 98.0
        assert quantile(np.arange(10.0), 50.0) == 4.0
        assert describe(np.empty(0)) == {"count": 0, "p50": None, "p99": None, "max": None}

    @pytest.mark.parametrize("truth", [0.8, 1.0, 1.5])
    def test_the_interval_holds_the_true_ratio_and_noise_holds_one(self, truth):
        ours, theirs = slices(truth, 12, 500, 1), slices(1.0, 12, 500, 2)
        found = ratio(ours, theirs, 99.0, np.random.default_rng(3))
        low, high = found["interval"]
        assert low <= truth <= high
        assert low <= found["value"] <= high
        assert high - low < 0.3 * truth
        assert found["noise"][0] < 1.0 < found["noise"][1]
        assert (low < 1.0 < high) == (truth == 1.0)

    def test_slices_that_differ_make_a_wide_interval_although_their_samples_are_many(self):
        ours = [np.full(1000, level) for level in (10.0, 10.0, 20.0, 40.0)]
        low, high = ratio(ours, slices(1.0, 4, 1000, 1), 50.0, np.random.default_rng(1))["interval"]
        assert high / low > 1.9

    def test_too_few_slices_give_a_ratio_without_an_interval(self):
        found = ratio(slices(1.0, 2, 500, 1), slices(1.0, 2, 500, 2), 50.0, np.random.default_rng(1))
        assert found["interval"] is found["noise"] is None
        assert found["value"] == pytest.approx(1.0, abs=0.1)
        assert ratio([], [], 50.0, np.random.default_rng(1)) == {"value": None, "interval": None, "noise": None}

    def test_ratios_to_the_floor_are_those_of_the_medians(self):
        found = {
            Kind.GRID: [Slice(wake_us=np.full(200, 20.0), exec_us=np.full(200, 60.0), resp_us=np.full(200, 90.0))],
            Kind.CYCLICTEST: [Slice(wake_us=np.full(200, 16.0), steal_ms=10.0)],
            Kind.ECHO: [Slice(rtt_us=np.full(200, 40.0), asked=200, unanswered=1)],
            Kind.FRAME: [Slice(rtt_us=np.full(200, 120.0), asked=200)],
        }
        figures = of_period(found)
        assert figures["wake_ratio"]["p99"]["value"] == 1.25
        assert (figures["response_ratio"], figures["frame_ratio"]) == (0.9, 1.2)
        assert figures["steal_ms"]["cyclictest"] == 10.0
        assert figures["unanswered"]["echo"] == 1

    @pytest.mark.parametrize(
        ("interval", "met"), [((0.9, 1.1), True), ((1.2, 1.4), False), ((1.0, 1.3), None), (None, None)]
    )
    def test_a_target_is_decided_by_the_interval(self, interval, met):
        wake = {"p99": {"value": 1.1, "interval": interval, "noise": None}}
        frame = {"frame_ratio": None, "frame_to_estimate_us": {"p50": 149.0}}
        figures = {"wake_ratio": wake, "response_ratio": 3.1, **frame}
        found = targets({"10": figures})
        assert found["wake_p99_10_ms"]["met"] is met
        assert [found[k]["met"] for k in ("response_ratio_p50_10_ms", "frame_ratio_p50_10_ms")] == [False, None]
        assert found["frame_to_estimate_p50_us"]["met"] is True


def test_records_are_frames_of_a_plant_in_their_order():
    decoder, ticks, seen = Decoder(load_dbc()), [], []
    for t_ns, can_id, length, data in RECORD.iter_unpack(records(INTERVALS)):
        frame = decoder.decode(can_id, data[:length])
        assert frame is not None
        assert frame.e2e is E2eStatus.OK
        assert frame.values["tick"] * 10_000_000 == t_ns
        seen.append(frame.name)
        if frame.name == "MotorState":
            ticks.append(frame.values["tick"])
    assert ticks == list(range(1, 10 * INTERVALS + 1))
    assert seen.count("TempMeas") == INTERVALS
    assert all(a in ("MotorState", "Coolant") for a, b in itertools.pairwise(seen) if b == "TempMeas")


def test_echo_answers_each_question_and_the_probe_times_it(tmp_path):
    raw = tmp_path / "records"
    raw.write_bytes(records(INTERVALS))
    core = str(max(os.sched_getaffinity(0)))
    with HubProcess.serving(bench_loop.choose_bus("hub")) as bus:
        ids = [f"{ASK:x}", f"{ANSWER:x}"]
        echo = subprocess.Popen([program("bench_loop_echo"), bus, *ids, core, "80"], stdout=subprocess.PIPE, text=True)
        assert echo.stdout is not None
        assert json.loads(echo.stdout.readline())["ready"]
        with raw.open("rb") as stdin:
            done = subprocess.run([program("bench_loop_probe"), bus, "10", *ids, core, "50", ids[1]], stdin=stdin,
                                  capture_output=True, text=True, timeout=60, check=True)  # fmt: skip
        echo.terminate()
        said = json.loads(echo.communicate(timeout=20)[0])
    figures = json.loads(done.stdout)
    assert (figures["asked"], figures["unanswered"], figures["tx_drops"]) == (INTERVALS, 0, 0)
    assert said == {"final": True, "answered": INTERVALS, "tx_drops": 0}
    assert len(figures["rtt_ns"]) == len(figures["frames"]["2A0"]) == INTERVALS
    assert min(figures["rtt_ns"]) > 0


@pytest.mark.parametrize("name", ["bench_loop_echo", "bench_loop_probe"])
def test_a_bus_that_is_not_there_is_one_line(name, tmp_path):
    arguments = ["1A0", "2A0", "0", "50"] if name.endswith("echo") else ["1", "1A0", "2A0", "0", "50"]
    done = subprocess.run([program(name), f"rt_hub:{tmp_path}/none", *arguments], input=records(1), check=False,
                          capture_output=True)  # fmt: skip
    assert (done.returncode, done.stdout) == (1, b"")
    assert len(done.stderr.splitlines()) == 1


def test_a_short_run_from_end_to_end(tmp_path, capsys):
    program("bench_loop_echo")
    if shutil.which("cyclictest") is None and os.environ.get("CI") != "true":
        pytest.skip("no cyclictest here: tools/apt-install rt-tests")
    out, doc = tmp_path / "loop.json", tmp_path / "doc.md"
    doc.write_text(f"before\n{bench_loop.BEGIN}\nold\n{bench_loop.END}\nafter\n")
    arguments = ["--bus=hub", "--seconds=2", "--periods=10", f"--json={out}", f"--doc={doc}"]
    assert bench_loop.main(arguments) == 0
    figures = json.loads(out.read_text())
    at = figures["periods"]["10"]
    # Jobs before the first and after the last question are there, too, and those that the machine took are not.
    assert 50 <= at["wake_us"]["ours"]["count"] <= 300
    assert at["wake_us"]["cyclictest"]["count"] == 100
    assert at["bare_round_trip_us"]["count"] == at["asked"]["echo"] - 100 - at["unanswered"]["echo"]
    for name in ("wake_us", "compute_us", "response_us", "bare_round_trip_us"):
        of = at[name]["ours"] if name == "wake_us" else at[name]
        assert 0 < of["p50"] <= of["max"], name
    assert at["response_us"]["p50"] > at["compute_us"]["p50"]
    floor = at["bare_round_trip_us"]["p50"] + at["compute_us"]["p50"]
    assert at["response_ratio"] == pytest.approx(at["response_us"]["p50"] / floor, rel=1e-3)
    assert at["wake_ratio"]["p50"]["value"] > 0
    assert figures["machine"]["policy"] in ("fifo", "other")
    text = capsys.readouterr().out
    assert all(line in text for line in lines(figures))
    assert markdown(figures) in doc.read_text()
    assert doc.read_text().startswith("before\n")
    assert "old" not in doc.read_text()


def test_a_period_too_short_for_the_lap_is_refused_before_anything_starts(capsys):
    for arguments in (["--seconds=0"], ["--periods=0.5"], ["--periods=x"]):
        assert rt_runner(["bench", "loop", *arguments]) == 1
        assert "rt-runner: " in capsys.readouterr().err


def test_every_kind_is_measured_with_one_core_and_one_priority():
    program("bench_loop_echo")
    if shutil.which("cyclictest") is None:
        pytest.skip("no cyclictest here: tools/apt-install rt-tests")
    core = max(os.sched_getaffinity(0))
    with HubProcess.serving(bench_loop.choose_bus("hub")) as bus:
        bench = Bench(bus, core, os.sched_getaffinity(0) - {core} or {core}, 1.2)
        assert set(bench.kinds) >= {Kind.GRID, Kind.CYCLICTEST, Kind.ECHO}
        bench.run(Kind.ECHO, 10.0)
        echo = dict(bench.granted)
        bench.run(Kind.GRID, 10.0)
    assert bench.granted["core"] == echo["core"] == core
    assert bench.granted["policy"] == echo["policy"]
