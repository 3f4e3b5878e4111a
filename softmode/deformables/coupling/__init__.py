"""Rigid degrees of freedom of other solvers as unknowns of the same step."""
