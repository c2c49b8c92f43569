"""Replay: a log's frames through the C estimator once more, and whether every estimate comes out again.

frames → `session` (inputs and jobs) → `cuts` (which inputs each job had read) → `engine` (the binary) → `differ`;
`search` joins them and tries the other possibilities where the log leaves some open.
"""
