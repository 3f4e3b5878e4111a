"""Find Young's modulus of a soft cantilever from the tracks of 20 markers on its surface.

A bar, clamped at one end, falls into its sag and swings for 2 s; a motion capture system follows 20 markers. Starting
a decade off, each iterate simulates the tracks and differentiates their squared error by ln E with the adjoint of the
step. The way to the next iterate needs no second derivative: from afar Newton's method for a root of the error's norm,
near the solution, where noise keeps that norm from vanishing, the secant of its gradient.

Run: ``python examples/identify_stiffness.py [--short]``
"""

import argparse
from typing import Any

import newton
import numpy as np
import warp as wp

from softmode.deformables import (
    AdjointReduced,
    BuildOptions,
    Markers,
    Material,
    SolverReduced,
    SolverReducedOptions,
    add_pins,
    add_reduced_body,
    build_body,
    quadrature_from_box,
)

TRUE_MODULUS = 2.0e5
"""What is to be found [Pa]."""


class Cantilever:
    """The experiment: simulates the tracks for a modulus, and differentiates their error."""

    def __init__(self, duration: float, dt: float = 1.0 / 60.0, marker_count: int = 20) -> None:
        """Build a bar of 0.4 x 0.1 x 0.1 m, clamped over its first 5 cm."""
        quadrature = quadrature_from_box((0.4, 0.1, 0.1), point_count=2000, surface_count=200)
        body = build_body(quadrature, BuildOptions(mode_count=6, kernel_count=200, cubature_count=128), name="bar")
        world = newton.ModelBuilder()
        bar = add_reduced_body(world, body, material=Material(density=600.0, viscosity=0.005))
        clamped = body.cubature.points[body.cubature.points[:, 0] < body.bounds[0, 0] + 0.05]
        add_pins(world, bar, clamped, stiffness=2000.0)
        self.model: Any = world.finalize()
        self.dt, self.step_count = dt, round(duration / dt)
        self.solver = SolverReduced(self.model, [body], options=SolverReducedOptions(tolerance=1.0e-7))
        self.adjoint = AdjointReduced(self.solver, self.step_count)
        chosen = np.random.default_rng(0).choice(body.surface_count, marker_count, replace=False)
        self.markers = Markers(self.solver, body.surface.points[chosen], instance=bar)

    def tracks(self, modulus: float) -> np.ndarray:
        """Return the positions of the markers [m], shape (step_count + 1, marker_count, 3)."""
        self.model.softmode.youngs_modulus.fill_(modulus)
        state, after, control = self.model.state(), self.model.state(), self.model.control()
        self.adjoint.start(state)
        for _ in range(self.step_count):
            self.adjoint.step(state, after, control, self.dt)
            state, after = after, state
        return self.markers.positions(self.adjoint.q.numpy())

    def loss(self, modulus: float, observed: np.ndarray) -> tuple[float, float]:
        """Return L = 1/2 sum |x - observed|^2 [m^2] and dL/d(ln E)."""
        error = self.tracks(modulus) - observed
        gradients = self.adjoint.backward(loss_q=self.markers.spread(error))
        return 0.5 * float((error**2).sum()), float(gradients.youngs_modulus.numpy()[0]) * modulus


def identify(
    cantilever: Cantilever, observed: np.ndarray, start: float, *, evaluation_max: int = 10, tolerance: float = 1e-3
) -> list[float]:
    """Return the iterates [Pa] from ``start`` until the next would differ by less than ``tolerance`` in ln E."""
    x, iterates, before = float(np.log(start)), [], None
    for _ in range(evaluation_max):
        iterates.append(float(np.exp(x)))
        loss, slope = cantilever.loss(iterates[-1], observed)
        if slope == 0.0:
            break
        if before and abs(x - before[0]) < 0.3 and (slope - before[1]) * (x - before[0]) > 0.0:
            step = -slope * (x - before[0]) / (slope - before[1])
        else:
            # Newton on sqrt(2 L), to first order; far off it takes the step that suits a sag proportional to 1 / E
            step = -float(np.sign(slope) * np.log1p(2.0 * loss / abs(slope)))
        if abs(step) < tolerance:
            break
        before, x = (x, slope), x + step
    return iterates


def test_final(rows: list[tuple[float, list[float]]]) -> None:
    """E is found to 1 % without noise, to 5 % with 1 mm of it, in at most 10 evaluations."""
    for noise, iterates in rows:
        assert len(iterates) <= 10
        assert abs(iterates[-1] / TRUE_MODULUS - 1.0) <= (0.01 if noise == 0.0 else 0.05)


def main() -> None:
    """Print one row per start and noise."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--short", action="store_true", help="0.4 s of tracks and one start")
    short = parser.parse_args().short
    wp.config.log_level = wp.LOG_WARNING
    cantilever = Cantilever(0.4 if short else 2.0)
    clean = cantilever.tracks(TRUE_MODULUS)
    noise = np.random.default_rng(1).normal(size=clean.shape)
    print(f"tip sags by {np.ptp(clean[..., 2], axis=0).max():.3f} m; {clean.shape[1]} markers, {clean.shape[0]} frames")
    rows = []
    for deviation in (0.0, 0.001):
        for factor in (10.0,) if short else (10.0, 0.1):
            iterates = identify(cantilever, clean + deviation * noise, factor * TRUE_MODULUS)
            rows.append((deviation, iterates))
            path = " ".join(f"{E / TRUE_MODULUS:.4f}" for E in iterates)
            print(f"noise {1e3 * deviation:.0f} mm, {len(iterates)} evaluations, E over the true E: {path}")
    test_final(rows)


if __name__ == "__main__":
    main()
