"""Raw frames of a log in any format: our MCAP, or what python-can reads (candump ``.log``, ASC, BLF, TRC, CSV …)."""

from collections.abc import Iterator
from pathlib import Path

from rt_runner.log_reader import LogError, LogReader, RawFrame
from rt_runner.log_schema import FLAG_BRS, FLAG_ERROR, FLAG_ESI, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE

MCAP_SUFFIX = ".mcap"


def raw_frames(path: str | Path) -> Iterator[RawFrame]:
    """Frames in the order of the log; stamps in ns, as fine as the format keeps them (candump and ASC: 1 us).

    Parameters
    ----------
    path : the suffix tells the format; what python-can reads may be gzipped

    Raises
    ------
    LogError
        No such file, a format nobody here reads, or one that its reader gives up on (one line).
    """
    path = Path(path)
    if path.suffix.lower() == MCAP_SUFFIX:
        yield from LogReader(path).raw()
        return
    import can

    try:
        with can.LogReader(path) as reader:
            for m in reader:
                yield raw_frame(m)
    except OSError as e:
        raise LogError(f"{path}: cannot read the log ({e.strerror or e}); give the path of a log") from None
    except LogError:
        raise
    except Exception as e:  # python-can's readers raise what their parsing happens to raise
        reason = " ".join(str(e).split()) or type(e).__name__
        known = ".mcap, .log (candump), .asc or .blf"
        raise LogError(f"{path}: no log that can be read ({reason}); give {known}") from None


def raw_frame(message) -> RawFrame:
    """One ``can.Message`` as a raw frame."""
    flags = (
        message.is_extended_id * FLAG_EXTENDED
        | message.is_remote_frame * FLAG_REMOTE
        | message.is_error_frame * FLAG_ERROR
        | message.is_fd * FLAG_FD
        | message.bitrate_switch * FLAG_BRS
        | message.error_state_indicator * FLAG_ESI
    )
    t_ns = round(message.timestamp * 1e9)
    return RawFrame(t_ns, message.arbitration_id, bytes(message.data), message.dlc, flags)
