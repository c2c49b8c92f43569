"""The page in a real browser: it draws, it reacts, it complains about nothing, in both themes and on paper."""

import os
import re
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import pytest

from tests.browser.synthetic import Run, write_log
from tools.report.__main__ import make_report

SCREENSHOT = Path(__file__).resolve().parents[2] / "tools" / "screenshot"
POKE = Path(__file__).with_name("poke.js")
RUNS = {
    "run": Run(duration_s=30, late_every=40, skip_every=71, sensor_lost_s=(20.0, 22.0)),
    "lockstep": Run(duration_s=30, lockstep=True, start_tick=0),
    "no-truth": Run(duration_s=12, truth=False),
    "no-estimator": Run(duration_s=5, estimator=False),
    "hostile": Run(duration_s=5, title="</script><script>throw 1</script><img src=x onerror=alert(1)>"),
}


def _chromium_runs() -> str | None:
    """None if the browser can be started, else why not."""
    done = subprocess.run([sys.executable, SCREENSHOT, "--check"], capture_output=True, text=True, check=False)
    return None if done.returncode == 0 else done.stderr.strip()


@pytest.fixture(scope="session", autouse=True)
def _needs_chromium():
    reason = _chromium_runs()
    if reason and os.environ.get("RT_REQUIRE_CHROMIUM") == "1":
        pytest.fail(f"RT_REQUIRE_CHROMIUM=1, but: {reason}")
    if reason:
        pytest.skip(f"browser tests not run: {reason}")


def shoot(page: Path, out: Path, *options: str) -> str:
    """Render by tools/screenshot; returns what the page wrote to its console. Fails on an error there."""
    done = subprocess.run(
        [sys.executable, SCREENSHOT, page, out, *options], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stderr


def make_page(folder: Path, run: Run, truncate: bool = False) -> Path:
    log, page = folder / "x.mcap", folder / "x.html"
    write_log(log, run)
    if truncate:
        log.write_bytes(log.read_bytes()[:-20000])
    make_report(log, page, None)
    return page


def pixels(path: Path) -> list[bytes]:
    """Rows of an 8-bit PNG, RGB or RGBA."""
    data, at, packed, size = path.read_bytes(), 8, b"", (0, 0, 0)
    while at < len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        body = data[at + 8 : at + 8 + length]
        if kind == b"IHDR":
            width, height, depth, colour = struct.unpack(">IIBB", body[:10])
            assert depth == 8
            size = (width, height, {2: 3, 6: 4}[colour])
        packed += body if kind == b"IDAT" else b""
        at += 12 + length
    raw, (width, height, step) = zlib.decompress(packed), size
    stride, rows, above = width * step, [], bytes(width * step)
    for y in range(height):
        method, line = raw[y * (stride + 1)], bytearray(raw[y * (stride + 1) + 1 : (y + 1) * (stride + 1)])
        for i in range(stride):
            left, up = line[i - step] if i >= step else 0, above[i]
            corner = above[i - step] if i >= step else 0
            near = min(
                (abs(up - corner), 0, left), (abs(left - corner), 1, up), (abs(left + up - 2 * corner), 2, corner)
            )
            line[i] = (line[i] + (0, left, up, (left + up) // 2, near[2])[method]) & 255
        above = bytes(line)
        rows.append(b"".join(above[i : i + 3] for i in range(0, stride, step)))
    return rows


@pytest.mark.parametrize("name", RUNS)
def test_page_renders_without_a_complaint(tmp_path, name):
    page, dom = make_page(tmp_path, RUNS[name]), tmp_path / "dom.html"
    console = shoot(page, dom, "--width", "1280")
    assert console == ""
    text = dom.read_text()
    assert 'data-ready="true"' in text
    # Every chart that has series has a canvas.
    charts = re.findall(r'<section class="panel chart" id="chart-[\w-]+">.*?</section>', text, re.S)
    assert len(charts) == 7
    for chart in charts:
        assert ("<canvas" in chart) != ("no data for this chart" in chart)


def test_truncated_log_renders(tmp_path):
    dom = tmp_path / "dom.html"
    assert shoot(make_page(tmp_path, RUNS["run"], truncate=True), dom) == ""
    assert "never finished" in dom.read_text()


def test_an_error_on_the_page_is_noticed(tmp_path):
    page = tmp_path / "bad.html"
    for fault in ("nothing.at.all()", "console.error('Error: x')", "throw 1", "Promise.reject(new Error('x'))"):
        page.write_text(f"<!doctype html><title>x</title><script>{fault}</script>")
        done = subprocess.run([sys.executable, SCREENSHOT, page, tmp_path / "o.html"], capture_output=True, check=False)
        assert done.returncode == 1, fault


def test_reactions(tmp_path):
    """Cursor in all charts at once, zoom in step and back, legend, theme: done by a script, told in the DOM."""
    page, dom = make_page(tmp_path, RUNS["run"]), tmp_path / "dom.html"
    page.write_text(page.read_text().replace("</body>", f"<script>{POKE.read_text()}</script></body>"))
    assert shoot(page, dom) == ""
    told = dict(re.findall(r'data-poke-(\w+)="([^"]*)"', dom.read_text()))
    assert told["done"] == "true", told
    assert int(told["readouts"]) == 6  # all time charts; the histogram has its own axis
    assert "truth" in told["first"]
    assert "°C" in told["first"]
    assert "settling" in told["first"]
    shown = [float(x) for x in re.findall(r"[\d.]+", told["zoomed"])]
    assert shown[1] - shown[0] < 10
    assert told["reset"] == told["whole"]
    assert told["legend"] == "false"
    assert told["theme"] == "light"
    assert told["loaded"] == ""


def test_themes_and_narrow_screen(tmp_path):
    page = make_page(tmp_path, RUNS["run"])
    corner = {}
    for theme, options in {"light": (), "dark": ("--dark",)}.items():
        out = tmp_path / f"{theme}.png"
        shoot(page, out, "--height", "400", *options)
        rows = pixels(out)
        corner[theme] = sum(rows[2][:3])
        assert len({rows[y][x : x + 3] for y in range(0, 300, 7) for x in range(0, 3840, 21)}) > 8
    assert corner["light"] > 700
    assert corner["dark"] < 120
    frame, dom = tmp_path / "frame.html", tmp_path / "dom.html"
    frame.write_text(
        '<iframe src="x.html" style="width:390px;height:4000px" onload="'
        "const d=this.contentDocument||{};document.title='w'+(d.documentElement||{}).scrollWidth\"></iframe>"
    )
    assert page.exists()
    shoot(frame, dom, "--allow-files")
    width = int(re.findall(r"<title>w(\d+)</title>", dom.read_text())[0])
    assert width <= 390


def test_prints(tmp_path):
    out = tmp_path / "x.pdf"
    shoot(make_page(tmp_path, RUNS["run"]), out)
    assert out.read_bytes().startswith(b"%PDF")
    pages = len(re.findall(rb"/Type\s*/Page\b", out.read_bytes()))
    assert 2 <= pages <= 6
