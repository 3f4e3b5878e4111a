"""Coloured meshes, the splats sampled on them, and the pictures of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import warp as wp
from PIL import Image
from scipy.spatial import KDTree
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from softmode.errors import AssetError, ConfigError
from softmode.objects.mesh_file import read_mesh
from softmode.splats.colored_mesh import GREY, ColoredMesh
from softmode.splats.fit.reference_views import orbit_poses, render_mesh
from softmode.splats.mesh_samples import sample_mesh
from softmode.splats.splats import rotations_from_quats
from tests.splats.meshes import bumpy_sphere, painted_box, smooth_texture, two_objects

CORNERS = np.eye(3)


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> str:
    """Every device that is there."""
    if request.param != "cpu" and not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    return request.param


# -- colour -----------------------------------------------------------------------------------------------------------


def textured_square(pixels: np.ndarray, uv: np.ndarray) -> ColoredMesh:
    """Return one triangle pair over the unit square with texture coordinates uv, shape (4, 2)."""
    material = SimpleMaterial(image=Image.fromarray(pixels))
    visual = TextureVisuals(uv=uv, material=material)
    points = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    return ColoredMesh.from_trimesh(trimesh.Trimesh(points, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False))


@pytest.mark.parametrize("turn", [-2, 0, 3])
def test_texture_lookup_is_bilinear_with_v_up_and_repeats(turn: int) -> None:
    """Texel (row j, column i) of an h x w image sits at u = (i + 1/2) / w + k, v = 1 - (j + 1/2) / h + k."""
    pixels = np.random.default_rng(0).integers(0, 256, (3, 5, 3), dtype=np.uint8)
    mesh = textured_square(pixels, np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) + turn)
    j, i = np.mgrid[0:3, 0:5].reshape(2, -1)
    x, y = (i + 0.5) / 5, 1 - (j + 0.5) / 3
    lower = x >= y  # triangle 0 holds (0, 0), (1, 0), (1, 1)
    weights = np.where(lower[:, None], np.stack([1 - x, x - y, y], 1), np.stack([1 - y, x, y - x], 1))
    colors = mesh.colors_at(np.where(lower, 0, 1), weights)
    np.testing.assert_allclose(colors, pixels.reshape(-1, 3) / 255, atol=1e-5)
    between = mesh.colors_at([0], [[0.5, 0.5, 0.0]])  # (1/2, 0): half of the last row, half of the first, repeated
    np.testing.assert_allclose(between[0], (pixels[2, 2] / 2 + pixels[0, 2] / 2) / 255, atol=1e-4)


def test_vertex_and_face_colors_are_taken_as_they_are() -> None:
    """Vertex colours are interpolated, face colours are constant, and a mesh without any is grey."""
    points, rng = CORNERS + 1.0, np.random.default_rng(1)
    chosen = rng.integers(0, 256, (3, 3), dtype=np.uint8)
    vertex = ColoredMesh.from_trimesh(trimesh.Trimesh(points, [[0, 1, 2]], vertex_colors=chosen, process=False))
    weights = rng.dirichlet(np.ones(3), 7)
    np.testing.assert_allclose(vertex.colors_at(np.zeros(7, int), weights), weights @ chosen / 255, atol=1e-6)
    face = ColoredMesh.from_trimesh(trimesh.Trimesh(points, [[0, 1, 2]], face_colors=chosen[:1], process=False))
    np.testing.assert_allclose(face.colors_at([0], weights[:1])[0], chosen[0] / 255, atol=1e-6)
    plain = ColoredMesh.from_trimesh(trimesh.Trimesh(points, [[0, 1, 2]], process=False))
    np.testing.assert_allclose(plain.colors_at([0], weights[:1])[0], GREY, atol=1e-6)


def test_materials_without_a_texture_color_the_mesh() -> None:
    """A .obj material's diffuse colour is gamma-encoded; glTF's base colour is linear: 0.5 becomes 188/255."""
    uv = np.zeros((3, 2))
    simple = SimpleMaterial(diffuse=[10, 200, 128, 255])
    metallic = PBRMaterial(baseColorFactor=[0, 255, 128, 255])
    for material, expected in ((simple, [10, 200, 128]), (metallic, [0, 255, 188])):
        visual = TextureVisuals(uv=uv, material=material)
        mesh = ColoredMesh.from_trimesh(trimesh.Trimesh(CORNERS, [[0, 1, 2]], visual=visual, process=False))
        np.testing.assert_allclose(255 * mesh.colors_at([0], [[0.2, 0.3, 0.5]])[0], expected, atol=0.5)


@pytest.mark.parametrize("kind", ["glb", "obj", "ply"])
def test_a_file_gives_the_mesh_that_was_saved(kind: str, tmp_path: Path) -> None:
    """Textures survive .glb and .obj, vertex colours survive .glb and .ply: the colours at equal points are equal."""
    for name, mesh in (("texture", bumpy_sphere(24, 12)), ("vertex", painted_box())):
        if (name, kind) in (("texture", "ply"), ("vertex", "obj")):
            continue
        file = tmp_path / name / f"toy.{kind}"
        file.parent.mkdir()
        mesh.export(file)
        read, known = read_mesh(file), ColoredMesh.from_trimesh(mesh)
        assert len(read.corners) == len(known.corners) and len(read.textures) == len(known.textures)
        centers = [np.full((len(m.corners), 3), 1 / 3) for m in (read, known)]
        index = np.arange(len(known.corners))
        nearest = KDTree(read.corners.mean(axis=1)).query(known.corners.mean(axis=1))[1]
        got, expected = read.colors_at(nearest, centers[0]), known.colors_at(index, centers[1])
        np.testing.assert_allclose(got, expected, atol=2 / 255)


def test_a_scene_is_one_mesh_with_every_part_in_place() -> None:
    """Every geometry is placed by its node, and keeps its own colour."""
    mesh = ColoredMesh.from_trimesh(two_objects())
    sphere = mesh.corners.mean(axis=1)[:, 0] > 0.5
    np.testing.assert_allclose(mesh.corners[sphere].mean(axis=(0, 1)), [1.0, 0.2, 0.0], atol=0.02)
    weights = np.full((len(mesh.corners), 3), 1 / 3)
    colors = mesh.colors_at(np.arange(len(mesh.corners)), weights)
    assert len(mesh.textures) == 1 and np.ptp(colors[sphere], axis=0).min() > 0.4
    expected = ColoredMesh.from_trimesh(painted_box())
    np.testing.assert_allclose(colors[~sphere], expected.corner_colors.mean(axis=1), atol=1e-6)


@pytest.mark.parametrize("case", ["missing", "unknown", "damaged", "points", "flat", "empty"])
def test_files_without_a_surface_are_refused(case: str, tmp_path: Path) -> None:
    """Each error names the file and a remedy."""
    file = tmp_path / f"{case}.ply"
    mesh = trimesh.creation.icosphere(subdivisions=1)
    if case == "unknown":
        file = tmp_path / "toy.docx"
        file.write_bytes(b"PK")
    elif case == "damaged":
        file = tmp_path / "toy.glb"
        mesh.export(file)
        file.write_bytes(file.read_bytes()[:200])
    elif case == "points":
        trimesh.PointCloud(mesh.vertices).export(file)
    elif case == "flat":
        trimesh.Trimesh(mesh.vertices * [1, 0, 0], mesh.faces, process=False).export(file)
    elif case == "empty":
        file.write_bytes(b"")
    with pytest.raises(AssetError, match=file.name) as caught:
        read_mesh(file)
    assert caught.value.hint


def test_positions_that_are_not_finite_are_refused() -> None:
    """A mesh with NaN among its corners is no surface."""
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, np.nan], [0.0, 1.0, 0.0]])
    with pytest.raises(AssetError, match="NaN"):
        ColoredMesh.from_trimesh(trimesh.Trimesh(points, [[0, 1, 2]], process=False, validate=False))


# -- samples ----------------------------------------------------------------------------------------------------------


def test_samples_lie_on_the_surface_flat_and_evenly() -> None:
    """On a sphere: |X| = 1, the third axis along X, a least distance near the largest possible one, moments integrated.

    Independent points have no least distance and integrate to 1 / sqrt(count).
    """
    count = 1000
    mesh = ColoredMesh.from_trimesh(trimesh.creation.icosphere(subdivisions=5))
    splats = sample_mesh(mesh, count)
    assert splats.count == count
    radius = np.linalg.norm(splats.means, axis=1)
    np.testing.assert_allclose(radius, 1.0, atol=1e-3)
    axis = rotations_from_quats(splats.quats)[:, :, 2]
    assert (np.abs(np.einsum("ni,ni->n", axis, splats.means)) > 0.998).all()
    assert (splats.scales[:, 2] < 0.2 * splats.scales[:, :2].min(axis=1)).all()
    gap = KDTree(splats.means).query(splats.means, k=2)[0][:, 1]
    largest = 2.0 * np.sqrt(mesh.area / (2.0 * np.sqrt(3.0) * count))
    assert gap.min() > 0.55 * largest
    independent = 1.0 / np.sqrt(count)
    assert np.abs(splats.means.mean(axis=0)).max() < 0.3 * independent
    second = splats.means.T @ splats.means / count
    assert np.abs(second - np.eye(3) / 3.0).max() < 0.3 * independent


def test_both_sides_of_a_thin_plate_get_their_share() -> None:
    """A plate as thin as a twentieth of the spacing has count / 2 splats on either side, evenly spread."""
    count = 400
    spacing = np.sqrt(2.0 / count)
    plate = trimesh.creation.box((1.0, 1.0, 0.05 * spacing))
    splats = sample_mesh(ColoredMesh.from_trimesh(plate), count)
    upper = splats.means[:, 2] > 0
    assert abs(int(upper.sum()) - count // 2) <= 0.05 * count
    gap = KDTree(splats.means[upper]).query(splats.means[upper], k=2)[0][:, 1]
    assert gap.min() > 0.5 * spacing


def test_a_fine_texture_is_averaged() -> None:
    """Stripes far below the spacing have the mean colour of black and white, within the noise of the drawn points."""
    stripes = np.zeros((4, 1024, 3), np.uint8)
    stripes[:, ::2] = 255
    mesh = textured_square(stripes, np.array([[0, 0], [1, 0], [1, 1], [0, 1]]))
    colors = sample_mesh(mesh, 200).colors()
    assert abs(colors.mean() - 0.5) < 0.05
    assert colors.std() < 0.29  # that of single points is 0.5 / sqrt(3) or more


def test_samples_repeat_with_the_seed() -> None:
    """Equal seeds give equal splats, others do not; a count of zero is refused."""
    mesh = ColoredMesh.from_trimesh(bumpy_sphere(24, 12))
    first, again, other = (sample_mesh(mesh, 50, seed=seed) for seed in (3, 3, 4))
    assert np.array_equal(first.means, again.means) and np.array_equal(first.sh, again.sh)
    assert not np.array_equal(first.means, other.means)
    with pytest.raises(ConfigError, match="count"):
        sample_mesh(mesh, 0)


# -- pictures ---------------------------------------------------------------------------------------------------------


def test_coverage_of_a_sphere_is_that_of_its_outline(device: str) -> None:
    """A sphere of radius r at distance d is seen as a disc of radius f r / sqrt(d^2 - r^2), area to 1 %."""
    mesh = ColoredMesh.from_trimesh(trimesh.creation.icosphere(subdivisions=5, radius=0.5))
    poses = orbit_poses(3, 2.0, np.random.default_rng(0))
    views = render_mesh(mesh, poses, (60, 60, 32, 32), width=64, height=64, device=device)
    expected = np.pi * (60 * 0.5 / np.sqrt(2.0**2 - 0.5**2)) ** 2
    alpha = views.alpha.numpy()
    np.testing.assert_allclose(alpha.sum(axis=(1, 2)), expected, rtol=0.01)
    np.testing.assert_allclose(views.rgb.numpy(), np.repeat(GREY * alpha[..., None], 3, axis=3), atol=1e-6)
    np.testing.assert_allclose(views.on((1, 0, 0))[..., 0], 1 - (1 - GREY) * alpha, atol=1e-6)


def test_pictures_agree_with_newtons_camera() -> None:
    """Newton's `SensorCamera` draws the same albedo of the same textured mesh from the same pose, to 8 bits.

    Both see one ray through the middle of each pixel. Pixels that a rim of the mesh crosses are left out.
    """
    import newton
    from newton.sensors import SensorCamera

    size, focal = 48, 60.0
    source = bumpy_sphere()
    visual: Any = source.visual
    views = render_mesh(
        ColoredMesh.from_trimesh(source), orbit_poses(4, 1.5, np.random.default_rng(2)),
        (focal, focal, size / 2, size / 2), width=size, height=size, samples=1,
    )  # fmt: skip
    builder = newton.ModelBuilder()
    builder.begin_world()
    mesh = newton.Mesh(
        source.vertices, source.faces.reshape(-1), uvs=visual.uv, texture=smooth_texture(), compute_inertia=False
    )
    builder.add_shape_mesh(-1, mesh=mesh, color=(1.0, 1.0, 1.0))
    builder.end_world()
    model = builder.finalize(device="cpu")
    camera = SensorCamera(model)
    rays = SensorCamera.compute_camera_rays_pinhole(
        size, size, camera_fov=2.0 * np.arctan(0.5 * size / focal), device="cpu"
    )
    poses = np.linalg.inv(views.world_to_camera.astype(np.float64))
    frames = []
    for pose in poses:
        turn = wp.quat_from_matrix(wp.mat33(*(pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])).reshape(-1)))  # OpenGL axes
        frames.append(wp.transform(wp.vec3(*pose[:3, 3]), turn))
    albedo: Any = camera.allocate_image_albedo(len(poses), size, size)
    camera.update(
        model.state(), wp.array(frames, dtype=wp.transform, device="cpu"), rays, albedo_image=albedo,
        world_indices=wp.zeros(len(poses), dtype=wp.int32, device="cpu"),
        render_config=SensorCamera.RenderConfig(enable_textures=True),
    )  # fmt: skip
    theirs = albedo.numpy().view(np.uint8).reshape(len(poses), size, size, 4)
    both = (theirs[..., 3] > 0) & (views.alpha.numpy() > 0)
    assert ((theirs[..., 3] > 0) != (views.alpha.numpy() > 0)).mean() < 0.005
    error = np.abs(theirs[..., :3] / 255.0 - views.rgb.numpy())[both]
    assert np.quantile(error, 0.99) < 2.5 / 255.0
