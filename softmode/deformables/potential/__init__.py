"""Energy, force and Hessian of a world at an iterate. It knows no schedule."""
