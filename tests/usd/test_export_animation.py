"""`UsdAnimation` and `read_animation`: states to rounding, baked splats equal to skinned ones, meshes in place."""

from __future__ import annotations

import dataclasses
import importlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables.model.authoring import add_reduced_body
from softmode.errors import AssetError, ConfigError, SolverDiverged, StorageError
from softmode.objects import Placed, SoftObject
from softmode.scenes import BoundSplats
from softmode.splats.formats import read_usd
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.splats import rotations_from_quats
from softmode.usd import (
    UsdAnimation,
    UsdAnimationOptions,
    UsdExportOptions,
    add_usd,
    read_animation,
    write_usd,
)
from softmode.usd.dents import Dents
from tests.usd.export_scenes import (
    KINDS,
    MATERIAL,
    assert_same,
    assert_same_splats,
    small_body,
    small_splats,
    some_state,
)

pytest.importorskip("pxr", reason="needs the extra [usd]")
Gf, Usd, UsdGeom = (importlib.import_module(f"pxr.{name}") for name in ("Gf", "Usd", "UsdGeom"))
EPSILON = float(np.finfo(np.float32).eps)
FRAMES = 4
BAKED = UsdAnimationOptions(mode="baked")


def sample_total(scene: Scene) -> int:
    """Return how many surface samples the model of a scene has."""
    return scene.state.softmode.dent.shape[0]


class Scene:
    """Two worlds of a box and two bars, one of them scaled; states are set, not simulated."""

    def __init__(self, *kinds: str, coefficients: int = 1) -> None:
        """Build the model."""
        world = newton.ModelBuilder()
        box = world.add_body(xform=wp.transform((0.0, 0.0, 0.05), wp.quat_identity()), label="box")
        world.add_shape_box(box, hx=0.05, hy=0.03, hz=0.02)
        self.scales = [1.0, 1.3][: len(kinds)]
        for kind, scale in zip(kinds, self.scales, strict=True):
            add_reduced_body(world, small_body(kind), material=MATERIAL, scale=scale)
        builder = newton.ModelBuilder()
        builder.replicate(world, 2)
        builder.add_ground_plane()
        self.model: Any = builder.finalize(device="cpu")
        self.state: Any = self.model.state()
        self.bodies = [
            Placed(object=SoftObject(body=small_body(kind), splats=small_splats(coefficients))) for kind in kinds
        ]

    def move(self, frame: int) -> list[np.ndarray]:
        """Set the state of a frame; return the coordinates of the bodies of world 1."""
        q = self.state.softmode.q.numpy()
        start = self.model.softmode.function_start.numpy()
        last = []
        for i, first in enumerate(start):
            k = i % len(self.bodies)
            body = self.bodies[k].body
            values = some_state(body, seed=10 * frame + i, scale=self.scales[k])
            q[first : first + body.function_count] = values
            last.append(values)
        self.state.softmode.q.assign(q)
        poses = self.state.body_q.numpy()
        half = 0.3 * frame
        poses[1] = (0.1 * frame, 0.2, 0.3, 0.0, 0.0, np.sin(half), np.cos(half))
        self.state.body_q.assign(poses)
        return last[len(self.bodies) :]

    def record(self, path: Path, options: UsdAnimationOptions | None = None) -> list[list[np.ndarray]]:
        """Record world 1; return its states."""
        states = []
        with UsdAnimation(path, self.model, self.bodies, world=1, options=options) as animation:
            for frame in range(FRAMES):
                states.append(self.move(frame))
                animation.record(self.state, 0.1 * frame)
        return states


@pytest.mark.parametrize("kind", KINDS)
def test_handles_hold_the_states(tmp_path: Path, kind: str) -> None:
    """The reduced coordinates come back to rounding in float64, with bodies, materials and splats exact."""
    scene = Scene("affine", kind)
    states = scene.record(tmp_path / "a.usdc")
    found = read_animation(tmp_path / "a.usdc")
    assert found.fps == 30.0 and len(found.bodies) == 2
    for k, played in enumerate(found.bodies):
        body = scene.bodies[k].body
        assert_same(played.object.body, body)
        assert played.object.splats is not None
        assert_same_splats(played.object.splats, scene.bodies[k].splats or played.object.splats)
        np.testing.assert_allclose(played.times, 0.1 * np.arange(FRAMES), atol=1e-15)
        expected = np.array([frame[k] for frame in states])
        rounding = np.finfo(float).eps * np.linalg.cond(body.transform) * len(body.transform)
        np.testing.assert_allclose(played.coordinates, expected, atol=rounding * np.abs(expected).max())
        surface = body.surface.points + body.surface.basis.astype(float) @ expected[2]
        np.testing.assert_allclose(played.points_at(2), surface, atol=1e-12)
    again = add_usd(newton.ModelBuilder(), tmp_path / "a.usdc")  # the first frame as a scene to go on from
    assert [body.material for body in again.bodies.values()] == [MATERIAL, MATERIAL]
    np.testing.assert_allclose([body.scale for body in again.bodies.values()], scene.scales, rtol=EPSILON)


@pytest.mark.parametrize("options", [None, BAKED])
def test_dents_come_back(tmp_path: Path, options: UsdAnimationOptions | None) -> None:
    """Surface and splats are played with the dents that they had, in the world of a scaled and turned body.

    Splats are those that cameras draw. A frame in which nothing was touched has none, and a stage neither.
    """
    scene, surfaces, means = Scene("affine", "regions"), [], []
    bound, rng = (
        BoundSplats(scene.model, [placed.object for placed in scene.bodies], worlds=[1]),
        np.random.default_rng(5),
    )
    data, body = scene.model.softmode, scene.bodies[1].body
    first = int(data.particle_start.numpy()[3])
    dents = np.zeros((FRAMES, sample_total(scene), 3), dtype=np.float32)
    for frame in (0, 2, 3):
        touched = first + rng.choice(body.surface_count, 7, replace=False)
        dents[frame, touched] = 1e-3 * rng.normal(size=(7, 3))
    with UsdAnimation(tmp_path / "a.usdc", scene.model, scene.bodies, world=1, options=options) as animation:
        for frame in range(FRAMES):
            q = scene.move(frame)[1]
            scene.state.softmode.dent.assign(dents[frame])
            animation.record(scene.state, 0.1 * frame)
            bound.update(scene.state)
            means.append(bound.frames()[0, 1].means)
            surfaces.append(body.surface.points + body.surface.basis.astype(float) @ q)
    plain, played = read_animation(tmp_path / "a.usdc").bodies
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert not plain.dents_at(0).any() and not stage.GetPrimAtPath(plain.path).HasAttribute("softmode:dents")
    for frame in range(FRAMES):
        given = dents[frame, first : first + body.surface_count]
        np.testing.assert_allclose(played.dents_at(frame), given, atol=4 * EPSILON * 3e-3)
        np.testing.assert_allclose(played.points_at(frame), surfaces[frame] + given, atol=4 * EPSILON * 3e-3)
        assert len(played.dents[frame].samples) == (0 if frame == 1 else 7)
        np.testing.assert_allclose(played.splats_at(frame).means, means[frame], atol=8 * EPSILON)
    bare = dataclasses.replace(played, dents=(Dents.of(np.zeros((1, 3))),) * FRAMES)
    assert np.abs(bare.splats_at(2).means - means[2]).max() > 1e-4
    if options is BAKED:
        seen = read_usd(tmp_path / "a.usdc", time_code=6.0).means[-len(means[2]) :]
        np.testing.assert_allclose(seen, means[2], atol=8 * EPSILON)


def test_dents_of_other_samples_are_refused(tmp_path: Path) -> None:
    """Indices that no sample has, and vectors that are no numbers."""
    for name, value in (("softmode:dents:samples", [10_000]), ("softmode:dents", [(float("nan"), 0.0, 0.0)])):
        scene = Scene("affine")
        scene.state.softmode.dent.assign(np.eye(sample_total(scene), 3, -sample_total(scene) // 2, dtype=np.float32))
        scene.record(tmp_path / "a.usda")
        stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
        assert read_animation(tmp_path / "a.usda").bodies[0].dents_at(0).any()
        stage.GetPrimAtPath("/World/bar_affine").GetAttribute(name).Set(value, 3.0)
        stage.GetRootLayer().Save()
        with pytest.raises(AssetError, match="its dents are not those of"):
            read_animation(tmp_path / "a.usda")


@pytest.mark.parametrize(("kind", "coefficients"), [("affine", 1), ("quadratic", 4), ("regions", 1)])
def test_baked_is_what_handles_play(tmp_path: Path, kind: str, coefficients: int) -> None:
    """Splats of a baked stage, read as any tool would, equal those skinned from the handles to float32 rounding."""
    scene = Scene(kind, coefficients=coefficients)
    scene.record(tmp_path / "baked.usdc", BAKED)
    scene.record(tmp_path / "handles.usdc")
    (played,) = read_animation(tmp_path / "handles.usdc").bodies
    (same,) = read_animation(tmp_path / "baked.usdc").bodies
    np.testing.assert_array_equal(played.coordinates, same.coordinates)
    reach = float(np.abs(played.splats_at(0).means).max())
    for frame in (0, FRAMES - 1):
        expected = played.splats_at(frame)
        seen = read_usd(tmp_path / "baked.usdc", time_code=frame * 3.0)
        np.testing.assert_allclose(seen.means, expected.means, atol=4 * EPSILON * reach)
        sigma = expected.covariances()
        np.testing.assert_allclose(seen.covariances(), sigma, atol=16 * EPSILON * np.abs(sigma).max())
        np.testing.assert_array_equal(seen.opacities, expected.opacities)
        np.testing.assert_allclose(
            seen.sh, expected.sh, atol=1e-4 if coefficients > 1 else 0.0
        )  # rotations are float32
    moved = np.abs(played.splats_at(1).means - played.splats_at(2).means).max()
    assert moved > 1e-3  # the frames differ by far more than the tolerance


def test_simulation_points_are_baked(tmp_path: Path) -> None:
    """Points in the world at a frame are X + sum_k b_k q_k at the cubature points."""
    scene = Scene("affine")
    states = scene.record(tmp_path / "a.usda", BAKED)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    prim = UsdGeom.Points.Get(stage, "/World/bar_affine/Simulation")
    body = scene.bodies[0].body
    for frame in range(FRAMES):
        matrix = np.array(UsdGeom.XformCache(3.0 * frame).GetLocalToWorldTransform(prim.GetPrim()))
        local = np.array(prim.GetPointsAttr().Get(3.0 * frame), dtype=float)
        expected = body.cubature.points + body.evaluate(body.cubature.points)[0] @ states[frame][0]
        np.testing.assert_allclose(local @ matrix[:3, :3] + matrix[3, :3], expected, atol=2 * EPSILON)


def test_rigid_bodies_are_in_place(tmp_path: Path) -> None:
    """Meshes once, their place sampled; what does not move has one; the other world is not there."""
    scene = Scene("affine")
    scene.record(tmp_path / "a.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    boxes = [prim for prim in stage.Traverse() if prim.GetParent().GetName() == "box"]
    assert [prim.GetTypeName() for prim in boxes] == ["Mesh"]
    mesh = UsdGeom.Mesh(boxes[0])
    assert not mesh.GetPointsAttr().GetNumTimeSamples()
    assert len(np.unique(np.array(mesh.GetPointsAttr().Get()), axis=0)) == 8
    color = scene.model.shape_color.numpy()[1]
    shown = np.array(mesh.GetDisplayColorAttr().Get())[0]  # linear, where the model has sRGB
    np.testing.assert_allclose(1.055 * shown ** (1 / 2.4) - 0.055, color, atol=1e-6)
    for frame in range(FRAMES):
        matrix = np.array(UsdGeom.XformCache(3.0 * frame).GetLocalToWorldTransform(boxes[0]))
        angle = 0.6 * frame
        turn = [[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]]  # of rows
        np.testing.assert_allclose(matrix[:3, :3], turn, atol=4 * EPSILON)
        np.testing.assert_allclose(matrix[3, :3], (0.1 * frame, 0.2, 0.3), atol=EPSILON)
    ground = stage.GetPrimAtPath("/World/Rigid/world")
    assert len(ground.GetChildren()) == 1 and not UsdGeom.Xform(ground).TransformMightBeTimeVarying()


def test_without_handles_bodies_move_rigidly(tmp_path: Path) -> None:
    """The frame of a body follows its centre of mass, so that a tool that knows no handles shows it where it is."""
    scene = Scene("affine")
    states = scene.record(tmp_path / "a.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, pytest.approx(9.0))
    assert stage.GetTimeCodesPerSecond() == 30.0
    prim = stage.GetPrimAtPath("/World/bar_affine")
    body = scene.bodies[0].body
    for frame in range(FRAMES):
        matrix = np.array(UsdGeom.XformCache(3.0 * frame).GetLocalToWorldTransform(prim))
        np.testing.assert_allclose(matrix[3, :3], body.mean_basis @ states[frame][0], atol=1e-12)
    samples = prim.GetAttribute("softmode:handles").GetNumTimeSamples()
    assert samples == FRAMES
    assert not stage.GetPrimAtPath("/World/bar_affine/Splats").GetAttribute("positions").GetNumTimeSamples()


def test_recordings_have_camera_light_and_whole_time_codes(tmp_path: Path) -> None:
    """The default camera sees all bodies in all frames; a given one is that pinhole; codes are whole."""
    scene, view = Scene("affine"), PinholeCamera.look_at("eye", position=(1, 0, 0.5), target=(0, 0, 0), fov_y=0.6)
    with UsdAnimation(tmp_path / "a.usdc", scene.model, scene.bodies, world=1) as animation:
        for frame in range(FRAMES):
            scene.move(frame)
            animation.record(scene.state, frame / 96.0)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert stage.GetTimeCodesPerSecond() == 480.0 and stage.GetFramesPerSecond() == 30.0
    assert stage.GetPrimAtPath("/World/bar_affine").GetAttribute("softmode:handles").GetTimeSamples() == [0, 5, 10, 15]
    assert {prim.GetTypeName() for prim in stage.GetPrimAtPath("/World/Lights").GetChildren()} == {
        "DomeLight",
        "DistantLight",
    }
    (camera,) = stage.GetPrimAtPath("/World/Cameras").GetChildren()
    frustum = UsdGeom.Camera(camera).GetCamera(0).frustum
    for frame in range(FRAMES):
        for x in read_animation(tmp_path / "a.usdc").bodies[0].points_at(frame):
            assert frustum.Intersects(Gf.Vec3d(*x.tolist()))
    scene.record(tmp_path / "b.usdc", UsdAnimationOptions(cameras=(view,)))
    stage = Usd.Stage.Open(str(tmp_path / "b.usdc"))
    (camera,) = stage.GetPrimAtPath("/World/Cameras").GetChildren()
    seen = UsdGeom.Camera(camera).GetCamera(0).frustum
    assert camera.GetName() == "eye" and not seen.Intersects(Gf.Vec3d(2.0, 0.0, 1.0))
    matrix = np.array(seen.ComputeViewMatrix()) @ np.array(seen.ComputeProjectionMatrix())
    point = np.array([0.1, 0.05, 0.02, 1.0]) @ matrix
    x, y, z = rotations_from_quats(np.array([view.quat]))[0].T @ (np.array([0.1, 0.05, 0.02]) - view.position)
    expected = 2.0 * np.array([view.fx * x / z + view.cx, view.fy * y / z + view.cy]) / (view.width, view.height) - 1.0
    np.testing.assert_allclose(point[:2] / point[3], expected * (1.0, -1.0), atol=1e-5)


def test_half_precision_of_a_baked_stage(tmp_path: Path) -> None:
    """Positions are off by half a step of a half, counted from the centre of the body and not from the world's."""
    scene = Scene("affine")
    scene.record(tmp_path / "a.usdc", BAKED)
    half = UsdAnimationOptions(mode="baked", export=UsdExportOptions(splats="half"), sh_degree=0)
    scene.record(tmp_path / "b.usdc", half)
    for code in (0.0, 6.0):
        exact, rough = (read_usd(tmp_path / f"{name}.usdc", time_code=code) for name in "ab")
        error = np.abs(rough.means - exact.means)
        assert 0.0 < error.max() <= 2.0**-11 * 0.1  # the bar is 0.1 m long and lies 0.6 m from the origin


def test_colours_are_cut(tmp_path: Path) -> None:
    """`sh_degree` cuts the degree of the colours, never raises it."""
    scene = Scene("affine", coefficients=9)
    scene.record(tmp_path / "a.usdc", UsdAnimationOptions(mode="baked", sh_degree=1))
    scene.record(tmp_path / "b.usdc", UsdAnimationOptions(sh_degree=3))
    assert read_usd(tmp_path / "a.usdc").sh_degree == 1 and read_usd(tmp_path / "b.usdc").sh_degree == 2


def test_validators_find_nothing(tmp_path: Path) -> None:
    """All validators that OpenUSD registers pass a baked stage and one of handles with rigid meshes."""
    scene = Scene("affine", "quadratic")
    scene.record(tmp_path / "a.usdc", BAKED)
    scene.record(tmp_path / "b.usda")
    script = (
        "import json, sys; from pxr import Usd, UsdValidation as V\n"
        "every = V.ValidationRegistry().GetOrLoadAllValidators()\n"
        "found = [[e.GetErrorAsString() for e in V.ValidationContext(every).Validate(Usd.Stage.Open(name))]"
        " for name in sys.argv[1:]]; print(json.dumps([len(every), *found]))"
    )
    files = [str(tmp_path / "a.usdc"), str(tmp_path / "b.usda")]
    done = subprocess.run([sys.executable, "-c", script, *files], capture_output=True, text=True, check=True)
    count, *found = json.loads(done.stdout.splitlines()[-1])
    assert count >= 20 and found == [[], []]


def test_file_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    """An error in the block, or nothing recorded, leaves no file; nor does a place that cannot be written."""
    scene = Scene("affine")
    with pytest.raises(KeyboardInterrupt), UsdAnimation(tmp_path / "a.usdc", scene.model, scene.bodies) as animation:
        animation.record(scene.state)
        raise KeyboardInterrupt
    with UsdAnimation(tmp_path / "a.usdc", scene.model, scene.bodies) as empty:
        pass
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ConfigError, match="no frame"):
        empty.publish()
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match=r"a\.usdc"):
        UsdAnimation(tmp_path / "file" / "a.usdc", scene.model, scene.bodies)
    deep = UsdAnimation(tmp_path / "deep" / "er" / "a.usdc", scene.model, scene.bodies)
    deep.record(scene.state)
    (tmp_path / "deep").touch()  # something came in the way meanwhile
    with pytest.raises(StorageError, match=r"a\.usdc"):
        deep.publish()
    (tmp_path / "deep").unlink()
    deep.publish()
    assert deep.frame_count == 1 and [path.name for path in deep.path.parent.iterdir()] == ["a.usdc"]


def test_bad_arguments(tmp_path: Path) -> None:
    """What cannot be recorded is refused when it happens, by name."""
    scene = Scene("affine", "quadratic")
    with pytest.raises(ConfigError, match="world must lie in"):
        UsdAnimation(tmp_path / "a.usdc", scene.model, scene.bodies, world=2)
    with pytest.raises(ConfigError, match="another order"):
        UsdAnimation(tmp_path / "a.usdc", scene.model, scene.bodies[::-1])
    with pytest.raises(ConfigError, match="holds 2 soft bodies"):
        UsdAnimation(tmp_path / "a.usdc", scene.model, scene.bodies[:1])
    with pytest.raises(ConfigError, match=r"\.mp4"):
        UsdAnimation(tmp_path / "a.mp4", scene.model, scene.bodies)
    for bad in ({"mode": "both"}, {"fps": 0.0}, {"sh_degree": 4}):
        with pytest.raises(ConfigError, match=next(iter(bad))):
            UsdAnimationOptions(**bad)  # type: ignore[arg-type]
    animation = UsdAnimation(tmp_path / "a.usdc", scene.model, scene.bodies)
    animation.record(scene.state)
    animation.record(scene.state)
    for time in (1.0 / 30.0, float("nan")):
        with pytest.raises(ConfigError, match="time"):
            animation.record(scene.state, time)
    scene.state.softmode.q.fill_(float("nan"))
    with pytest.raises(SolverDiverged, match="not finite"):
        animation.record(scene.state)
    assert animation.frame_count == 2


def test_what_is_no_animation_is_refused(tmp_path: Path) -> None:
    """A stage without samples, a damaged file, and handles of another count."""
    write_usd(tmp_path / "a.usdc", Placed(object=SoftObject(body=small_body("affine"))))
    with pytest.raises(AssetError, match="no animated body"):
        read_animation(tmp_path / "a.usdc")
    (tmp_path / "b.usdc").write_bytes((tmp_path / "a.usdc").read_bytes()[:5000])
    with pytest.raises(AssetError, match=r"b\.usdc"):
        read_animation(tmp_path / "b.usdc")
    Scene("affine").record(tmp_path / "c.usda")
    stage = Usd.Stage.Open(str(tmp_path / "c.usda"))
    handles = stage.GetPrimAtPath("/World/bar_affine").GetAttribute("softmode:handles")
    handles.Set(handles.Get(0.0)[:2], 3.0)
    stage.GetRootLayer().Save()
    with pytest.raises(AssetError, match=r"c\.usda"):
        read_animation(tmp_path / "c.usda")
