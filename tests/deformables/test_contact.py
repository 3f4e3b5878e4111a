"""Contact with shapes that move as prescribed: weight, friction, detection."""

import dataclasses

import newton
import numpy as np
import pytest
import trimesh
import warp as wp

from softmode.deformables.materials.material import Material
from softmode.deformables.model import status as bits
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.model.struct_kernels import OVERLAP
from softmode.deformables.solver import step_tables
from softmode.deformables.solver.solver_reduced import SolverReduced, SolverReducedOptions
from softmode.errors import ConfigError
from tests import reference
from tests.bodies import changed, cube
from tests.deformables.probe_kernels import evaluate_potentials
from tests.deformables.test_coupling import impact, totals
from tests.scenes import GRAVITY, Scene, rotation

FLOAT32 = float(np.finfo(np.float32).eps)
EDGE = 0.1
DOWN = (0.0, 0.0, -GRAVITY)
ShapeConfig = newton.ModelBuilder.ShapeConfig


def box_mesh(half, offset=(0.0, 0.0, 0.0)):
    """Return a closed triangle mesh of a box, outward oriented."""
    box = trimesh.creation.box(extents=2.0 * np.asarray(half))
    return newton.Mesh(np.asarray(box.vertices) + offset, np.asarray(box.faces).ravel())


# -- detection of deep contact ----------------------------------------------------------------------------------------


def test_mesh_contact_is_not_lost_when_deep():
    """A face 5 cm inside a mesh is in contact however small the detection distance (1.7 mm here)."""
    mesh = box_mesh((0.1, 0.1, 0.1))
    scene = on_shape(lambda world: world.add_shape_mesh(-1, mesh=mesh), height=0.05)
    scene.reduced.begin(scene.state, scene.control, scene.dt)
    scene.reduced.detect(scene.state, scene.control, scene.dt, prescribed=True)
    bottom = cube().surface.points[:, 2] < -0.49 * EDGE
    assert scene.reduced.view.constraints.count.numpy()[0] >= bottom.sum()


# -- potentials --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "given", [(0.0, 0.0, 0.0, 0.0), (0.3, 1.0e-3, 0.5, 2.0e-3), (40.0, 4.0e-3, 0.01, -1.0e-3)], ids=str
)
def test_potentials(given):
    """psi_n is p^3/(6 eps), p^2/2 - eps p/2 + eps^2/6, a stiffer one from a depth on, that of edges; psi_t IPC's."""
    eps, step = 1.0e-3, 1.0e-9
    x = np.concatenate([np.linspace(-eps, 12 * eps, 501), [0.0, eps, 0.5 * eps]])

    def evaluate(values):
        with wp.ScopedDevice("cpu"):
            normal = wp.zeros(len(values), dtype=wp.vec3d)
            friction = wp.zeros(len(values), dtype=wp.vec3d)
            inputs = [wp.array(values, dtype=wp.float64), *map(wp.float64, (eps, *given))]
            wp.launch(evaluate_potentials, dim=len(values), inputs=inputs, outputs=[normal, friction])
        return normal.numpy(), friction.numpy()

    normal, friction = evaluate(x)
    np.testing.assert_allclose(normal[:, 0], reference.normal_potential(x, eps, *given), rtol=1e-12, atol=1e-15)
    plus, minus = evaluate(x + step), evaluate(x - step)
    # Curvature jumps in its own slope only (C2), so differences err by step times 1/eps.
    np.testing.assert_allclose((plus[0] - minus[0])[:, 0] / (2 * step), normal[:, 1], atol=1e-9)
    np.testing.assert_allclose((plus[0] - minus[0])[:, 1] / (2 * step), normal[:, 2], atol=5 * step / eps)
    slip = x > 2 * step
    np.testing.assert_allclose(friction[slip, 0], reference.friction_potential(x[slip], eps), atol=1e-15)
    slope = (plus[1] - minus[1])[slip, 0] / (2 * step)
    np.testing.assert_allclose(slope, (friction[:, 1] * x)[slip], atol=4 * step / eps)
    force = evaluate(x + step)[1][slip, 1] * (x + step)[slip] - evaluate(x - step)[1][slip, 1] * (x - step)[slip]
    np.testing.assert_allclose(
        force / (2 * step), friction[slip, 2], atol=8 * step / eps**2
    )  # f1' jumps in slope at eps
    assert friction[np.flatnonzero(x > eps)[0], 1] * x[x > eps][0] == pytest.approx(1.0)


# -- rest --------------------------------------------------------------------------------------------------------------


def on_shape(add_shape, *, height, material=None, x=0.0, **kw):
    """Return a scene with a cube just above a fixed shape."""
    body = cube()

    def populate(world):
        add_shape(world)
        add_reduced_body(world, body, material=material, position=(x, 0.0, height + 0.5 * EDGE))

    return Scene(populate, [body], **{"gravity": DOWN, **kw})


def settle(scene, steps):
    """Replay a captured pair of steps; return instance forces (steps / 2, 3) and the union of status bits."""
    replay = scene.capture()
    forces, status = [], 0
    for _ in range(steps // 2):
        replay()
        forces.append(scene.reduced.instance_force.numpy()[0].copy())
        status |= int(scene.reduced.status.numpy()[0])
    return np.array(forces), status


HEAD_DOWN = wp.transform(wp.vec3(), wp.quat(1.0, 0.0, 0.0, 0.0))
BUMPY = newton.Heightfield(0.1 - 0.05 * (np.arange(21) % 2)[:, None] * np.ones(21), 21, 21, hx=0.3, hy=0.3)
"""Ridges along X, 6 cm apart and 5 cm high."""
FLOORS = {
    "plane": (lambda w: w.add_ground_plane(), 0.0),
    "box": (lambda w: w.add_shape_box(-1, hx=0.3, hy=0.3, hz=0.1), 0.1),
    "cylinder": (lambda w: w.add_shape_cylinder(-1, radius=0.3, half_height=0.1), 0.1),
    "sphere": (lambda w: w.add_shape_sphere(-1, radius=2.0), 2.0),
    "capsule": (lambda w: w.add_shape_capsule(-1, radius=2.0, half_height=0.5), 2.5),
    "cone": (lambda w: w.add_shape_cone(-1, xform=HEAD_DOWN, radius=0.3, half_height=0.1), 0.1),
    "ellipsoid": (lambda w: w.add_shape_ellipsoid(-1, rx=1.5, ry=2.0, rz=1.0), 1.0),
    "heightfield": (lambda w: w.add_shape_heightfield(heightfield=BUMPY), 0.1),
    "mesh": (lambda w: w.add_shape_mesh(-1, mesh=box_mesh((0.3, 0.3, 0.1))), 0.1),
    "convex mesh": (lambda w: w.add_shape_convex_hull(-1, mesh=box_mesh((0.3, 0.3, 0.1))), 0.1),
}


@pytest.mark.parametrize("floor", FLOORS)
def test_cube_at_rest_carries_its_weight(floor):
    """Sum of contact forces = m g within 0.1 %, without trembling, no status bit but a converged line search."""
    add_shape, height = FLOORS[floor]
    scene = on_shape(add_shape, height=height, material=Material(mass_damping=2.0))
    forces, status = settle(scene, 500)
    weight = scene.mass() * GRAVITY
    np.testing.assert_allclose(forces[-25:].mean(axis=0), [0.0, 0.0, weight], atol=1e-3 * weight)
    assert forces[-25:].std(axis=0).max() <= 1e-3 * weight
    assert not status & (bits.WORLD_ITERATION_LIMIT | bits.WORLD_NOT_FINITE | bits.WORLD_CONTACT_OVERFLOW)


@pytest.mark.parametrize("offset", [0.0, 100.0])
def test_rest_far_from_the_origin(offset):
    """100 m from the origin, positions in float32 have 8 um; the cube still carries its weight to 0.1 %."""
    scene = on_shape(lambda w: w.add_ground_plane(), height=0.0, material=Material(mass_damping=2.0), x=offset)
    forces, _ = settle(scene, 400)
    np.testing.assert_allclose(forces[-25:, 2].mean(), scene.mass() * GRAVITY, rtol=1e-3)


def stiffness_per_area(scene, instance=0):
    """Return the contact stiffness per area [Pa/m] of the contacts of the last step, the largest."""
    entries, basis = scene.reduced.view.constraints, scene.reduced.view.basis
    count = int(entries.count.numpy()[instance])
    area = basis.row_area.numpy()[entries.partner_row.numpy()[instance, :count]]
    return float((entries.stiffness.numpy()[instance, :count] / area).max())


def test_stiffness_and_size_of_the_penalty():
    """At rest under a pressure P = m g / A a face sinks x with kappa (x - eps / 2) = P, or kappa x^2 / (2 eps).

    Of the onset 0.41 sqrt(E / E_c) lie outside. A face that touches as a whole has 2 % of its dents, in series with the
    penalty.
    """
    material = Material(youngs_modulus=1.0e7, mass_damping=5.0)
    scene = on_shape(lambda w: w.add_ground_plane(), height=0.0, material=material)
    settle(scene, 400)
    held, contacts = scene.reduced.view.constraints, slice(0, int(scene.reduced.view.constraints.count.numpy()[0]))
    ratio = (held.stiffness.numpy() * held.dent_compliance.numpy())[0, contacts].min()
    kappa = stiffness_per_area(scene) / (1.0 + ratio)
    eps = float(scene.reduced.view.instances.smoothing.numpy()[0])
    pressure = scene.mass() * GRAVITY / EDGE**2
    p = np.sqrt(2 * eps * pressure / kappa)
    p = p if p < eps else pressure / kappa + eps / 2
    bottom = scene.body().surface.normals[:, 2] < -0.9
    depth = -scene.state.particle_q.numpy()[bottom, 2].astype(float)
    # E = 10 MPa is stiff but not rigid, and the areas of the samples sum to the face's only on average.
    areas, dents = scene.body().surface.areas[bottom], scene.state.softmode.dent.numpy()[bottom, 2]
    nu = material.poissons_ratio
    outside = 0.406 * np.sqrt((1.0 + nu) * (1.0 - 2.0 * nu) / (1.0 - nu))
    assert np.average(depth + dents, weights=areas) + outside * eps == pytest.approx(p, rel=0.1)
    assert 0.0 < ratio < 0.02 * 30.0 and np.abs(dents).max() < 0.3 * p


@pytest.mark.parametrize("dt", [0.004, 0.0005], ids=["bulk", "inertia"])
def test_automatic_stiffness_follows_the_parameters(dt):
    """Largest of 150 M / L, 100 m / (A dt^2) and 1e8 per world, from what the model holds when a graph is replayed."""
    scene = on_shape(lambda w: w.add_ground_plane(), height=-1e-4, world_count=2, dt=dt)
    replay = scene.capture()
    body, first = cube(), Material()
    second = Material(youngs_modulus=3.0e7, poissons_ratio=0.45, density=200.0)
    for material in (first, second):
        for name in ("youngs_modulus", "poissons_ratio", "density"):
            scene.set_parameter(name, [getattr(first, name), getattr(material, name)])
        scene.solver.reset(scene.state)
        replay()
        for world, expected in enumerate((first, material)):
            assert stiffness_per_area(scene, world) == pytest.approx(
                reference.contact_stiffness(body, expected, dt), rel=1e-5
            )
    assert reference.contact_stiffness(body, first, dt) != reference.contact_stiffness(body, second, dt)
    scene.set_parameter("contact_stiffness", [2.0e6, 0.0])
    scene.solver.reset(scene.state)
    replay()
    assert stiffness_per_area(scene, 0) == pytest.approx(2.0e6, rel=1e-5)
    assert stiffness_per_area(scene, 1) == pytest.approx(reference.contact_stiffness(body, second, dt), rel=1e-5)


@pytest.mark.parametrize("count", [1, 2], ids=["ground", "pair"])
def test_automatic_stiffness_is_that_of_the_touching_part(count):
    """A cube whose half is ten times as stiff touches with kappa(E) there and kappa(10 E) here; in pairs in series."""
    jump = np.where(cube().cubature.points[:, 0] < 0.0, 1.0, 10.0)
    body = changed(cube(), stiffness_scale=jump, fingerprint="a cube of two halves")
    material, dt = Material(youngs_modulus=1.0e6), 0.02

    def populate(world):
        for k in range(count):
            add_reduced_body(world, body, material=material, position=(0.0, 0.0, (0.5 + k) * EDGE - 1e-4))

    scene = Scene(populate, [body], ground=0.5 if count == 1 else None, dt=dt)
    scene.step()
    entries, basis = scene.reduced.view.constraints, scene.reduced.view.basis
    touching = slice(0, int(entries.count.numpy()[0]))
    own = entries.row.numpy()[0, touching] < len(basis.row_point)  # of a pair, the body's samples and not the other's
    row = entries.row.numpy() if count == 2 else entries.partner_row.numpy()
    row = row[0, touching]
    ratio = entries.stiffness.numpy()[0, touching][own] / basis.row_area.numpy()[row[own]]
    x, clear = body.surface.points[row[own], 0], np.abs(body.surface.points[row[own], 0]) > 0.2 * EDGE
    assert (x[clear] < 0.0).any() and (x[clear] > 0.0).any()
    for side, factor in ((x < 0.0, 1.0), (x > 0.0, 10.0)):
        part = dataclasses.replace(material, youngs_modulus=factor * material.youngs_modulus)
        partner = material.density * body.volume if count == 2 else np.inf
        kappa = reference.contact_stiffness(body, part, dt, partner)
        assert kappa > 1.0e8
        np.testing.assert_allclose(ratio[clear & side], kappa if count == 1 else 0.25 * kappa, rtol=1e-5)


@pytest.mark.parametrize("ratio", [0.1, 10.0])
def test_automatic_stiffness_takes_the_effective_mass(ratio):
    """Against a free box of 0.1 and 10 times the mass: 1/m_eff = 1/m + 1/m_box, over the smaller of both surfaces."""
    dt = 0.0005
    scene, _ = impact(ratio, dt=dt)
    scene.step()
    body, material = scene.body(), Material()
    box = ratio * material.density * body.volume
    expected = reference.contact_stiffness(body, material, dt, box, 6.0 * EDGE**2)
    assert expected < 0.95 * reference.contact_stiffness(body, material, dt)
    assert stiffness_per_area(scene) == pytest.approx(expected, rel=1e-4)


def dent_bound(scene):
    """Return the deepest dent [m], beyond which contact hardens."""
    return float(scene.reduced.view.constraints.dent_depth.numpy()[0].max())


@pytest.mark.parametrize("youngs_modulus, density", [(1.0e4, 100.0), (1.0e5, 1000.0), (1.0e6, 8000.0)])
def test_fast_impact_stays_shallow(youngs_modulus, density):
    """Thrown at the ground with 5 m/s, 20 mm per step: no sample sinks deeper than 1 % of the edge besides the dent."""
    material = Material(youngs_modulus=youngs_modulus, density=density)
    scene = on_shape(lambda w: w.add_ground_plane(), height=0.001, material=material)
    qd = scene.body().affine(np.eye(3), (0.0, 0.0, -5.0))
    scene.set(qd=qd)
    depth = []
    for _ in range(20):
        scene.step()
        depth.append(-scene.state.particle_q.numpy()[:, 2].min())
    assert 0.0 < max(depth) <= 0.01 * EDGE + dent_bound(scene)
    assert not scene.reduced.status.numpy()[0] & (bits.WORLD_NOT_FINITE | bits.WORLD_COLLAPSED)


@pytest.mark.parametrize("ratio", [0.001, 1000.0])
def test_fast_impact_of_light_and_heavy_boxes(ratio):
    """A free box of 0.001 and 1000 times the mass hits a soft cube at 5 m/s: 1 % of the edge deep besides the dent.

    Depths are those at the starts of steps: the light box is turned back in the first, by the outer half of the onset.
    """
    scene, twin = impact(ratio, speed=5.0, dt=0.001)
    momentum, _, energy = totals(scene, twin)
    depth, pressed = [], False
    for _ in range(60):
        scene.step()
        pressed = pressed or bool(scene.reduced.instance_force.numpy().any())
        depth.append(-float(scene.reduced.view.samples.gap.numpy()[0, :, 0].min()))
        p, _, e = totals(scene, twin)
        assert np.abs(p - momentum).max() <= 1e-5 * np.abs(momentum).max()
        assert e <= (1.0 + 1e-6) * energy
    assert pressed and max(depth) <= 0.01 * EDGE + dent_bound(scene)


# -- friction ----------------------------------------------------------------------------------------------------------


def slide(angle, friction, *, tilted_box, time=1.0):
    """Return displacement [m] and acceleration in the second half [m/s^2] of a cube down a slope, and the scene."""
    material = Material(youngs_modulus=5.0e5, friction=friction)
    body, R = cube(), rotation((0, 1, 0), angle)
    config = ShapeConfig(mu=friction)
    down = np.array([np.sin(angle), 0.0, -np.cos(angle)])  # in the frame of the slope

    def populate(world):
        if not tilted_box:
            world.add_ground_plane(cfg=config)
            add_reduced_body(world, body, material=material, position=(0.0, 0.0, 0.5 * EDGE))
            return
        half = 3.0
        pose = wp.transform(wp.vec3(*(R @ [0.0, 0.0, -half])), wp.quat_from_axis_angle(wp.vec3(0, 1, 0), float(angle)))
        world.add_shape_box(-1, xform=pose, hx=half, hy=half, hz=half, cfg=config)
        add_reduced_body(world, body, material=material, position=R @ [0.0, 0.0, 0.5 * EDGE], rotation=R)

    scene = Scene(populate, [body], gravity=DOWN if tilted_box else GRAVITY * down)
    along = R @ [1.0, 0.0, 0.0] if tilted_box else np.array([1.0, 0.0, 0.0])
    replay = scene.capture()
    x = []
    for _ in range(round(time / scene.dt / 2)):
        replay()
        x.append(along @ scene.centre())
    half, pair = len(x) // 2, 2 * scene.dt
    v = np.diff(x) / pair
    return x[-1], (v[-1] - v[half]) / ((len(v) - 1 - half) * pair), scene


@pytest.mark.parametrize("tilted_box", [False, True], ids=["tilted gravity", "tilted box"])
def test_friction_holds_below_the_cone(tilted_box):
    """tan(angle) = 0.9 mu: the cube stays, but for shearing under its weight, rho g L^2 / mu = 6e-5 m."""
    moved, acceleration, _ = slide(np.arctan(0.45), 0.5, tilted_box=tilted_box)
    assert abs(moved) <= 1.0e-4
    assert abs(acceleration) <= 1e-3 * GRAVITY


@pytest.mark.parametrize("tilted_box", [False, True], ids=["tilted gravity", "tilted box"])
def test_friction_slips_above_the_cone(tilted_box):
    """tan(angle) = 1.5 mu: a = g (sin - mu cos) within 1 %."""
    angle = np.arctan(0.75)
    _, acceleration, _ = slide(angle, 0.5, tilted_box=tilted_box)
    assert acceleration == pytest.approx(GRAVITY * (np.sin(angle) - 0.5 * np.cos(angle)), rel=1e-2)


def test_belt_drags_with_friction():
    """On a belt of speed u the cube gains mu g t until it moves with the belt: v = min(mu g t, u)."""
    body, speed, mu = cube(), 0.5, 0.4

    def populate(world):
        link = world.add_body(is_kinematic=True)
        world.add_shape_box(link, hx=5.0, hy=1.0, hz=0.1, cfg=ShapeConfig(density=0.0, mu=mu))
        material = Material(youngs_modulus=5.0e5, friction=mu)
        add_reduced_body(world, body, material=material, position=(0.0, 0.0, 0.1 + 0.5 * EDGE))

    scene = Scene(populate, [body], gravity=DOWN, dt=0.002)
    twist = np.zeros((1, 6), np.float32)
    twist[0, 0] = speed
    for state in (scene.state, scene.next_state):
        state.body_qd.assign(twist)
    half = round(0.5 * speed / (mu * GRAVITY) / scene.dt)
    scene.step(half)
    assert scene.qd()[0, 0] == pytest.approx(mu * GRAVITY * half * scene.dt, rel=0.03)  # the contact first has to load
    scene.step(3 * half)
    assert scene.qd()[0, 0] == pytest.approx(speed, abs=10 * scene.reduced.options.stick_velocity)


# -- detection ---------------------------------------------------------------------------------------------------------


def contacts_after_one_step(populate_shape, position):
    """Return how many contacts a cube at a position finds."""
    body = cube()

    def populate(world):
        populate_shape(world)
        add_reduced_body(world, body, position=position)

    scene = Scene(populate, [body], dt=0.001)
    scene.step()
    return int(scene.reduced.view.constraints.count.numpy()[0])


def test_mesh_away_from_its_own_origin_is_found():
    """A mesh whose vertices lie 1 m from the shape's origin is touched where it is."""
    add = lambda w: w.add_shape_mesh(-1, mesh=box_mesh((0.1, 0.1, 0.1), offset=(1.0, 0.0, 0.0)))  # noqa: E731
    assert contacts_after_one_step(add, (1.0, 0.0, 0.1 + 0.499 * EDGE)) > 0


def test_shape_margin_is_part_of_the_shape():
    """A sphere with a margin of 5 cm is touched at radius + margin, here 5 mm deep."""
    add = lambda w: w.add_shape_sphere(-1, radius=0.05, cfg=ShapeConfig(margin=0.05))  # noqa: E731
    assert contacts_after_one_step(add, (0.0, 0.0, 0.095 + 0.5 * EDGE)) > 0


def test_spinning_shape_is_found_in_time():
    """A box far out on a fast spinning arm that will hit within the step's reach passes the coarse test too."""
    body, omega, dt = cube(), 100.0, 0.001

    def populate(world):
        link = world.add_body(is_kinematic=True)
        pose = wp.transform(wp.vec3(1.0, 0.0, 0.0), wp.quat_identity())
        world.add_shape_box(link, xform=pose, hx=0.05, hy=0.05, hz=0.05, cfg=ShapeConfig(density=0.0))
        # the box's face moves at 100 m/s towards y: 0.1 m per step, and is 0.09 m away
        add_reduced_body(world, body, position=(1.0, 0.05 + 0.09 + 0.5 * EDGE, 0.0))

    scene = Scene(populate, [body], dt=dt)
    twist = np.zeros((1, 6), np.float32)
    twist[0, 5] = omega
    scene.state.body_qd.assign(twist)
    scene.step()
    assert scene.reduced.view.constraints.count.numpy()[0] > 0


def test_bounded_plane_ends_where_it_ends():
    """A plane of width 1 holds within 0.5 of its centre and nowhere else."""
    add = lambda w: w.add_shape_plane(width=1.0, length=1.0)  # noqa: E731
    assert contacts_after_one_step(add, (0.4, 0.0, 0.499 * EDGE)) > 0
    assert contacts_after_one_step(add, (0.6, 0.0, 0.499 * EDGE)) == 0


def test_shapes_of_other_worlds_are_not_touched():
    """Each world meets its own shapes and the global ones."""
    body = cube()
    builder = newton.ModelBuilder()
    for height in (0.1, -1.0):  # under the first cube, far from the second
        world = newton.ModelBuilder()
        world.add_shape_box(-1, xform=wp.transform(wp.vec3(0, 0, height - 0.1), wp.quat_identity()), hx=1, hy=1, hz=0.1)
        add_reduced_body(world, body, position=(0.0, 0.0, 0.1 + 0.499 * EDGE))
        builder.add_world(world)
    model = builder.finalize(device="cpu")
    solver = SolverReduced(model, [body])
    first, second = model.state(), model.state()
    solver.step(first, second, None, None, 0.001)
    counts = solver.view.constraints.count.numpy()
    assert counts[0] > 0 and counts[1] == 0


def test_too_small_a_contact_max_is_refused(monkeypatch):
    """Less room than the samples need is an error with the number; without, a bit, and the touching ones come first."""
    options = SolverReducedOptions(contact_max=8)
    with pytest.raises(ConfigError, match=r"contact_max is 8, and 150 samples .*contact_max=150 or more"):
        on_shape(lambda w: w.add_ground_plane(), height=-0.001, options=options)
    monkeypatch.setattr(step_tables, "sample_room", lambda *_: 0)
    scene = on_shape(lambda w: w.add_ground_plane(), height=-0.001, options=options)
    scene.step()
    assert scene.reduced.status.numpy()[0] & bits.WORLD_CONTACT_OVERFLOW
    assert scene.reduced.view.constraints.count.numpy()[0] == 8
    assert scene.reduced.instance_force.numpy()[0, 2] > 0.0


def test_worlds_in_contact_are_independent():
    """World i of 3 on the ground, each dropped differently, equals the single world bit for bit."""
    batch = on_shape(lambda w: w.add_ground_plane(), height=0.001, world_count=3)
    alone = on_shape(lambda w: w.add_ground_plane(), height=0.001)
    states = []
    for i in range(3):
        qd = batch.qd(i)
        qd[0] = [0.3 * i, 0.1, -0.5 * i]
        batch.set(qd=qd, instance=i)
        states.append((batch.q(i), qd))
    batch.step(20)
    for i, (q, qd) in enumerate(states):
        alone.restart()
        alone.set(q=q, qd=qd)
        alone.step(20)
        np.testing.assert_array_equal(batch.q(i), alone.q())
        np.testing.assert_array_equal(batch.reduced.instance_force.numpy()[i], alone.reduced.instance_force.numpy()[0])


def test_overlap_at_the_start_is_pushed_out_slowly():
    """A cube placed half in the ground leaves by at most OVERLAP of its size in a step, plus a tenth as it unbends."""
    scene = on_shape(lambda w: w.add_ground_plane(), height=-0.5 * EDGE)
    size = float(scene.reduced.view.instances.size.numpy()[0])
    fastest = 0.0
    for _ in range(60):
        scene.step()
        fastest = max(fastest, float(np.abs(scene.momentum()[0][2]) / scene.mass()))
    assert 0.0 < fastest <= 1.1 * OVERLAP * size / scene.dt
    assert scene.state.particle_q.numpy()[:, 2].min() > -0.01 * size


def test_over_a_joint() -> None:
    """Over the joint of two boxes side by side a cube slides on: without friction it keeps its momentum within 3 %.

    Its dents lie below the top of the second box, whose flank turned it back while cells reached beyond its own edges.
    """
    body = cube()

    def populate(world: newton.ModelBuilder) -> None:
        material = Material(youngs_modulus=1.0e5, density=300.0, friction=0.0)
        add_reduced_body(world, body, material=material, position=(-0.06, 0.013, 0.0502), velocity=(0.2, 0.0, 0.0))
        for x in (-0.2, 0.2):
            world.add_shape_box(
                -1, xform=wp.transform(wp.vec3(x, 0.0, -0.05), wp.quat_identity()), hx=0.2, hy=0.2, hz=0.05
            )

    scene = Scene(populate, [body], gravity=(0.0, 0.0, -GRAVITY), dt=1.0 / 240.0)
    scene.step(40)
    assert scene.centre()[0] + 0.05 > 0.01
    assert scene.momentum()[0][0] == pytest.approx(0.2 * scene.mass(), rel=0.03)
