"""Find Young's modulus from where mass is, by two methods: no markers, and not even the same particles.

A soft bar swings for a quarter of a second. Known of it then are masses on a grid, those of other particles. Adjoints
of the material point method and of a reduced body give the derivative of their distance by E; a secant finds E.

Run: ``python examples/morph_identify.py [--short]``
"""

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import newton
import numpy as np
import warp as wp

from softmode import deformables as soft
from softmode import mpm

TRUE_MODULUS = 4.0e4  # What is to be found [Pa].
HALF, VOLUME = np.array([6.0, 1.5, 1.5]), 108.0  # Half edges [m] and volume [m^3] of the bar.
DT, STEPS = 1.0 / 120.0, 30  # Of the particles; the reduced body takes steps twice as long.
GRID = mpm.Grid(shape=(47, 27, 39), spacing=0.5, origin=(-11.5, -6.5, -9.5))  # Three cells across are too stiff.
MATERIAL = soft.Material(youngs_modulus=TRUE_MODULUS, poissons_ratio=0.2, density=75.0, viscosity=0.0)


def bend(x: np.ndarray) -> np.ndarray:
    """Return the velocity that the bar begins with [m/s], that of a first bend."""
    return np.outer(16.0 * ((x[:, 0] / HALF[0]) ** 2 - 1.0 / 3.0), [0.0, 0.0, 1.0])


def moved(modulus: float, h: float, options: mpm.MpmOptions) -> mpm.MpmSimulation:
    """Return the bar as particles, after it has moved."""
    made, box = replace(MATERIAL, youngs_modulus=modulus), [-HALF + 0.5 * h, HALF - 0.5 * h]
    body = mpm.particles_from_shape(lambda x: x[:, 0] < 6.0, box, spacing=h, material=made, volume=VOLUME)
    found = mpm.MpmSimulation(body, options, step_count=STEPS, keep_grids=True, device="cpu")
    C = np.multiply.outer(32.0 * body.positions[:, 0] / HALF[0] ** 2, np.outer([0.0, 0.0, 1.0], [1.0, 0.0, 0.0]))
    found.start(v=bend(body.positions)[None], C=C[None])
    found.forward()
    return found


def slope_of_particles(loss: mpm.MassLoss, options: mpm.MpmOptions, modulus: float) -> float:
    """Return dL/d(ln E) = mu dL/dmu + lambda dL/dlambda of the bar as particles."""
    s = moved(modulus, 0.25, options)
    loss.after(s, wp.zeros(1, dtype=wp.float64, device="cpu"))
    bars = loss.gradient(s)[1]
    return float((s.mu.numpy() * bars.mu.numpy() + s.lam.numpy() * bars.lam.numpy()).sum())


class ReducedBar:
    """The same bar as a reduced body."""

    def __init__(self) -> None:
        """Build it."""
        box = soft.quadrature_from_box(2.0 * HALF, point_count=3000, surface_count=200)
        body = soft.build_body(box, soft.BuildOptions(mode_count=4, kernel_count=60, cubature_count=96), progress=False)
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        soft.add_reduced_body(builder, body, material=MATERIAL)
        self.model: Any = builder.finalize(device="cpu")
        self.masses = mpm.particles_from_body(body, material=MATERIAL).masses
        tight = soft.SolverReducedOptions(integrator="bdf2", tolerance=1.0e-8)
        self.adjoint = soft.AdjointReduced(soft.SolverReduced(self.model, [body], options=tight), STEPS // 2)
        self.markers, self.velocity = soft.Markers(self.adjoint.solver, box.points), body.project(bend)

    def step_through(self, modulus: float) -> None:
        """Simulate the same time."""
        self.model.softmode.youngs_modulus.fill_(modulus)
        state, after = self.model.state(), self.model.state()
        state.softmode.qd.assign(self.velocity)
        self.adjoint.start(state)
        for _ in range(STEPS // 2):
            self.adjoint.step(state, after, None, 2.0 * DT)
            state, after = after, state

    def slope(self, loss: mpm.MassLoss, modulus: float) -> float:
        """Return dL/d(ln E)."""
        self.step_through(modulus)
        q = self.adjoint.q.numpy()
        loss_q, points = np.zeros_like(q), self.markers.positions(q[-1])
        loss_q[-1] = self.markers.spread(loss.value_and_gradient(points, self.masses)[1])
        return float(self.adjoint.backward(loss_q=loss_q).youngs_modulus.numpy()[0]) * modulus


def identify(slope_at: Callable[[float], float], start: float) -> list[float]:
    """Return the iterates [Pa]: secants of dL/d(ln E), begun with a small step downhill."""
    x, iterates, before, step = float(np.log(start)), [], None, 1.0
    while abs(step) > 1.0e-3 and len(iterates) < 14:
        iterates.append(float(np.exp(x)))
        step = -0.15 * float(np.sign(slope := slope_at(iterates[-1])))
        if before and (slope - before[1]) * (x - before[0]) > 0.0:
            step = float(np.clip(-slope * (x - before[0]) / (slope - before[1]), -0.5, 0.5))
        before, x = (x, slope), x + step
    return iterates


def test_final(iterates: list[float]) -> None:
    """E is found to 5 %."""
    assert abs(iterates[-1] / TRUE_MODULUS - 1.0) < 0.05, iterates


def main() -> None:
    """Observe, then identify."""
    wp.config.log_level = wp.LOG_WARNING
    options = mpm.MpmOptions(grid=GRID, dt=DT, precision="float64")
    true = moved(TRUE_MODULUS, 0.1875, options)
    observed = mpm.ParticleBody(positions=true.last.x.numpy()[0], masses=true.bodies[0].masses)
    loss = mpm.MassLoss(options.grid, observed, mass_scale=1.25, dtype=wp.float64, device="cpu")
    ways = {"particles": partial(slope_of_particles, loss, options), "reduced body": partial(ReducedBar().slope, loss)}
    for factor, (name, slope_at) in product((2.0,) if "--short" in sys.argv else (2.0, 0.5), ways.items()):
        iterates = identify(slope_at, factor * TRUE_MODULUS)
        print(f"{name}, E over the true E: {' '.join(f'{E / TRUE_MODULUS:.4f}' for E in iterates)}")
        test_final(iterates)


if __name__ == "__main__":
    main()
