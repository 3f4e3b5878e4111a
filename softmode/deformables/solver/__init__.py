"""One step: the minimisation of one potential."""
