"""Measure a bus: `python -m tools.bench_bus [--bus hub|vcan0] [--json FILE]`.

Flood: one C client sends as fast as the bus takes it, two others read. Round trip: one C client asks, another answers,
a third listens. Python: the same flood read by python-can on our interface. Build first: `make build`.
"""

import argparse
import json
import subprocess
import time

from rt_runner import paths
from rt_runner.bus import HubProcess, choose_bus, open_bus

CLIENT = "tests/test_hub_port"


def start(bus: str, *arguments: object) -> subprocess.Popen:
    """A C client that is connected."""
    # Unbuffered: communicate() reads the descriptor and would miss what readline has read ahead.
    p = subprocess.Popen([paths.binary(CLIENT), bus, *map(str, arguments)], stdout=subprocess.PIPE, bufsize=0)
    assert p.stdout is not None
    p.stdout.readline()
    return p


def last_line(p: subprocess.Popen) -> list[dict]:
    """What a client has printed by its end."""
    out, _ = p.communicate()
    return [json.loads(line) for line in out.splitlines() if line.startswith(b"{")]


def flood(bus: str, count: int) -> dict:
    """Frames per second with two readers; frames lost are counted by the readers."""
    readers = [start(bus, "count", count) for _ in range(2)]
    t0 = time.perf_counter()
    sender = start(bus, "send", count)
    last_line(sender)  # on a lossless bus the readers hold it back: its time is theirs
    seconds = time.perf_counter() - t0
    lost = [last_line(r)[-1] for r in readers]
    return {"frames_per_s": round(count / seconds), "lost": sum(count - r["received"] for r in lost)}


def python_flood(bus: str, count: int) -> dict:
    """Frames per second that one python-can reader takes."""
    with open_bus(bus) as reader:
        sender = start(bus, "send", count)
        t0 = last = time.perf_counter()
        got = 0
        while got < count and reader.recv(2.0) is not None:
            got, last = got + 1, time.perf_counter()
        seconds = last - t0
        last_line(sender)
        return {"frames_per_s": round(got / seconds), "lost": count - got}


def round_trip(bus: str, count: int) -> dict:
    """Quantiles of request and answer in us, with a third client listening."""
    listener, answerer = start(bus, "count", 2 * count), start(bus, "pong")
    result = last_line(start(bus, "ping", count))[0]
    last_line(listener)
    answerer.kill()
    answerer.communicate()
    return result


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description="Measure a bus: flood and round trip.")
    parser.add_argument("--bus", default="auto")
    parser.add_argument("--frames", type=int, default=200_000)
    parser.add_argument("--pings", type=int, default=20_000)
    parser.add_argument("--json", metavar="FILE")
    args = parser.parse_args()
    choice = choose_bus(args.bus)
    with HubProcess.serving(choice) as bus:
        figures = {
            "bus": choice.name,
            "flood_c_two_readers": flood(bus, args.frames),
            "flood_python_reader": python_flood(bus, min(args.frames, 50_000)),
            "round_trip_c_us": round_trip(bus, args.pings),
        }
    text = json.dumps(figures, indent=2)
    print(text)
    if args.json:
        with open(args.json, "w") as f:
            f.write(text + "\n")


if __name__ == "__main__":
    main()
