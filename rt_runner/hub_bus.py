"""python-can interface ``rt_hub``: the user-space hub, ``can.Bus(interface="rt_hub", channel=SOCKET_PATH)``.

Registered as an entry point, so every python-can program works on the hub:
``python -m can.logger -i rt_hub -c PATH``, ``cantools monitor -i rt_hub -c PATH dbc/drive.dbc``.
"""

from __future__ import annotations

import os
import socket
import struct

import can

from .fd_bus import FdBus

_CONNECT_TIMEOUT_S = 2  # a hub that was stopped accepts nobody


class HubBus(FdBus):
    """One client of the hub: sees every other client's frames, in one order, without loss.

    A client that does not read holds the others up and is disconnected by the hub after a while: read, or say
    ``receive=False``.

    Parameters
    ----------
    channel : str
        Path of the hub's socket.
    receive : bool
        False: this client only sends.

    Raises
    ------
    can.CanInitializationError
        No hub listens there. One line: what, where, what to do.
    """

    def __init__(self, channel: str, can_filters=None, receive: bool = True, **kwargs) -> None:
        path = os.fspath(channel)
        if not 0 < len(os.fsencode(path)) < 108:
            raise can.CanInitializationError(
                f"rt_hub channel {path!r}: a socket path has 1 to 107 bytes: give the hub a shorter one"
            )
        kwargs.pop("fd", None)  # the hub carries both kinds of frames, always
        kwargs.pop("bitrate", None)  # and has no bit rate
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            # Not settimeout: a non-blocking connect gives up at once when many connect at the same time.
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("@ll", _CONNECT_TIMEOUT_S, 0))
            sock.connect(path)
            if not receive:
                sock.shutdown(socket.SHUT_RD)
        except OSError as e:
            sock.close()
            reason = "it does not answer" if isinstance(e, TimeoutError | BlockingIOError) else e.strerror
            raise can.CanInitializationError(
                f"no hub at {path} ({reason}): start one with `rt_hub --socket {path}`"
            ) from e
        super().__init__(sock, f"rt_hub {path}", can_filters=can_filters, receive=receive, **kwargs)
