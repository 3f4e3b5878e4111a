"""Rayleigh damping: modes of a free body decay as alpha (mass) and beta (stiffness) say, and beta spares rotations.

A mode of angular frequency omega obeys x'' + c x' + omega^2 x = 0 with c = alpha + beta omega^2, that is, the damping
ratio zeta = c / (2 omega) = alpha / (2 omega) + beta omega / 2. An affine cube has its modes in closed form.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from softmode.deformables.materials.material import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from tests import reference
from tests.deformables.affine_body import affine_cube, mean_gradient
from tests.scenes import Scene

MODES = {"breathing": np.eye(3), "shear": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])}
"""Mode shapes dF: a change of volume, which lambda resists, and a shear, which it does not."""
MATERIAL = Material(youngs_modulus=1.0e4, poissons_ratio=0.3, density=1000.0, viscosity=0.0)
EXACT = SolverReducedOptions(tolerance=1.0e-11, iteration_max=50)
AMPLITUDE = 1.0e-4
"""Strain of the vibration: beyond the linear theory come terms smaller by this."""


def squared_frequency(material: Material, shape: np.ndarray) -> float:
    """Return omega^2 of a mode dF = shape: V (2 mu |e|^2 + lambda tr(e)^2) over the modal mass."""
    body = affine_cube()
    mu, lam = reference.hooke_moduli(material.model, *reference.lame(material.youngs_modulus, material.poissons_ratio))
    q = body.affine(np.eye(3) + shape)
    stiffness = 2 * mu * (shape**2).sum() + lam * np.trace(shape) ** 2
    return stiffness / (material.density * (q**2).sum())


def vibrate(material: Material, shape: np.ndarray, dt: float, count: int = 60) -> np.ndarray:
    """Return the amplitude of a mode over time, let go at rest."""
    body = affine_cube()
    scene = Scene(lambda world: add_reduced_body(world, body, material=material), [body], dt=dt, options=EXACT)
    scene.set(q=body.affine(np.eye(3) + AMPLITUDE * shape))
    amplitude = []
    for _ in range(count):
        scene.step()
        F = mean_gradient(body, scene.q())
        amplitude.append(((F - np.eye(3)) * shape).sum() / (shape**2).sum())
    return np.array(amplitude)


def decay_rate(x: np.ndarray, dt: float) -> float:
    """Return the rate [1/s] at which the envelope decays: x_(n+1) = a x_n - b x_(n-1) has roots of modulus sqrt(b)."""
    solution, *_ = np.linalg.lstsq(np.column_stack([x[1:-1], -x[:-2]]), x[2:], rcond=None)
    return -np.log(solution[1]) / (2 * dt)


def test_frequencies():
    """The mode shapes of a cube of edge L: omega^2 = 12 (2 mu + 3 lambda) / (rho L^2) and 24 mu / (rho L^2)."""
    mu, lam = reference.lame(MATERIAL.youngs_modulus, MATERIAL.poissons_ratio)
    # The second moment of n^3 cell centres is that of the cube less 1 / n^2, here n = 9.
    expected = {"breathing": 12 * (2 * mu + 3 * lam) / MATERIAL.density, "shear": 24 * mu / MATERIAL.density}
    for name, shape in MODES.items():
        assert squared_frequency(MATERIAL, shape) == pytest.approx(expected[name], rel=1.05 / 81)


@pytest.mark.parametrize("model", list(MaterialModel))
@pytest.mark.parametrize(("alpha", "beta"), [(4.0, 0.0), (0.0, 0.01), (4.0, 0.01)], ids=["alpha", "beta", "both"])
@pytest.mark.parametrize("mode", MODES)
def test_decay_of_a_step(mode, alpha, beta, model):
    """Implicit Euler: (1 + c dt + omega^2 dt^2) x_(n+1) - (2 + c dt) x_n + x_(n-1) = 0, c = alpha + beta omega^2."""
    dt, shape = 0.005, MODES[mode]
    material = replace(MATERIAL, mass_damping=alpha, viscosity=beta, model=model)
    w2 = squared_frequency(material, shape)
    c = alpha + beta * w2
    expected = np.log(1 + c * dt + w2 * dt * dt) / (2 * dt)
    assert decay_rate(vibrate(material, shape, dt), dt) == pytest.approx(expected, rel=20 * AMPLITUDE)


@pytest.mark.parametrize(("alpha", "beta"), [(4.0, 0.0), (0.0, 0.01)], ids=["alpha", "beta"])
@pytest.mark.parametrize("mode", MODES)
def test_damping_ratio(mode, alpha, beta):
    """As dt -> 0 the rate is zeta omega = (alpha + beta omega^2) / 2: extrapolated from dt and dt / 2, to 1 %.

    The step's own damping, omega^2 dt / 2, is of first order, so that the extrapolation leaves terms of second order.
    """
    dt, shape = 0.002, MODES[mode]
    material = replace(MATERIAL, mass_damping=alpha, viscosity=beta)
    coarse, fine = (decay_rate(vibrate(material, shape, h), h) for h in (dt, dt / 2))
    omega = np.sqrt(squared_frequency(material, shape))
    zeta = (2 * fine - coarse) / omega
    assert zeta == pytest.approx(alpha / (2 * omega) + beta * omega / 2, rel=0.01)


def test_stiffness_damping_spares_rotations():
    """A stiff spinning body keeps its spin whatever beta: the Green strain does not see rotations."""
    body, omega, dt = affine_cube(), 2.0, 0.01
    ends = []
    for beta in (0.0, 0.1):
        material = replace(MATERIAL, youngs_modulus=1.0e7, viscosity=beta)

        def populate(world, material=material):
            add_reduced_body(world, body, material=material, angular_velocity=(0.0, 0.0, omega))

        scene = Scene(populate, [body], dt=dt, options=EXACT)
        scene.step(50)
        ends.append(scene.momentum()[1][2])
    # Spinning up from rest shape the body widens by rho omega^2 L^2 / E; while it does, beta acts.
    widening = MATERIAL.density * omega**2 / 1.0e7
    assert ends[1] == pytest.approx(ends[0], rel=2 * widening)
