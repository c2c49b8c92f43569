"""Timing read from what was on the bus: pure functions over stamps and decoded frames."""
