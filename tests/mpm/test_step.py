"""A step of the material point method: identities, conservation, closed forms, bits."""

from __future__ import annotations

from dataclasses import replace

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.errors import AssetError, ConfigError, SolverDiverged
from softmode.mpm import (
    MORPH_MATERIAL,
    Grid,
    GridShapes,
    MpmOptions,
    MpmSimulation,
    ParticleBody,
    ParticleState,
    particles_from_body,
    particles_from_mesh,
    particles_from_shape,
)
from tests.mpm.scenes import ball, moving, torus
from tests.oracle.fem import Mesh, Solid, static

EXACT = MpmOptions(precision="float64")
DX = EXACT.grid.spacing


def angular_momentum(simulation: MpmSimulation, state: ParticleState) -> np.ndarray:
    """Return sum_p m (x cross v + D axial(C)), D = dx^2/3: what affine transfer conserves [kg m^2/s]."""
    x, v, C, m = state.x.numpy()[0], state.v.numpy()[0], state.C.numpy()[0], simulation.mass.numpy()[0]
    spin = np.stack([C[:, 2, 1] - C[:, 1, 2], C[:, 0, 2] - C[:, 2, 0], C[:, 1, 0] - C[:, 0, 1]], axis=1)
    return m @ (np.cross(x, v) + DX**2 / 3.0 * spin)


@pytest.mark.parametrize("model", list(MaterialModel), ids=lambda m: m.name)
def test_momentum_is_conserved(model: MaterialModel) -> None:
    """Without damping, ten steps change linear momentum by 1e-12 and angular momentum by 1e-10 of their scale."""
    body = ball(3.0, material=Material(youngs_modulus=1e5, poissons_ratio=0.2, density=75.0, model=model))
    s = moving(body, EXACT)
    before, spin = s.mass.numpy()[0] @ s.first.v.numpy()[0], angular_momentum(s, s.first)
    s.forward()
    s.check()
    m, v = s.mass.numpy()[0], s.first.v.numpy()[0]
    scale = m @ np.linalg.norm(v, axis=1)
    assert np.abs(m @ s.last.v.numpy()[0] - before).max() < 1e-12 * scale
    reach = m @ (np.linalg.norm(s.first.x.numpy()[0], axis=1) * np.linalg.norm(v, axis=1))
    assert np.abs(angular_momentum(s, s.last) - spin).max() < 1e-10 * reach


def test_grid_holds_the_mass_of_the_particles() -> None:
    """sum_i m_i = sum_p m_p, since the weights of a particle sum to one."""
    s = moving(ball(3.0), EXACT)
    s.forward()
    s.scatter_mass()
    assert s.grid_mass.numpy().sum() == pytest.approx(s.bodies[0].mass, rel=1e-12)


def test_free_fall() -> None:
    """Without stress symplectic Euler falls by g dt^2 T (T + 1) / 2, every particle alike."""
    options = MpmOptions(precision="float64", gravity=(0.0, 0.0, -9.81))
    s = MpmSimulation(ball(2.0), options, step_count=20, device="cpu")
    s.forward()
    moved = s.last.x.numpy()[0] - s.first.x.numpy()[0]
    assert np.allclose(moved, [0.0, 0.0, -9.81 * options.dt**2 * 20 * 21 / 2.0], rtol=1e-9, atol=1e-12)


def test_affine_velocity_passes_through() -> None:
    """Particles with v = B x and C = B have the same field after a transfer without stress; F grows by dt B F."""
    body = ball(3.0, material=Material(youngs_modulus=1e-6, poissons_ratio=0.0, density=75.0))
    s = MpmSimulation(body, EXACT, step_count=1, device="cpu")
    B = np.array([[0.1, 0.3, -0.2], [0.0, -0.2, 0.4], [0.5, 0.1, 0.1]])
    x = body.positions[None]
    s.start(v=x @ B.T, C=np.tile(B, (1, body.count, 1, 1)))
    s.forward()
    assert np.abs(s.last.v.numpy() - x @ B.T).max() < 1e-12
    assert np.abs(s.last.C.numpy() - B).max() < 1e-12
    assert np.abs(s.last.F.numpy() - (np.eye(3) + EXACT.dt * B)).max() < 1e-12


def test_damping_takes_its_part_of_the_velocity() -> None:
    """A body that flies without strain keeps (1 - zeta dt)^T of its velocity."""
    options = MpmOptions(precision="float64", damping=3.0)
    s = MpmSimulation(ball(2.0), options, step_count=12, device="cpu")
    s.start(v=np.tile([1.0, 0.0, 0.0], (1, s.count, 1)))
    s.forward()
    assert s.last.v.numpy()[0, :, 0] == pytest.approx((1.0 - 3.0 * options.dt) ** 12, rel=1e-10)


def ringing_bar(step_count: int, damping: float = 0.0) -> tuple[np.ndarray, float, float]:
    """Return the amplitude of a bar's first longitudinal wave, free ends, nu = 0, after every step; its period; dt."""
    length, width, modulus, density = 20.0, 3.0, 2.0e4, 75.0
    half = 0.5 * np.array([length, width, width])
    material = Material(youngs_modulus=modulus, poissons_ratio=0.0, density=density, model=MaterialModel.COROTATED)
    bar = particles_from_shape(
        lambda x: (np.abs(x) < half).all(axis=1), [-half + 0.25, half - 0.25], spacing=0.5, material=material
    )
    speed = np.sqrt(modulus / density)
    period = 2.0 * length / speed
    dt = period / 400.0
    options = MpmOptions(precision="float64", dt=dt, damping=damping)
    s = MpmSimulation(bar, options, step_count=step_count, device="cpu")
    mode = np.sin(np.pi * bar.positions[:, 0] / length)
    slope = 0.01 * np.cos(np.pi * bar.positions[:, 0] / length) * np.pi / length * speed
    s.start(
        v=0.01 * speed * mode[None, :, None] * [1.0, 0.0, 0.0],
        C=slope[None, :, None, None] * np.eye(3)[:1].T @ np.eye(3)[:1],
    )
    s.forward()
    s.check()
    return np.array([mode @ state.v.numpy()[0, :, 0] / (mode @ mode) for state in s.states()]), period, dt


def test_a_pressure_wave_has_its_speed() -> None:
    """A standing longitudinal wave between free ends of a bar rings with f = c / (2 L), c = sqrt(E / rho), nu = 0."""
    amplitude, period, dt = ringing_bar(300)
    crossing = next(k for k in range(300) if amplitude[k] > 0.0 >= amplitude[k + 1])
    quarter = crossing + amplitude[crossing] / (amplitude[crossing] - amplitude[crossing + 1])
    assert 4.0 * quarter * dt == pytest.approx(period, rel=0.02)


def test_damping_takes_its_part_of_the_energy() -> None:
    """Energy falls by exp(-zeta T) in a period T, more than without zeta; amplitudes by the root of it.

    The affine velocities are not damped: (k dx)^2 / 3 = 0.8 % of the inertia, k the wave number.
    """
    free, period, _ = ringing_bar(400)
    damped, _, _ = ringing_bar(400, damping=1.0 / period)
    assert damped[-1] / free[-1] == pytest.approx(np.exp(-0.5), rel=0.01)
    assert free[-1] / free[0] > 0.9


def sag(dx: float, gravity: float) -> float:
    """Return how far the end of a bar of 8 x 2 x 2 m sinks that sticks to a wall at x = 0, on a grid with cells dx."""
    modulus, density, length, width, h = 1.0e5, 75.0, 8.0, 2.0, 0.5 * dx
    material = Material(youngs_modulus=modulus, poissons_ratio=0.3, density=density)
    first = np.array([h, h - width, h - width]) / 2.0
    bounds = [first, [length, -first[1] + 0.1 * h, -first[1] + 0.1 * h]]
    bar = particles_from_shape(lambda x: np.ones(len(x), dtype=bool), bounds, spacing=h, material=material)
    assert bar.mass == pytest.approx(density * length * width**2)
    builder = newton.ModelBuilder()
    # The nodes at x = 0 stick too.
    builder.add_shape_box(-1, xform=wp.transform(wp.vec3(0.01 * dx - 5.0, 0.0, 0.0)), hx=5.0, hy=20.0, hz=20.0)
    shapes = GridShapes(builder.finalize(device="cpu"), boundary="stick")
    frequency = 3.516 * width / np.sqrt(12.0) / length**2 * np.sqrt(modulus / density)
    cells = (int(15 / dx), int(8 / dx), int(10 / dx))
    grid = Grid(shape=(cells[0] + 1, cells[1] + 1, cells[2] + 1), spacing=dx, origin=(-3.0, -4.0, -6.0))
    dt = 0.4 * dx / np.sqrt(modulus / density)
    options = MpmOptions(grid=grid, dt=dt, damping=2.0 * frequency, gravity=(0.0, 0.0, -gravity), precision="float64")
    s = MpmSimulation(bar, options, step_count=100, shapes=shapes, device="cpu")
    for _ in range(round(9.0 / frequency / dt / 100)):
        s.forward()
        s.check()
        s.first.copy_from(s.last)
    end = bar.positions[:, 0] > length - h
    return -float((s.first.x.numpy()[0] - bar.positions)[end, 2].mean())


def test_a_cantilever_comes_to_finite_elements() -> None:
    """The sag of a thick bar, nu 0.3, comes to that of quadratic finite elements with the order of the cell.

    Cells of 1 and 0.5 m are two and four across the bar. What sticks to nodes gives way beneath them by a part of a
    cell, so that the error is of first order: half the cell halves it, and extrapolation comes within 3 %.
    """
    count, edge = (16, 4, 4), 0.5
    lines = tuple(edge * np.arange(n + 1) for n in count)
    mesh = Mesh((lines[0], lines[1] - 1.0, lines[2] - 1.0), np.ones(count, dtype=bool))
    solid = Solid(mesh, energy="stable_neo_hookean_log", youngs_modulus=1.0e5, poissons_ratio=0.3, density=75.0)
    held = mesh.nodes[:, 0] == 0.0
    found = static(solid, held=held, target=mesh.nodes, force=solid.body_force((0.0, 0.0, -0.6)))
    reference = -float((found - mesh.nodes)[mesh.nodes[:, 0] == 8.0, 2].mean())
    coarse, fine = sag(1.0, 0.6), sag(0.5, 0.6)
    assert abs(fine - reference) < 0.6 * abs(coarse - reference) < 0.6 * 0.25 * reference
    assert 2.0 * fine - coarse == pytest.approx(reference, rel=0.03)


def test_rest_stays_rest() -> None:
    """A body at rest does not move at all."""
    s = MpmSimulation(ball(2.0), EXACT, device="cpu")
    s.forward()
    assert np.array_equal(s.last.x.numpy(), s.first.x.numpy())


def test_two_runs_in_a_row_are_one_long_run() -> None:
    """Ten steps and ten more end with the bits of twenty."""
    long = moving(ball(2.5), MpmOptions(), step_count=20, layer_count=2)
    short = moving(ball(2.5), MpmOptions(), step_count=10)
    for layer in range(2):
        wp.copy(short.control[0], long.control[layer])
        short.forward()
        short.first.copy_from(short.last)
    start = moving(ball(2.5), MpmOptions(), step_count=20, layer_count=2)
    wp.copy(start.control, long.control)
    start.forward()
    for name in ("x", "v", "C", "F"):
        assert np.array_equal(getattr(short.first, name).numpy(), getattr(start.last, name).numpy())


def test_world_of_many_is_the_single_world() -> None:
    """Worlds of different size side by side have the bits that each has alone."""
    bodies = [ball(2.0), torus(3.0, 1.2), ball(2.5)]
    together = MpmSimulation(bodies, MpmOptions(gravity=(0.0, 1.0, -2.0)), device="cpu")
    rng = np.random.default_rng(1)
    control = 0.05 * rng.standard_normal((1, 3, together.count, 3, 3)).astype(np.float32)
    together.control.assign(control)
    together.forward()
    together.check()
    for world, body in enumerate(bodies):
        alone = MpmSimulation(body, together.options, device="cpu")
        alone.control.assign(control[:, world : world + 1, : body.count])
        alone.forward()
        assert np.array_equal(alone.last.x.numpy()[0], together.last.x.numpy()[world, : body.count])
        assert np.array_equal(alone.last.F.numpy()[0], together.last.F.numpy()[world, : body.count])


def test_failures_name_step_and_particle() -> None:
    """A particle that leaves the grid, one turned inside out and one that is not finite each raise."""
    s = MpmSimulation(ball(2.0), MpmOptions(), device="cpu")
    s.start(v=np.tile([400.0, 0.0, 0.0], (1, s.count, 1)))
    s.forward()
    with pytest.raises(SolverDiverged, match=r"world 0, step \d+: particle \d+ left the grid"):
        s.check()
    s = MpmSimulation(ball(2.0), MpmOptions(control="additive"), device="cpu")
    control = np.zeros((1, 1, s.count, 3, 3), dtype=np.float32)
    control[0, 0, 7] = np.diag([-3.0, 0.0, 0.0])
    s.control.assign(control)
    s.forward()
    with pytest.raises(SolverDiverged, match=r"step 0: particle 7 was turned inside out"):
        s.check()
    s = MpmSimulation(ball(2.0), MpmOptions(), device="cpu")
    v = np.zeros((1, s.count, 3))
    v[0, 3] = np.nan
    s.start(v=v)
    s.forward()
    with pytest.raises(SolverDiverged, match="finite"):
        s.check()


def test_particles_of_a_mesh_and_of_a_body_have_its_mass() -> None:
    """Masses sum to density times volume; a lattice of the paper has density times h^3 each, a point its own volume."""
    import trimesh

    from softmode.deformables.reduction.sources import pack_sources, unpack_sources
    from tests.bodies import RECIPES, brick

    mesh = trimesh.creation.icosphere(subdivisions=3, radius=2.0)
    found = particles_from_mesh(mesh.vertices, mesh.faces, spacing=0.25, material=MORPH_MATERIAL)
    assert found.mass == pytest.approx(75.0 * mesh.volume, rel=1e-12)
    assert np.linalg.norm(found.centre) < 0.05
    printed = particles_from_mesh(mesh.vertices, mesh.faces, spacing=0.25, material=MORPH_MATERIAL, exact=False)
    assert printed.masses == pytest.approx(75.0 * 0.25**3)
    quadrature, body = RECIPES["brick"]().integrate(), brick()
    inside = particles_from_body(body, spacing=0.01, material=MORPH_MATERIAL)
    assert inside.mass == pytest.approx(75.0 * 0.2 * 0.12 * 0.06, rel=1e-12)
    assert inside.count == pytest.approx(1440, rel=0.2)
    at_points = particles_from_body(body, material=MORPH_MATERIAL)
    assert at_points.masses == pytest.approx(75.0 * quadrature.weights, rel=1e-15)
    assert at_points.mass == pytest.approx(75.0 * quadrature.volume, rel=1e-12)
    assert np.abs(at_points.centre).max() < 1e-12
    painted = replace(unpack_sources(body), density_scale=np.linspace(0.5, 1.5, len(quadrature.points)))
    with pytest.raises(ConfigError, match="varies"):
        particles_from_body(replace(body, sources=pack_sources(painted)))
    with pytest.raises(ConfigError, match="does not keep"):
        particles_from_body(replace(body, sources=None))


def test_bad_input() -> None:
    """Errors name what is wrong and what helps."""
    with pytest.raises(ConfigError, match=r"dt: sound crosses .* cells"):
        MpmSimulation(ball(2.0), MpmOptions(dt=0.1), device="cpu")
    with pytest.raises(ConfigError, match="outside of the grid"):
        MpmSimulation(ball(2.0).moved((14.0, 0.0, 0.0)), MpmOptions(), device="cpu")
    with pytest.raises(ConfigError, match="particles per cell"):
        MpmSimulation(ball(6.0, spacing=1.5), MpmOptions(), device="cpu")
    with pytest.raises(ConfigError, match="memory_limit"):
        MpmSimulation(ball(2.0), MpmOptions(memory_limit=1e4), step_count=100, device="cpu")
    with pytest.raises(ConfigError, match="one energy"):
        MpmSimulation([ball(2.0), ball(2.0, material=Material(density=75.0))], MpmOptions(), device="cpu")
    with pytest.raises(ConfigError, match="smoothing"):
        MpmOptions(smoothing=1.0)
    with pytest.raises(ConfigError, match="shape"):
        Grid(shape=(3, 8, 8))
    with pytest.raises(AssetError, match="no particle"):
        particles_from_shape(lambda x: np.zeros(len(x), dtype=bool), [[0, 0, 0], [1, 1, 1]], spacing=0.1)
    with pytest.raises(AssetError, match="encloses no volume"):
        particles_from_mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], spacing=0.1)
    with pytest.raises(AssetError, match="masses"):
        ParticleBody(positions=np.zeros((2, 3)), masses=np.array([1.0, -1.0]))
