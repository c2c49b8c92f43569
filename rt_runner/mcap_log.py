"""The log: every raw frame and its decoded signals in one MCAP file.

Channels ``can/raw`` and ``signals/<Message>``, attachments, metadata ``run`` and ``result``; see
``docs/decisions/log-format.md``. Writing knows no clock: the stamps come with the frames, and who writes in real
time calls ``flush`` when he wants what is buffered on the disk. Reading is in `rt_runner.log_reader`.
"""

import contextlib
import errno
import fcntl
import json
import os
import stat
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from mcap.writer import CompressionType, Writer

from rt_runner import log_schema
from rt_runner.codec import Decoded, Decoder
from rt_runner.dbc import Dbc
from rt_runner.log_reader import LogError, LogFrame, LogReader, RawFrame, read_log
from rt_runner.log_summary import LogSummary, MessageSummary, summarise
from rt_runner.mcap_chunk import speed_up

__all__ = [
    "LogError", "LogFrame", "LogReader", "LogSummary", "LogWriter", "MessageSummary", "RawFrame",
    "prepare_log_path", "read_log", "summarise",
]  # fmt: skip

CHUNK_BYTES = 64 * 1024  # what a crash can lose at most, beside the time since the last flush
LIBRARY = "rt-runner log 1"
_MEDIA = {".toml": "application/toml", ".json": "application/json", ".dbc": "text/plain", ".txt": "text/plain"}
_UNDECODED = log_schema.FLAG_EXTENDED | log_schema.FLAG_REMOTE | log_schema.FLAG_ERROR


class _Disk:
    """Unbuffered file: a write is on its way to the disk whole, or the file ends where it ended before."""

    def __init__(self, fd: int, path: Path) -> None:
        self._fd, self._path, self._size = fd, path, 0
        self.failed = False

    def write(self, data: bytes) -> int:
        if self.failed:
            raise LogError(f"{self._path}: the log ended earlier, nothing more is written to it")
        view, done = memoryview(data), 0
        try:
            while done < len(view):
                done += os.write(self._fd, view[done:])
        except OSError as e:
            self.failed = True
            with contextlib.suppress(OSError):  # keep whole records only: what is there stays readable
                os.ftruncate(self._fd, self._size)
            raise LogError(
                f"{self._path}: cannot write the log on ({e.strerror}); the first {self._size} bytes are kept and "
                f"readable; {_advice(e)}"
            ) from None
        self._size += done
        return done

    def tell(self) -> int:
        return self._size

    def flush(self) -> None:
        """Nothing is held back here."""

    def close(self) -> None:
        os.close(self._fd)


def _advice(e: OSError) -> str:
    if e.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return "make room on the disk, or log elsewhere with --log"
    if e.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return "log where you may write, with --log"
    return "choose another file with --log"


def _is_locked(path: Path) -> bool:
    """Whether another process writes this log now."""
    with contextlib.suppress(OSError):
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        finally:
            os.close(fd)
    return False


def _open(path: Path, force: bool) -> int:
    flags = os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | (0 if force else os.O_EXCL)
    try:
        fd = os.open(path, flags, 0o644)
    except FileExistsError:
        if path.is_dir():
            raise LogError(f"{path}: is a directory; give a file name with --log") from None
        if _is_locked(path):
            raise LogError(f"{path}: another logger writes it; choose another file with --log") from None
        raise LogError(f"{path}: exists already; choose another file") from None
    except OSError as e:
        raise LogError(f"{path}: cannot write the log ({e.strerror}); {_advice(e)}") from None
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.ftruncate(fd, 0)  # only now: with --force it may have been somebody's
    except BlockingIOError:
        os.close(fd)
        raise LogError(f"{path}: another logger writes it; choose another file with --log") from None
    return fd


def prepare_log_path(path: Path | None, stem: str) -> Path:
    """Path a new log can be written to; an older log in its place is kept under a numbered name.

    Parameters
    ----------
    path : file asked for; None makes ``logs/STEM-DATE-TIME.mcap`` in the working directory
    stem : name for that case, usually the scenario's

    Raises
    ------
    LogError : it is a directory, another logger writes it, or its folder cannot be made or written to
    """
    if path is None:
        path = Path("logs") / f"{stem}-{time.strftime('%Y%m%d-%H%M%S')}.mcap"
    try:
        mode = path.stat().st_mode if path.exists() else stat.S_IFREG
        if stat.S_ISDIR(mode):
            raise LogError(f"{path}: is a directory; give a file name, such as {path / (stem + '.mcap')}")
        if not stat.S_ISREG(mode):
            raise LogError(f"{path}: is no ordinary file; a log needs one, choose another with --log")
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            if _is_locked(path):
                raise LogError(f"{path}: another logger writes it; choose another file with --log")
            path.rename(_free_name(path))
        with path.open("xb"):
            pass
        path.unlink()
    except OSError as e:
        raise LogError(f"{path}: cannot write the log ({e.strerror}); {_advice(e)}") from None
    return path


def _free_name(path: Path) -> Path:
    number = 1
    while (kept := path.with_name(f"{path.stem}.{number}{path.suffix}")).exists():
        number += 1
    return kept


class LogWriter:
    """Writes one log. The same calls give the same content.

    Parameters
    ----------
    path : new file; an existing one is refused unless ``force``
    dbc : decodes the frames; goes into the log as attachment ``drive.dbc``
    run_metadata : metadata record ``run``
    attachments : name -> file, or bytes
    force : overwrite an existing file (never one that another logger writes)

    Raises
    ------
    LogError : file or attachment cannot be used, or, later, not be written on (disk full); one line
    """

    def __init__(
        self,
        path: str | Path,
        dbc: Dbc,
        run_metadata: Mapping[str, object] | None = None,
        attachments: Mapping[str, str | Path | bytes] | None = None,
        *,
        force: bool = False,
    ) -> None:
        self.path = Path(path)
        files = {"drive.dbc": dbc.text}
        files |= {name: _contents(name, src) for name, src in (attachments or {}).items() if name not in files}
        self._disk = _Disk(_open(self.path, force), self.path)
        self._decoder = Decoder(dbc)
        self._closed = False
        self._last_ns = 0
        self.frames = 0
        self._writer = Writer(self._disk, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
        speed_up(self._writer)
        try:
            self._writer.start(profile="", library=LIBRARY)
            self.metadata("run", run_metadata or {})
            for name, data in files.items():
                self.attach(name, data)
        except LogError:
            self.close()
            raise
        schema = self._writer.register_schema(log_schema.RAW_SCHEMA, "protobuf", log_schema.raw_schema())
        self._raw_channel = self._writer.register_channel(log_schema.RAW_TOPIC, "protobuf", schema)
        self._channels: dict[str, tuple[int, log_schema.FrameSerializer]] = {}
        for m in dbc:
            schema = self._writer.register_schema(
                log_schema.schema_name(m.name), "protobuf", log_schema.message_schema(m)
            )
            channel = self._writer.register_channel(
                log_schema.TOPIC_PREFIX + m.name, "protobuf", schema, log_schema.channel_metadata(m)
            )
            self._channels[m.name] = channel, log_schema.FrameSerializer(m)

    @property
    def unknown(self) -> int:
        """Frames so far whose id the DBC does not have; they are logged raw only."""
        return self._decoder.unknown

    def write(self, t_ns: int, can_id: int, data: bytes, flags: int = 0, dlc: int | None = None) -> Decoded | None:
        """Log one frame as received at ``t_ns`` (receive stamp); returns it decoded, None if it is not in the DBC.

        ``flags`` are the ``FLAG_*`` bits of `log_schema`; extended, remote and error frames are logged raw only.
        """
        data = bytes(data)
        self._last_ns = t_ns
        self.frames += 1
        raw = log_schema.serialize_raw(can_id, data, len(data) if dlc is None else dlc, flags)
        self._writer.add_message(self._raw_channel, t_ns, raw, t_ns, self.frames & 0xFFFFFFFF)
        if flags & _UNDECODED:
            return None
        decoded = self._decoder.decode(can_id, data)
        if decoded is not None:
            channel, serialize = self._channels[decoded.name]
            payload = serialize(decoded.values, decoded.e2e)
            self._writer.add_message(channel, t_ns, payload, t_ns, self.frames & 0xFFFFFFFF)
        return decoded

    def metadata(self, name: str, values: Mapping[str, object]) -> None:
        """Add a metadata record; values become text."""
        self._writer.add_metadata(name, {str(k): str(v) for k, v in values.items()})

    def attach(self, name: str, data: bytes) -> None:
        """Add an attachment, stamped with the newest frame's time."""
        media = _MEDIA.get(Path(name).suffix, "application/octet-stream")
        self._writer.add_attachment(0, self._last_ns, name, media, data)

    def seal(self, facts: Mapping[str, Any], result: Mapping[str, Any]) -> None:
        """Write what ends a run: what was granted, the facts no frame can tell, and the result (JSON each)."""
        self.attach("granted.json", json.dumps(facts.get("granted", {}), sort_keys=True).encode())
        self.metadata("facts", {"json": json.dumps(facts, sort_keys=True)})
        self.metadata("result", {"json": json.dumps(result)})

    def flush(self) -> None:
        """Hand everything so far to the operating system: a killed process loses nothing of it."""
        self._writer.flush()

    def close(self) -> None:
        """Finish the file; calling it again does nothing. After a failed write the file is left as it is."""
        if self._closed:
            return
        self._closed = True
        try:
            if not self._disk.failed:
                self._writer.finish()
        finally:
            self._disk.close()

    def __enter__(self) -> "LogWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _contents(name: str, source: str | Path | bytes) -> bytes:
    if isinstance(source, bytes):
        return source
    try:
        return Path(source).read_bytes()
    except OSError as e:
        raise LogError(f"{source}: cannot attach it to the log as {name} ({e.strerror})") from None
