"""Off-line tools: data sets, benchmarks, plots. Nothing imports them at run time."""
