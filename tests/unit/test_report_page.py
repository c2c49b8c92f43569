"""Log → page: figures as in the log, safe against what a log may say, nothing loaded from anywhere."""

import json
import math
import os
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from rt_runner.cli import main as rt_runner
from rt_runner.dbc import load_dbc
from rt_runner.mcap_log import LogWriter
from tests.browser.synthetic import Run, write_log
from tools.report.data import Trace
from tools.report.page import build_page, script_json
from tools.report.read import read_report

HOSTILE = "</script><script>alert('x')</script><img src=x onerror=alert(1)> \u2028 {{data}} & \"q\""


class Page(HTMLParser):
    """Elements, their attributes, and the text of scripts, styles and the rest."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text: dict[str, list[str]] = {}
        self._open: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in ("meta", "link", "br", "img"):
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag, f"</{tag}> closes nothing"

    def handle_data(self, data):
        self.text.setdefault(self._open[-1] if self._open else "", []).append(data)

    def count(self, tag: str) -> int:
        return sum(t == tag for t, _ in self.elements)

    def words(self) -> str:
        return " ".join(" ".join(part) for tag, part in self.text.items() if tag not in ("script", "style"))

    def data(self) -> dict:
        return json.loads(self.text["script"][0])


def page_of(tmp_path: Path, run: Run, with_result: bool = True) -> tuple[Page, str, dict | None]:
    log = tmp_path / "x.mcap"
    result = write_log(log, run, with_result)
    text = build_page(read_report(log))
    return Page(text), text, result


@pytest.fixture(scope="module")
def ordinary(tmp_path_factory):
    run = Run(duration_s=30, late_every=40, skip_every=71, sensor_lost_s=(20.0, 22.0))
    return page_of(tmp_path_factory.mktemp("log"), run)


def series(page: Page, chart: str, label: str) -> Trace:
    charts = {c["id"]: c for c in page.data()["charts"]}
    found = next(s for s in charts[chart]["series"] if s["label"].startswith(label))
    values = np.array([np.nan if v is None else v for v in found["y"]], dtype=float)
    return Trace(np.cumsum(found["dt"]) * 1e-4, values)


def test_figures_are_those_of_the_log(ordinary):
    page, _, result = ordinary
    assert result is not None
    figures = page.data()["figures"]
    assert figures["result"] == result
    words = page.words()
    for channel in ("theta_w", "theta_r"):
        for key in ("raw_rmse_degc", "est_rmse_degc", "est_max_degc"):
            assert f"{result['accuracy'][channel][key]:.3f}" in words
    timing = result["timing"]["estimator"]
    assert f"{timing['wake_lat_us']['p50']:.1f}" in words
    assert f"{timing['miss_late']} late, {timing['miss_skipped']} skipped" in words
    assert timing["miss_late"] == 7
    assert timing["miss_skipped"] == 7 + 4
    for finding in result["findings"]:
        assert finding["evidence"] in words


def test_the_error_curve_has_the_judged_rmse(ordinary):
    page, _, result = ordinary
    assert result is not None
    for chart, channel in (("winding-error", "theta_w"), ("rotor-error", "theta_r")):
        error = series(page, chart, "estimate")
        first_s = error.t_s[np.isfinite(error.value)][0]
        judged = error.value[(error.t_s >= first_s + 10 - 1e-3) & np.isfinite(error.value)]
        rmse = math.sqrt(float(np.mean(judged**2)))
        assert rmse == pytest.approx(result["accuracy"][channel]["est_rmse_degc"], abs=1e-3)


def test_lost_sensor_frames_are_a_gap(ordinary):
    sensor = series(ordinary[0], "winding", "sensor")
    inside = (sensor.t_s > 19.95) & (sensor.t_s < 21.95)
    assert inside.any()
    assert np.isnan(sensor.value[inside]).all()
    assert np.count_nonzero(np.isnan(sensor.value)) == 1


def test_time_runs_from_the_first_frame_to_the_last(ordinary):
    """An estimator that has heard no plant sends tick 0, which must not count as a time."""
    data = ordinary[0].data()
    assert data["t_range"] == pytest.approx([0, 29.99], abs=0.2)
    assert data["cycle_start_s"] == pytest.approx(400, abs=0.01)


def test_cycle_time_of_a_late_start_is_resolved_by_the_scenario(tmp_path):
    log = tmp_path / "x.mcap"
    write_log(log, Run(duration_s=2, start_tick=(40000 + 2 * 65536) % 65536))
    assert read_report(log).cycle_start_s == pytest.approx(400, abs=0.01)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tests.browser.synthetic.SCENARIO", b"[cycle]\nstart_s = 1055.0\n")
        other = tmp_path / "y.mcap"
        write_log(other, Run(duration_s=2))
    assert read_report(other).cycle_start_s == pytest.approx(400 + 655.36, abs=0.01)


def test_every_miss_is_marked_where_it_happened(ordinary):
    page = ordinary[0]
    late, skipped = series(page, "response", "late"), series(page, "response", "skipped")
    # Release n comes at n/10 - 0.03 s; a late job's frames are logged 112 ms after it.
    assert late.t_s == pytest.approx([k * 4 - 0.03 + 0.112 for k in range(1, 8)], abs=2e-3)
    assert late.value == pytest.approx([112000.0] * 7)
    releases = sorted([k * 40 + 1 for k in range(1, 8)] + [71 * k for k in range(1, 5)])
    # Between two logged jobs the skipped one is drawn on a straight line: right to about the response time.
    assert skipped.t_s == pytest.approx([n / 10 - 0.03 for n in releases], abs=0.1)


def test_histogram_counts_every_job(ordinary):
    page, _, result = ordinary
    assert result is not None
    chart = next(c for c in page.data()["charts"] if c["id"] == "histogram")
    assert [s["label"] for s in chart["series"]] == ["wake latency", "execution", "response"]
    for one in chart["series"]:
        assert sum(y for y in one["y"] if y >= 1) == result["timing"]["estimator"]["jobs"]
    assert chart["lines"][0]["value"] == pytest.approx(1e5)


def test_frames_table_measures_rates_and_gaps(ordinary):
    frames = {f["name"]: f for f in ordinary[0].data()["figures"]["frames"]}
    assert frames["MotorState"]["count"] == 3000
    assert frames["MotorState"]["rate_hz"] == pytest.approx(100, rel=1e-3)
    assert frames["TempMeas"]["gap_max_ms"] == pytest.approx(2100, abs=2)
    assert frames["TempMeas"]["rate_ok"] is True  # one long silence is no wrong rate
    assert {n for n, f in frames.items() if f["timed_out"]} == {"TempMeas"}
    assert frames["Reference"]["count"] == 0
    assert {f["crc_errors"] for f in frames.values()} == {0}


def test_nothing_is_loaded_from_anywhere(ordinary):
    page, text, _ = ordinary
    for tag, attributes in page.elements:
        assert tag not in ("iframe", "object", "embed", "base", "audio", "video")
        for name in ("src", "href", "srcset", "action", "data", "poster"):
            assert attributes.get(name, "data:").startswith("data:"), (tag, attributes)
    styles, scripts = "".join(page.text["style"]), "".join(page.text["script"][1:])
    assert "@import" not in styles
    assert "url(" not in styles
    for call in ("fetch(", "XMLHttpRequest", "WebSocket", "import(", "EventSource", "sendBeacon", "new Image"):
        assert call not in scripts
    assert "default-src 'none'" in text


def test_hostile_text_stays_text(tmp_path):
    warnings = ("<script>alert(2)</script>",)
    page, text, _ = page_of(tmp_path, Run(duration_s=3, title=HOSTILE, warnings=warnings))
    assert page.count("script") == 2
    assert page.count("img") == 0
    assert page.data()["figures"]["title"] == HOSTILE
    assert "alert(2)" in page.words()
    assert text.count("</script>") == 2


def test_json_in_a_script_cannot_end_it_and_refuses_nan():
    coded = script_json({"a": "</script><!--\u2028&"})
    assert not set("<>&\u2028") & set(coded)
    assert json.loads(coded) == {"a": "</script><!--\u2028&"}
    with pytest.raises(ValueError):
        script_json(float("nan"))


def test_lockstep_says_what_cannot_be_had(tmp_path):
    page, _, result = page_of(tmp_path, Run(duration_s=20, lockstep=True, start_tick=0))
    assert result is not None
    assert page.words().count("n/a (lock-step)") >= 4
    charts = {c["id"]: c for c in page.data()["charts"]}
    assert [s["label"] for s in charts["histogram"]["series"]] == ["execution"]
    assert [s["label"] for s in charts["response"]["series"]] == ["execution"]
    assert "simulated time" in page.words()


def test_a_whole_lap_stays_under_four_megabytes(tmp_path):
    page, text, _ = page_of(tmp_path, Run(duration_s=720, lockstep=True, start_tick=0))
    assert len(text.encode()) < 4e6
    torque = series(page, "drive", "torque")
    assert torque.t_s.size <= 8100
    assert float(np.nanmax(torque.value)) == pytest.approx(150, abs=0.05)
    estimate = series(page, "winding", "estimate")
    assert np.isfinite(estimate.value).sum() > 7000
    assert estimate.t_s[-1] == pytest.approx(719.97, abs=0.01)  # over the wrap of the 16-bit tick


def test_truncated_log_is_shown_with_a_banner_and_never_passes(tmp_path):
    log = tmp_path / "cut.mcap"
    write_log(log, Run(duration_s=40))
    whole = log.read_bytes()
    log.write_bytes(whole[: len(whole) * 3 // 4])
    data = read_report(log)
    page = Page(build_page(data))
    assert not data.complete
    assert "never finished" in page.words()
    figures = page.data()["figures"]
    assert figures["result_from_log"] is False
    assert figures["result"]["verdict"] == "inconclusive"
    assert figures["result"]["timing"]["estimator"]["jobs"] > 100
    assert figures["result"]["accuracy"]["theta_w"]["est_rmse_degc"] < 0.25


def test_a_log_without_truth_says_so(tmp_path):
    page, _, _ = page_of(tmp_path, Run(duration_s=15, truth=False))
    assert "no truth" in page.words()
    charts = {c["id"]: c for c in page.data()["charts"]}
    assert charts["winding-error"]["series"] == []
    assert [s["label"] for s in charts["winding"]["series"]] == ["sensor", "estimate"]


def test_a_log_without_an_estimator_and_an_empty_one_still_make_pages(tmp_path):
    page, _, _ = page_of(tmp_path, Run(duration_s=3, estimator=False), with_result=False)
    assert page.data()["figures"]["result"]["verdict"] == "inconclusive"
    empty = tmp_path / "empty.mcap"
    LogWriter(empty, load_dbc()).close()
    page = Page(build_page(read_report(empty)))
    assert "no frames" in page.words()
    assert all(c["series"] == [] for c in page.data()["charts"])


def test_identity_is_checked_against_the_log(ordinary):
    identity = ordinary[0].data()["figures"]["identity"]
    assert identity["DBC"].startswith(f"{load_dbc().hash24:06x} ✓")
    assert identity["scenario"].startswith("123456 ✓")
    assert identity["weights"] == "00beef"


# ---- the verb -------------------------------------------------------------------------------------------
def test_verb_writes_page_and_figures_from_any_directory(tmp_path, monkeypatch, capfd):
    (tmp_path / "tools").mkdir()  # somebody else's "tools" in the way
    (tmp_path / "tools" / "__init__.py").write_text("raise RuntimeError('not these')")
    monkeypatch.chdir(tmp_path)
    write_log(tmp_path / "x.mcap", Run(duration_s=5))
    assert rt_runner(["report", "x.mcap", "-o", "out.html", "--json", "f.json"]) == 0
    page, figures = Page((tmp_path / "out.html").read_text()), json.loads((tmp_path / "f.json").read_text())
    assert figures["page_bytes"] == (tmp_path / "out.html").stat().st_size
    assert {k: figures[k] for k in page.data()["figures"]} == page.data()["figures"]
    assert capfd.readouterr().out.startswith("report: out.html")


@pytest.mark.parametrize(
    ("log", "out", "says"),
    [
        ("missing.mcap", "o.html", "missing.mcap"),
        ("text.mcap", "o.html", "not an MCAP log"),
        ("good.mcap", "nowhere/o.html", "cannot write the report"),
        ("good.mcap", "good.mcap", "is the log itself"),
        (".", "o.html", "directory"),
    ],
)
def test_trouble_is_one_line_and_status_one(tmp_path, monkeypatch, capfd, log, out, says):
    monkeypatch.chdir(tmp_path)
    Path("text.mcap").write_text("not a log at all")
    write_log(Path("good.mcap"), Run(duration_s=1))
    before = Path("good.mcap").read_bytes()
    assert rt_runner(["report", log, "-o", out]) == 1
    err = capfd.readouterr().err
    assert says in err
    assert err.count("\n") == 1
    assert err.startswith("rt-runner: ")
    assert Path("good.mcap").read_bytes() == before
    assert not list(tmp_path.rglob("*.part"))


def test_the_runner_itself_does_not_import_the_tools():
    code = ("import sys; from rt_runner.cli import build_parser; build_parser(); import rt_runner.commands.report; "
            "print([m for m in sys.modules if m.split('.')[0] in ('tools', 'numpy')])")  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=dict(os.environ)
    )
    assert done.stdout.strip() == "[]"
