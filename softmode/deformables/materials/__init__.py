"""Energy, stress and Hessian of hyperelastic materials at a point."""
