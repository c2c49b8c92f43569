"""Lock-step: the whole lap through the verb, and the same bytes every time."""

import pytest

from rt_runner.mcap_log import LogReader
from rt_runner.result import CAUSES
from tests.support.runs import load_result, rt_runner

# Measured: execution and response times, what the kernel did. All else is computed.
TIMED = {0x2A8, 0x2A9, 0x2AB, 0x4AA, 0x4AB, 0x4AC, 0x4AD, 0x4AE, 0x4AF}


def test_the_whole_lap_passes(tmp_path):
    done = rt_runner("mil", "--log", tmp_path / "lap.mcap", "--json", tmp_path / "lap.json")
    assert done.returncode == 0, done.stdout + done.stderr
    r = load_result(tmp_path / "lap.json")
    assert (r["verdict"], r["bus"], r["scenario"]) == ("pass", "lockstep", "lap")
    assert 705 < r["duration_s"] < 725
    timing = r["timing"]["estimator"]
    assert timing["jobs"] == int(r["duration_s"] * 10)
    assert (timing["miss_late"], timing["miss_skipped"], timing["causes"]) == (0, 0, {})
    assert timing["wake_lat_us"] == {"p50": None, "p99": None, "max": None}
    assert 0 < timing["exec_wall_us"]["p50"] <= timing["exec_wall_us"]["p99"] <= timing["exec_wall_us"]["max"]
    for channel in ("theta_w", "theta_r"):
        figures = r["accuracy"][channel]
        assert figures["est_rmse_degc"] <= 0.25 < 1.0 <= figures["raw_rmse_degc"]
    assert r["log"] == {"frames": r["log"]["frames"], "dropped": 0, "damaged": 0}
    inspected = rt_runner("inspect", tmp_path / "lap.mcap")
    assert inspected.returncode == 0, inspected.stderr
    assert "recomputed from the frames: the same result" in inspected.stdout
    timed = rt_runner("timing", tmp_path / "lap.mcap", "--json", tmp_path / "timing.json")
    assert timed.returncode == 0, timed.stdout + timed.stderr
    figures = load_result(tmp_path / "timing.json")
    assert {c["name"]: c["ok"] for c in figures["audit"]["checks"]}["histograms"] is True
    assert figures["estimator"]["windows"]["since_start"]["slack"]["count"] == 0


@pytest.mark.parametrize("period", [0.1, 0.01])
def test_a_scenario_and_a_seed_give_the_same_frames(tmp_path, period):
    def frames(name, seed):
        log = tmp_path / name
        done = rt_runner("mil", "hot-lap", "--duration", 12, "--period", period, "--seed", seed, "--log", log)
        assert done.returncode in (0, 2), done.stderr
        return [(f.t_ns, f.can_id, f.data) for f in LogReader(log).raw() if f.can_id not in TIMED]

    first = frames("a.mcap", 1)
    assert first == frames("b.mcap", 1)
    assert first != frames("c.mcap", 2)


def test_a_faster_loop_publishes_more_often_and_no_worse(tmp_path):
    for name, period in (("slow", 0.1), ("fast", 0.01)):
        rt_runner("mil", "hot-lap", "--period", period, "--log", tmp_path / f"{name}.mcap",
                  "--json", tmp_path / f"{name}.json")  # fmt: skip
    slow, fast = (load_result(tmp_path / f"{n}.json") for n in ("slow", "fast"))
    assert fast["timing"]["estimator"]["jobs"] == 10 * slow["timing"]["estimator"]["jobs"]
    # The net is stepped at its training rate in both: between its steps the fast loop publishes the prediction.
    assert fast["accuracy"]["theta_w"]["est_rmse_degc"] == pytest.approx(
        slow["accuracy"]["theta_w"]["est_rmse_degc"], rel=0.05
    )
    assert set(fast["timing"]["estimator"]["causes"]) <= set(CAUSES)
