"""SocketCAN through the same code as the hub, so that both count the same things.

python-can's own ``socketcan`` interface works on the same bus; it shows neither SO_RXQ_OVFL (how many frames
the kernel had to drop) nor has it a way to ask for a receive buffer that outlasts a busy moment.
"""

from __future__ import annotations

import contextlib
import socket
import struct

import can
import can.typechecking

from .fd_bus import CAN_EFF_FLAG, SO_RXQ_OVFL, FdBus

_SO_RCVBUFFORCE, _CAN_RAW_ERR_FILTER = 33, 2  # asm-generic/socket.h, linux/can/raw.h
_ALL_ERRORS = 0x1FFFFFFF
_RCVBUF_BYTES = 4 << 20  # the default holds about 222 frames: 0.7 s of this project's bus
_FILTER = struct.Struct("=II")


class SocketcanBus(FdBus):
    """A CAN interface of the kernel, with drop counting, error frames and filters in the kernel.

    Parameters
    ----------
    channel : str
        Name of the interface.
    receive : bool
        False: this client only sends.

    Raises
    ------
    can.CanInitializationError
        No such interface. One line: what and where.
    """

    def __init__(self, channel: str, can_filters=None, receive: bool = True, **kwargs) -> None:
        try:
            sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except OSError as e:
            raise can.CanInitializationError(f"this kernel has no CAN support ({e.strerror})") from e
        try:
            with contextlib.suppress(OSError):  # needs CAP_NET_ADMIN; else as much as the system allows
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RCVBUF_BYTES)
                sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RCVBUF_BYTES)
            sock.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
            sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
            sock.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, _ALL_ERRORS)
            sock.bind((channel,))
        except OSError as e:
            sock.close()
            raise can.CanInitializationError(f"CAN interface {channel}: {e.strerror or e}") from e
        super().__init__(sock, f"socketcan {channel}", can_filters=can_filters, receive=receive, **kwargs)

    def _apply_filters(self, filters) -> None:
        if not self._receives:
            packed = b""
        elif not filters:
            packed = _FILTER.pack(0, 0)
        else:
            packed = b"".join(_pack_filter(f) for f in filters)
        self.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, packed)
        # Frames queued before the change were not filtered: python-can's own filter still looks at each.


def _pack_filter(f: can.typechecking.CanFilter) -> bytes:
    can_id, mask = f["can_id"], f["can_mask"]
    if "extended" in f:
        mask |= CAN_EFF_FLAG
        can_id |= CAN_EFF_FLAG if f["extended"] else 0
    return _FILTER.pack(can_id, mask)
