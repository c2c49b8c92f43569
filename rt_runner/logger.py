"""The logger process: ``python -m rt_runner.logger --bus BUS --log FILE --config CONFIG.json``.

Speaks JSON lines. Out: ``{"ready": true}`` once it receives, ``{"progress": {...}}`` about once a second,
``{"error": "..."}`` when bus or disk are lost, at the end ``{"result": {...}}``. In:
``{"finish": {"outcome": {...}, "granted": {...}, "texts": {...}}}`` (``outcome`` as `rt_runner.result.RunFacts`,
``texts`` are attached to the log: name -> text).
SIGTERM, SIGINT and the end of standard input finish the file as well: whatever happens, the log is readable.
"""

import argparse
import contextlib
import json
import os
import queue
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import can

from rt_runner import log_schema
from rt_runner.dbc import load_dbc
from rt_runner.errors import RtError, UsageError
from rt_runner.mcap_log import LogError, LogWriter
from rt_runner.result import ResultAccumulator, RunFacts

FLUSH_S = 0.5
PROGRESS_S = 1.0
POLL_S = 0.05  # how long a wait for frames may hold up a control line or a flush
DRAIN_QUIET_S, DRAIN_MAX_S = 0.2, 10.0
DRAIN_LATER_NS = 300_000_000  # frames stamped later than this after the finish are no part of the run
SO_MEMINFO, SK_MEMINFO_DROPS = 55, 8  # asm-generic/socket.h, linux/sock_diag.h; Python does not name them
ORPHAN_WAIT_S = 0.5
FINISH_WAIT_S = 10.0  # after the bus is lost: how long to wait to be told how the run ended
_PROGRESS = ("theta_w_est_degc", "theta_w_true_degc", "resp_us")


@dataclass(frozen=True)
class Config:
    """What the supervisor says about the run before it starts."""

    run: dict[str, Any] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)  # attachments: name -> path
    texts: dict[str, str] = field(default_factory=dict)  # attachments: name -> text
    facts: dict[str, Any] = field(default_factory=dict)  # `RunFacts` as far as they are known before the start

    @staticmethod
    def load(path: Path) -> "Config":
        """Read ``{"run": {...}, "files": {name: path}, "texts": {name: text}, "facts": {...}}``, each optional.

        Raises
        ------
        UsageError : missing, not JSON, or of another shape
        """
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
            return Config(**{name: dict(values.get(name, {})) for name in ("run", "files", "texts", "facts")})
        except OSError as e:
            raise UsageError(f"{path}: cannot read the logger's configuration ({e.strerror})") from None
        except (ValueError, TypeError, AttributeError):
            raise UsageError(f'{path}: must be JSON, {{"run": {{...}}, "files": {{...}}, ...}}') from None


class Control:
    """What the outside wants: control lines, signals, the end of standard input. The loop asks ``poll``."""

    def __init__(self) -> None:
        self._events: queue.SimpleQueue[dict] = queue.SimpleQueue()

    def listen(self, fd: int) -> None:
        """Read lines from ``fd`` in a thread of its own, and take SIGTERM and SIGINT."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: self._events.put({"stop": "interrupt"}))
        threading.Thread(target=self._read, args=(fd,), daemon=True).start()

    def _read(self, fd: int) -> None:
        # os.read and not sys.stdin: a thread that holds its lock would hang the interpreter's end.
        pending = b""
        while block := os.read(fd, 65536):
            *lines, pending = (pending + block).split(b"\n")
            for line in lines:
                self.put_line(line)
        self._events.put({"stop": "crash"})

    def put_line(self, line: bytes) -> None:
        """Take one control line; what is no JSON object is passed on as an event nobody knows."""
        with contextlib.suppress(ValueError):
            event = json.loads(line)
            self._events.put(event if isinstance(event, dict) else {"unknown": event})

    def poll(self) -> dict | None:
        """Oldest event not yet taken."""
        with contextlib.suppress(queue.Empty):
            return self._events.get_nowait()
        return None


class Logger:
    """Takes frames from a bus into a log until told to finish.

    Parameters
    ----------
    bus : receives; its ``rx_ns`` (integer stamp of the newest frame) and ``rx_drops`` are used where it has them
    writer : open log
    control : asked between frames
    say : takes one JSON-ready object for the supervisor
    clock : monotonic seconds
    wall_ns : the clock of the receive stamps, ns UTC
    """

    def __init__(
        self,
        bus: can.BusABC,
        writer: LogWriter,
        control: Control,
        say: Callable[[dict], None],
        clock: Callable[[], float] = time.monotonic,
        wall_ns: Callable[[], int] = time.time_ns,
        known: RunFacts | None = None,
    ) -> None:
        self._wall_ns = wall_ns
        self._bus, self._writer, self._control, self._say, self._clock = bus, writer, control, say, clock
        self._known = known or RunFacts()
        self._parent = os.getppid()
        self._cut_short = False
        self._accumulator = ResultAccumulator()
        self._newest: dict[str, float | None] = {}
        self._first_ns: int | None = None
        self._now_ns = 0
        self._next_flush = self._next_progress = clock()

    def run(self) -> dict:
        """Log until the end; returns the result, which is in the log by then.

        Raises
        ------
        LogError : the log cannot be written on
        """
        finish = self._until_told()
        self._drain()
        facts = self._facts(finish)
        result = self._accumulator.result(facts)
        for name, text in (finish.get("finish", {}).get("texts") or {}).items():
            self._writer.attach(name, text.encode())
        self._writer.seal(asdict(facts), result)
        return result

    def _until_told(self) -> dict:
        while True:
            event = self._control.poll()
            if event is not None and ("finish" in event or "stop" in event):
                return event
            try:
                self._take(POLL_S)
            except can.CanError as e:
                self._say({"error": f"bus lost: {e}"})
                return self._told_within(FINISH_WAIT_S) or {"stop": "crash", "why": f"bus lost: {e}"}
            self._housekeeping()

    def _told_within(self, wait_s: float) -> dict | None:
        deadline = self._clock() + wait_s
        while self._clock() < deadline:
            event = self._control.poll()
            if event is not None and ("finish" in event or "stop" in event):
                return event
            time.sleep(POLL_S)
        return None

    def _take(self, timeout_s: float) -> bool:
        """Log one frame; False if none came in time."""
        message = self._bus.recv(timeout_s)
        if message is None:
            return False
        # A float stamp is good to 0.2 us only; our own buses keep the kernel's integer beside it.
        t_ns = getattr(self._bus, "rx_ns", 0) or round(message.timestamp * 1e9)
        decoded = self._writer.write(t_ns, message.arbitration_id, bytes(message.data), _flags(message), message.dlc)
        if self._first_ns is None:
            self._first_ns = t_ns
        self._now_ns = t_ns
        if decoded is not None:
            self._accumulator.feed(t_ns, decoded.name, decoded.values, decoded.e2e)
            self._newest.update(decoded.values)
        return True

    def _housekeeping(self) -> None:
        now = self._clock()
        if now >= self._next_flush:
            self._next_flush = now + FLUSH_S
            self._writer.flush()
        if now >= self._next_progress:
            self._next_progress = now + PROGRESS_S
            t_s = 0.0 if self._first_ns is None else (self._now_ns - self._first_ns) / 1e9
            shown = {name: self._newest.get(name) for name in _PROGRESS}
            self._say({"progress": {"t_s": round(t_s, 3), "frames": self._writer.frames, **shown}})

    def _drain(self) -> None:
        """Take what is still on its way: until the bus is quiet, or, on one that never is, up to now.

        A logger that lags behind has frames waiting which the bus carried long ago: stamps decide, not our clock.
        """
        last_ns = self._wall_ns() + DRAIN_LATER_NS
        deadline = self._clock() + DRAIN_MAX_S
        with contextlib.suppress(can.CanError):
            while self._take(DRAIN_QUIET_S) and self._now_ns < last_ns:
                if self._clock() > deadline:
                    self._cut_short = True
                    return

    def _orphaned(self) -> bool:
        """Whether the signal that stopped us came because the supervisor died; it may come just before it is gone."""
        deadline = self._clock() + ORPHAN_WAIT_S
        while os.getppid() == self._parent and self._clock() < deadline:
            time.sleep(POLL_S)
        return os.getppid() != self._parent

    def _facts(self, told: dict) -> RunFacts:
        dropped = _dropped(self._bus)
        if "finish" not in told:
            crash = told.get("why") or "the supervisor ended without finishing the run"
            stopped_by = "crash" if told["stop"] == "crash" or self._orphaned() else told["stop"]
            return replace(
                self._known,
                stopped_by=stopped_by,
                crash=crash if stopped_by == "crash" else None,
                log_dropped=dropped,
                log_cut_short=self._cut_short,
            )
        finish = told["finish"]
        facts = RunFacts.from_dict(finish.get("outcome") or {})
        return replace(
            facts,
            granted=finish.get("granted") or facts.granted,
            log_dropped=facts.log_dropped + dropped,
            log_cut_short=self._cut_short,
        )


def _dropped(bus: can.BusABC) -> int:
    """Frames the kernel dropped because we read too slowly.

    The bus counts them when it receives the next frame; what was dropped after the last one only the socket knows.
    """
    seen = int(getattr(bus, "rx_drops", 0))
    sock = getattr(bus, "socket", None)
    try:
        info = struct.unpack("=9I", sock.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, 36))  # type: ignore[union-attr]
    except (AttributeError, OSError, struct.error):
        return seen
    return max(seen, info[SK_MEMINFO_DROPS])


def _flags(message: can.Message) -> int:
    return (
        message.is_extended_id * log_schema.FLAG_EXTENDED
        | message.is_remote_frame * log_schema.FLAG_REMOTE
        | message.is_error_frame * log_schema.FLAG_ERROR
        | message.is_fd * log_schema.FLAG_FD
        | message.bitrate_switch * log_schema.FLAG_BRS
        | message.error_state_indicator * log_schema.FLAG_ESI
    )


def _say(line: dict) -> None:
    with contextlib.suppress(BrokenPipeError):  # the supervisor is gone; its end of the pipe tells us to finish
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()


def _run(args: argparse.Namespace) -> None:
    from rt_runner.bus import open_bus

    config = Config.load(args.config) if args.config else Config()
    attachments = {**config.files, **{name: text.encode() for name, text in config.texts.items()}}
    control = Control()
    bus = open_bus(args.bus)
    try:
        with LogWriter(args.log, load_dbc(args.dbc), config.run, attachments, force=args.force) as writer:
            control.listen(sys.stdin.fileno())
            _say({"ready": True})
            result = Logger(bus, writer, control, _say, known=RunFacts.from_dict(config.facts)).run()
    finally:
        bus.shutdown()
    _say({"result": result})


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    parser = argparse.ArgumentParser(prog="rt_runner.logger", description="Log a CAN bus to MCAP.")
    parser.add_argument("--bus", required=True, metavar="BUS", help="socketcan:IFACE or rt_hub:PATH")
    parser.add_argument("--log", required=True, metavar="FILE", type=Path)
    parser.add_argument("--config", metavar="FILE", type=Path, help="JSON: run metadata and attachments")
    parser.add_argument("--dbc", metavar="FILE", help="default: the project's own")
    parser.add_argument("--force", action="store_true", help="overwrite an existing log")
    args = parser.parse_args(argv)
    try:
        _run(args)
    except RtError as e:
        if isinstance(e, LogError):
            _say({"error": str(e)})
        print(f"logger: {e}", file=sys.stderr)
        return e.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
