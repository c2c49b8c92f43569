"""Timing on the virtual bus, judged from the log after the run. Ratios, orders and conservation laws only.

One real run per transport: plant, estimator and logger as processes, fifteen seconds of the hot lap.
"""

import itertools
from collections import defaultdict
from types import SimpleNamespace

import pytest

from rt_runner.dbc import load_dbc
from rt_runner.mcap_log import read_log
from rt_runner.result import Unwrapper
from rt_runner.timing.age import PARTS
from rt_runner.timing.analyse import analyse
from rt_runner.timing.jobs import NO_NS
from tests.support import timing_logs
from tests.support.buses import have_vcan
from tests.support.runs import load_result, rt_runner
from tests.timing.estimator_process import PER_JOB

SECONDS = 15
DBC = load_dbc()
FOR_A_CONTROLLER = {"VehicleState", "PlantControl"}


@pytest.fixture(scope="module", params=["hub", pytest.param("vcan0", marks=pytest.mark.vcan)])
def run(request, tmp_path_factory):
    if request.param == "vcan0":
        have_vcan()
    folder = tmp_path_factory.mktemp(request.param)
    log, out = folder / "run.mcap", folder / "run.json"
    done = rt_runner("run", "hot-lap", "--bus", request.param, "--duration", SECONDS, "--log", log, "--json", out)
    # 3 (inconclusive) is an honest answer on a machine that is taken from us; the laws below hold all the same.
    assert done.returncode in (0, 3), done.stdout + done.stderr
    frames = defaultdict(list)
    order = []
    for t_ns, name, values, e2e in read_log(log):
        frames[name].append((t_ns, values, e2e))
        order.append((t_ns, name, values))
    return SimpleNamespace(
        bus=request.param, log=log, frames=frames, order=order, result=load_result(out), text=done.stderr
    )


def test_it_says_which_bus_it_took_and_why(run):
    assert f"bus: {run.bus}" in run.text
    assert run.result["bus"] == run.bus


def test_what_no_neighbour_can_spoil_passes(run):
    """The machine may be taken from us (timing: inconclusive); figures, counters and log may not suffer from it."""
    findings = {f["what"]: f for f in run.result["findings"]}
    for what in ("theta_w accuracy", "theta_r accuracy", "conservation", "log"):
        assert findings[what]["verdict"] == "pass", findings[what]
    for channel in ("theta_w", "theta_r"):
        figures = run.result["accuracy"][channel]
        assert figures["est_rmse_degc"] <= 0.25
        assert figures["raw_rmse_degc"] >= 1.0


def test_every_release_is_accounted_for(run):
    unwrap = Unwrapper(24)
    indices = [unwrap(v["release_index"]) for _, v, _ in run.frames["EstTimingA"]]
    assert indices == sorted(set(indices)), "a release ran twice, or out of order"
    skipped = sum(b - a - 1 for a, b in itertools.pairwise(indices))
    final_releases, final_misses = run.frames["EstReleases"][-1][1], run.frames["EstMisses"][-1][1]
    assert final_releases["releases"] == final_releases["jobs"] + final_misses["miss_skipped"]
    assert final_releases["jobs"] == len(indices), "executed jobs and logged jobs differ"
    assert final_misses["miss_skipped"] == skipped
    timing = run.result["timing"]["estimator"]
    assert (timing["jobs"], timing["miss_skipped"]) == (len(indices), skipped)


def test_the_books_balance(run):
    """Counters, flags, histograms and frames of the real processes agree, on either bus."""
    timing = analyse(run.log).processes[0]
    assert timing.audit.ok, timing.audit.failed
    made = {c.name for c in timing.audit.checks if c.ok}
    assert made >= {"file", "frames", "releases", "executed", "skipped", "counts", "clusters", "monotonic"}
    assert len(timing.jobs) == len(run.frames["Estimate"])


def test_one_frame_less_and_they_do_not(run, tmp_path):
    number = next(i for i, (_, name, _) in enumerate(run.order) if name == "EstTimingC" and i > len(run.order) / 2)
    cut = timing_logs.copy_without(run.log, tmp_path / "cut.mcap", lambda i, _: i == number)
    report = analyse(cut)
    assert not report.processes[0].audit.ok
    assert report.verdict == "fail"
    assert [(m.message, m.count) for m in report.processes[0].audit.missing] == [("EstTimingC", 1)]


def test_estimates_are_as_old_as_their_sample(run):
    """From the plant's sample to the bus; the parts are those of three clocks and still add up to little rest."""
    ages = analyse(run.log).processes[0].ages
    known = [k for k, v in enumerate(ages["e2e_rest"]) if v != NO_NS]
    assert len(known) > 0.7 * len(run.frames["Estimate"])
    for k in known:
        parts = {p: ages[f"e2e_{p}"][k] for p in PARTS}
        assert sum(parts.values()) == ages["e2e"][k]
        assert min(parts[p] for p in ("send", "wait", "compute", "publish")) >= 0
    rest = sorted(abs(ages["e2e_rest"][k]) for k in known)
    e2e = sorted(ages["e2e"][k] for k in known)
    assert e2e[0] > 0
    # A sample is at most one tick old when the job starts, if plant and bus get their processor at all: in the middle.
    assert e2e[len(e2e) // 2] < 25_000_000
    assert rest[len(rest) // 2] < 5_000_000


def test_skipped_releases_are_announced_by_the_next_job(run):
    unwrap, before = Unwrapper(24), None
    for _, v, _ in run.frames["EstTimingA"]:
        index = unwrap(v["release_index"])
        if before is not None:
            assert bool(v["after_skip"]) == (index - before > 1)
        before = index


def test_one_estimate_frame_per_executed_job(run):
    counts = {n: len(run.frames[n]) for n in PER_JOB}
    assert len(set(counts.values())) == 1, counts
    jobs = [n for _, n, _ in run.order if n in counts]
    assert jobs == list(PER_JOB) * counts["Estimate"]


def test_response_is_late_exactly_where_the_flag_says(run):
    period_us = run.result["timing"]["estimator"]["period_s"] * 1e6
    for (_, a, _), (_, b, _) in zip(run.frames["EstTimingA"], run.frames["EstTimingB"], strict=True):
        assert bool(a["miss_late"]) == (b["resp_us"] > period_us)
        assert b["resp_us"] >= b["exec_wall_us"]


def test_ids_come_at_their_dbc_rates(run):
    plant_s = len(run.frames["MotorState"]) * 0.01
    assert plant_s == SECONDS
    for message in DBC:
        if message.sender != "PLANT":
            continue
        if message.name in FOR_A_CONTROLLER:
            assert not run.frames.get(message.name), "there is none on this bus"
            continue
        expected = plant_s * 1000 / message.cycle_ms
        assert abs(len(run.frames[message.name]) - expected) <= 1, message.name


def test_job_frames_come_once_per_period(run):
    stamps = [t for t, _, _ in run.frames["Estimate"]]
    steps = sorted(b - a for a, b in itertools.pairwise(stamps))
    assert steps[len(steps) // 2] == pytest.approx(100e6, rel=0.02)
    released = run.result["timing"]["estimator"]["releases"]
    assert (stamps[-1] - stamps[0]) / 100e6 == pytest.approx(released - 1, abs=1)


def test_counters_have_no_gaps(run):
    for name, frames in run.frames.items():
        counters = [int(v["counter"]) for _, v, _ in frames]
        steps = {(b - a) % 16 for a, b in itertools.pairwise(counters)}
        assert steps <= {1}, f"{name}: counter steps {steps}"
        assert {e for _, _, e in frames} == {0}, name


def test_an_estimate_is_newer_than_its_inputs(run):
    """Its tick was on the bus before it, and it is the newest there was when the job took its inputs."""
    seen, motor, newest = {}, Unwrapper(16), None
    ages = []
    for t_ns, name, v in run.order:
        if name == "MotorState":
            newest = motor(v["tick"])
            seen[newest % 65536] = t_ns
        elif name == "Estimate" and v["theta_w_est_degc"] is not None:
            assert int(v["tick"]) in seen, "an estimate for a tick that was not on the bus yet"
            assert seen[int(v["tick"])] <= t_ns
            ages.append((newest - int(v["tick"])) % 65536)
    assert len(ages) > 100
    assert sorted(ages)[len(ages) // 2] <= 1, "estimates lag behind the inputs they could have used"


def test_estimates_never_go_back_in_time(run):
    unwrap = Unwrapper(16)
    ticks = [unwrap(v["tick"]) for _, v, _ in run.frames["Estimate"] if v["theta_w_est_degc"] is not None]
    assert ticks == sorted(ticks)


def test_identity_is_on_the_bus_and_matches_what_was_built(run):
    identity = run.frames["EstIdentity"][0][1]
    assert int(identity["dbc_hash"]) == DBC.hash24
    granted = run.frames["EstGranted"][0][1]
    assert granted["period_us"] == run.result["timing"]["estimator"]["period_s"] * 1e6
    assert (granted["policy"] == 1) == (run.result["granted"]["policy"] == "fifo")
    assert granted["core"] == run.result["granted"]["core"]


def test_nothing_was_lost_on_the_way_into_the_log(run):
    assert run.result["log"]["dropped"] == 0
    assert run.result["bus_faults"] == {"rx_drops": 0, "tx_drops": 0, "rejected": 0}
    assert run.result["input_faults"]["crc_errors"] == 0
