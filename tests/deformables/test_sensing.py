"""Contact sensors: identities, statics, equal and opposite wrenches, batching, reset, capture, errors."""

import numpy as np
import pytest
import warp as wp

from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.solver.attachments import Attachment, attach
from softmode.deformables.tools.sensing import ContactSensor, ForceTorqueSensor, SurfacePressure
from softmode.errors import ConfigError
from tests import reference
from tests.bodies import cube
from tests.deformables.test_attachments import joined
from tests.deformables.test_coupling import grasp, impact
from tests.scenes import GRAVITY, GRIPPER, Scene, add_free_box

FLOAT32 = float(np.finfo(np.float32).eps)
EDGE = 0.1
DOWN = (0.0, 0.0, -GRAVITY)
CONTACT_READINGS = ("force", "force_friction", "torque", "position", "normal", "area")


def resting(**kw):
    """Return a scene of a soft cube on the ground, settled."""
    body = cube()

    def populate(world):
        material = Material(youngs_modulus=5.0e5, mass_damping=5.0)
        add_reduced_body(world, body, material=material, position=(0.0, 0.0, 0.5 * EDGE + 1e-4))

    scene = Scene(populate, [body], gravity=DOWN, ground=0.8, **kw)
    scene.step(200)
    return scene


def readings(sensor):
    """Return copies of all arrays of a contact sensor."""
    names = [f"{name}_matrix" for name in CONTACT_READINGS if name != "force_friction"]
    names += ["force_matrix_friction", *(f"total_{name}" for name in CONTACT_READINGS)]
    return {name: getattr(sensor, name).numpy().copy() for name in names}


def integral(sensor, world=0):
    """Return sum area (pressure normal + traction) [N]."""
    p, n, t = (getattr(sensor, name).numpy()[world].astype(float) for name in ("pressure", "normal", "traction"))
    return sensor.area @ (p[:, None] * n + t)


# -- statics -----------------------------------------------------------------------------------------------------------


def test_weight_through_the_pressure():
    """A cube at rest: int p n + t dA = m g e_z; the patch is its bottom face, the torque about its centre vanishes."""
    scene = resting()
    sensor, ground = SurfacePressure(scene.solver), ContactSensor(scene.solver, [-1])
    sensor.update()
    ground.update()
    weight = scene.mass() * GRAVITY
    force = sensor.total_force.numpy()[0]
    np.testing.assert_allclose(force, [0.0, 0.0, weight], atol=1e-3 * weight)
    np.testing.assert_allclose(integral(sensor), force, atol=16 * FLOAT32 * weight)
    np.testing.assert_allclose(sensor.total_torque.numpy()[0], 0.0, atol=1e-3 * weight * EDGE)
    np.testing.assert_allclose(sensor.total_normal.numpy()[0], [0.0, 0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(sensor.total_position.numpy()[0, :2], 0.0, atol=1e-3 * EDGE)
    pressed = sensor.pressure.numpy()[0] > 0.0
    assert sensor.total_area.numpy()[0] == pytest.approx(sensor.area[pressed].sum(), rel=1e-6)
    bottom = scene.body().surface.points[:, 2] < -0.499 * EDGE
    np.testing.assert_array_equal(pressed, bottom)
    np.testing.assert_allclose(ground.total_force.numpy()[0, 0], -force, atol=4 * FLOAT32 * weight)
    assert ground.total_area.numpy()[0, 0] == sensor.total_area.numpy()[0]


def test_centre_of_pressure_of_an_eccentric_load():
    """Statics: the ground's centre of pressure is the mean of the two centres of mass, weighted by mass."""
    body, offset, mass = cube(), 0.015, 0.5

    def populate(world):
        add_free_box(world, (0.03, 0.05, 0.02), mass, (offset, 0.0, EDGE + 0.0202))
        material = Material(youngs_modulus=5.0e5, mass_damping=5.0)
        add_reduced_body(world, body, material=material, position=(0.0, 0.0, 0.5 * EDGE + 1e-4))

    scene = Scene(populate, [body], coupled=True, gravity=DOWN, ground=0.8)
    sensor = ContactSensor(scene.solver, [0, -1])
    replay = scene.capture()
    for _ in range(120):
        replay()
    sensor.update()
    position, force, torque = (
        getattr(sensor, f"total_{name}").numpy()[0].astype(float) for name in ("position", "force", "torque")
    )
    box, cube_centre = scene.state.body_q.numpy()[0, :3], scene.centre()
    total = mass + scene.mass()
    expected = (mass * box[:2] + scene.mass() * cube_centre[:2]) / total
    np.testing.assert_allclose(position[1, :2], expected, atol=0.01 * offset)
    np.testing.assert_allclose(force[1], [0.0, 0.0, -total * GRAVITY], atol=2e-3 * total * GRAVITY)
    # the box is carried below its centre of mass: no torque about it, and the levers of the two readings agree
    np.testing.assert_allclose(position[0, :2], box[:2], atol=0.01 * offset)
    np.testing.assert_allclose(torque[0], 0.0, atol=0.01 * offset * mass * GRAVITY)
    np.testing.assert_allclose(torque[1], np.cross(position[1], force[1]), atol=0.01 * offset * total * GRAVITY)
    assert (sensor.total_normal.numpy()[0, :, 2] * [1, -1] < -0.999).all()


def test_grasp():
    """Fingers that hold a cube in the air: readings equal body_wrench and the NumPy twin; friction is the weight."""
    scene, close, count = grasp(5.0e5, 0.004)
    sensor, pressure = ContactSensor(scene.solver), SurfacePressure(scene.solver)
    for k in range(count):
        close(0.008 * k)
    for reader in (sensor, pressure):
        reader.update()
    wrench = scene.solver.body_wrench.numpy().astype(float)
    seen = {name: array[0].astype(float) for name, array in readings(sensor).items()}
    scale = np.abs(wrench[:, :3]).max()
    np.testing.assert_allclose(seen["total_force"], wrench[:, :3], atol=64 * FLOAT32 * scale)
    np.testing.assert_allclose(seen["total_torque"], wrench[:, 3:], atol=64 * FLOAT32 * scale * EDGE)
    for name in ("force_friction", "position", "normal", "area"):
        matrix = "force_matrix_friction" if name == "force_friction" else f"{name}_matrix"
        np.testing.assert_array_equal(seen[matrix][:, 0], seen[f"total_{name}"])
    weight = scene.mass() * GRAVITY
    assert -seen["total_force"][1:, 2].sum() == pytest.approx(weight, rel=2e-2)
    drive = GRIPPER["stiffness"] * (GRIPPER["squeeze"] - scene.state.joint_q.numpy()[1:])
    np.testing.assert_allclose(np.abs(seen["total_force"][1:, 1]), drive, rtol=1e-2)
    np.testing.assert_allclose(seen["total_normal"][1:], [[0, -1, 0], [0, 1, 0]], atol=1e-3)
    # each patch is the face of a finger, 0.04 m wide and high, to half a row of samples around
    assert (np.abs(np.sqrt(seen["total_area"][1:]) - 0.04) <= np.sqrt(pressure.area.max())).all()
    assert seen["total_area"][0] == 0.0
    assert pressure.total_area.numpy()[0] == pytest.approx(seen["total_area"].sum())
    np.testing.assert_allclose(integral(pressure), pressure.total_force.numpy()[0], atol=64 * FLOAT32 * scale)

    entries = scene.reduced.view.constraints
    count = entries.count.numpy()[0]
    body, q = scene.body(), scene.next_state.softmode.q.numpy()  # the start of the last step
    row, basis = entries.row.numpy()[0, :count], scene.reduced.view.basis
    values = basis.row.numpy().reshape(len(basis.row), -1)[row, : body.function_count]
    rows = {
        "body": entries.body.numpy()[0, :count],
        "point": basis.row_point.numpy()[row] + values @ q,
        "normal": entries.normal.numpy()[0, :count],
        "force": entries.force.numpy()[0, :count],
    }
    poses, coms = scene.next_state.body_q.numpy().astype(float), scene.model.body_com.numpy()
    for link in range(3):
        twin = reference.contact_readings(rows, link, poses[link], coms[link])
        for name, expected in zip(CONTACT_READINGS, twin, strict=False):
            size = scale if "force" in name else scale * EDGE if name == "torque" else 1.0
            np.testing.assert_allclose(seen[f"total_{name}"][link], expected, atol=64 * FLOAT32 * size)


def test_torque_turns_the_body():
    """In a step dL = dt (c cross F + M), to what implicit Euler loses, omega dt of the angular momentum passed on.

    Three and a half times that: while the body dents, its surface moves on faster than the body turns.
    """
    scene, _ = impact(1.0, offset=(0.03, 0.02))
    sensor, worst, passed = SurfacePressure(scene.solver), 0.0, 0.0
    for _ in range(40):
        c, L = scene.centre(), scene.momentum()[1]
        scene.step()
        sensor.update()
        impulse = scene.dt * (np.cross(c, sensor.total_force.numpy()[0]) + sensor.total_torque.numpy()[0])
        worst = max(worst, np.linalg.norm(scene.momentum()[1] - L - impulse))
        passed = max(passed, np.linalg.norm(impulse))
    omega = np.linalg.norm(scene.momentum()[1]) / (scene.mass() * EDGE**2 / 6.0)
    assert passed > 0.0
    assert worst <= 3.5 * omega * scene.dt * np.linalg.norm(scene.momentum()[1])


def test_soft_on_soft():
    """A cube on a cube on the ground: each feels the other's m g, and the pressures make it up.

    The solver puts a reaction on a mean of samples, the sensor at the sample that touches: levers to a share of their
    spacing.
    """
    body = cube()
    lever = 0.02 * np.sqrt(body.surface.areas.mean())

    def populate(world):
        for k in range(2):
            material = Material(youngs_modulus=5.0e5, mass_damping=5.0)
            add_reduced_body(world, body, material=material, position=(0.0, 0.0, (0.5 + k) * EDGE + (1 + k) * 1e-4))

    scene = Scene(populate, [body], gravity=DOWN, ground=0.8)
    sensors = [SurfacePressure(scene.solver, k) for k in range(2)]
    scene.step(200)
    weight = scene.mass() * GRAVITY
    for sensor in sensors:
        sensor.update()
        total = sensor.total_force.numpy()[0]
        np.testing.assert_allclose(total, [0.0, 0.0, weight], atol=2e-3 * weight)
        np.testing.assert_allclose(integral(sensor), total, atol=64 * FLOAT32 * weight)
        np.testing.assert_allclose(sensor.total_torque.numpy()[0], 0.0, atol=lever * weight)
    for sensor, side in zip(sensors, (1.0, -1.0), strict=True):
        touched = side * body.surface.points[:, 2] > 0.499 * EDGE
        p, n = sensor.pressure.numpy()[0], sensor.normal.numpy()[0]
        force = (sensor.area * p * n[:, 2])[touched].sum()
        assert force == pytest.approx(-side * weight, rel=1e-2)
        assert sensor.area[touched & (p > 0.0)].sum() == pytest.approx(EDGE**2, rel=0.1)
    ground = ContactSensor(scene.solver, [-1])
    ground.update()
    force = ground.force_matrix.numpy()[0, 0, :, 2]
    np.testing.assert_allclose(force, [-2.0 * weight, 0.0], atol=4e-3 * weight)


# -- attachments -------------------------------------------------------------------------------------------------------


def test_attachment_and_contact_make_the_wrench():
    """A cube glued to a box and squeezed on the ground: glue plus contact of the box is its body_wrench."""
    scene, attachment = joined(gravity=DOWN, mass=2.0)
    glue, touch = ForceTorqueSensor(scene.solver, [attachment]), ContactSensor(scene.solver)
    scene.step(40)
    glue.update()
    touch.update()
    wrench = scene.solver.body_wrench.numpy()[0]
    sum_ = np.append(
        glue.force.numpy()[0, 0] + touch.total_force.numpy()[0, 0],
        glue.torque.numpy()[0, 0] + touch.total_torque.numpy()[0, 0],
    )
    np.testing.assert_allclose(sum_, wrench, atol=64 * FLOAT32 * max(np.abs(wrench).max(), 1.0))
    scene.reduced.release(attachment)
    scene.step()
    glue.update()
    assert not glue.force.numpy().any() and not glue.torque.numpy().any()


def test_wrench_on_the_world():
    """A cube that hangs from the world x beside its origin pulls with m g and turns with x m g about it."""
    body, kept, x = cube(), [], 0.2

    def populate(world):
        material = Material(youngs_modulus=2.0e5, mass_damping=10.0)
        instance = add_reduced_body(world, body, material=material, position=(x, 0.0, 0.3))
        top = ((-1.0, -1.0, 0.45 * EDGE), (1.0, 1.0, 1.0))
        kept.append(attach(world, instance, body, box=top))

    scene = Scene(populate, [body], gravity=DOWN)
    sensor = ForceTorqueSensor(scene.solver, kept)
    scene.step(150)
    sensor.update()
    weight = scene.mass() * GRAVITY
    np.testing.assert_allclose(sensor.force.numpy()[0, 0], [0.0, 0.0, -weight], atol=2e-3 * weight)
    np.testing.assert_allclose(sensor.torque.numpy()[0, 0], [0.0, x * weight, 0.0], atol=5e-3 * x * weight)


# -- worlds, graphs, reset ---------------------------------------------------------------------------------------------


def test_worlds_capture_and_reset():
    """World i of 3 equals the single world bit for bit, captured equals eager, a masked reset clears its world."""

    def run(world_count, captured):
        scene, _ = impact(1.0, world_count=world_count, offset=(0.02, 0.0))
        contact, pressure = ContactSensor(scene.solver), SurfacePressure(scene.solver)
        sensors = (contact, pressure)
        if captured:
            for sensor in sensors:
                sensor.update()
            with wp.ScopedCapture(device="cpu") as capture:
                scene.solver.step(scene.state, scene.next_state, scene.control, None, scene.dt)
                for sensor in sensors:
                    sensor.update()
            scene.solver.reset(scene.state)
            for _ in range(8):
                wp.capture_launch(capture.graph)
                scene.state.assign(scene.next_state)
        else:
            for _ in range(8):
                scene.step()
                for sensor in sensors:
                    sensor.update()
        arrays = readings(contact)
        arrays |= {name: getattr(pressure, name).numpy().copy() for name in ("pressure", "traction", "normal")}
        arrays["moment"] = pressure.total_torque.numpy().copy()
        return scene, sensors, arrays

    batch, sensors, many = run(3, False)
    _, _, alone = run(1, True)
    assert alone["total_force"].any() and alone["pressure"].any() and alone["total_area"].any()
    for name, array in many.items():
        for w in range(3):
            np.testing.assert_array_equal(array[w], alone[name][0], err_msg=name)
    mask = wp.array([False, True, False, False], dtype=bool, device="cpu")
    batch.solver.reset(batch.state, mask)
    for sensor in sensors:
        sensor.update()
    after = readings(sensors[0])
    for name, array in after.items():
        assert not array[1].any()
        np.testing.assert_array_equal(array[[0, 2]], many[name][[0, 2]])
    assert not sensors[1].pressure.numpy()[1].any()
    np.testing.assert_array_equal(sensors[1].pressure.numpy()[2], many["pressure"][2])


# -- choice and errors -------------------------------------------------------------------------------------------------


def test_choice_by_label_and_errors():
    """Links are chosen by pattern in the order given; what matches nothing is named with what is near."""
    scene, _, _ = grasp(5.0e5, 0.004, world_count=2)
    labels = scene.model.body_label[:3]
    sensor = ContactSensor(scene.solver, [labels[2], 1])
    assert sensor.bodies == (2, 1)
    assert sensor.force_matrix.shape == (2, 2, 1)
    assert ContactSensor(scene.solver, "*").bodies == (0, 1, 2)
    with pytest.raises(ConfigError, match="no rigid body matches 'body'") as error:
        ContactSensor(scene.solver, "body")
    assert labels[0] in str(error.value)
    for bodies in ([3], [-2], [1, 1], []):
        with pytest.raises(ConfigError, match="bodies"):
            ContactSensor(scene.solver, bodies)
    for soft in ([1], [0, 0], [-1], []):
        with pytest.raises(ConfigError, match="soft"):
            ContactSensor(scene.solver, soft=soft)
    with pytest.raises(ConfigError, match="soft"):
        SurfacePressure(scene.solver, 2)
    with pytest.raises(ConfigError, match="attachments"):
        ForceTorqueSensor(scene.solver, [])
    with pytest.raises(ConfigError, match="pins"):
        ForceTorqueSensor(scene.solver, [Attachment(instance=0, first=0, count=3)])
    with pytest.raises(ConfigError, match="solver"):
        ContactSensor(scene.model)
