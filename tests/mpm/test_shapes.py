"""Rigid shapes on the grid: balance of momentum, weight, what each boundary does, derivatives."""

from __future__ import annotations

from typing import get_args

import newton
import numpy as np
import pytest
import warp as wp

from softmode.errors import ConfigError
from softmode.mpm import (
    MORPH_MATERIAL,
    Grid,
    GridShapes,
    MassLoss,
    MpmOptions,
    MpmSimulation,
    ParticleBody,
    particles_from_shape,
)
from softmode.mpm.shapes import Boundary
from tests.mpm.scenes import ball
from tests.mpm.test_step import angular_momentum

FALLING = MpmOptions(grid=Grid(shape=(20, 16, 16), origin=(-8.5, -7.5, -4.5)), gravity=(0.0, 0.0, -9.81))
EXACT = MpmOptions(grid=FALLING.grid, gravity=FALLING.gravity, precision="float64")
GROUND = -0.25
"""Height of the plane [m], between two layers of nodes."""


def block(low: float = 0.75, at: float = 0.0) -> ParticleBody:
    """Return a block of 4 x 3 x 2 m whose lower particles lie at a height."""
    corner = np.array([at - 1.75, -1.25, low])
    return particles_from_shape(
        lambda x: np.ones(len(x), dtype=bool),
        [corner, corner + np.array([3.5, 2.5, 1.5])],
        spacing=0.5,
        material=MORPH_MATERIAL,
    )


def ground(mu: float = 0.5, boundary: Boundary = "separate") -> GridShapes:
    """Return a plane."""
    builder = newton.ModelBuilder()
    builder.add_ground_plane(height=GROUND, cfg=newton.ModelBuilder.ShapeConfig(mu=mu))
    return GridShapes(builder.finalize(device="cpu"), boundary=boundary)


def moving_box(*, mesh: bool = False, mu: float = 0.5, world_count: int = 1) -> tuple[newton.Model, newton.State]:
    """Return a box on a body that rises, slides and turns, beneath z = -1, and the plane of :func:`ground`."""
    builder = newton.ModelBuilder()
    config = newton.ModelBuilder.ShapeConfig(mu=mu)
    body = builder.add_body(xform=wp.transform(wp.vec3(1.0, 0.5, -1.2), wp.quat_identity()))
    builder.body_com[body] = wp.vec3(0.1, 0.2, -0.1)
    half = np.array([3.05, 2.65, 1.3])  # no node is as near to one face as to another
    if mesh:
        import trimesh

        made = trimesh.creation.box(extents=2.0 * half)
        builder.add_shape_mesh(body, mesh=newton.Mesh(made.vertices, made.faces.ravel()), cfg=config)
    else:
        builder.add_shape_box(body, hx=half[0], hy=half[1], hz=half[2], cfg=config)
    if world_count > 1:
        alone, builder = builder, newton.ModelBuilder()
        builder.replicate(alone, world_count)
    builder.add_ground_plane(height=GROUND, cfg=config)
    model = builder.finalize(device="cpu")
    state = model.state()
    state.body_qd.assign(np.tile([0.3, -0.2, 0.8, 0.1, -0.2, 0.3], (world_count, 1)))
    return model, state


def test_a_block_falls_on_a_plane_and_its_weight_comes_back() -> None:
    """After the fall, the mean wrench on the plane over a second is the weight m g at the block's centre, to 1 %."""
    options = MpmOptions(grid=FALLING.grid, gravity=FALLING.gravity, damping=4.0)
    shapes = ground()
    s = MpmSimulation(block(at=1.0), options, step_count=120, shapes=shapes, device="cpu")
    for _ in range(3):
        s.forward()
        s.check()
        s.first.copy_from(s.last)
    wrench = s.wrenches()[0, 0]
    weight = 9.81 * s.bodies[0].mass
    centre = s.mass.numpy()[0] @ s.last.x.numpy()[0] / s.bodies[0].mass
    assert np.linalg.norm(wrench[:3] - [0.0, 0.0, -weight]) < 0.01 * weight
    assert np.linalg.norm(wrench[3:] - np.cross(centre, wrench[:3])) < 0.01 * weight
    assert centre[0] == pytest.approx(s.bodies[0].centre[0], abs=0.02)
    assert GROUND < s.last.x.numpy()[0, :, 2].min() < GROUND + 1.0


@pytest.mark.parametrize("boundary", get_args(Boundary))
def test_momentum_goes_to_the_shapes(boundary: Boundary) -> None:
    """The momentum m v changes by m g dt less the impulses to 1e-12 of its scale; its moment likewise.

    Arms of impulses are float32, so that moments agree to its rounding.
    """
    model, state = moving_box()
    s = MpmSimulation(
        block(), EXACT, step_count=60, shapes=GridShapes(model, boundary=boundary, state=state), device="cpu"
    )
    s.start(v=np.tile([1.0, 0.5, -4.0], (1, s.count, 1)))
    s.forward()
    s.check()
    m, states, impulse = s.mass.numpy()[0], s.states(), s.impulse.numpy()[:, 0]
    momenta = np.array([m @ state.v.numpy()[0] for state in states])
    scale = np.abs(momenta).max()
    weight = m.sum() * np.array(EXACT.gravity) * EXACT.dt
    assert np.abs(np.diff(momenta, axis=0) - weight + impulse[:, :, :3].sum(axis=1)).max() < 1e-12 * scale
    assert (np.abs(impulse[:, :, :3]).max(axis=(0, 2)) > 0.0).all()  # the box and the plane were met
    # Moments: those on the box are about its centre of mass, which moves with its velocity.
    place, twist = state.body_q.numpy()[0], state.body_qd.numpy()[0]
    com = place[:3] + model.body_com.numpy()[0]  # no rotation at the start
    times = EXACT.dt * np.arange(60)[:, None]
    moment = impulse[:, :, 3:].sum(axis=1) + np.cross(com + times * twist[:3], impulse[:, 0, :3])
    pull = np.cross([m @ state.x.numpy()[0] for state in states[:-1]], np.array(EXACT.gravity) * EXACT.dt)
    spin = [angular_momentum(s, state) for state in states]
    assert np.abs(np.diff(spin, axis=0) - pull + moment).max() < np.finfo(np.float32).eps * np.abs(spin).max()


def slide(boundary: Boundary, mu: float, v: tuple[float, float, float], steps: int = 60) -> MpmSimulation:
    """Return a block after it was thrown from just above the plane."""
    options = MpmOptions(grid=FALLING.grid, gravity=FALLING.gravity)
    s = MpmSimulation(block(low=0.25, at=-3.0), options, step_count=steps, shapes=ground(mu, boundary), device="cpu")
    s.start(v=np.tile(v, (1, s.count, 1)))
    s.forward()
    s.check()
    return s


def mean_velocity(s: MpmSimulation, step: int = -1) -> np.ndarray:
    """Return the velocity of the centre of mass [m/s]."""
    return s.mass.numpy()[0] @ s.states()[step].v.numpy()[0] / s.bodies[0].mass


def test_a_block_that_slides_is_slowed_by_coulomb_friction() -> None:
    """What friction takes of the momentum is mu times what the plane bears; without friction the block slides on."""
    for mu in (0.0, 0.2):
        s = slide("separate", mu, (6.0, 0.0, -0.5))
        force = s.wrenches()[0, 0, :3]
        assert force[2] < -0.5 * 9.81 * s.bodies[0].mass
        assert force[0] == pytest.approx(-mu * force[2], rel=0.02, abs=1e-3 * abs(force[2]))
        assert mean_velocity(s)[0] == pytest.approx(6.0 - force[0] * 0.5 / s.bodies[0].mass, abs=1e-3)


def test_stick_slip_and_separate() -> None:
    """A block thrown along and away: stick holds its foot, slip lets it slide but not leave, separate lets it fly."""
    thrown = (2.0, 0.0, 3.0)
    foot = {}
    for boundary in get_args(Boundary):
        s = slide(boundary, 0.5, thrown, steps=24)
        low = s.bodies[0].positions[:, 2] < 0.3
        foot[boundary] = (s.last.x.numpy()[0] - s.first.x.numpy()[0])[low].mean(axis=0), s.wrenches()[0, 0, :3]
    time = 24 * FALLING.dt
    flight = 3.0 * time - 0.5 * 9.81 * time**2
    assert foot["separate"][0][2] == pytest.approx(flight, rel=0.1)
    assert foot["separate"][0][0] == pytest.approx(2.0 * time, rel=0.02)
    assert np.abs(foot["separate"][1]).max() < 1e-6
    assert foot["slip"][0][2] < 0.5 * flight
    assert foot["slip"][0][0] == pytest.approx(2.0 * time, rel=0.1)
    assert foot["slip"][1][2] > 0.0 and abs(foot["slip"][1][0]) < 1e-3 * foot["slip"][1][2]
    assert foot["stick"][0][2] < 0.5 * flight
    assert foot["stick"][0][0] < 0.5 * 2.0 * time


@pytest.mark.parametrize("boundary", get_args(Boundary))
def test_gradient_with_shapes(boundary: Boundary) -> None:
    """Along random directions central differences agree to 2e-5: two shapes at a node, one that moves and turns."""
    model, state = moving_box(mu=0.3)
    shapes = GridShapes(model, boundary=boundary, state=state)
    s = MpmSimulation(block(), EXACT, step_count=12, layer_count=2, shapes=shapes, device="cpu")
    rng = np.random.default_rng(1)
    s.start(
        v=[3.0, 1.0, -6.0] + 0.3 * rng.standard_normal((1, s.count, 3)),
        F=np.eye(3) + 0.02 * rng.standard_normal((1, s.count, 3, 3)),
    )
    loss = MassLoss(EXACT.grid, ball(2.0).moved((0.0, 0.0, 2.0)), dtype=wp.float64, device="cpu")
    value = wp.zeros(1, dtype=wp.float64, device="cpu")

    def evaluate() -> float:
        s.forward()
        loss.after(s, value)
        return float(value.numpy()[0])

    evaluate()
    assert np.abs(s.impulse.numpy()).sum(axis=(0, 1, 3)).min() > 0.0
    first, parameters = loss.gradient(s)
    bars = {name: getattr(first, name).numpy() for name in ("x", "v", "C", "F")}
    bars |= {name: getattr(parameters, name).numpy().copy() for name in ("control", "mass", "mu", "lam")}
    for name, bar in bars.items():
        array = getattr(s.first, name) if name in ("x", "v", "C", "F") else getattr(s, name)
        start, along = array.numpy().copy(), rng.standard_normal(array.numpy().shape)
        size = {"mass": 1e-5, "mu": 0.1, "lam": 0.1}.get(name, 1e-6)
        ends = []
        for sign in (1.0, -1.0):
            array.assign(start + sign * size * along)
            ends.append(evaluate())
        array.assign(start)
        assert (ends[0] - ends[1]) / (2.0 * size) == pytest.approx((bar * along).sum(), rel=2e-5, abs=1e-7), name


def test_wrenches_act_on_bodies_and_worlds_are_alone() -> None:
    """Each world's box gets the wrench that it gets alone, to the bit; ``body_f`` takes it, the plane has no body."""
    bodies = [block(), block(low=1.0)]
    model, state = moving_box(world_count=2)
    s = MpmSimulation(bodies, FALLING, step_count=30, shapes=GridShapes(model, state=state), device="cpu")
    s.start(v=np.tile([0.0, 0.0, -4.0], (2, s.count, 1)))
    s.forward()
    wrench = s.wrenches()
    assert not wrench[0, 1].any() and not wrench[1, 0].any() and wrench[1, 1].any()
    state.body_f.fill_(1.0)
    s.add_wrenches(state)
    assert np.allclose(state.body_f.numpy(), 1.0 + wrench[[0, 1], [0, 1]], rtol=1e-5)
    for world, body in enumerate(bodies):
        model, state = moving_box()
        alone = MpmSimulation(body, FALLING, step_count=30, shapes=GridShapes(model, state=state), device="cpu")
        alone.start(v=np.tile([0.0, 0.0, -4.0], (1, body.count, 1)))
        alone.forward()
        assert np.array_equal(alone.last.x.numpy()[0], s.last.x.numpy()[world])
        assert np.array_equal(alone.impulse.numpy()[:, 0, 0], s.impulse.numpy()[:, world, world])


def test_a_mesh_acts_as_the_box_that_it_is() -> None:
    """The mesh of a box gets the impulses of the box, to rounding of normals in float32."""
    found = []
    for mesh in (False, True):
        model, state = moving_box(mesh=mesh)
        s = MpmSimulation(block(), EXACT, step_count=30, shapes=GridShapes(model, state=state), device="cpu")
        s.start(v=np.tile([0.0, 0.0, -4.0], (1, s.count, 1)))
        s.forward()
        found.append(s.impulse.numpy())
    assert np.abs(found[1] - found[0]).max() < 1e-4 * np.abs(found[0]).max()


def test_bad_shapes() -> None:
    """What cannot act is named with what helps."""
    model, _ = moving_box()
    with pytest.raises(ConfigError, match=r"boundary.*glue"):
        GridShapes(model, boundary="glue")
    with pytest.raises(ConfigError, match="one word for each of 2"):
        GridShapes(model, boundary=["slip"])
    with pytest.raises(ConfigError, match="no shape collides"):
        GridShapes(newton.ModelBuilder().finalize(device="cpu"))
    with pytest.raises(ConfigError, match="begin inside of a shape"):
        MpmSimulation(block(low=-0.5), FALLING, shapes=ground(), device="cpu")
    with pytest.raises(ConfigError, match="of world 1"):
        MpmSimulation(block(), FALLING, shapes=GridShapes(moving_box(world_count=2)[0]), device="cpu")
    builder = newton.ModelBuilder()
    builder.add_shape_box(-1, hx=2.0, hy=2.0, hz=0.2, label="sheet")
    with pytest.raises(ConfigError, match=r"sheet.* 0.4 m thin.*margin"):
        MpmSimulation(block(), FALLING, shapes=GridShapes(builder.finalize(device="cpu")), device="cpu")
