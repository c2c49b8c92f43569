"""Latency histograms as OSADL draws them: linear time, logarithmic count, what lies beyond the axis counted at its end.

Pure SVG: it needs no script, prints, and can be cut out of the page. Colours are the page's variables.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

BINS = 64
WIDTH, HEIGHT = 400, 250
LEFT, RIGHT, TOP, BOTTOM = 40, 40, 56, 34  # margins; the overflow column stands in the right one
FLOOR = 0.7  # a logarithmic axis has no zero: a count of one must still be a bar
MAX_BEYOND = 1.6  # an axis is stretched so far to show all values; else what lies beyond is overflow
THIN = "\u202f"
Values = NDArray[np.int64]


@dataclass(frozen=True)
class Duration:
    """What one panel shows: values in ns, their releases (-1: unknown), and the same of the warm-up."""

    title: str
    colour: str  # a variable of the page's style
    values_ns: Values
    releases: Values
    warmup_ns: Values
    deadline_ns: int | None = None


@dataclass(frozen=True)
class Bins:
    """Counts of equal bins from 0 to ``limit_ns``, and of what lies outside."""

    limit_ns: float
    counts: Values
    warmup: Values
    under: int
    over: int
    warmup_over: int


def nice(value: float) -> float:
    """Smallest of 1, 1.5, 2, 2.5, 3, 4, 5, 6, 8 times a power of ten that is not less."""
    if value <= 0:
        return 1.0
    decade = 10.0 ** math.floor(math.log10(value))
    steps = (m * decade for m in (1, 1.5, 2, 2.5, 3, 4, 5, 6, 8))
    return next((step for step in steps if step >= value * (1 - 1e-12)), 10 * decade)


def bins_of(d: Duration) -> Bins:
    """Choose the axis: all values where the longest is not far out, else up to p99.9 (or the next best) and a bit."""
    values = d.values_ns
    longest = float(values.max()) if values.size else 1.0
    share = 99.9 if values.size >= 1000 else 99.0 if values.size >= 100 else 100.0
    usual = float(np.percentile(values, share)) if values.size else 1.0
    limit = nice(longest * 1.02) if longest <= MAX_BEYOND * usual else nice(usual * 1.1)
    limit = max(limit, float(BINS))
    edges = np.linspace(0.0, limit, BINS + 1)
    counts, _ = np.histogram(values, edges)
    warmup, _ = np.histogram(d.warmup_ns, edges)
    return Bins(limit, counts, warmup, int((values < 0).sum()), int((values > limit).sum()),
                int((d.warmup_ns > limit).sum()))  # fmt: skip


def time_text(ns: float) -> str:
    """A time with a unit that suits it, four digits."""
    for unit, scale in (("s", 1e9), ("ms", 1e6), ("µs", 1e3)):
        if abs(ns) >= scale:
            return f"{float(f'{ns / scale:.4g}'):g}{THIN}{unit}"
    return f"{ns:.0f}{THIN}ns"


def group(count: int) -> str:
    """Digits in threes."""
    return f"{count:,}".replace(",", THIN)


def panel(d: Duration) -> str:
    """The figure as SVG, or a line that says there is nothing to show."""
    if not d.values_ns.size:
        return f'<figure class="hist"><figcaption><b>{escape(d.title)}</b> n/a</figcaption></figure>'
    b = bins_of(d)
    decades = max(1, math.ceil(math.log10(max(int(b.counts.max()), int(b.warmup.max()), b.over, 1) * 1.2)))
    scale = _Scale(b.limit_ns, 10.0**decades)
    parts = [
        *_grid(scale, decades),
        *_bars(scale, b.counts, "bar", "jobs"),
        *_bars(scale, b.warmup, "warm", "in warm-up"),
        *_overflow(scale, b),
        *_deadline(scale, d.deadline_ns),
        *_maximum(scale, d, b),
        *_title(d),
    ]
    label = escape(f"{d.title}: histogram of {d.values_ns.size} jobs, longest {time_text(float(d.values_ns.max()))}")
    return (
        f'<figure class="hist" style="--hist:var({d.colour})"><svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        f'aria-label="{label}">{"".join(parts)}</svg></figure>'
    )


@dataclass(frozen=True)
class _Scale:
    """Where times and counts lie on the paper."""

    limit_ns: float
    top: float

    def x(self, ns: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * ns / self.limit_ns

    def y(self, count: float) -> float:
        span = math.log10(self.top / FLOOR)
        return TOP + (HEIGHT - TOP - BOTTOM) * (1 - math.log10(max(count, FLOOR) / FLOOR) / span)


def _grid(s: _Scale, decades: int) -> list[str]:
    base, right = HEIGHT - BOTTOM, WIDTH - RIGHT
    out = []
    for k in range(decades + 1):
        y = s.y(10.0**k)
        out.append(f'<path class="rule" d="M{LEFT} {y:.1f}H{right}"/>')
        out.append(f'<text x="{LEFT - 5}" y="{y + 3.5:.1f}" text-anchor="end">{group(10**k)}</text>')
    unit, scale = next((u, v) for u, v in (("s", 1e9), ("ms", 1e6), ("µs", 1e3), ("ns", 1.0)) if s.limit_ns >= v)
    step = nice(s.limit_ns / 5)
    for k in range(int(s.limit_ns / step * (1 + 1e-9)) + 1):
        x = s.x(k * step)
        out.append(f'<path class="tick" d="M{x:.1f} {base}v4"/>')
        if x < right - 12 or k * step < s.limit_ns * 0.9:  # the last place is the overflow column's
            out.append(f'<text x="{x:.1f}" y="{base + 15}" text-anchor="middle">{k * step / scale:g}</text>')
    out.append(f'<path class="axis" d="M{LEFT} {TOP}V{base}H{right}"/>')
    out.append(f'<text x="{(LEFT + right) / 2:.0f}" y="{HEIGHT - 4}" text-anchor="middle">{unit}</text>')
    return out


def _bars(s: _Scale, counts: Values, kind: str, what: str) -> list[str]:
    base, width = HEIGHT - BOTTOM, s.limit_ns / BINS
    out = []
    for i in np.flatnonzero(counts):
        x0, x1, y = s.x(i * width), s.x((i + 1) * width), s.y(int(counts[i]))
        tip = f"{time_text(i * width)} … {time_text((i + 1) * width)}: {group(int(counts[i]))} {what}"
        out.append(
            f'<rect class="{kind}" x="{x0:.1f}" y="{y:.1f}" width="{max(x1 - x0 - 0.6, 0.8):.1f}" '
            f'height="{base - y:.1f}"><title>{tip}</title></rect>'
        )
    return out


def _overflow(s: _Scale, b: Bins) -> list[str]:
    """The column at the end of the axis: how many lie beyond it."""
    base, x = HEIGHT - BOTTOM, WIDTH - RIGHT + 14
    out = [f'<text class="over" x="{x + 8}" y="{base + 15}" text-anchor="middle">beyond</text>']
    if b.over:
        y = s.y(b.over)
        tip = f"{group(b.over)} jobs beyond {time_text(b.limit_ns)}"
        out.append(
            f'<rect class="beyond" x="{x}" y="{y:.1f}" width="16" height="{base - y:.1f}"><title>{tip}</title></rect>'
        )
    y = s.y(max(b.over, FLOOR)) - 5
    out.append(f'<text class="over strong" x="{x + 8}" y="{y:.1f}" text-anchor="middle">{group(b.over)}</text>')
    return out


def _deadline(s: _Scale, deadline_ns: int | None) -> list[str]:
    if deadline_ns is None or deadline_ns > s.limit_ns:
        return []
    x = s.x(deadline_ns)
    return [
        f'<path class="deadline" d="M{x:.1f} {TOP - 4}V{HEIGHT - BOTTOM}"/>',
        f'<text class="over" x="{x - 4:.1f}" y="{TOP + 6}" text-anchor="end">deadline</text>',
    ]


def _maximum(s: _Scale, d: Duration, b: Bins) -> list[str]:
    """A mark over the longest value, and the release it belongs to."""
    i = int(d.values_ns.argmax())
    longest, release = int(d.values_ns[i]), int(d.releases[i])
    at = f" @ release {release}" if release >= 0 else ""
    inside = longest <= b.limit_ns
    x = s.x(max(longest, 0)) if inside else WIDTH - RIGHT + 22
    count = b.counts[min(max(int(longest / b.limit_ns * BINS), 0), BINS - 1)] if inside else b.over
    y = s.y(float(count)) - (4 if inside else 16)
    text_y = TOP - 11
    end = "end" if x > WIDTH * 0.45 else "start"
    return [
        f'<path class="max" d="M{x:.1f} {y:.1f}l-3.5 -6h7z"/>',
        f'<path class="lead" d="M{x:.1f} {y - 6:.1f}V{text_y + 3:.1f}"/>' if y - 6 > text_y + 3 else "",
        f'<text class="strong" x="{x + (4 if end == "end" else -4):.1f}" y="{text_y:.1f}" text-anchor="{end}">'
        f"max {time_text(longest)}{at}</text>",
    ]


def _title(d: Duration) -> list[str]:
    n = d.values_ns.size
    shown = [("p50", 50.0, 2), ("p99", 99.0, 100), ("p99.9", 99.9, 1000)]
    words = [
        f"{name} {time_text(float(np.percentile(d.values_ns, p, method='inverted_cdf')))}"
        if n >= least
        else f"{name} n/a"
        for name, p, least in shown
    ]
    return [
        f'<text class="head" x="{LEFT}" y="13">{escape(d.title)}</text>',
        f'<text x="{LEFT}" y="28">{group(n)} jobs · {" · ".join(words)}</text>',
    ]
