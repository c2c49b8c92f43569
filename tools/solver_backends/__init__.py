"""Solvers of the MHE problem behind one interface, a recorded stream of problems, and the oracle: for `bench solver`."""
