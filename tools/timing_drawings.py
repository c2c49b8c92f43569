"""The drawings of docs/timing.md: `python -m tools.timing_drawings [FOLDER]` writes them as SVG."""

from __future__ import annotations

import sys
from pathlib import Path

INK, SOFT, LINE = "#15181d", "#59616d", "#b9c0c9"
WAKE, EXEC, SEND, MISS, OFF = "#d98200", "#008a70", "#0067b0", "#c22a1b", "#e3e6ea"


class Drawing:
    """Collects shapes; text is 12 px unless told. Attributes of SVG are keywords with _ for -."""

    def __init__(self, width: int, height: int, title: str) -> None:
        self.size, self.title, self.shapes = (width, height), title, []

    def text(self, x: float, y: float, words: str, anchor: str = "middle", colour: str = INK, **look: object) -> None:
        """Words; ``a_{b}`` is a with the subscript b."""
        head, _, low = words.partition("_{")
        low, _, tail = low.partition("}")
        body = head + (f'<tspan dy="3" font-size="9">{low}</tspan><tspan dy="-3">{tail}</tspan>' if low else "")
        extra = "".join(f' {k.replace("_", "-")}="{v}"' for k, v in look.items())
        self.shapes.append(f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}" fill="{colour}"{extra}>{body}</text>')

    def box(self, x: float, y: float, w: float, h: float, fill: str, **look: object) -> None:
        """A rectangle."""
        extra = "".join(f' {k.replace("_", "-")}="{v}"' for k, v in look.items())
        self.shapes.append(f'<rect x="{x:g}" y="{y:g}" width="{w:g}" height="{h:g}" rx="2" fill="{fill}"{extra}/>')

    def line(
        self, x1: float, y1: float, x2: float, y2: float, colour: str = LINE, dash: str = "", **look: object
    ) -> None:
        """A straight line."""
        extra = (f' stroke-dasharray="{dash}"' if dash else "") + "".join(
            f' {k.replace("_", "-")}="{v}"' for k, v in look.items()
        )
        self.shapes.append(f'<path d="M{x1:g} {y1:g}L{x2:g} {y2:g}" stroke="{colour}" fill="none"{extra}/>')

    def span(self, x1: float, x2: float, y: float, words: str, colour: str = INK, below: bool = False) -> None:
        """A measured distance with its name."""
        self.line(x1, y, x2, y, colour, marker_start="url(#tip)", marker_end="url(#tip)")
        self.text((x1 + x2) / 2, y + (14 if below else -6), words, colour=colour)

    def svg(self) -> str:
        """The whole file."""
        w, h = self.size
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {w} {h}" width="{w}" height="{h}" role="img" '
            f'aria-label="{self.title}" font-family="system-ui, Segoe UI, Helvetica, Arial, sans-serif" '
            'font-size="12">\n'
            '<defs><marker id="tip" viewBox="0 0 8 8" refX="7.5" refY="4" markerWidth="6" markerHeight="6" '
            'orient="auto-start-reverse"><path d="M0 0.8L8 4L0 7.2z" fill="context-stroke"/></marker></defs>\n'
            f'<rect width="{w}" height="{h}" fill="#fff"/>\n' + "\n".join(self.shapes) + "\n</svg>\n"
        )


def job() -> Drawing:
    """One job on the release grid, and what each duration spans."""
    d = Drawing(
        860, 330, "One job on the release grid: wake latency, execution, preemption, publishing, response, slack"
    )
    r0, r1, start, off, on, stepped, out, done = 60, 760, 170, 300, 370, 470, 540, 585
    base = 120
    for x, name in ((r0, "r_{n}"), (r1, "r_{n+1}")):
        d.line(x, 52, x, 282, SOFT, "4 3")
        d.text(x, 42, name, font_weight=600)
    d.line(20, base + 34, 830, base + 34, LINE)
    d.text(52, base + 24, "thread", "end", SOFT, font_size=11)
    d.box(start, base, off - start, 34, EXEC)
    d.box(off, base, on - off, 34, OFF, stroke=LINE, stroke_dasharray="3 2")
    d.text((off + on) / 2, base + 21, "off the core", colour=SOFT, font_size=10.5)
    d.box(on, base, stepped - on, 34, EXEC)
    d.box(stepped, base, out - stepped, 34, SEND)
    d.box(out, base, done - out, 34, SOFT, opacity=0.55)
    d.text((start + off) / 2, base + 21, "step", colour="#fff")
    d.text((on + stepped) / 2, base + 21, "step", colour="#fff")
    d.text((stepped + out) / 2, base + 21, "publish", colour="#fff", font_size=11)
    d.text((out + done) / 2, base + 48, "counters, timing frames", "middle", SOFT, font_size=10)
    d.span(r0, start, 100, "wake_lat", WAKE)
    d.span(start, stepped, 100, "exec_wall", EXEC)
    d.span(stepped, out, 100, "publish", SEND)
    d.span(off, on, 196, "preempt = exec_wall − exec_cpu", SOFT, below=True)
    d.line(off, base + 36, off, 190, LINE, "2 2")
    d.line(on, base + 36, on, 190, LINE, "2 2")
    d.span(r0, out, 244, "resp: from the release that was meant, never from the start")
    d.line(out, base + 36, out, 250, LINE, "2 2")
    d.span(out, r1, 244, "slack = D − resp", EXEC)
    d.text(r1, 300, "deadline D, here = T", colour=MISS, font_weight=600)
    d.line(r1, 60, r1, 282, MISS)
    d.text(430, 20, "One job", font_size=14, font_weight=650)
    return d


def overrun() -> Drawing:
    """A job of 3.1 periods: what each policy does with the three activations it runs over."""
    d = Drawing(860, 372, "A job of 3.1 periods under the policies skip, queue and rebase")
    left, period = 120, 108
    rows = (("skip", 84), ("queue:2", 168), ("rebase", 252))
    title = "A job of 3.1 T hits three activations: overrun = 3 under every policy"
    d.text(430, 22, title, font_size=14, font_weight=650)
    for n in range(7):
        x = left + n * period
        d.line(x, 46, x, 316, LINE, "3 3")
        d.text(x, 40, f"r_{{{n + 1}}}", colour=SOFT)
    for name, y in rows:
        d.text(left - 16, y + 18, name, "end", font_weight=600)
        d.line(left - 8, y + 28, 850, y + 28, LINE)
        d.box(left + 6, y, 3.1 * period, 28, EXEC)
        d.text(left + 6 + 1.55 * period, y + 18, "3.1 T", colour="#fff")
    end = left + 6 + 3.1 * period

    def short(x: float, y: float, name: str, fill: str = EXEC) -> None:
        d.box(x, y, 40, 28, fill)
        d.text(x + 20, y + 18, name, colour="#fff", font_size=11)

    for k in (1, 2, 3):
        x = left + k * period
        d.text(x, 84 + 44, "skipped", colour=MISS, font_size=11)
    short(left + 4 * period + 6, 84, "5")
    short(left + 5 * period + 6, 84, "6")
    short(left + 6 * period + 6, 84, "7")
    for k, word in ((1, "waits"), (2, "waits"), (3, "skipped")):
        d.text(left + k * period, 168 + 44, word, colour=MISS if word == "skipped" else WAKE, font_size=11)
    short(end + 2, 168, "2", WAKE)
    short(end + 44, 168, "3", WAKE)
    short(left + 4 * period + 6, 168, "5")
    short(left + 5 * period + 6, 168, "6")
    short(left + 6 * period + 6, 168, "7")
    for k in range(3):
        short(end + 3 + k * period, 252, str(k + 2))
    d.span(left + period, end + 3, 296, "the grid moves: phase, counted and named as drift", SOFT, below=True)
    words = "orange: runs late, flagged queued · releases = executed + skipped + waiting, at every instant"
    d.text(430, 346, words, colour=SOFT)
    d.text(430, 362, "numbers: the release a job runs for", colour=SOFT, font_size=11)
    return d


def age() -> Drawing:
    """From the plant's sample to the estimate on the bus."""
    d = Drawing(
        860, 300, "Age of an estimate: the plant sends, the bus carries, the estimator waits, computes and publishes"
    )
    lanes = (("plant", 70), ("bus", 120), ("estimator", 170))
    xs = {"sample": 130, "handed": 220, "received": 330, "start": 510, "stepped": 640, "published": 740, "stamp": 775}
    d.text(430, 22, "Age of an estimate, and its parts", font_size=14, font_weight=650)
    for name, y in lanes:
        d.text(100, y + 18, name, "end", font_weight=600)
        d.line(110, y + 28, 835, y + 28, LINE)
    for key, x in xs.items():
        d.line(x, 62, x, 236 if key not in ("sample", "stamp") else 262, LINE, "2 2")
    pieces = (
        ("sample", "handed", 70, SOFT, "send"), ("handed", "received", 120, SEND, "bus"),
        ("received", "start", 170, WAKE, "wait for the release"), ("start", "stepped", 170, EXEC, "compute"),
        ("stepped", "published", 170, SEND, "publish"), ("published", "stamp", 120, SOFT, "rest"),
    )  # fmt: skip
    for a, b, y, colour, words in pieces:
        wide = xs[b] - xs[a]
        d.box(xs[a], y, wide, 28, colour, opacity=0.35 if words.startswith("wait") else 1)
        d.text(xs[a] + wide / 2, y + 18, words, colour=INK if words.startswith("wait") else "#fff",
               font_size=12 if wide > 40 else 10.5)  # fmt: skip
    who = (
        ("sample", "handed", "the plant's clock"), ("handed", "received", "stamp − plant"),
        ("received", "start", "in_age"), ("start", "stepped", "exec_wall"),
        ("stepped", "published", "resp − wake − exec"),
    )  # fmt: skip
    for a, b, words in who:
        d.text((xs[a] + xs[b]) / 2, 222, words, colour=SOFT, font_size=10)
    d.span(xs["sample"], xs["stamp"], 256, "")
    d.text((xs["sample"] + xs["stamp"]) / 2, 280, "e2e = send + bus + wait + compute + publish + rest", font_weight=600)
    d.text(xs["sample"], 54, "sample", colour=SOFT, font_size=11)
    d.text(xs["stamp"], 54, "Estimate on the bus", colour=SOFT, font_size=11)
    d.text(xs["received"], 54, "MotorState on the bus", colour=SOFT, font_size=11)
    return d


DRAWINGS = {"timing_job": job, "timing_overrun": overrun, "timing_age": age}


def main(argv: list[str] | None = None) -> int:
    """Write all drawings; returns the exit status."""
    arguments = sys.argv[1:] if argv is None else argv
    folder = Path(arguments[0] if arguments else "docs/figures")
    for name, draw in DRAWINGS.items():
        (folder / f"{name}.svg").write_text(draw().svg(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
