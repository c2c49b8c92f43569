"""The figures: drawn from what they are given, the same every time, refused with a clear line."""

from __future__ import annotations

import io
import os
import re
from pathlib import Path

import numpy as np
import pytest

from tools.rows import DataError, rows_from

if os.environ.get("RT_REQUIRE_TORCH") == "1":  # the extra `train` brings both
    import matplotlib
else:
    matplotlib = pytest.importorskip("matplotlib", reason="matplotlib is absent (extra `train`): plots are NOT tested")

from matplotlib.figure import Figure

from tools import plots


@pytest.fixture
def rows():
    rng = np.random.default_rng(3)
    theta = 140.0 + 20.0 * rng.random((500, 2))
    values = np.column_stack([11000.0 * rng.random(500), 160.0 * rng.random(500), theta, rng.normal(0, 0.3, (500, 2))])
    return rows_from(values, np.zeros(500, dtype=np.int32))


@pytest.fixture
def drawn(monkeypatch) -> list[Figure]:
    """The figures that were saved."""
    seen: list[Figure] = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (seen.append(self), save(self, *a, **k))[1])
    return seen


def evaluation(path: Path, rows, shift: float = 0.1) -> None:
    t_s = np.arange(500) * 0.1
    plots.plot_evaluation(path, t_s, rows, rows.rates_degc_s + shift, rows.x[:, 2:] - 1.5, "net on lap")


@pytest.mark.parametrize(("suffix", "magic"), [(".svg", b"<?xml"), (".png", b"\x89PNG")])
def test_same_figures_same_file(tmp_path, rows, suffix, magic):
    for draw in (lambda path: plots.plot_dataset(path, rows, "set R"), lambda path: evaluation(path, rows)):
        one, two = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
        draw(one)
        draw(two)
        assert one.read_bytes() == two.read_bytes()
        assert one.read_bytes().startswith(magic)
        assert len(one.read_bytes()) > 5000


def test_histograms_hold_every_row(tmp_path, rows, drawn):
    plots.plot_dataset(tmp_path / "a.svg", rows, "set R")
    axes = drawn[0].axes
    assert len(axes) == 4
    for ax in axes:
        bars = [patch for patch in ax.patches if hasattr(patch, "get_height") and patch.get_y() == 0]
        assert sum(bar.get_height() for bar in bars if bar.get_height() != 1.0 or len(bars) > 1) >= 500
    hot = np.mean((rows.x[:, 2] >= 150.0) & (rows.x[:, 2] <= 160.0))
    assert f"{hot:.1%} of 500 rows" in axes[2].get_title()
    assert f"mean {rows.rates_degc_s[:, 0].mean():.3f}" in axes[0].get_xlabel()


def test_evaluation_shows_prediction_truth_and_their_difference(tmp_path, rows, drawn):
    evaluation(tmp_path / "a.svg", rows)
    axes = drawn[0].axes
    scatter = axes[0].get_lines()[0]
    np.testing.assert_array_equal(scatter.get_xdata(), rows.rates_degc_s[:, 0])
    np.testing.assert_array_equal(scatter.get_ydata(), rows.rates_degc_s[:, 0] + 0.1)
    theta = axes[5].get_lines()
    np.testing.assert_array_equal(theta[0].get_ydata(), rows.x[:, 3])
    np.testing.assert_array_equal(theta[1].get_ydata(), rows.x[:, 3] - 1.5)
    errors = [line for ax in axes[6:] for line in ax.get_lines() if line.get_label().startswith("error")]
    assert len(errors) == 4
    np.testing.assert_allclose(errors[0].get_ydata(), 0.1)


@pytest.mark.parametrize("name", ["a.pdf", "a", "a.svgz"])
def test_unknown_formats_are_refused(name):
    with pytest.raises(DataError, match=re.escape(".svg or .png")):
        plots.check_plot(Path(name))


def test_missing_matplotlib_names_the_extra(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(DataError, match=r"matplotlib.*pip install -e '\.\[train\]'"):
        plots.check_plot(Path("a.svg"))


def test_a_plot_that_cannot_be_written_leaves_nothing(tmp_path, rows):
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(OSError, match="file"):
        plots.plot_dataset(blocked / "a.svg", rows, "set R")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_thinned_line_keeps_its_ends_its_peaks_and_its_gaps():
    y = np.zeros(5000)
    y[[1234, 1235, 4000]] = 7.0, -7.0, np.nan
    y[2000:2100] = np.nan
    rows = plots.outline(y, 200)
    assert 100 < len(rows) <= 200
    assert rows[0] == 0
    assert rows[-1] == 4999
    assert {1234, 1235} <= set(rows.tolist())
    assert np.all(np.diff(rows) > 0)
    assert np.isnan(y[rows]).any(), "a gap stays a gap"
    assert plots.outline(y, 5000).tolist() == list(range(5000))


def test_a_path_is_one_line_of_hundredths(tmp_path):
    figure = Figure()
    figure.subplots().plot(np.random.default_rng(1).normal(size=400))
    plots.save(figure, tmp_path / "a.svg")
    paths = re.findall(r' d="([^"]*)"', (tmp_path / "a.svg").read_text())
    assert max(path.count("L") for path in paths) > 300
    assert not any("\n" in path or re.search(r"\.\d{3}", path) for path in paths)
    plain = io.BytesIO()
    figure.savefig(plain, format="svg")
    drawn = max(re.findall(r' d="([^"]*)"', plain.getvalue().decode()), key=len)
    kept = max(paths, key=len)
    numbers = [np.array(re.findall(r"-?[\d.]+", path), dtype=float) for path in (drawn, kept)]
    np.testing.assert_allclose(numbers[1], numbers[0], rtol=0, atol=0.00501)
