"""Fast impacts end on the side where they began; near misses cost nothing; every shape is found by the broad phase."""

import newton
import numpy as np
import pytest
import trimesh
import warp as wp

from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.model.inner_offsets import inner_offsets
from softmode.deformables.solver.solver_reduced import SolverReduced
from tests import reference
from tests.bodies import cube
from tests.scenes import GRAVITY, Scene, add_free_box, rotation_of

EDGE = 0.1
THIN = 0.001
"""Half the thickness of the plates [m]."""
SOFT = 1.0e5
"""Young's modulus of what hits [Pa]: the softer, the farther a body sinks in; here by several plates' thickness."""
ShapeConfig = newton.ModelBuilder.ShapeConfig


def mesh_of(mesh):
    """Return a trimesh as Newton's mesh."""
    return newton.Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces).ravel())


PLATE = mesh_of(trimesh.creation.box((0.6, 0.6, 2.0 * THIN)))
OBSTACLES = {
    "plate": (lambda w, body: w.add_shape_box(body, hx=0.3, hy=0.3, hz=THIN, cfg=ShapeConfig(density=0.0)), THIN),
    "thin mesh": (lambda w, body: w.add_shape_mesh(body, mesh=PLATE, cfg=ShapeConfig(density=0.0)), THIN),
    "sphere": (lambda w, body: w.add_shape_sphere(body, radius=0.05, cfg=ShapeConfig(density=0.0)), 0.05),
}


def samples(scene):
    """Return the surface samples (N, 3) [m]."""
    return scene.state.particle_q.numpy().astype(float)


def depth_of(name, x):
    """Return the distances of points to an obstacle at the origin."""
    if name == "sphere":
        return reference.distance_sphere(x, 0.05)
    return reference.distance_box(x, np.array([0.3, 0.3, THIN]))


def assert_rebound(name, x, centre):
    """All samples have left the obstacle on the side of positive z, to a thousandth of the body."""
    assert centre[2] > 0.0
    assert depth_of(name, x).min() > -1e-3 * EDGE
    if name != "sphere":
        assert x[:, 2].min() > 0.0


SPEEDS = [
    pytest.param(speed, dt, marks=[] if speed == 20.0 else pytest.mark.slow)
    for speed in (5.0, 10.0, 20.0)
    for dt in (0.001, 0.004, 0.01)
]


@pytest.mark.parametrize("name", OBSTACLES)
@pytest.mark.parametrize(("speed", "dt"), SPEEDS)
def test_fast_body_does_not_pass(name, speed, dt):
    """A soft cube of 10 cm that hits a plate of 2 mm, a mesh of it or a sphere turns back.

    The sphere it hits by the top: farther beside it glances off.
    """
    body = cube()
    add, top = OBSTACLES[name]
    beside = (0.005, 0.003) if name == "sphere" else (0.013, 0.007)

    def populate(world):
        add(world, -1)
        position = (*beside, top + 0.011 + 0.5 * EDGE)
        velocity = (0.0, 0.0, -speed)
        add_reduced_body(world, body, material=Material(youngs_modulus=SOFT), position=position, velocity=velocity)

    scene = Scene(populate, [body], dt=dt)
    for _ in range(max(round(0.06 / dt), 16)):
        scene.step()
        assert scene.centre()[2] > 0.0
    assert_rebound(name, samples(scene), scene.centre())
    assert scene.momentum()[0][2] > 0.0


@pytest.mark.parametrize("name", OBSTACLES)
@pytest.mark.parametrize(("speed", "dt"), SPEEDS)
def test_fast_shape_does_not_pass(name, speed, dt):
    """A shape that is driven into a soft cube at rest drives it before itself."""
    body = cube()
    add, top = OBSTACLES[name]

    def populate(world):
        add(world, world.add_body(is_kinematic=True))
        position = (0.0, 0.0, top + 0.011 + 0.5 * EDGE)
        add_reduced_body(world, body, material=Material(youngs_modulus=SOFT), position=position)

    scene = Scene(populate, [body], dt=dt)
    pose = scene.state.body_q.numpy().copy()
    for _ in range(max(round(0.04 / dt), 12)):
        for state in (scene.state, scene.next_state):
            state.body_qd.assign(np.array([[0, 0, speed, 0, 0, 0]], np.float32))
        scene.state.body_q.assign(pose)
        scene.step()
        pose[0, 2] += speed * dt
        assert scene.centre()[2] > pose[0, 2]
    assert_rebound(name, samples(scene) - pose[0, :3], scene.centre() - pose[0, :3])


@pytest.mark.parametrize("friction", [0.0, 0.5])
@pytest.mark.parametrize(
    ("mass", "speed", "dt"), [(0.05, 5.0, 0.004), (0.05, 20.0, 0.004), (2.0, 20.0, 0.001), (2.0, 20.0, 0.004)]
)
def test_fast_free_box_does_not_pass(mass, speed, dt, friction):
    """A free plate of 4 mm that hits a soft cube beside its centre turns it and itself back.

    In every step momentum stays to 1e-5 and energy does not grow, whatever friction does.
    """
    body, half = cube(), np.array([0.08, 0.08, 0.002])
    material = Material(youngs_modulus=SOFT, friction=friction)

    def populate(world):
        position = (0.013, 0.007, -(half[2] + 0.011 + 0.5 * EDGE))
        add_free_box(world, half, mass, position, velocity=(0.0, 0.0, speed), friction=friction)
        add_reduced_body(world, body, material=material)

    scene = Scene(populate, [body], dt=dt, coupled=True)
    twin = reference.FreeBody(body=body, material=reference.with_float32(material), dt=dt)
    before = scene.momentum()[0] + scene.rigid_momentum()[0]
    last = first = scene.rigid_momentum()[2]
    for _ in range(round(0.04 / dt)):
        scene.step()
        energy = scene.kinetic_energy() + scene.rigid_momentum()[2] + twin.elastic_energy(scene.q())
        assert energy <= last + 1e-6 * first
        change = scene.momentum()[0] + scene.rigid_momentum()[0] - before
        assert np.linalg.norm(change) <= 1e-5 * np.linalg.norm(before)
        last = energy
    assert scene.reduced.status.numpy()[0] == 0
    pose = scene.state.body_q.numpy()[0].astype(float)
    x = (samples(scene) - pose[:3]) @ rotation_of(pose[3:])
    assert x[:, 2].min() > 0.0
    assert reference.distance_box(x, half).min() > -1e-3 * EDGE


def test_plate_inside_a_body_is_left_on_the_nearer_side():
    """A cube whose lowest 5 mm are through a plate of 2 mm ends on top of it, with no sample left below."""
    body = cube()

    def populate(world):
        OBSTACLES["plate"][0](world, -1)
        material = Material(youngs_modulus=SOFT, mass_damping=5.0)
        add_reduced_body(world, body, material=material, position=(0.0, 0.0, -0.005 - THIN + 0.5 * EDGE))

    scene = Scene(populate, [body], gravity=(0.0, 0.0, -GRAVITY))
    below = samples(scene)[:, 2] < -THIN
    assert below.sum() > 10
    scene.step(100)
    assert samples(scene)[:, 2].min() > 0.0


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_body_bent_around_an_end(friction):
    """Samples that lie beyond a plate are through it only if they touched it, or if no step led here.

    What a step is told: nothing, that they touched nothing in the step before, and that they touched the plate.
    """
    body = cube()

    def populate(world):
        OBSTACLES["plate"][0](world, -1)
        material = Material(youngs_modulus=SOFT, friction=friction)
        add_reduced_body(world, body, material=material, position=(0.0, 0.0, -0.005 - THIN + 0.5 * EDGE))

    for known, touched in ((False, False), (True, False), (True, True)):
        scene = Scene(populate, [body])
        beyond = samples(scene)[:, 2] < -THIN
        memory = scene.state.softmode
        if known:
            memory.dt_before.fill_(-scene.dt)
        if touched:
            memory.stick_shape.fill_(wp.vec2i(0, -1))
        scene.step()
        constraints = scene.reduced.view.constraints
        count = int(constraints.count.numpy()[0])
        force = constraints.force.numpy()[0, :count, 2]
        found = beyond[constraints.partner_row.numpy()[0, :count]]
        assert beyond.sum() > 10 and (force[found] > 0.0).any() == (touched or not known)
        remembered = scene.state.softmode.stick_shape.numpy()[beyond, 0] == 0
        assert remembered.any() == (touched or not known)


BESIDE = wp.transform(wp.vec3(0.5 * EDGE + 0.024, 0.0, -0.1), wp.quat_identity())
"""Of shapes of radius 2 cm: 4 mm beside the way of the cube, and 2.4 times its detection margin away."""
BYSTANDERS = {
    "sphere": lambda w: w.add_shape_sphere(-1, xform=BESIDE, radius=0.02),
    "box": lambda w: w.add_shape_box(-1, xform=BESIDE, hx=0.02, hy=0.02, hz=0.02),
    "cone": lambda w: w.add_shape_cone(-1, xform=BESIDE, radius=0.02, half_height=0.02),
    "ellipsoid": lambda w: w.add_shape_ellipsoid(-1, xform=BESIDE, rx=0.02, ry=0.01, rz=0.02),
    "mesh": lambda w: w.add_shape_mesh(-1, xform=BESIDE, mesh=mesh_of(trimesh.creation.icosphere(2, 0.02))),
}


@pytest.mark.parametrize("name", BYSTANDERS)
@pytest.mark.parametrize(("speed", "dt"), [(5.0, 0.004), (20.0, 0.001), (20.0, 0.01)])
def test_near_miss_leaves_no_trace(name, speed, dt):
    """A cube that flies past a small shape without touching it keeps its momentum to rounding."""
    body = cube()

    def populate(world):
        BYSTANDERS[name](world)
        add_reduced_body(world, body, position=(0.0, 0.0, 0.06), velocity=(0.0, 0.0, -speed))

    scene = Scene(populate, [body], dt=dt)
    before = scene.momentum()[0]
    scene.step(max(round(0.25 / speed / dt), 3))
    assert scene.centre()[2] < -0.1 - EDGE / 2.0  # past it
    assert np.linalg.norm(scene.momentum()[0] - before) <= 1e-9 * np.linalg.norm(before)


# -- broad phase -------------------------------------------------------------------------------------------------------

HILLS = newton.Heightfield(np.random.default_rng(0).uniform(0.0, 0.1, (9, 9)), 9, 9, hx=0.4, hy=0.4)
FAR_MESH = mesh_of(
    trimesh.creation.box((0.2, 0.2, 0.2), transform=trimesh.transformations.translation_matrix([1, 0, 0]))
)
TOUCHED = {
    "sphere": (lambda w: w.add_shape_sphere(-1, radius=0.1), (0.0, 0.0, 0.1)),
    "capsule": (lambda w: w.add_shape_capsule(-1, radius=0.1, half_height=0.5), (0.0, 0.0, 0.6)),
    "cylinder": (lambda w: w.add_shape_cylinder(-1, radius=0.1, half_height=0.5), (0.1, 0.0, 0.45)),
    "cone": (lambda w: w.add_shape_cone(-1, radius=0.3, half_height=0.5), (0.3, 0.0, -0.5)),
    "tip of a cone": (lambda w: w.add_shape_cone(-1, radius=0.3, half_height=0.5), (0.0, 0.0, 0.5)),
    "ellipsoid": (lambda w: w.add_shape_ellipsoid(-1, rx=0.1, ry=0.2, rz=0.5), (0.0, 0.0, 0.5)),
    "box": (lambda w: w.add_shape_box(-1, hx=0.1, hy=0.2, hz=0.5), (0.1, 0.2, 0.5)),
    "mesh": (lambda w: w.add_shape_mesh(-1, mesh=FAR_MESH), (1.1, 0.1, 0.1)),
    "convex mesh": (lambda w: w.add_shape_convex_hull(-1, mesh=FAR_MESH), (1.1, 0.1, 0.1)),
    "heightfield": (lambda w: w.add_shape_heightfield(heightfield=HILLS), (0.35, 0.35, 0.05)),
    "below a heightfield": (lambda w: w.add_shape_heightfield(heightfield=HILLS), (0.1, 0.1, -3.0)),
    "bounded plane": (lambda w: w.add_shape_plane(width=1.0, length=1.0), (0.45, 0.45, 0.0)),
    "below a bounded plane": (lambda w: w.add_shape_plane(width=1.0, length=1.0), (0.1, 0.1, -3.0)),
}


@pytest.mark.parametrize("name", TOUCHED)
def test_shape_is_found_in_its_own_world_only(name):
    """A cube around a point of a shape, at its far end or deep below it, has contacts; in another world it has none."""
    body = cube()
    add, place = TOUCHED[name]
    builder = newton.ModelBuilder()
    for has_shape in (False, True, False):
        world = newton.ModelBuilder()
        if has_shape:
            add(world)
        add_reduced_body(world, body, position=place)
        builder.add_world(world)
    model = builder.finalize(device="cpu")
    solver = SolverReduced(model, [body])
    first, second = model.state(), model.state()
    solver.step(first, second, None, None, 0.001)
    counts = solver.view.constraints.count.numpy()
    assert counts[1] > 0 and counts[0] == counts[2] == 0


@pytest.mark.parametrize("name", ["sphere", "cone", "ellipsoid", "mesh"])
def test_far_shape_is_culled(name):
    """A shape with bounds that is far from a body does not reach the exact test."""
    body = cube()
    add, place = TOUCHED[name]

    def populate(world):
        add(world)
        add_reduced_body(world, body, position=(place[0], place[1] + 2.0, place[2]))

    scene = Scene(populate, [body])
    scene.step()
    assert not scene.reduced.tables.near.numpy().any()


# -- the body's inside -------------------------------------------------------------------------------------------------


def test_inner_offsets_end_inside():
    """The ways inward end in the cube, a tenth of its diagonal deep, and at edges go in between their faces."""
    body = cube()
    offsets = inner_offsets(body.surface.points, body.surface.normals, EDGE * np.sqrt(3.0))
    length = np.linalg.norm(offsets, axis=1)
    assert (length > 0.0).all() and np.median(length) == pytest.approx(0.1 * EDGE * np.sqrt(3.0))
    inside = reference.distance_box(body.surface.points + offsets, np.full(3, 0.5 * EDGE))
    assert (inside < 0.0).all() and (inside < -0.3 * length).mean() > 0.95
    assert ((offsets * body.surface.normals).sum(axis=1) < -0.5 * length).all()


def test_inner_offsets_of_a_sheet_stay_inside():
    """In a sheet 1/40 thick, sampled as finely, they go at most to the middle."""
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-0.5, 0.5, 41)]), axis=-1).reshape(-1, 2)
    half = 0.0125
    points = np.concatenate([np.column_stack([grid, np.full(len(grid), side * half)]) for side in (-1.0, 1.0)])
    normals = np.sign(points * [0.0, 0.0, 1.0])
    offsets = inner_offsets(points, normals, np.sqrt(2.0))
    reached = points[:, 2] + offsets[:, 2]
    assert (np.abs(offsets[:, 2]) > 0.0).all() and (np.sign(reached) != -normals[:, 2]).all()


def test_inner_offsets_of_a_thin_wall_stay_inside():
    """In a tube whose wall is a third of the spacing of its samples thick, no offset goes through the wall.

    The samples of one face lie between those of the other, so that none is nearer to a point outside than its own.
    """
    outer, wall, step = 0.03, 0.004, 2.0 * np.pi / 15
    found = []
    for k in range(12):
        radius, side = (outer, 1.0) if k % 2 else (outer - wall, -1.0)
        angle = step * (np.arange(15) + 0.5 * (k % 2))
        way = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(15)])
        found.append((radius * way + [0.0, 0.0, 0.006 * k], side * way))
    points, normals = np.concatenate([x for x, _ in found]), np.concatenate([n for _, n in found])
    offsets = inner_offsets(points, normals, 0.11)
    away, some = np.hypot(*(points + offsets)[:, :2].T), (offsets != 0.0).any(axis=1)
    assert some.mean() > 0.9
    assert (away[some] < outer).all() and (away[some] > outer - wall).all()
