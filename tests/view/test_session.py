"""The live session: time, picking, pulling, pinning, parameters, handles, recordings, environments."""

import time
from dataclasses import replace
from typing import Any

import newton
import numpy as np
import pytest

from softmode.deformables.materials.material import Material
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.reduction.patch import Patch
from softmode.envs.tasks.lift_soft.task import LiftSoftConfig, lift_scene
from softmode.errors import AssetError, ConfigError, MaterialError, StorageError
from softmode.objects import ObjectConfig, load
from softmode.scenes.motion import coordinates
from softmode.splats.formats import write_splats
from softmode.view.live_recording import LiveRecording
from softmode.view.live_types import LiveOptions
from softmode.view.pace import Pace
from softmode.view.session import LiveSession
from tests.scenes import rotation

BUILD = BuildOptions(mode_count=4, kernel_count=150, cubature_count=128)
EXTENTS = (0.05, 0.05, 0.1)
SIZE = float(np.linalg.norm(EXTENTS))
BOX = ObjectConfig(shape="box", extents=EXTENTS, splat_count=1500, surface_count=150, build=BUILD)
PATIENT = LiveOptions(budget=1.0e6)
"""Simulated time never lags, however busy the machine is."""
SOFT = Material(youngs_modulus=3.0e4, density=300.0, viscosity=0.02)
FRAME = 1.0 / 30.0

STAGE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 0.01
    kilogramsPerUnit = 1
    upAxis = "Z"
)
def Xform "World"
{
    def Mesh "Cube" (
        prepend apiSchemas = ["PhysicsDeformableBodyAPI", "PhysicsVolumeDeformableSimAPI", "MaterialBindingAPI"]
    )
    {
        int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
        int[] faceVertexIndices = [0, 3, 2, 1, 4, 5, 6, 7, 0, 1, 5, 4, 1, 2, 6, 5, 2, 3, 7, 6, 3, 0, 4, 7]
        point3f[] points = [(-5, -5, -5), (5, -5, -5), (5, 5, -5), (-5, 5, -5),
            (-5, -5, 5), (5, -5, 5), (5, 5, 5), (-5, 5, 5)]
        rel material:binding:physics = </World/Rubber>
    }
    def Material "Rubber" (
        prepend apiSchemas = ["PhysicsVolumeDeformableMaterialAPI", "PhysicsMaterialAPI"]
    )
    {
        float physics:youngsModulus = 500
        float physics:poissonsRatio = 0.4
        float physics:density = 0.00012
    }
}
"""
"""A cube of 10 cm in centimetres, E = 5e4 Pa, 120 kg/m^3."""


def session(scene="hang", *, material=SOFT, options=PATIENT, **kw):
    """Return a session with a small box."""
    return LiveSession.from_object(BOX, scene=scene, material=material, options=options, **kw)


@pytest.fixture
def hanging():
    """A box that hangs by its top, at rest."""
    made = session()
    settle(made)
    return made


def settle(live, frames=40):
    """Let frames pass."""
    for _ in range(frames):
        live.advance(FRAME)


def side(live):
    """Return what a ray along +y meets at the height of the centre of mass."""
    hit = live.pick(live.centre() + np.array([0.0, -1.0, 0.0]), (0.0, 2.0, 0.0))
    assert hit is not None
    return hit


# -- time -------------------------------------------------------------------------------------------------------------


def test_time_that_did_not_fit_is_lost():
    """After a frame in which two blocks of ten fitted, a fast one owes its own block and the one begun, not eight."""
    pace = Pace(block_dt=0.01, budget=0.5)
    pace.took(0.025)
    assert pace.blocks(0.1) == 2
    pace.frame(0.0, 0.02)
    pace.block_seconds = 1e-6
    assert pace.blocks(0.01) == 2


def test_time_passes_as_told():
    """Thirty frames of a thirtieth are a second, in blocks; an odd frame is carried over; paused none passes."""
    live = session()
    assert sum(live.advance(FRAME) for _ in range(30)) == pytest.approx(1.0, abs=1e-9)
    assert live.advance(0.004) == 0.0  # half a block
    assert live.advance(0.0045) == pytest.approx(1.0 / 120.0)
    live.pause()
    before = live.surface()
    assert live.advance(FRAME) == 0.0 and not live.status().playing
    np.testing.assert_array_equal(live.surface(), before)
    assert live.step() == pytest.approx(1.0 / 120.0)
    live.play()
    assert live.advance(FRAME) == pytest.approx(FRAME)
    assert live.status().time == pytest.approx(1.0 + 2.0 / 120.0 + FRAME)


def test_a_small_budget_lags_behind():
    """Physics that takes more than its share of a frame takes one block, and what did not fit is not made up for."""
    live = session(options=LiveOptions(budget=0.001))
    live.advance(FRAME)  # nothing is known yet of how long a block takes
    assert [live.advance(FRAME) for _ in range(3)] == pytest.approx([1.0 / 120.0] * 3)
    assert live.status().step_milliseconds > 0.0


def test_reset_starts_over(hanging):
    """After anything a reset brings back the first state to the bit, holds again, and keeps parameters."""
    fresh = session()
    hanging.set_parameters(friction=0.3)
    hanging.begin_drag(side(hanging))
    hanging.drag_to((0.2, 0.1, 0.3))
    settle(hanging, 5)
    hanging.unpin(1)
    settle(hanging, 5)
    hanging.reset()
    np.testing.assert_array_equal(hanging.surface(), fresh.surface())
    assert hanging.status().time == 0.0 and hanging.drag() is None and list(hanging.pins()) == [2]
    assert hanging.parameters.friction == pytest.approx(0.3)
    settle(hanging, 3)
    fresh.set_parameters(friction=0.3)
    settle(fresh, 3)
    np.testing.assert_array_equal(hanging.surface(), fresh.surface())


# -- what is shown ----------------------------------------------------------------------------------------------------


def test_splats_move_with_the_body():
    """Dropped on the table: centres fall by g t (t + dt) / 2, covariances stay; no two reads share memory."""
    live = session("drop")
    before = live.splats()
    count = 12
    for _ in range(count):
        live.step()
    after, t, dt = live.splats(), count / 120.0, 1.0 / 240.0
    drop = 0.5 * 9.81 * t * (t + dt)
    np.testing.assert_allclose(after.means - before.means, np.tile([0.0, 0.0, -drop], (1500, 1)), atol=2e-6)
    np.testing.assert_allclose(after.covariances, before.covariances, atol=1e-5 * np.abs(before.covariances).max())
    assert after.colors.shape == (1500, 3) and after.opacities.shape == (1500,)
    np.testing.assert_allclose(live.energies().kinetic, 0.5 * 300.0 * 2.5e-4 * (9.81 * t) ** 2, rtol=1e-3)
    assert [mesh.label for mesh in live.meshes()] == ["world/table"]
    assert session().meshes() == () and live.poses().shape == (0, 7)


def test_energy_only_goes_down():
    """A box that is plucked and let go swings: the sum of its energies, on pins at rest, never grows."""
    live = session(material=Material(youngs_modulus=3.0e4, density=300.0, viscosity=0.0))
    settle(live, 20)
    live.set_parameters(gravity=(5.0, 0.0, -9.81))
    settle(live, 10)
    live.set_parameters(gravity=9.81)
    first = last = live.energies().total
    for _ in range(60):
        live.step()
        total = live.energies().total
        assert total <= last + 1e-4 * abs(first)
        last = total
    assert last < first


def test_pick_meets_the_near_face():
    """A ray along y meets the face at y = -0.025 within the splats' thickness; one beside the box meets nothing.

    The rest point is the point less the placement.
    """
    live = session("drop")
    centre = live.centre()
    for x, z in ((0.0, 0.0), (0.015, 0.03), (-0.02, -0.04)):
        hit = live.pick(centre + np.array([x, -1.0, z]), (0.0, 0.5, 0.0))
        assert hit is not None and hit.object_index == 0
        np.testing.assert_allclose(hit.point, centre + np.array([x, -0.025, z]), atol=2e-3)
        np.testing.assert_allclose(hit.rest_point, hit.point - centre, atol=1e-4)
        assert hit.distance == pytest.approx(1.0 + hit.point[1] - centre[1], abs=1e-9)
        assert np.linalg.norm(live.splats().means[hit.splat] - hit.point) < 6e-3
    assert live.pick(centre + np.array([0.05, -1.0, 0.0]), (0.0, 1.0, 0.0)) is None
    assert live.pick(centre + np.array([0.0, -1.0, 0.0]), (0.0, -1.0, 0.0)) is None


def test_pick_finds_the_material_point_of_a_deformed_body(hanging):
    """Where the body is bent, the rest point of a pick is carried to the point picked, within 0.5 % of the size."""
    hanging.begin_drag(side(hanging))
    hanging.drag_to(hanging.centre() + np.array([0.05, -0.03, 0.02]))
    settle(hanging)
    body = load(BOX).body
    hit = hanging.pick(hanging.drag().point + np.array([0.0, -1.0, 0.0]), (0.0, 1.0, 0.0))
    x = hit.rest_point + body.evaluate(hit.rest_point[None])[0][0] @ coordinates(hanging._scene, "q")
    assert np.linalg.norm(hit.rest_point - x) > 0.1 * SIZE
    np.testing.assert_allclose(x, hit.point, atol=5e-3 * SIZE)


# -- pulling ----------------------------------------------------------------------------------------------------------


def test_a_drag_pulls_deforms_and_lets_go(hanging):
    """The gripped point goes to the cursor, the body deforms, and after the release it comes back to where it hung."""
    rest, pinned = hanging.surface(), hanging.pins()[1].position
    hit = side(hanging)
    hanging.begin_drag(hit)
    np.testing.assert_allclose(hanging.drag().point, hit.point, atol=1e-3 * SIZE)
    np.testing.assert_array_equal(hanging.drag().force, np.zeros(3))
    target = hit.point + np.array([0.04, 0.0, 0.0])
    hanging.drag_to(target)
    settle(hanging)
    drag = hanging.drag()
    assert drag.point[0] - hit.point[0] > 0.01
    assert drag.force @ (target - drag.point) > 0.99 * np.linalg.norm(drag.force) * np.linalg.norm(target - drag.point)
    stiffness = 0.25 * SOFT.youngs_modulus * SIZE
    np.testing.assert_allclose(drag.force, stiffness * (target - drag.point), rtol=2e-3, atol=1e-4)
    np.testing.assert_allclose(hanging.pins()[1].position, pinned, atol=1e-12)
    assert hanging.status().solver == ()
    hanging.end_drag()
    settle(hanging, 90)
    np.testing.assert_allclose(hanging.surface(), rest, atol=1e-4 * SIZE)


def test_a_drag_lifts_the_weight():
    """A free box that is pulled up hangs on the cursor, below it by weight over stiffness."""
    live = session("drop", material=Material(youngs_modulus=3.0e4, density=300.0, viscosity=0.02, mass_damping=10.0))
    settle(live)
    top = live.pick(live.centre() + np.array([0.0, 0.0, 1.0]), (0.0, 0.0, -1.0))
    live.begin_drag(top)
    live.drag_to(top.point + np.array([0.0, 0.0, 0.1]))
    settle(live, 150)
    mass = 300.0 * float(np.prod(EXTENTS))
    weight = mass * 9.81
    k = max(min(0.25 * 3.0e4 * SIZE, mass * 250.0**2), weight / (0.05 * SIZE))
    drag = live.drag()
    np.testing.assert_allclose(drag.force, [0.0, 0.0, weight], atol=1e-2 * weight)
    np.testing.assert_allclose(drag.target - drag.point, [0.0, 0.0, weight / k], atol=1e-2 * weight / k)
    assert live.centre()[2] > 0.1


def test_a_wild_drag_stays_finite(hanging):
    """A cursor that jumps a metre to and fro makes nothing infinite, and all comes back.

    Its spring pulls one point with up to 50 N, where the whole section yields under E A = 75 N: two points in a hundred
    may collapse beside it.
    """
    rest = hanging.surface()
    hanging.begin_drag(side(hanging))
    for k in range(12):
        hanging.drag_to(((-1.0) ** k, 0.5, 0.2 * k))
        hanging.advance(FRAME)
        assert "not_finite" not in hanging.status().solver
    hanging.end_drag()
    settle(hanging, 120)
    assert not {"not_finite", "collapsed"} & set(hanging.status().solver)
    np.testing.assert_allclose(hanging.surface(), rest, atol=1e-3 * SIZE)


# -- pins -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hold", ["top", "base"])
@pytest.mark.parametrize("youngs_modulus", [2.0e3, 1.0e7])
def test_what_hangs_is_held(hold, youngs_modulus):
    """The held region stays within 1 % of the size under gravity, soft or stiff."""
    live = session(hold=hold, material=Material(youngs_modulus=youngs_modulus, density=1000.0, viscosity=0.01))
    settle(live, 60)
    (pin,) = live.pins().values()
    assert len(pin.points) >= 4 and pin.error < 0.01 * SIZE
    start = session(hold=hold).pins()[1].points
    np.testing.assert_allclose(pin.points, start, atol=0.01 * SIZE)


def test_a_pin_holds_moves_and_turns():
    """A box lifted off the table by a pinned region follows it through a right angle; the region keeps its shape."""
    live = session("drop")
    settle(live)
    hit = live.pick(live.centre() + np.array([0.0, 0.0, 1.0]), (0.0, 0.0, -1.0))
    number = live.pin(hit, radius=0.03)
    pin = live.pins()[number]
    before, start, centre = pin.points, pin.position, live.centre()
    goal = start + np.array([0.02, 0.0, 0.1])
    half = np.sqrt(0.5)
    for k in range(1, 16):
        angle = 0.5 * np.pi * k / 15
        live.move_pin(number, start + (goal - start) * k / 15, (np.cos(0.5 * angle), 0.0, 0.0, np.sin(0.5 * angle)))
        live.advance(FRAME)
    settle(live, 60)
    pin, turn = live.pins()[number], rotation((0, 0, 1), np.pi / 2)
    np.testing.assert_allclose(pin.position, goal, atol=1e-9)
    np.testing.assert_allclose(pin.wxyz, [half, 0.0, 0.0, half], atol=1e-9)
    np.testing.assert_allclose(pin.points, goal + (before - start) @ turn.T, atol=0.01 * SIZE)
    assert pin.error < 0.01 * SIZE
    np.testing.assert_allclose(live.centre(), goal + turn @ (centre - start), atol=0.05 * SIZE)
    live.unpin(number)
    assert live.pins() == {}
    settle(live, 60)
    assert live.centre()[2] < 0.06


def test_a_build_for_pins_goes_on_where_it_was(hanging):
    """What hangs is told of; the build runs beside the session; motion and pins stay, and the body then knows them."""
    before, pins = hanging.surface(), hanging.pins()
    assert "which was not built for it" in hanging.status().notice
    hanging.build_for_pins()
    assert hanging.status().notice.startswith("building") and hanging.pins().keys() == pins.keys()
    with pytest.raises(ConfigError, match="under way"):
        hanging.build_for_pins()
    for _ in range(6000):
        hanging.advance(FRAME)
        if not hanging.status().notice:
            break
        time.sleep(0.01)
    body = hanging._object(0).body
    assert body.regions.names == ("pin 1",) and hanging.status().notice == ""
    assert hanging.pins().keys() == pins.keys() and hanging.pins()[1].error < 0.01 * SIZE
    settle(hanging)
    np.testing.assert_allclose(hanging.surface(), before, atol=0.03 * SIZE)


def test_a_build_for_pins_needs_pins_and_sources(tmp_path):
    """Nothing is pinned, or the body was saved without what it was built from."""
    live = session("drop")
    with pytest.raises(ConfigError, match="nothing is pinned"):
        live.build_for_pins()
    live._object(0).body.save(tmp_path / "bare.npz", sources=False)
    bare = LiveSession.from_object(tmp_path / "bare.npz", options=PATIENT)
    assert "which was not built for it" in bare.status().notice
    with pytest.raises(ConfigError, match="does not keep"):
        bare.build_for_pins()


def test_pins_are_limited_and_known():
    """There are pin_max pins beside the one that holds; numbers are not used twice; what is wrong is refused."""
    live = session(options=LiveOptions(budget=1.0e6, pin_max=2))
    hit = side(live)
    assert [live.pin(hit), live.pin(hit)] == [2, 3]
    with pytest.raises(ConfigError, match="2 pins already"):
        live.pin(hit)
    live.unpin(3)
    assert live.pin(hit, 0.001) == 4 and len(live.pins()[4].points) == 4
    for call in (lambda: live.unpin(3), lambda: live.move_pin(9, (0, 0, 0))):
        with pytest.raises(ConfigError, match="there is no pin"):
            call()
    live.unpin(4)
    with pytest.raises(ConfigError, match="radius"):
        live.pin(hit, -1.0)
    for wrong in ((0, 0), (0, 0, np.nan), "abc"):
        with pytest.raises(ConfigError, match="position"):
            live.move_pin(2, wrong)
    for wrong in ((1, 0, 0), (0, 0, 0, 0), (np.inf, 0, 0, 0)):
        with pytest.raises(ConfigError, match="wxyz"):
            live.move_pin(2, (0, 0, 0), wrong)


# -- parameters -------------------------------------------------------------------------------------------------------


def test_parameters_take_effect_at_run_time():
    """A session whose parameters are set while it runs is, after a reset, the one made with them, bit by bit."""
    made = Material(
        youngs_modulus=8.0e4, poissons_ratio=0.3, density=500.0, viscosity=0.01, mass_damping=3.0, friction=0.2
    )
    one, other = session("drop", material=made), session("drop")
    settle(other, 3)
    other.set_parameters(
        youngs_modulus=8.0e4, poissons_ratio=0.3, density=500.0, viscosity=0.01, mass_damping=3.0, friction=0.2
    )
    assert other.parameters == one.parameters
    other.reset()
    for live in (one, other):
        settle(live, 10)
    np.testing.assert_array_equal(one.surface(), other.surface())
    other.set_parameters(gravity=0.0)
    assert other.parameters.gravity == (0.0, 0.0, 0.0)


def test_stiffness_and_gravity_change_what_hangs():
    """The stretch of a hanging box goes with g / E: doubled by twice the gravity, undone by twice the modulus too."""
    hanging = session(material=Material(youngs_modulus=1.2e5, density=300.0, viscosity=0.01))
    settle(hanging)

    def length(live):
        return live.pins()[1].points[:, 2].mean() - live.centre()[2]

    start, rest = session().centre(), length(session())
    first = length(hanging) - rest
    assert first > 1e-5
    hanging.set_parameters(gravity=2.0 * 9.81)
    settle(hanging, 60)
    second = length(hanging) - rest
    hanging.set_parameters(youngs_modulus=2.4e5)
    settle(hanging, 60)
    third = length(hanging) - rest
    assert second == pytest.approx(2.0 * first, rel=0.02)
    assert third == pytest.approx(first, rel=0.01)
    hanging.set_parameters(gravity=(0.0, 9.81, 0.0))
    settle(hanging, 60)
    assert hanging.centre()[1] > start[1] + 1e-4


def test_wrong_parameters_change_nothing(hanging):
    """A value out of range is refused together with those given with it."""
    before = hanging.parameters
    for wrong in (
        {"youngs_modulus": 0.0},
        {"youngs_modulus": np.nan},
        {"poissons_ratio": 0.5},
        {"density": -1.0},
        {"viscosity": -0.1},
        {"mass_damping": np.inf},
        {"friction": "much"},
        {"gravity": (0.0, 1.0)},
        {"gravity": 1.0e9},
        {"gravity": np.nan},
    ):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            hanging.set_parameters(**{"friction": 0.1, **wrong} if "friction" not in wrong else wrong)
    assert hanging.parameters == before


def test_handles_change_while_it_moves():
    """Other handles carry over shape, velocity and pins: what both bases span exactly, the rest within 1 % of size."""
    live = session()
    live.begin_drag(side(live))
    live.drag_to(live.centre() + np.array([0.03, 0.0, 0.0]))
    settle(live, 10)
    before, rest, speed = live.surface(), session().surface(), coordinates(live._scene, "qd")
    pins, elapsed = live.pins(), live.status().time
    body = load(BOX).body
    momentum = body.mean_basis @ speed
    live.set_functions(36)
    assert live.parameters.functions == 36 and live.drag() is None
    assert live.status().time == elapsed
    assert np.abs(before - rest).max() > 0.05 * SIZE
    np.testing.assert_allclose(live.surface(), before, atol=0.01 * SIZE)
    new = live._object(0).body
    np.testing.assert_allclose(
        new.mean_basis @ coordinates(live._scene, "qd"), momentum, atol=0.02 * np.linalg.norm(momentum)
    )
    (old,), (held,) = pins.values(), live.pins().values()
    np.testing.assert_array_equal(held.position, old.position)
    live.end_drag()
    settle(live, 60)
    assert live.pins()[next(iter(live.pins()))].error < 0.01 * SIZE and live.status().solver == ()
    for wrong in (-1, 9, 121, 2.5):
        with pytest.raises(ConfigError, match="function"):
            live.set_functions(wrong)


def test_pins_keep_their_numbers_when_handles_change():
    """A pin is let go by the number that `pin` gave; as many as before may be set, the one it hangs by not counted."""
    live = session(options=replace(PATIENT, pin_max=2))
    (own,) = live.pins()
    number = live.pin(side(live))
    before = live.pins()
    live.set_functions(36)
    assert list(live.pins()) == [own, number]
    for one, pin in live.pins().items():
        np.testing.assert_array_equal(pin.position, before[one].position)
    live.pin(side(live))
    with pytest.raises(ConfigError, match="2 pins already"):
        live.pin(side(live))
    live.begin_drag(side(live))  # there is room for the drag still
    live.unpin(number)
    live.unpin(own)
    live.set_functions(24)
    assert len(live.pins()) == 1


# -- cuts -------------------------------------------------------------------------------------------------------------


def finish(live, seconds=60.0):
    """Let time run until what is built in the background is done.

    The thread that builds needs Python's lock. A paused session that is never left alone made a cut take 32 s, not 1.2.
    """
    ends = time.monotonic() + seconds
    while live.status().notice.endswith("...") and time.monotonic() < ends:
        live.advance(FRAME)
        time.sleep(0.01)
    live.advance(1e-3)


def test_a_cut_lets_the_lower_half_fall():
    """Cut across while it hangs: two objects, the pin keeps its number and half, the other falls at g.

    The session goes on meanwhile, momentum and energy do not jump, a reset makes the box whole again.
    """
    live = session()
    settle(live)
    centre, count = live.centre(), len(live.splats().means)
    assert live.generation == 1
    live.pause()
    before = live.energies()
    live.cut(Patch.plane(centre, (0.2, 0.0, 1.0)))
    assert live.status().notice == "cutting ..."
    with pytest.raises(ConfigError, match="under way"):
        live.cut(Patch.plane(centre, (0.0, 0.0, 1.0)))
    finish(live)
    assert live.generation == 2 and "is cut into 2 parts" in live.status().notice
    after = live.energies()
    assert after.elastic <= before.elastic and after.kinetic <= before.kinetic * (1.0 + 1e-9)
    assert after.gravitational == pytest.approx(before.gravitational, rel=1e-6)
    assert len(live.splats().means) > count and list(live.pins()) == [1]
    upper = int(live.centre(1)[2] > live.centre(0)[2])
    assert live.pins()[1].object_index == upper
    held, start, rate = live.centre(upper), live.centre(1 - upper)[2], coordinates(live._scene, "qd", 1 - upper)
    speed = live.objects[1 - upper].body.mean_basis @ rate
    for _ in range(12):
        live.step()
    t, dt = 12 / 120.0, 1.0 / 240.0
    fall = speed[2] * t - 0.5 * 9.81 * t * (t + dt)
    assert live.centre(1 - upper)[2] - start == pytest.approx(fall, rel=0.02)
    assert np.linalg.norm(live.centre(upper) - held) < 0.2 * abs(fall)
    with pytest.raises(ConfigError, match="cut"):
        live.set_functions(16)
    live.reset()
    assert live.generation == 3 and len(live.splats().means) == count and len(live.pins()) == 1


def test_a_slit_and_a_miss():
    """A stroke that ends inside leaves one object with a slit; one beside it nothing, and says so."""
    live = session("drop")
    live.pause()
    centre = live.centre()
    live.cut(Patch.stroke(centre - np.array([0.0, 1.0, 0.0]), centre + np.array([0.0, 0.0, 0.2]), centre))
    finish(live)
    assert "has a slit" in live.status().notice and live.generation == 2
    live.cut(Patch.plane(centre + 1.0, (0.0, 0.0, 1.0)))
    finish(live)
    assert "misses" in live.status().notice and live.generation == 2


def test_an_environment_is_not_cut():
    """Its object is its own; nor is a body cut that keeps no sources, which the notice says."""
    live = LiveSession.from_object(replace(load(BOX), body=replace(load(BOX).body, sources=None)), options=PATIENT)
    live.cut(Patch.plane(live.centre(), (0.0, 0.0, 1.0)))
    finish(live)
    assert "cutting failed" in live.status().notice and live.generation == 1


def test_a_brush_makes_softer(tmp_path):
    """What it touches gives way more; undone it does not; the file keeps the field and the material."""
    live = session("drop")
    live.pause()
    hit = side(live)
    stiff = live.objects[0].body
    assert (stiff.cubature.stiffness_scale == 1.0).all()
    live.paint([hit], 0.1, radius=0.3 * SIZE, depth=0.3 * SIZE)
    finish(live)
    body = live.objects[0].body
    assert "0.1 times as stiff" in live.status().notice
    near = np.linalg.norm(body.cubature.points - hit.rest_point, axis=1)
    assert body.cubature.stiffness_scale[near.argmin()] == 0.1 and body.cubature.stiffness_scale[near.argmax()] == 1.0
    live.save(tmp_path / "painted.npz")
    again = load(tmp_path / "painted.npz")
    assert np.array_equal(again.body.cubature.stiffness_scale, body.cubature.stiffness_scale)
    assert again.material is not None and again.material.youngs_modulus == pytest.approx(SOFT.youngs_modulus)
    live.paint([hit], 0.1, radius=0.3 * SIZE, depth=0.3 * SIZE)
    finish(live)
    assert live.objects[0].body.cubature.stiffness_scale.min() == pytest.approx(0.01)
    with pytest.raises(MaterialError, match=r"0\.001"):
        live.paint([hit], 0.05, radius=0.3 * SIZE, depth=0.3 * SIZE)
    for _ in range(2):
        live.undo_paint()
    assert live.objects[0].body is stiff
    with pytest.raises(ConfigError, match="nothing is painted"):
        live.undo_paint()
    with pytest.raises(MaterialError, match="factor"):
        live.paint([hit], 1e-4, radius=0.1, depth=0.1)
    with pytest.raises(ConfigError, match="touched nothing"):
        live.paint([], 2.0, radius=0.1, depth=0.1)


# -- recording --------------------------------------------------------------------------------------------------------


def test_a_recording_of_coordinates_is_played_back(hanging, tmp_path):
    """Thirty frames a second, whatever `advance` is told; shown again, a frame has the surface it had."""
    path = tmp_path / "poke.npz"
    hanging.start_recording(path)
    assert hanging.status().recording and not path.exists()
    hanging.begin_drag(side(hanging))
    hanging.drag_to(hanging.centre() + np.array([0.05, 0.0, 0.0]))
    for _ in range(24):
        hanging.advance(1.0 / 60.0)
    kept = hanging.surface()
    with pytest.raises(ConfigError, match="is being recorded"):
        hanging.start_recording(path)
    assert hanging.stop_recording() == path
    recording = LiveRecording.load(path)
    np.testing.assert_allclose(recording.times, np.arange(13) / 30.0, atol=1e-6)
    settle(hanging, 3)
    hanging.show_frame(recording, 12)
    np.testing.assert_array_equal(hanging.surface(), kept)
    assert not hanging.status().playing
    with pytest.raises(ConfigError, match=r"0\.\.12"):
        hanging.show_frame(recording, 13)
    other = LiveSession.from_object(ObjectConfig(shape="box", extents=(0.05, 0.05, 0.05), build=BUILD))
    with pytest.raises(ConfigError, match="other objects"):
        other.show_frame(recording, 0)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(AssetError, match="damaged"):
        LiveRecording.load(path)


def test_a_recording_keeps_dents(tmp_path):
    """What stands on the table is shown again with the dents that it had: surface and splats, while it is elsewhere."""
    round_one = ObjectConfig(shape="sphere", extents=(0.05, 0.05, 0.05), build=BUILD)
    live, path = (
        LiveSession.from_object(round_one, scene="drop", material=SOFT, options=PATIENT),
        tmp_path / "stand.npz",
    )
    settle(live, 60)
    live.start_recording(path)
    settle(live, 2)
    kept, drawn = live.surface(), live.splats().means
    live.stop_recording()
    recording = LiveRecording.load(path)
    dents = recording.dent[-1]
    assert dents.shape == kept.shape and dents[:, 2].max() > 1e-5 and abs(kept[:, 2].min()) < 1e-4
    live.reset()
    assert live.surface()[:, 2].min() > 1e-3
    live.show_frame(recording, len(recording.times) - 1)
    np.testing.assert_array_equal(live.surface(), kept)
    np.testing.assert_array_equal(live.splats().means, drawn)


def test_a_recording_as_a_stage(hanging, tmp_path):
    """What is pulled, and of what it is made, comes back from an OpenUSD stage."""
    pytest.importorskip("pxr", reason="needs the extra [usd]")
    from softmode.usd import add_usd, read_animation

    path = tmp_path / "poke.usdc"
    hanging.set_parameters(youngs_modulus=3.0e4)
    hanging.start_recording(path)
    hanging.begin_drag(side(hanging))
    hanging.drag_to(hanging.centre() + np.array([0.05, 0.0, 0.0]))
    settle(hanging, 6)
    kept = hanging.surface()
    assert not path.exists() and hanging.stop_recording() == path
    (body,) = read_animation(path).bodies
    np.testing.assert_allclose(body.times, np.arange(7) / 30.0, atol=1e-6)
    np.testing.assert_allclose(body.points_at(6), kept, atol=1e-6)
    assert np.abs(body.points_at(6) - body.points_at(0)).max() > 1e-3
    (found,) = add_usd(newton.ModelBuilder(), path).bodies.values()
    assert found.material.youngs_modulus == 3.0e4


def test_a_video_shows_the_object(hanging, tmp_path):
    """The video has its frames, and its object is where the camera looks."""
    imageio = pytest.importorskip("imageio.v2")
    path = tmp_path / "poke.mp4"
    hanging.start_recording(path, edge=96)
    settle(hanging, 5)
    hanging.stop_recording()
    frames = imageio.mimread(path)
    assert len(frames) == 6 and frames[0].shape == (96, 96, 3)
    middle, corner = frames[-1][40:56, 40:56].astype(float), frames[-1][:8, :8].astype(float)
    assert np.abs(middle.mean(axis=(0, 1)) - corner.mean(axis=(0, 1))).max() > 40.0


def test_recordings_that_cannot_be(hanging, tmp_path):
    """Wrong names and places are refused, nothing to stop is said, and a closed session leaves nothing behind."""
    (tmp_path / "folder.npz").mkdir()
    for wrong, error in ((tmp_path / "poke.gif", ConfigError), (tmp_path / "folder.npz", StorageError)):
        with pytest.raises(error, match="recording"):
            hanging.start_recording(wrong)
    with pytest.raises(ConfigError, match="edge"):
        hanging.start_recording(tmp_path / "poke.mp4", edge=7)
    with pytest.raises(ConfigError, match="nothing is being recorded"):
        hanging.stop_recording()
    hanging.start_recording(tmp_path / "poke.npz")
    with pytest.raises(ConfigError, match="a recording is being made"):
        hanging.set_functions(16)
    hanging.close()
    hanging.close()
    assert [path.name for path in tmp_path.iterdir()] == ["folder.npz"]


# -- sources ----------------------------------------------------------------------------------------------------------


def test_objects_come_from_files(tmp_path):
    """A splat file, a mesh file and a saved body make sessions; a saved body has its own size and handles."""
    thing = load(BOX)
    body = tmp_path / "box.npz"
    thing.body.save(body)
    live = LiveSession.from_object(body, options=PATIENT)
    np.testing.assert_allclose(live.size, SIZE, rtol=1e-6)
    settle(live, 2)
    assert live.pick(live.centre() + np.array([0.0, -1.0, 0.0]), (0.0, 1.0, 0.0)) is not None
    with pytest.raises(ConfigError, match="cannot be given other functions"):
        live.set_functions(16)
    with pytest.raises(ConfigError, match="size"):
        LiveSession.from_object(body, size=0.1)
    write_splats(tmp_path / "box.ply", thing.splats)
    live = LiveSession.from_object(tmp_path / "box.ply", size=0.2, scene="drop", options=PATIENT)
    assert np.ptp(live.splats().means, axis=0).max() == pytest.approx(0.2, rel=0.02)
    import trimesh

    trimesh.creation.box(EXTENTS).export(tmp_path / "box.stl")
    assert LiveSession.from_object(tmp_path / "box.stl").size > 0.0
    with pytest.raises(AssetError, match="no such file"):
        LiveSession.from_object(tmp_path / "none.ply")


def test_a_model_stands_in_its_foot():
    """A cube of gel is held by its foot alone: it sags a little less than a column whose foot is free to widen."""
    live = LiveSession.from_object("jelly", options=PATIENT)
    rest = live.surface()
    settle(live, 60)
    moved = live.surface() - rest
    low = rest[:, 2] < rest[:, 2].min() + 1e-6
    assert np.abs(moved[low]).max() < 1e-9
    # that column, of 90 mm, E = 2e4 Pa, 1,000 kg/m^3: rho g h^2 / 2 E is 2.0 mm
    high = rest[:, 2] > rest[:, 2].max() - 1e-6
    assert 0.75 < -moved[high, 2].mean() / (1000.0 * 9.81 * 0.09**2 / 4.0e4) < 1.0
    with pytest.raises(ConfigError, match="size given for the model 'jelly'"):
        LiveSession.from_object("jelly", size=0.2)


def test_a_body_of_a_stage(tmp_path):
    """A mesh that a stage declares deformable comes with the stage's material and units, and has no other handles."""
    pytest.importorskip("pxr")
    (tmp_path / "cube.usda").write_text(STAGE)
    live = LiveSession.from_object(tmp_path / "cube.usda", options=PATIENT)
    assert live.size == pytest.approx(np.sqrt(3.0) * 0.1, rel=1e-3)
    assert live.parameters.youngs_modulus == pytest.approx(5.0e4, rel=1e-5)
    assert live.parameters.density == pytest.approx(120.0, rel=1e-5)
    settle(live, 30)
    assert live.pins()[1].error < 0.01 * live.size
    hit = side(live)
    assert live.pick(live.centre() + np.array([0.0, -1.0, 0.0]), (0.0, 1.0, 0.0)).object_index == hit.object_index
    with pytest.raises(ConfigError, match="cannot be given other functions"):
        live.set_functions(16)


def test_wrong_settings():
    """Settings out of range are refused by name."""
    for wrong in ({"substep": 0.0}, {"budget": 0.0}, {"pin_max": -1}, {"pin_points": 3}, {"drag_rate": np.nan}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            LiveOptions(**wrong)
    for wrong in ({"scene": "fly"}, {"hold": "left"}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            LiveSession.from_object(BOX, **wrong)
    with pytest.raises(ConfigError, match="unknown environment"):
        LiveSession.from_env("softmode/None-v0")
    with pytest.raises(ConfigError, match="unknown policy"):
        LiveSession.from_env(policy="nobody")
    live = session()
    for wrong in (np.nan, -1.0, "1"):
        with pytest.raises(ConfigError, match="frame_dt"):
            live.advance(wrong)
    with pytest.raises(ConfigError, match="nothing is dragged"):
        live.drag_to((0, 0, 0))
    for origin, direction in (((0, 0), (0, 0, 1)), ((0, 0, 0), (0, 0, np.inf)), ((0, 0, 0), (0, 0, 0))):
        with pytest.raises(ConfigError, match=r"origin|direction"):
            live.pick(origin, direction)
    with pytest.raises(ConfigError, match="object_index"):
        live.surface(1)


# -- environments -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def lifting():
    """LiftSoft with a small plush, played by the script."""
    live = LiveSession.from_env("softmode/LiftSoft-v0", policy="scripted", seed=3, options=PATIENT)
    yield live
    live.close()


def test_an_environment_goes_on_while_its_object_is_pulled(lifting):
    """The robot moves by its policy and the object by the hand; the reward's terms are told."""
    lifting.reset()
    before, poses = lifting.centre(), lifting.poses()
    hit = lifting.pick(before + np.array([0.0, 0.0, 1.0]), (0.0, 0.0, -1.0))
    lifting.begin_drag(hit)
    lifting.drag_to(hit.point + np.array([-0.1, 0.15, 0.1]))
    settle(lifting, 20)
    moved = lifting.centre() - before
    np.testing.assert_allclose(moved, [-0.1, 0.15, 0.1], atol=0.05)
    drag = lifting.drag()
    assert np.linalg.norm(drag.target - drag.point) < 0.02
    assert np.abs(lifting.poses() - poses).max() > 0.01
    assert lifting.poses().shape[1] == 7 and len(lifting.meshes()) > 10
    assert set(lifting.status().reward_terms) == {"reach", "grasp", "lift", "goal", "hold", "gentle"}
    lifting.end_drag()
    settle(lifting, 20)
    assert lifting.centre()[2] < before[2] + 0.03


def test_the_time_limit_waits_while_something_is_held(lifting):
    """150 control steps end an episode; while a region is pinned it goes on, and the next begins after the release."""
    lifting.reset()
    episode = lifting.status().episode
    number = lifting.pin(lifting.pick(lifting.centre() + np.array([0.0, 0.0, 1.0]), (0.0, 0.0, -1.0)))
    for _ in range(155):
        lifting.step()
    assert lifting.status().episode == episode and lifting.status().time == pytest.approx(155 / 30.0)
    assert lifting.pins()[number].error < 0.01 * lifting.size
    lifting.unpin(number)
    lifting.advance(FRAME)
    assert lifting.status().episode == episode + 1 and lifting.status().time == 0.0


def test_parameters_outlast_episodes(lifting):
    """What is set stays through resets, which draw the rest anew; without gravity the object stays in the air."""
    lifting.set_parameters(youngs_modulus=7.0e4, gravity=0.0)
    lifting.reset()
    assert lifting.parameters.youngs_modulus == pytest.approx(7.0e4)
    hit = lifting.pick(lifting.centre() + np.array([0.0, 0.0, 1.0]), (0.0, 0.0, -1.0))
    number = lifting.pin(hit)
    lifting.move_pin(number, hit.point + np.array([-0.1, 0.2, 0.1]))
    settle(lifting, 30)
    lifting.unpin(number)
    height = lifting.centre()[2]
    settle(lifting, 10)
    assert lifting.centre()[2] == pytest.approx(height, abs=0.02) and height > 0.1
    lifting.set_parameters(gravity=9.81)


def test_idle_grips_leave_an_environment_as_it_is():
    """Nobody touching anything, the session is the environment played by its script, bit by bit."""
    import gymnasium as gym

    from softmode.envs.scripted import scripted_policy

    config = LiftSoftConfig(scene=lift_scene())
    live = LiveSession.from_env("softmode/LiftSoft-v0", config=config, seed=5, options=PATIENT)
    env = gym.make("softmode/LiftSoft-v0", config=config)
    observation, _ = env.reset(seed=5)
    policy = scripted_policy(env)
    for _ in range(40):
        live.step()
        observation, *_ = env.step(policy(observation))
    base: Any = env.unwrapped
    np.testing.assert_array_equal(coordinates(live._scene, "q"), base.scene.state.softmode.q.numpy())
    live.close()
    env.close()
