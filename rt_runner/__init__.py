"""The runner: starts, logs and judges the processes of a run. Knows no physics."""
