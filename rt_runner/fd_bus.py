"""A bus is a file descriptor that yields CAN frames: what our transports share as python-can buses.

The C twin is ``estimator_c/src/can_port.c``. One datagram is one kernel frame (``struct can_frame``, 16
bytes, or ``struct canfd_frame``, 72 bytes), stamped by the kernel on arrival. Transports differ only in how
they open the socket.
"""

from __future__ import annotations

import errno
import select
import socket
import struct
import time

import can
from can.bus import CanProtocol

CAN_EFF_FLAG, CAN_RTR_FLAG, CAN_ERR_FLAG = 0x80000000, 0x40000000, 0x20000000
CAN_SFF_MASK, CAN_EFF_MASK = 0x7FF, 0x1FFFFFFF
CANFD_BRS, CANFD_ESI, CANFD_FDF = 0x01, 0x02, 0x04
SO_RXQ_OVFL, SO_TIMESTAMPNS = 40, 35  # asm-generic/socket.h; Python 3.11 does not name them
CLASSIC = struct.Struct("=IB3x8s")  # struct can_frame
FD = struct.Struct("=IBB2x64s")  # struct canfd_frame
_TIMESPEC, _U32 = struct.Struct("@ll"), struct.Struct("=I")
_ANCILLARY_BYTES = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(_U32.size)
_ENOBUFS_WAIT_S = 0.0005  # a full device queue wakes nobody: look again


def pack_frame(msg: can.Message) -> bytes:
    """Give the kernel's frame for a message.

    Raises
    ------
    ValueError
        The message is none that a CAN bus can carry (id, length).
    """
    limit = CAN_EFF_MASK if msg.is_extended_id else CAN_SFF_MASK
    if not 0 <= msg.arbitration_id <= limit:
        raise ValueError(f"id 0x{msg.arbitration_id:x} does not fit into a frame (largest: 0x{limit:x})")
    can_id = msg.arbitration_id
    can_id |= (msg.is_extended_id and CAN_EFF_FLAG) | (msg.is_remote_frame and CAN_RTR_FLAG)
    can_id |= msg.is_error_frame and CAN_ERR_FLAG
    data = bytes(msg.data)
    if msg.is_fd:
        if len(data) > 64:
            raise ValueError(f"{len(data)} data bytes: a CAN FD frame carries at most 64")
        flags = CANFD_FDF | (msg.bitrate_switch and CANFD_BRS) | (msg.error_state_indicator and CANFD_ESI)
        return FD.pack(can_id, len(data), flags, data)
    length = msg.dlc if msg.is_remote_frame else len(data)
    if length > 8:
        raise ValueError(f"{length} data bytes: a classic CAN frame carries at most 8")
    return CLASSIC.pack(can_id, length, data)


def unpack_frame(raw: bytes) -> tuple[int, int, bytes] | None:
    """Give (id with flag bits, FD flags, data), or None if the bytes are no CAN frame.

    FD flags always hold CANFD_FDF for a CAN FD frame and are 0 for a classic one. The data of a remote frame
    are zeros, as many as it asks for.
    """
    if len(raw) == CLASSIC.size:
        can_id, length, data = CLASSIC.unpack(raw)
        flags, longest = 0, 8
    elif len(raw) == FD.size:
        can_id, length, flags, data = FD.unpack(raw)
        flags, longest = flags | CANFD_FDF, 64
    else:
        return None
    standard = not can_id & (CAN_EFF_FLAG | CAN_ERR_FLAG)
    if length > longest or (standard and can_id & CAN_EFF_MASK > CAN_SFF_MASK):
        return None
    return can_id, flags, data[:length]


class FdBus(can.BusABC):
    """A python-can bus on a connected socket; subclasses open it and name it.

    Counters only grow: ``received`` and ``sent`` frames, ``rx_drops`` (lost by the kernel because we read too
    slowly; never on the hub), ``rejected`` (datagrams that are no CAN frame, skipped). ``rx_ns`` is the
    receive stamp of the last message in integer ns UTC: ``Message.timestamp`` is a float, good to 0.2 µs.

    Parameters
    ----------
    sock : socket.socket
        Connected and open; the bus owns it from now on.
    channel_info : str
        What error messages call this bus.
    receive : bool
        False: this end only sends; the subclass has told the other side.
    """

    def __init__(
        self, sock: socket.socket, channel_info: str, can_filters=None, receive: bool = True, **kwargs
    ) -> None:
        self.socket = sock
        self.channel_info = channel_info
        self.received = self.sent = self.rx_drops = self.rejected = self.rx_ns = 0
        self._overflow_seen = 0
        self._receives = receive
        self._can_protocol = CanProtocol.CAN_FD
        self.socket.setblocking(False)
        self.socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._readable, self._writable = select.poll(), select.poll()
        self._readable.register(self.socket, select.POLLIN)
        self._writable.register(self.socket, select.POLLOUT)
        super().__init__(channel=channel_info, can_filters=can_filters, **kwargs)

    def fileno(self) -> int:
        """Give the descriptor, for Notifier, asyncio, select."""
        return self.socket.fileno()

    def _gone(self, why: str, error_code: int | None = None) -> can.CanOperationError:
        return can.CanOperationError(f"{self.channel_info}: {why}", error_code)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """Read one message; unusable datagrams are counted and skipped."""
        if not self._receives:
            raise self._gone("this bus was opened to send only")
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            try:
                raw, ancillary, flags, _ = self.socket.recvmsg(FD.size, _ANCILLARY_BYTES)
            except BlockingIOError:
                left_s = None if deadline is None else deadline - time.monotonic()
                if left_s is not None and left_s <= 0:
                    return None, False
                self._readable.poll(None if left_s is None else left_s * 1e3)
                continue
            except ConnectionResetError:
                continue  # the hub died with frames of ours unread; what it had queued for us is still there
            except OSError as e:
                raise self._gone(e.strerror or str(e)) from e
            if not raw:
                raise self._gone("the hub has closed the connection; restart the run")
            stamp_ns = self._read_ancillary(ancillary)
            frame = unpack_frame(raw) if not flags & socket.MSG_TRUNC else None
            if frame is None:
                self.rejected += 1
                if deadline is not None and time.monotonic() >= deadline:
                    return None, False  # a flood of garbage must not hold the caller
                continue
            self.received += 1
            self.rx_ns = stamp_ns
            return self._message(frame, stamp_ns, not flags & socket.MSG_DONTROUTE), False

    def _read_ancillary(self, ancillary: list[tuple[int, int, bytes]]) -> int:
        stamp_ns = 0
        for level, kind, data in ancillary:
            if level != socket.SOL_SOCKET:
                continue
            if kind == SO_TIMESTAMPNS:
                seconds, nanoseconds = _TIMESPEC.unpack_from(data)
                stamp_ns = seconds * 1_000_000_000 + nanoseconds
            elif kind == SO_RXQ_OVFL:
                total = _U32.unpack_from(data)[0]
                self.rx_drops += (total - self._overflow_seen) & 0xFFFFFFFF  # the kernel's counter wraps
                self._overflow_seen = total
        return stamp_ns

    def _message(self, frame: tuple[int, int, bytes], stamp_ns: int, is_rx: bool) -> can.Message:
        can_id, flags, data = frame
        extended = bool(can_id & CAN_EFF_FLAG)
        remote = bool(can_id & CAN_RTR_FLAG)
        return can.Message(
            timestamp=stamp_ns * 1e-9,
            arbitration_id=can_id & (CAN_EFF_MASK if extended or can_id & CAN_ERR_FLAG else CAN_SFF_MASK),
            is_extended_id=extended,
            is_remote_frame=remote,
            is_error_frame=bool(can_id & CAN_ERR_FLAG),
            is_fd=bool(flags & CANFD_FDF),
            bitrate_switch=bool(flags & CANFD_BRS),
            error_state_indicator=bool(flags & CANFD_ESI),
            is_rx=is_rx,
            dlc=len(data),
            data=None if remote else data,
        )

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one message; ``timeout`` None waits as long as it takes (back-pressure), 0 not at all.

        Raises
        ------
        can.CanOperationError
            No room within ``timeout``, or the bus has ended.
        ValueError
            The message is none that a CAN bus can carry.
        """
        raw = pack_frame(msg)
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            try:
                self.socket.send(raw, socket.MSG_NOSIGNAL)
                self.sent += 1
                return
            except OSError as e:
                if e.errno not in (errno.EAGAIN, errno.ENOBUFS):
                    if e.errno in (errno.EPIPE, errno.ECONNRESET):
                        raise self._gone("the hub has closed the connection; restart the run") from e
                    raise self._gone(e.strerror or str(e)) from e
                left_s = None if deadline is None else deadline - time.monotonic()
                if left_s is not None and left_s <= 0:
                    raise self._gone(f"no room to send within {timeout:g} s", e.errno) from e
                if e.errno == errno.ENOBUFS:
                    time.sleep(_ENOBUFS_WAIT_S)
                else:
                    self._writable.poll(None if left_s is None else left_s * 1e3)

    def flush_tx_buffer(self) -> None:
        """Do nothing: what was sent is with the kernel."""

    def shutdown(self) -> None:
        """Close the socket; harmless when already closed."""
        super().shutdown()
        self.socket.close()
