"""Meshes of a model's shapes: sizes in closed form, what is shown, where it is."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import newton
import numpy as np
import pytest
import warp as wp

from softmode.errors import ConfigError
from softmode.scenes import scene_meshes, scene_poses
from softmode.scenes.meshes import SEGMENTS

TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
TETRAHEDRON_FACES = np.array([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3], np.int32)
FACETS = 1.0 - np.sinc(2.0 / SEGMENTS)
"""Relative volume that a cylinder loses to its facets: the inscribed polygon has sin(2 pi/n)/(2 pi/n) of the disc."""


def _one(add: str, **given: Any) -> Any:
    builder = newton.ModelBuilder()
    getattr(builder, add)(-1, **given)
    (mesh,) = scene_meshes(builder.finalize(device="cpu"))
    return mesh


@pytest.mark.parametrize(
    ("add", "given", "half", "volume", "loss"),
    [
        ("add_shape_box", {"hx": 0.1, "hy": 0.2, "hz": 0.3}, (0.1, 0.2, 0.3), 8 * 0.006, 1e-6),
        ("add_shape_sphere", {"radius": 0.2}, (0.2,) * 3, 4 / 3 * math.pi * 0.008, 3 * FACETS),
        (
            "add_shape_capsule",
            {"radius": 0.1, "half_height": 0.3},
            (0.1, 0.1, 0.4),
            math.pi * (0.006 + 0.004 / 3),
            0.05,
        ),
        ("add_shape_cylinder", {"radius": 0.1, "half_height": 0.3}, (0.1, 0.1, 0.3), math.pi * 0.006, 1.01 * FACETS),
        ("add_shape_cone", {"radius": 0.1, "half_height": 0.3}, (0.1, 0.1, 0.3), math.pi * 0.002, 1.01 * FACETS),
        ("add_shape_ellipsoid", {"rx": 0.1, "ry": 0.2, "rz": 0.3}, (0.1, 0.2, 0.3), 0.008 * math.pi, 3 * FACETS),
        (
            "add_shape_mesh",
            {"mesh": newton.Mesh(TETRAHEDRON, TETRAHEDRON_FACES), "scale": (0.1, 0.2, 0.3)},
            (0.1, 0.2, 0.3),
            0.001,
            1e-6,
        ),
        (
            "add_shape_convex_hull",
            {"mesh": newton.Mesh(TETRAHEDRON, TETRAHEDRON_FACES), "scale": (-0.1, 0.2, 0.3)},
            (0.1, 0.2, 0.3),
            0.001,
            1e-6,
        ),
    ],
)
def test_bounds_and_volume(
    add: str, given: dict[str, Any], half: tuple[float, ...], volume: float, loss: float
) -> None:
    """Bounds are the shape's; the volume is the closed form less what facets lose; faces outwards, turned too."""
    mesh = _one(add, **given)
    np.testing.assert_allclose(np.abs(mesh.vertices).max(axis=0), half, rtol=1e-2 if loss > 1e-3 else 1e-6)
    assert (np.abs(mesh.vertices) <= np.array(half) * (1 + 1e-6)).all()
    assert volume * (1.0 - loss) <= mesh.volume <= volume * (1.0 + 1e-6)
    corners = mesh.vertices[mesh.faces].astype(float)
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    real = np.linalg.norm(facing, axis=1) > 1e-9
    assert (np.einsum("fj,fkj->fk", facing, mesh.normals[mesh.faces])[real] > 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-5)
    turn = wp.quat_rpy(0.3, -0.4, 0.5)
    turned = _one(add, **given, xform=wp.transform(wp.vec3(0.1, 0.2, 0.3), turn))
    R = np.array(wp.quat_to_matrix(turn)).reshape(3, 3)
    np.testing.assert_allclose(turned.vertices, mesh.vertices @ R.T + [0.1, 0.2, 0.3], atol=1e-6)
    np.testing.assert_allclose(turned.normals, mesh.normals @ R.T, atol=1e-5)


def test_meshes_are_cut_along_creases() -> None:
    """A cube of eight corners gets the six normals of its faces; a fine sphere keeps its corners and radial normals."""
    box = newton.Mesh.create_box(0.1, 0.1, 0.1, duplicate_vertices=False, compute_normals=False, compute_inertia=False)
    cube = _one("add_shape_mesh", mesh=newton.Mesh(box.vertices, box.indices))
    assert len(cube.vertices) == 24
    assert len(np.unique(cube.normals.round(6), axis=0)) == 6
    ball = newton.Mesh.create_sphere(0.1, compute_normals=False, compute_inertia=False)
    sphere = _one("add_shape_mesh", mesh=newton.Mesh(ball.vertices, ball.indices))
    assert len(sphere.vertices) < 1.05 * len(ball.vertices)
    np.testing.assert_allclose(sphere.normals, sphere.vertices / 0.1, atol=0.1)


def test_plane_is_a_quad() -> None:
    """A finite plane keeps its size, an infinite one gets the size asked for; both face along their normal."""
    builder = newton.ModelBuilder()
    builder.add_shape_plane(width=0.4, length=0.6)
    builder.add_ground_plane()
    finite, ground = scene_meshes(builder.finalize(device="cpu"), plane_extent=3.0)
    assert finite.area == pytest.approx(0.24, rel=1e-6)
    assert ground.area == pytest.approx(9.0, rel=1e-6)
    np.testing.assert_allclose(ground.normals, np.tile([0.0, 0.0, 1.0], (len(ground.normals), 1)))


def test_what_is_shown_is_what_cameras_see() -> None:
    """Invisible shapes and those of other worlds are left out, shared ones belong to every world."""
    world = newton.ModelBuilder()
    body = world.add_body(label="link")
    hidden = newton.ModelBuilder.ShapeConfig(is_visible=False)
    world.add_shape_box(body, hx=0.1, hy=0.1, hz=0.1, label="seen")
    world.add_shape_box(body, hx=0.1, hy=0.1, hz=0.1, label="seen")
    world.add_shape_box(body, hx=0.1, hy=0.1, hz=0.1, label="collider", cfg=hidden)
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    builder.replicate(world, 3)
    model = builder.finalize(device="cpu")
    scenes = [scene_meshes(model, world=w) for w in range(3)]
    for w, meshes in enumerate(scenes):
        assert [mesh.label.rsplit("/", 1)[-1] for mesh in meshes] == ["ground_plane", "seen", "seen_2"]
        assert [mesh.body for mesh in meshes] == [-1, w, w]
    with pytest.raises(ConfigError, match="world"):
        scene_meshes(model, world=3)
    with pytest.raises(ConfigError, match="plane_extent"):
        scene_meshes(model, plane_extent=float("nan"))


def test_vertices_are_in_the_frame_of_the_body() -> None:
    """World points are T_body T_shape X: both the shape on its body and the body are turned and moved."""
    quarter = math.sqrt(0.5)
    builder = newton.ModelBuilder()
    body = builder.add_body(xform=wp.transform((1.0, 0.0, 0.0), wp.quat(0.0, 0.0, quarter, quarter)))
    shape = wp.transform((0.0, 0.0, 0.5), wp.quat(quarter, 0.0, 0.0, quarter))
    builder.add_shape_box(body, xform=shape, hx=0.1, hy=0.2, hz=0.3)
    builder.add_shape_box(-1, hx=0.1, hy=0.1, hz=0.1)
    model = builder.finalize(device="cpu")
    state = model.state()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    meshes = scene_meshes(model)
    poses = scene_poses(meshes, state)
    # about x, half extents (0.1, 0.2, 0.3) become (0.1, 0.3, 0.2); then the body's quarter turn about z
    np.testing.assert_allclose(meshes[0].vertices.min(axis=0), [-0.1, -0.3, 0.3], atol=1e-6)
    np.testing.assert_allclose(meshes[0].vertices.max(axis=0), [0.1, 0.3, 0.7], atol=1e-6)
    np.testing.assert_allclose(poses[0], [1.0, 0.0, 0.0, 0.0, 0.0, quarter, quarter], atol=1e-6)
    np.testing.assert_array_equal(poses[1], [0, 0, 0, 0, 0, 0, 1])


def test_all_of_an_environment_is_there() -> None:
    """Every visible shape of the arm and the table has a mesh, and each link has some."""
    env: Any = gym.make("softmode/LiftSoft-v0")
    try:
        model = env.unwrapped.scene.model
        meshes = scene_meshes(model)
        assert {mesh.shape for mesh in meshes} == set(range(model.shape_count))
        assert {mesh.body for mesh in meshes} == set(range(-1, model.body_count))
        assert len({mesh.label for mesh in meshes}) == len(meshes)
        assert "world/table" in {mesh.label for mesh in meshes}
        assert all(mesh.volume > 0.0 for mesh in meshes)
    finally:
        env.close()
