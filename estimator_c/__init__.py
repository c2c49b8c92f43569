"""The estimator: CasADi formulation (build time), trained weights, settings and the C that runs."""
