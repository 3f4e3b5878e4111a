"""Points and Gaussians at any rest point, moved by the reduced coordinates, forward and adjoint."""
