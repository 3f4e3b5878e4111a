"""Acting on and reading a running solver: grips, sensors, markers."""
