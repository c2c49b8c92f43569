"""For all tests: SIGINT as a terminal would have it.

A shell that starts us in the background makes SIGINT ignored, and every process we start would inherit that: Ctrl-C
could not be tested.
"""

import signal

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
