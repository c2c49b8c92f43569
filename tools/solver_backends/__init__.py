"""Solvers of the MHE problem behind one interface, recorded problems, and the oracle: for `bench solver`."""
