"""Energies of soft bodies: closed forms, the dense reference, conservation, batching."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from softmode.deformables.tools.energies import SoftEnergies
from softmode.errors import ConfigError
from tests import reference
from tests.bodies import cube
from tests.scenes import GRAVITY, Scene, rotation

EDGE = 0.1
DOWN = (0.0, 0.0, -GRAVITY)
MATERIAL = Material(youngs_modulus=1.0e5, density=1000.0)


def _scene(material: Material = MATERIAL, scale: float = 1.0, **given) -> Scene:
    body = cube()

    def populate(world):
        add_reduced_body(world, body, material=material, scale=scale)

    return Scene(populate, [body], gravity=DOWN, **given)


def _energies(scene: Scene) -> tuple[float, float, float]:
    energies = SoftEnergies(scene.solver)
    energies.update(scene.state)
    kinetic, elastic, gravitational = (
        float(e.numpy()[0]) for e in (energies.kinetic, energies.elastic, energies.gravitational)
    )
    return kinetic, elastic, gravitational


@pytest.mark.parametrize("scale", [1.0, 1.5])
def test_rigid_motion(scale: float) -> None:
    """T = m v^2/2 + w.I w/2 with I of a cube, m edge^2/6; U_g = m g h; no elastic energy, turned or not."""
    scene, body = _scene(scale=scale), cube()
    R, height = rotation((1, 2, 3), 0.7), 2.5
    v, w = np.array([0.3, -0.2, 0.5]), np.array([2.0, -1.0, 0.7])
    scene.set(q=body.affine(scale * R, (0.0, 0.0, height)))
    spin = scale * np.cross(w, R.T).T  # d/dt (s R X) = w x s R X
    scene.set(qd=body.affine(np.eye(3) + spin, v))
    kinetic, elastic, gravitational = _energies(scene)
    mass = MATERIAL.density * (scale * EDGE) ** 3
    exact = 0.5 * mass * v @ v + 0.5 * (mass * (scale * EDGE) ** 2 / 6.0) * w @ w
    assert kinetic == pytest.approx(exact, rel=5e-3)  # the inertia is that of the body's quadrature
    assert gravitational == pytest.approx(mass * GRAVITY * height, rel=1e-6)
    assert abs(elastic) <= 1e-7 * MATERIAL.youngs_modulus * body.volume


@pytest.mark.parametrize("viscosity", [0.0, 0.05])
@pytest.mark.parametrize("scale", [1.0, 1.5])
def test_uniform_stretch(scale: float, viscosity: float) -> None:
    """U = s^3 V Psi(F) of a body of scale s stretched by F, whatever a step would dissipate."""
    material = replace(MATERIAL, viscosity=viscosity)
    scene, body = _scene(material, scale), cube()
    F = np.diag([1.2, 0.9, 1.05]) + 0.1 * np.eye(3)[[1, 2, 0]]
    scene.set(q=body.affine(scale * F, np.zeros(3)))
    volume = float(body.cubature.weights.sum()) * scale**3
    exact = (
        volume
        * reference.energy(material.model, F[None], *reference.lame(material.youngs_modulus, material.poissons_ratio))[
            0
        ]
    )
    assert _energies(scene)[1] == pytest.approx(exact, rel=1e-5)  # gradients are float32


def test_dense_reference() -> None:
    """Under any deformation the elastic energy is that of the dense reference."""
    scene, body = _scene(), cube()
    q = np.random.default_rng(0).normal(size=(body.function_count, 3))
    q *= 0.02 * EDGE / np.linalg.norm(q) * np.sqrt(3.0)
    scene.set(q=q)
    exact = reference.FreeBody(body=body, material=MATERIAL, dt=scene.dt).elastic_energy(q)
    assert _energies(scene)[1] == pytest.approx(exact, rel=1e-5)


def test_flight_conserves_the_sum() -> None:
    """A stretched cube swings while it flies: what the integrator takes of T + U + U_g falls at least like its step."""
    options = SolverReducedOptions(tolerance=1.0e-7, iteration_max=50, integrator="bdf2")
    loss, swing = [], 0.0
    for dt, every in ((2.0e-4, 5), (1.0e-4, 10)):
        scene, body = _scene(replace(MATERIAL, viscosity=0.0), options=options, dt=dt), cube()
        scene.set(q=body.affine(np.diag([1.05, 0.98, 0.98]), np.zeros(3)), qd=body.affine(np.eye(3), (0.0, 0.0, 1.0)))
        history = [_energies(scene)]
        for _ in range(20):
            scene.step(every)
            history.append(_energies(scene))
        energies = np.array(history)
        swing = np.ptp(energies[:, 1])
        assert swing > 0.5 * energies[0, 1]
        loss.append(np.abs(energies.sum(axis=1) - energies[0].sum()).max() / swing)
    assert loss[0] < 0.1
    assert loss[1] < 0.55 * loss[0]


def test_world_of_many_is_the_single_world() -> None:
    """World i of three has the bits of the single world, and update may be captured."""
    q = 0.003 * np.random.default_rng(1).normal(size=(cube().function_count, 3))
    single, many = _scene(), _scene(world_count=3)
    single.set(q=q, qd=10.0 * q)
    for i in range(3):
        many.set(q=q, qd=10.0 * q, instance=i)
    energies = SoftEnergies(many.solver)
    energies.update(many.state)
    with wp.ScopedCapture(device="cpu") as capture:
        energies.update(many.state)
    for array in (energies.kinetic, energies.elastic, energies.gravitational):
        array.zero_()
    wp.capture_launch(capture.graph)
    for array, expected in zip(
        (energies.kinetic, energies.elastic, energies.gravitational), _energies(single), strict=True
    ):
        assert (array.numpy() == expected).all()


def test_foreign_solver() -> None:
    """What is no solver of soft bodies is refused."""
    with pytest.raises(ConfigError, match="solver is a int"):
        SoftEnergies(3)
