"""Attachments: held by a link or the world, two-way, released and held again, and the errors."""

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.solver.attachments import attach
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from softmode.errors import ConfigError
from tests.bodies import cube, default_box
from tests.scenes import GRAVITY, Scene, add_free_box, rotation

DOWN = (0.0, 0.0, -GRAVITY)
EDGE = 0.1
HALF = 0.5 * EDGE
TOP = ((-1.0, -1.0, 0.9 * HALF), (1.0, 1.0, 1.0))


def joined(*, mass=0.5, gap=0.02, spin=(0.0, 0.0, 0.0), **kw):
    """Return a soft cube that hangs under a free box by its top, and the attachment."""
    body, kept = cube(), []

    def populate(world):
        link = add_free_box(world, (0.05, 0.05, 0.02), mass, (0.0, 0.0, HALF + gap + 0.02))
        instance = add_reduced_body(world, body, material=Material(youngs_modulus=1.0e5), angular_velocity=spin)
        kept.append(attach(world, instance, body, link=link, box=TOP))

    return Scene(populate, [body], coupled=True, **kw), kept[0]


@pytest.mark.parametrize("integrator", ["euler", "bdf2"])
def test_momentum_of_a_joined_pair(integrator):
    """A soft cube glued to a free box, the cube spinning at first: p kept to 1e-6 of m omega edge / 2, L to 2e-4.

    The levers of a step are those of its start: what that and implicit Euler take of the angular momentum is of first
    order in dt, within these 50 ms far below the spin that the box takes up.
    """
    scene, _ = joined(spin=(0.5, 0.3, 1.0), dt=0.002, options=SolverReducedOptions(integrator=integrator))
    L0 = scene.momentum()[1] + scene.rigid_momentum()[1]
    scale = scene.mass() * 0.5 * EDGE
    for _ in range(50):
        scene.step()
        assert np.linalg.norm(scene.momentum()[0] + scene.rigid_momentum()[0]) <= 1e-6 * scale
    L = scene.momentum()[1] + scene.rigid_momentum()[1]
    assert np.linalg.norm(scene.rigid_momentum()[1]) > 0.1 * np.linalg.norm(L0)
    assert np.linalg.norm(L - L0) <= 2e-4 * np.linalg.norm(L0)


def test_free_fall_of_a_joined_pair():
    """Everything falls with g, and nothing pulls: the joint carries no force in free fall."""
    scene, _ = joined(gravity=DOWN)
    scene.step(50)
    v = scene.momentum()[0] / scene.mass()
    np.testing.assert_allclose(v, [0.0, 0.0, -GRAVITY * 50 * scene.dt], atol=1e-5)
    assert np.abs(scene.solver.body_wrench.numpy()).max() <= 1e-4 * scene.mass() * GRAVITY


@pytest.mark.parametrize("released", ["held", "released", "held again"])
def test_hanging_from_the_world(released):
    """A cube glued to the world by its top hangs still; let go it falls as sqrt says; a reset or hold takes it up."""
    body, kept = cube(), []

    def populate(world):
        instance = add_reduced_body(world, body, rotation=rotation((0, 0, 1), 0.3), position=(0.2, 0.0, 1.0))
        kept.append(attach(world, instance, body, box=TOP))

    scene = Scene(populate, [body], gravity=DOWN)
    start = scene.centre()
    if released != "held":
        scene.reduced.release(kept[0])
    if released == "held again":
        scene.reduced.hold(kept[0])
    scene.step(100)
    drop = start[2] - scene.centre()[2]
    t = 100 * scene.dt
    if released == "released":
        assert drop == pytest.approx(0.5 * GRAVITY * t * (t + scene.dt), rel=1e-5)
        scene.reduced.reset(scene.state)
        scene.step(100)
        drop = start[2] - scene.centre()[2]
    # the glue of k = 20 M / size per area stretches by weight / (k A), the body by less than weight / (E edge)
    assert 0.0 < drop <= 2.0 * scene.mass() * GRAVITY / (Material().youngs_modulus * EDGE)


def test_release_of_one_world_in_a_recorded_graph():
    """A mask chooses the worlds, inside a captured graph too; the others hang on, bit for bit."""
    body, kept = cube(), []

    def populate(world):
        instance = add_reduced_body(world, body)
        kept.append(attach(world, instance, body, box=TOP))

    def run(world_count, masked):
        scene = Scene(populate, [body], gravity=DOWN, world_count=world_count)
        mask = wp.array([w == masked for w in range(world_count + 1)], dtype=bool, device="cpu")
        with wp.ScopedCapture(device="cpu") as capture:
            scene.reduced.release(kept[-1], mask)
        replay = scene.capture()
        wp.capture_launch(capture.graph)
        for _ in range(10):
            replay()
        return scene

    batch, alone = run(3, 1), run(1, -1)
    np.testing.assert_array_equal(batch.q(0), alone.q())
    np.testing.assert_array_equal(batch.q(2), alone.q())
    assert batch.centre(1)[2] < -0.01


def test_an_attachment_is_moved_in_a_recorded_graph():
    """Poses written between replays carry the glued top along, each world its own; one that is not moved keeps bits."""
    body, kept = cube(), []

    def populate(world):
        instance = add_reduced_body(world, body, position=(0.2, 0.0, 1.0), material=Material(mass_damping=20.0))
        kept.append(attach(world, instance, body, box=TOP))

    scene, still = (Scene(populate, [body], gravity=DOWN, world_count=2) for _ in range(2))
    poses = wp.array([wp.transform_identity()] * 2, dtype=wp.transform, device="cpu")
    with wp.ScopedCapture(device="cpu") as capture:
        scene.solver.move(kept[0], scene.control, poses)
        for _ in range(2):
            scene.step()
    scene.solver.reset(scene.state)
    shift = np.array([0.05, 0.02, -0.1])
    for k in range(1, 101):
        turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), 0.01 * min(k, 80))
        move = wp.transform(wp.vec3(shift * min(k, 80) / 80), turn)
        poses.assign([wp.transform_identity(), move])
        wp.capture_launch(capture.graph)
        still.step(2)
    for name in ("q", "qd"):
        np.testing.assert_array_equal(getattr(scene, name)(0), getattr(still, name)(0))
    top = body.surface.points[:, 2] >= TOP[0][2]
    hung, moved = scene.state.particle_q.numpy().reshape(2, -1, 3)[:, top].astype(float)
    np.testing.assert_allclose(moved, hung @ rotation((0, 0, 1), 0.8).T + shift, atol=1e-3 * EDGE)
    poses.fill_(wp.transform_identity())
    scene.solver.move(kept[0], scene.control, poses)
    np.testing.assert_array_equal(scene.control.softmode.pin_target.numpy(), scene.model.softmode.pin_target.numpy())
    for wrong in ([wp.transform_identity()] * 2, wp.zeros(2, dtype=wp.vec3, device="cpu"), poses[:1]):
        with pytest.raises(ConfigError, match=r"pose must be a wp.array of wp.transform, shape \(2,\)"):
            scene.solver.move(kept[0], scene.control, wrong)
    with pytest.raises(ConfigError, match="shares its arrays"):
        scene.solver.move(kept[0], scene.model.control(clone_variables=False), poses)


@pytest.mark.parametrize("coupled", [True, False])
def test_weight_on_a_moving_link(coupled):
    """Hung on a rigid body: at rest its wrench is the weight of the cube, the lever about its centre of mass included.

    The link is held by a stiff drive (coupled) or prescribed (not coupled).
    """
    body, kept = cube(), []
    x = 0.1

    def populate(world):
        pose = wp.transform(wp.vec3(x, 0.0, 0.08), wp.quat_identity())
        link = world.add_link(xform=pose, mass=1.0, inertia=wp.mat33(np.eye(3) * 1.0e-3))
        joint = world.add_joint_prismatic(
            parent=-1, child=link, axis=(0, 0, 1), parent_xform=pose,
            target_ke=1.0e4, target_kd=2.0e2,
        )  # fmt: skip
        world.add_articulation([joint])
        instance = add_reduced_body(world, body, material=Material(youngs_modulus=2.0e5, mass_damping=10.0))
        kept.append(attach(world, instance, body, link=link, box=TOP))

    options = SolverReducedOptions(tolerance=1e-7)
    scene = Scene(populate, [body], coupled=coupled, gravity=DOWN, options=options)
    scene.step(300)
    wrench = scene.reduced.body_wrench.numpy()[0]
    weight = scene.mass() * GRAVITY
    np.testing.assert_allclose(wrench[:3], [0.0, 0.0, -weight], atol=2e-3 * weight)
    # the centre of the cube is x beside the centre of mass of the link: moment (-x) e_x cross (-weight) e_z
    np.testing.assert_allclose(wrench[3:], [0.0, -x * weight, 0.0], atol=5e-3 * x * weight)
    if coupled:
        sunk = scene.state.joint_q.numpy()[0]
        assert sunk == pytest.approx(-(1.0 * GRAVITY + weight) / 1.0e4, rel=1e-2)


def test_prescribed_link_carries_the_body_along():
    """A link that moves as told drags the body: after a while they have one velocity."""
    body = cube()

    def populate(world):
        link = add_free_box(world, (0.05, 0.05, 0.02), 1.0, (0.0, 0.0, 0.09))
        attach(world, add_reduced_body(world, body, material=Material(mass_damping=5.0)), body, link=link, box=TOP)

    scene = Scene(populate, [body])
    for k in range(200):
        for state in (scene.state, scene.next_state):
            state.body_q.assign(np.array([[0.3 * k * scene.dt, 0.0, 0.09, 0.0, 0.0, 0.0, 1.0]], np.float32))
            state.body_qd.assign(np.array([[0.3, 0.0, 0.0, 0.0, 0.0, 0.0]], np.float32))
        scene.step()
    np.testing.assert_allclose(scene.momentum()[0] / scene.mass(), [0.3, 0.0, 0.0], atol=3e-3)
    assert scene.reduced.instance_force.numpy()[0] == pytest.approx(np.zeros(3))


def test_pins_of_a_prescribed_link_stay_on_their_circle():
    """Where a link turns by omega dt in a step, its pins end on the circle they began on: t = x + R(omega dt) a."""
    body, turn = cube(), 0.2

    def populate(world):
        link = add_free_box(world, (0.05, 0.05, 0.02), 1.0, (0.0, 0.0, HALF + 0.04))
        attach(world, add_reduced_body(world, body), body, link=link, box=TOP)

    scene = Scene(populate, [body], dt=0.01)
    solver, state, link = scene.reduced, scene.state, np.array([0.0, 0.0, HALF + 0.04])
    state.body_qd.assign(np.array([[0.0, 0.0, 0.0, 0.0, turn / scene.dt, 0.0]], np.float32))
    solver.begin(state, scene.control, scene.dt)
    solver.detect(state, scene.control, scene.dt, prescribed=True)
    count = solver.view.instances.pin_count.numpy()[0]
    rows = solver.view.constraints.row.numpy()[0, :count]
    points = solver.view.basis.row_point.numpy()[rows]
    target = points - solver.view.constraints.offset.numpy()[0, :count]  # the body is where it was put: x_n = X
    circle = link + (points - link) @ rotation((0, 1, 0), turn).T
    np.testing.assert_allclose(target, circle, atol=1e-6)
    assert np.linalg.norm(circle - points, axis=1).min() > 1e-3


def test_held_body_does_not_touch_its_link():
    """The shapes of the link a body is fixed to are not in contact with it, until it is released."""
    scene, attachment = joined(gap=-0.01)
    scene.step()
    assert scene.reduced.view.constraints.count.numpy()[0] == attachment.count
    scene.reduced.release(attachment)
    scene.step()
    assert scene.reduced.view.constraints.count.numpy()[0] > attachment.count


def test_errors():
    """No point inside, a link that does not exist, not exactly one place: typed errors with a remedy."""
    builder = newton.ModelBuilder()
    body = cube()
    instance = add_reduced_body(builder, body)
    with pytest.raises(ConfigError, match="no point") as error:
        attach(builder, instance, body, box=((1.0,) * 3, (2.0,) * 3))
    assert "spans" in str(error.value)
    with pytest.raises(ConfigError, match="link"):
        attach(builder, instance, body, link=3, box=TOP)
    with pytest.raises(ConfigError, match="exactly one"):
        attach(builder, instance, body)
    with pytest.raises(ConfigError, match="stiffness"):
        attach(builder, instance, body, box=TOP, stiffness=-1.0)


def test_own_surface_can_be_attached():
    """The surface samples of a body count as inside, also those in a corner that no kernel reaches; beyond them not."""
    body = default_box()
    builder = newton.ModelBuilder()
    soft = add_reduced_body(builder, body)
    found = attach(builder, soft, body, points=body.surface.points)
    assert found.count == len(body.surface.points)
    with pytest.raises(ConfigError, match="1 of 1 points lie outside"):
        attach(builder, soft, body, points=[[0.0, 0.0, 0.05]])
