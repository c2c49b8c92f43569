"""For tests of what is on a bus: what the pytest plugin's fixtures are made of. See ``docs/pytest-plugin.md``."""

from rt_runner.testing.checks import assert_cycle_times, assert_no_timeouts

__all__ = ["assert_cycle_times", "assert_no_timeouts"]
