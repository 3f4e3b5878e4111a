"""The adjoint of a step."""
