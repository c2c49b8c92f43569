"""One supervised child process: its JSON lines, its last words, its end."""

import contextlib
import ctypes
import json
import os
import queue
import signal
import subprocess
import threading
import time
from collections import deque

from rt_runner.errors import RtError, SetupError

_PR_SET_PDEATHSIG = 1
_libc = ctypes.CDLL(None, use_errno=True)


def spawn(command: list[str], cores: set[int] | None = None) -> subprocess.Popen:
    """Start a process with pipes on all three streams, on ``cores``, that ends when we do.

    It gets a session of its own: Ctrl-C reaches us alone, and we end the others in order. What lies in the working
    folder cannot stand in for a module of ours.
    """

    def in_child() -> None:
        # Who is killed takes his children along; nobody is left sending on the bus.
        _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if cores:
            with contextlib.suppress(OSError):
                os.sched_setaffinity(0, cores)

    return subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        preexec_fn=in_child,
        env={**os.environ, "PYTHONSAFEPATH": "1"},
    )


class ChildError(RtError):
    """A child process ended, or stayed silent, when it should not have."""


class Child:
    """A process that speaks JSON, one object a line, on stdout; everything else it says is kept as last words.

    Parameters
    ----------
    name : how people call it: plant, estimator, logger, hub
    command : argument vector
    cores : cores it may run on; None leaves it as it is
    """

    def __init__(self, name: str, command: list[str], cores: set[int] | None = None) -> None:
        self.name = name
        self.lines: queue.Queue[dict | None] = queue.Queue()
        self._words: deque[str] = deque(maxlen=20)

        try:
            self.process = spawn(command, cores)
        except OSError as e:
            raise SetupError(f"cannot start the {name}: {command[0]}: {e.strerror}") from e
        self._readers = [
            threading.Thread(target=self._read_stdout, daemon=True),
            threading.Thread(target=self._read_stderr, daemon=True),
        ]
        for reader in self._readers:
            reader.start()

    def _read_stdout(self) -> None:
        assert self.process.stdout is not None
        for raw in self.process.stdout:
            try:
                line = json.loads(raw)
            except ValueError:
                line = None
            if isinstance(line, dict):
                self.lines.put(line)
            else:
                self._words.append(raw.decode(errors="replace").rstrip())
        self.lines.put(None)

    def _read_stderr(self) -> None:
        assert self.process.stderr is not None
        for raw in self.process.stderr:
            self._words.append(raw.decode(errors="replace").rstrip())

    def tell(self, text: str) -> None:
        """Write one line to its stdin; a child that is gone is noticed elsewhere."""
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError, ValueError, OSError):
            self.process.stdin.write(text.encode() + b"\n")
            self.process.stdin.flush()

    def wait_line(self, key: str, timeout_s: float, cancelled=lambda: False) -> dict:
        """The next JSON line that has ``key``.

        Raises
        ------
        ChildError
            It ended or stayed silent; the message carries its last words.
        """
        deadline = time.monotonic() + timeout_s
        while not cancelled():
            try:
                line = self.lines.get(timeout=0.05)
            except queue.Empty:
                if time.monotonic() > deadline:
                    raise ChildError(
                        f"the {self.name} did not answer within {timeout_s:g} s: {self.last_words()}"
                    ) from None
                continue
            if line is None:
                raise ChildError(self.obituary())
            if key in line:
                return line
        raise ChildError(f"stopped while waiting for the {self.name}")

    def ended(self) -> bool:
        """Whether the process has ended (it is reaped then)."""
        return self.process.poll() is not None

    def stop(self, grace_s: float = 5.0, sig: int = signal.SIGTERM) -> int:
        """Ask it to end, then make it; returns its exit status."""
        if self.process.poll() is None:
            self.process.send_signal(sig)
        return self.reap(grace_s)

    def reap(self, grace_s: float) -> int:
        """Wait for its end, kill it where it will not; returns its exit status."""
        try:
            self.process.wait(grace_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        for reader in self._readers:
            reader.join(1.0)
        return self.process.returncode

    def last_words(self) -> str:
        """What it said last outside the protocol, on one line."""
        words = [w for w in self._words if w.strip()]
        return words[-1].strip() if words else "(it said nothing)"

    def obituary(self) -> str:
        """One line on how it ended."""
        code = self.reap(1.0)
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit status {code}"
        return f"the {self.name} {how}; its last words: {self.last_words()}"
