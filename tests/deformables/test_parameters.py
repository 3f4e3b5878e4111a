"""Parameters set on the device: masked, captured, clamped, and equal to a model that was built with them."""

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables.materials.material import Material
from softmode.deformables.model import status as bits
from softmode.deformables.model.authoring import MATERIAL_FIELDS, add_pins, add_reduced_body
from softmode.deformables.tools.parameters import PARAMETER_FLAGS, PARAMETER_LIMITS, ShapeFriction, set_parameters
from softmode.errors import ConfigError, MaterialError
from tests.bodies import clamped, cube
from tests.scenes import GRAVITY, Scene, add_gripper, rotation

DOWN = (0.0, 0.0, -GRAVITY)
EDGE = 0.1
GIVEN = {"youngs_modulus": 3.0e4, "poissons_ratio": 0.3, "density": 700.0, "friction": 0.3, "scale": 1.2}
PLACED = {
    "position": (0.1, 0.0, 0.075),
    "rotation": rotation((1, 2, 3), 0.3),
    "velocity": (0.3, 0.0, -0.2),
    "angular_velocity": (1.0, -2.0, 0.5),
}


def device(values, dtype=float):
    """Return an array on the CPU device."""
    return wp.array(values, dtype=dtype, device="cpu")


def falling(material=None, scale=1.0, **options):
    """Return worlds in which a turning cube falls on the ground."""

    def populate(world):
        add_reduced_body(world, cube(), material=material or Material(), scale=scale, **PLACED)

    return Scene(populate, [cube()], gravity=DOWN, ground=0.8, **options)


def everything(scene):
    """Return copies of all that a step reads or writes, by instance or particle."""
    state, model, instances = scene.state, scene.model, scene.reduced.view.instances
    arrays = {name: getattr(state.softmode, name) for name in ("q", "qd", "q_before", "qd_before", "dt_before")}
    arrays |= {name: getattr(state, name) for name in ("particle_q", "particle_qd")}
    arrays |= {name: getattr(model, name) for name in ("particle_mass", "particle_inv_mass", "particle_radius")}
    arrays |= {name: getattr(model.softmode, name) for name in GIVEN}
    names = ("mass", "inertia", "size", "area", "tolerance", "margin", "smoothing")
    arrays |= {f"instance {name}": getattr(instances, name) for name in names}
    arrays |= {"force": scene.reduced.instance_force, "tolerance": scene.reduced.view.rigid_tolerance}
    return {name: array.numpy().copy() for name, array in arrays.items()}


def given(count, where=None):
    """Return the parameters of ``count`` instances: GIVEN everywhere, or NaN but at ``where``."""
    out = {}
    for name, value in GIVEN.items():
        values = np.full(count, value if where is None else np.nan, np.float32)
        values[where if where is not None else slice(None)] = value
        out[name] = device(values)
    return out


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.5])
@pytest.mark.parametrize("name", MATERIAL_FIELDS)
def test_a_bad_parameter_written_into_the_model_is_flagged(name, bad):
    """Of three worlds in a replayed graph the one whose parameter left its range, and no other, says so."""
    scene = falling(world_count=3)
    replay = scene.capture()
    replay()
    assert not scene.reduced.status.numpy().any()
    array = getattr(scene.model.softmode, name)
    values = array.numpy()
    values[1] = bad
    array.assign(values)
    scene.solver.notify_model_changed(0)  # density counts from here on
    replay()
    status = scene.reduced.status.numpy()
    assert {"parameter_range", f"{name}_range"} <= set(bits.status_reasons(int(status[1])))
    assert not status[[0, 2]].any()
    values[1] = GIVEN.get(name, 0.0)
    array.assign(values)
    scene.solver.notify_model_changed(0)
    scene.solver.reset(scene.state)
    replay()
    assert not scene.reduced.status.numpy().any()


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        *((name, np.nan) for name in ("pin_stiffness", "pin_target", "shape_material_mu", "gravity")),
        *((name, -1.0) for name in ("scale", "contact_stiffness", "contact_radius", "shape_material_mu")),
        ("material_model", 6),
        ("density", -100.0),
    ],
)
def test_whatever_else_is_written_is_flagged_by_name(name, bad):
    """Pins, targets, contact, shapes and gravity of one of two worlds; without ``notify_model_changed``."""

    def populate(world):
        index = add_reduced_body(world, cube(), position=(0.0, 0.0, 0.2))
        add_pins(world, index, cube().cubature.points[:3], stiffness=20.0)
        world.add_shape_box(-1, hx=0.05, hy=0.05, hz=0.05)

    scene = Scene(populate, [cube()], gravity=DOWN, world_count=2)
    scene.step()
    assert not scene.reduced.status.numpy().any()
    owner = scene.control.softmode if name == "pin_target" else scene.model.softmode
    array = getattr(scene.model if name in ("shape_material_mu", "gravity") else owner, name)
    values = array.numpy()
    values[len(values) // 2] = bad  # the first of the second world
    array.assign(values)
    scene.step()
    first, second = (bits.status_reasons(int(status)) for status in scene.reduced.status.numpy())
    assert not first and {"parameter_range", f"{name}_range"} <= set(second)


def test_a_solver_refuses_models_that_are_not_known():
    """A number written into the model before the solver is made, and one written later and told."""
    with pytest.raises(MaterialError, match="material model 6"):
        falling(finish=lambda model: model.softmode.material_model.fill_(6))
    scene = falling()
    scene.model.softmode.material_model.fill_(6)
    with pytest.raises(MaterialError, match="material model 6"):
        scene.solver.notify_model_changed(0)


def test_a_driven_target_that_is_no_number_is_flagged():
    """NaN in where a driven region is to be names ``q_driven``."""
    scene = Scene(lambda world: add_reduced_body(world, clamped()), [clamped()])
    target = scene.control.softmode.q_driven.numpy()
    target[0] = np.nan
    scene.control.softmode.q_driven.assign(target)
    scene.step()
    assert "q_driven_range" in bits.status_reasons(int(scene.reduced.status.numpy()[0]))


def test_a_body_that_sinks_in_is_flagged():
    """Of three cubes the one that starts deeper than a twentieth of its size is flagged, and only while it is."""

    def populate(world):
        add_reduced_body(world, cube(), position=(0.0, 0.0, EDGE / 2))

    scene = Scene(populate, [cube()], gravity=DOWN, ground=0.5, world_count=3)
    size = float(scene.reduced.view.instances.size.numpy()[0])
    q = scene.state.softmode.q.numpy().reshape(3, -1, 3)
    q[1] -= 0.06 * size * cube().linear_coordinates[:, 3:] * np.array([0.0, 0.0, 1.0])
    scene.state.softmode.q.assign(q.reshape(-1, 3))
    scene.step()
    status = scene.reduced.status.numpy()
    assert "penetration" in bits.status_reasons(int(status[1])) and not status[[0, 2]].any()
    scene.step(20)
    scene.reduced.status.zero_()
    scene.step()
    assert not scene.reduced.status.numpy().any()


def test_masked_update_in_a_captured_run():
    """Set and reset in one of three running worlds, in a graph: the others keep every bit, it equals a fresh model."""
    scene, twin = falling(world_count=3), falling(world_count=3)
    mask, values = device([False] * 4, wp.bool), given(3, where=1)
    for target in (scene, twin):
        target.step(2)
    with wp.ScopedCapture(device="cpu") as update:
        flags = set_parameters(scene.solver, mask, **values)
        scene.solver.reset(scene.state, mask)
    with wp.ScopedCapture(device="cpu") as capture:
        scene.solver.step(scene.state, scene.next_state, scene.control, None, scene.dt)
        scene.solver.step(scene.next_state, scene.state, scene.control, None, scene.dt)
    wp.capture_launch(update.graph)  # an empty mask changes nothing
    for _ in range(5):
        wp.capture_launch(capture.graph)
        twin.step(2)
    before, same = everything(scene), everything(twin)
    for name, value in before.items():
        np.testing.assert_array_equal(value, same[name], err_msg=name)

    mask.assign([False, True, False, False])
    wp.capture_launch(update.graph)
    np.testing.assert_array_equal(flags.numpy(), 0)
    for _ in range(15):
        wp.capture_launch(capture.graph)
        twin.step(2)
    material = {name: value for name, value in GIVEN.items() if name != "scale"}
    fresh = falling(Material(**material), GIVEN["scale"])
    fresh.step(30)
    found, other, new = everything(scene), everything(twin), everything(fresh)
    for name, value in found.items():
        rows = value.reshape(3, -1)
        np.testing.assert_array_equal(rows[[0, 2]], other[name].reshape(3, -1)[[0, 2]], err_msg=name)
        expected = new[name].ravel()
        np.testing.assert_allclose(rows[1], expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max(), err_msg=name)
    assert found["force"][1, 2] > 0.0


def test_the_same_parameters_change_no_bit():
    """Setting what is there already leaves a run as it is, to the bit, and a reset is the initial state."""
    scene, twin = falling(), falling()
    for target in (scene, twin):
        target.step(10)
    same = {name: wp.clone(getattr(scene.model.softmode, name)) for name in GIVEN}
    set_parameters(scene.solver, **same)
    for target in (scene, twin):
        target.step(10)
    for name, value in everything(scene).items():
        np.testing.assert_array_equal(value, everything(twin)[name], err_msg=name)
    scene.solver.reset(scene.state)
    np.testing.assert_array_equal(scene.q(), scene.model.softmode.q.numpy())


@pytest.mark.parametrize("placed", [1.0, 0.8])
def test_reset_places_the_scaled_body(placed):
    """After a change of scale a reset gives the placement and motion that add_reduced_body would, about the centre."""
    scene, fresh = falling(scale=placed), falling(scale=1.2)
    for value in (0.5, 1.2):  # the history does not matter
        set_parameters(scene.solver, scale=device([value]))
        scene.solver.reset(scene.state)
    np.testing.assert_allclose(scene.q(), fresh.q(), atol=1e-8)
    np.testing.assert_allclose(scene.qd(), fresh.qd(), atol=1e-7)
    np.testing.assert_allclose(scene.centre(), PLACED["position"], atol=1e-12)
    np.testing.assert_allclose(scene.state.particle_q.numpy(), fresh.state.particle_q.numpy(), atol=1e-7)
    once = falling(scale=placed)
    set_parameters(once.solver, scale=device([1.2]))
    once.solver.reset(once.state)
    np.testing.assert_array_equal(once.q(), scene.q())


@pytest.mark.parametrize("name", list(GIVEN))
def test_values_out_of_range(name):
    """Beyond a limit: the limit, flagged; no number: what was there, flagged; the body stays finite."""
    low, high = PARAMETER_LIMITS[name]
    scene = falling(world_count=6)
    before = float(getattr(scene.model.softmode, name).numpy()[0])
    bad = [low - 1.0, high * 2.0, np.nan, np.inf, -np.inf, GIVEN[name]]
    flags = set_parameters(scene.solver, **{name: device(bad)})
    bit = PARAMETER_FLAGS[name]
    np.testing.assert_array_equal(flags.numpy(), [bit] * 5 + [0])
    expected = np.array([low, high, before, high, low, GIVEN[name]], np.float32)
    np.testing.assert_array_equal(getattr(scene.model.softmode, name).numpy(), expected)
    assert np.isfinite(scene.reduced.view.instances.mass.numpy()).all()
    set_parameters(scene.solver, **{name: device([GIVEN[name]] * 6)})
    assert not flags.numpy().any()
    scene.solver.reset(scene.state)
    scene.step(2)
    assert np.isfinite(scene.state.softmode.q.numpy()).all()


def test_limits_lie_inside_the_materials():
    """Every value that passes is one that Material accepts."""
    for name, pair in PARAMETER_LIMITS.items():
        if name != "scale":
            for value in pair:
                Material(**{name: float(np.float32(value))})


def test_held_bodies_keep_their_scale():
    """A pinned or driven body keeps its scale and is flagged where another is asked for; the rest is set."""

    def populate(world):
        add_pins(world, add_reduced_body(world, cube()), cube().cubature.points[:3], stiffness=10.0)
        add_reduced_body(world, clamped(), position=(1.0, 0.0, 0.0))
        add_reduced_body(world, cube(), position=(2.0, 0.0, 0.0))

    scene = Scene(populate, [cube(), clamped()])
    held = PARAMETER_FLAGS["held_scale"]
    flags = set_parameters(scene.solver, scale=device([1.1, 1.1, 1.1]), density=device([400.0] * 3))
    np.testing.assert_array_equal(flags.numpy(), [held, held, 0])
    np.testing.assert_array_equal(scene.model.softmode.scale.numpy(), np.float32([1.0, 1.0, 1.1]))
    np.testing.assert_array_equal(scene.model.softmode.density.numpy(), 400.0)
    set_parameters(scene.solver, scale=device([1.0, 1.0, 1.2]))
    assert not flags.numpy().any()


def test_coupled_worlds_and_shape_friction():
    """With a gripper, per world: the contacts of a step have sqrt(friction of body * friction of the fingers)."""
    palm = []

    def populate(world):
        first = world.shape_count
        add_gripper(world, 0.5 * EDGE - 0.005, friction=0.8)
        palm.extend(range(first, world.shape_count))
        add_reduced_body(world, cube(), position=(0.0, 0.0, 0.05))

    scene = Scene(populate, [cube()], coupled=True, world_count=3, ground=0.5)
    fingers = ShapeFriction(scene.solver, palm)
    mask = device([True, True, False, False], wp.bool)
    friction = device([0.2, -1.0, 0.9])
    with wp.ScopedCapture(device="cpu") as capture:
        set_parameters(scene.solver, mask, friction=device([0.4, 0.6, 5.0]))
        flags = fingers.set(friction, mask)
        scene.solver.step(scene.state, scene.next_state, scene.control, None, scene.dt)
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(flags.numpy(), [0, PARAMETER_FLAGS["friction"], 0])
    entries = scene.reduced.view.constraints
    count, body = entries.count.numpy(), entries.body.numpy()
    for w, expected in enumerate((np.sqrt(0.2 * 0.4), 0.0, np.sqrt(0.8 * 0.8))):
        fingertip = body[w, : count[w]] >= 0
        assert fingertip.sum() > 2
        np.testing.assert_allclose(entries.friction.numpy()[w, : count[w]][fingertip], expected, rtol=1e-6)
    scene.solver.rigid.notify_model_changed(newton.ModelFlags.SHAPE_PROPERTIES)
    mujoco = scene.solver.rigid.mjw_model.geom_friction.numpy()[..., 0]
    assert np.isclose(mujoco[0], 0.2, atol=1e-6).sum() == len(palm)
    assert not np.isclose(mujoco[2], 0.2, atol=1e-6).any()


@pytest.mark.parametrize(
    ("values", "match"),
    [
        ([1.0], "wp.array of float32"),
        (wp.zeros(2, dtype=float, device="cpu"), r"shape \(1,\)"),
        (wp.zeros(1, dtype=wp.float64, device="cpu"), "float32"),
    ],
)
def test_wrong_arrays(values, match):
    """An array of another type or shape is refused before a kernel reads it."""
    scene = falling()
    with pytest.raises(ConfigError, match=match):
        set_parameters(scene.solver, scale=values)
    with pytest.raises(ConfigError, match="world_mask"):
        set_parameters(scene.solver, device([1, 0], int))
    with pytest.raises(ConfigError, match="solver is a Model"):
        set_parameters(scene.model)


@pytest.mark.parametrize("shapes", [[], [0], [-1]])
def test_shapes_outside_the_worlds(shapes):
    """The common ground has one friction: it cannot be set per world."""
    with pytest.raises(ConfigError, match="replicated"):
        ShapeFriction(falling(world_count=2).solver, shapes)
