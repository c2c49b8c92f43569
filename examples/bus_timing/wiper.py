"""A node of one's own, as small as can be: WiperState every 20 ms, WiperHealth every 100 ms.

python wiper.py INTERFACE CHANNEL SECONDS
"""

import sys
import time

import can


def main(interface: str, channel: str, seconds: float) -> None:
    """Send on an absolute grid of 20 ms."""
    options = {"receive": False} if interface == "rt_hub" else {}  # it only sends
    with can.Bus(interface=interface, channel=channel, **options) as bus:
        start = time.monotonic()
        for k in range(round(seconds / 0.02)):
            time.sleep(max(0.0, start + k * 0.02 - time.monotonic()))
            bus.send(can.Message(arbitration_id=0x300, is_extended_id=False, data=[k % 180, 1]))
            if k % 5 == 0:
                bus.send(can.Message(arbitration_id=0x301, is_extended_id=False, data=[0]))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]))
