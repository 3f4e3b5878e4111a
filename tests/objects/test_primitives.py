"""Primitive shapes and meshes as soft objects: volume, area, splats, pattern, bending, what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import newton
import numpy as np
import pytest
import trimesh
from scipy.integrate import solve_bvp
from trimesh.visual import ColorVisuals

from softmode.deformables import BuildOptions, Material
from softmode.deformables.model.authoring import add_pins, add_reduced_body
from softmode.deformables.quadrature.quadrature_mesh import cap_holes
from softmode.errors import ConfigError
from softmode.objects import ObjectConfig, SoftObject, load, pipeline, task_objects
from softmode.objects.shapes.primitives import checker, primitive_mesh, primitive_quadrature
from softmode.objects.source import object_source
from softmode.splats import ColoredMesh
from softmode.splats.splats import rotations_from_quats
from tests.marks import rest_but
from tests.scenes import GRAVITY, Scene

R, L = 0.02, 0.1
SHAPES = {
    "box": (("box", (L, 0.05, R)), L * 0.05 * R, 2 * (L * 0.05 + 0.05 * R + R * L)),
    "rod": (("cylinder", (L, 2 * R, 2 * R)), np.pi * R**2 * L, 2 * np.pi * R * (R + L)),
    "disc": (("cylinder", (L, L, R)), np.pi * L**2 / 4 * R, np.pi * L * (L / 2 + R)),
    "capsule": (("capsule", (2 * R, L, 2 * R)), np.pi * R**2 * (L - 2 * R / 3), 2 * np.pi * R * L),
    "sphere": (("sphere", (L, L, L)), np.pi / 6 * L**3, np.pi * L**2),
}


@pytest.mark.parametrize("name", SHAPES)
def test_solid_has_the_closed_form_volume_area_and_bounds(name: str) -> None:
    """Volumes of all shapes and areas of all but the 64-sided cylinder are exact; samples lie on the surface."""
    (shape, extents), volume, area = SHAPES[name]
    found = primitive_quadrature(shape, extents, 100)
    assert found.weights.sum() == pytest.approx(volume, rel=1e-9)
    assert found.surface_areas.sum() == pytest.approx(area, rel=1e-9 if shape != "cylinder" else (np.pi / 64) ** 2)
    polygon = 1.0 if shape != "cylinder" else 1.0 + (np.pi / 64) ** 2
    assert (np.abs(found.surface_points) <= 0.5 * polygon * np.array(extents) * (1 + 1e-6)).all()
    np.testing.assert_allclose(np.ptp(found.bounds, axis=0), extents, rtol=(np.pi / 64) ** 2)
    np.testing.assert_allclose(found.weights @ found.points / volume, 0.0, atol=1e-4 * L)


@pytest.mark.parametrize("name", SHAPES)
def test_mesh_is_closed_and_as_large_as_the_solid(name: str) -> None:
    """The surface that is drawn encloses the volume that moves, to what facets of a 64th of a turn cut off."""
    (shape, extents), volume, _ = SHAPES[name]
    mesh = primitive_mesh(shape, extents)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(volume, rel=(np.pi / 32) ** 2)
    np.testing.assert_allclose(np.ptp(mesh.bounds, axis=0), extents, rtol=(np.pi / 64) ** 2)


@pytest.mark.parametrize("name", rest_but(["box", "capsule"], SHAPES))
def test_splats_lie_flat_on_the_surface_in_two_colours(name: str) -> None:
    """Centres lie on the mesh, third axes point outward, and both colours cover between a third and two thirds."""
    (shape, extents), _, _ = SHAPES[name]
    config = ObjectConfig(shape=shape, extents=extents, splat_count=600, colors=((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    splats = object_source(config).splats
    assert splats.count == 600
    mesh = primitive_mesh(shape, extents)  # convex: the distance is the largest to the planes of its faces
    height = (mesh.face_normals * mesh.triangles_center).sum(axis=1)
    np.testing.assert_allclose((splats.means @ mesh.face_normals.T - height).max(axis=1), 0.0, atol=1e-6)
    outward = rotations_from_quats(splats.quats)[:, :, 2]
    assert ((outward * splats.means).sum(axis=1) > 0.0).all()
    red = splats.colors()[:, 0] > splats.colors()[:, 2]
    assert 1 / 3 < red.mean() < 2 / 3
    np.testing.assert_array_equal(red, checker(splats.means) == 0)


def test_checker_stripes_a_beam_and_checks_a_cube() -> None:
    """Cells are cubes: a beam 8:1:1 has eight along x and one across, a cube four along each axis."""
    rng = np.random.default_rng(0)
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    unit = np.concatenate([corners, rng.random((500, 3))])
    np.testing.assert_array_equal(checker(unit * [8.0, 1.0, 1.0]), np.minimum(8 * unit[:, 0], 7).astype(int) % 2)
    np.testing.assert_array_equal(checker(unit), np.minimum(4 * unit, 3).astype(int).sum(axis=1) % 2)


def write_mesh(path: Path, *, closed: bool) -> None:
    """Write a red box 0.2 x 0.1 x 0.1 as a mesh, y up, or a sphere with a hole at its top."""
    mesh = trimesh.creation.box((0.1, 0.2, 0.1))
    if not closed:
        mesh = trimesh.creation.icosphere(3, 0.1)
        mesh.update_faces(mesh.triangles_center[:, 1] < 0.085)
    mesh.visual = ColorVisuals(mesh, face_colors=(255, 0, 0, 255))
    mesh.export(path)


def test_mesh_file_becomes_a_body_of_its_size_and_colour(tmp_path: Path) -> None:
    """A glTF file has y up; size is the longest edge; the red stays but for the painted light."""
    write_mesh(tmp_path / "box.glb", closed=True)
    config = ObjectConfig(mesh=tmp_path / "box.glb", size=0.1, splat_count=300, surface_count=100)
    thing = load(config.changed(build=BuildOptions(mode_count=2, kernel_count=60, cubature_count=48)))
    np.testing.assert_allclose(np.ptp(thing.body.bounds, axis=0), (0.05, 0.05, 0.1), rtol=1e-5)
    assert thing.body.volume == pytest.approx(0.05**2 * 0.1, rel=1e-5)
    assert thing.height == pytest.approx(0.05, rel=1e-5)
    color = thing.splats.colors()
    assert (color[:, 0] > 0.5).all() and (color[:, 1:] < 0.01).all()


def test_open_mesh_stands_for_what_it_encloses(tmp_path: Path) -> None:
    """The hole of a sphere is capped flat: the volume is the sphere's less that of the cap that is missing."""
    write_mesh(tmp_path / "shell.ply", closed=False)
    mesh = trimesh.load_mesh(tmp_path / "shell.ply")
    config = ObjectConfig(mesh=tmp_path / "shell.ply", size=0.1, up="+y", splat_count=300, surface_count=100)
    found = object_source(config).integrate()  # what a body is built from
    assert found.report["capped_holes"] == 1
    hull = mesh.convex_hull  # closes the hole flat too
    assert found.volume == pytest.approx(hull.volume * (0.1 / np.ptp(mesh.vertices, axis=0).max()) ** 3, rel=5e-3)


def test_box_without_a_face_keeps_its_size() -> None:
    """A box of 50 mm without its lid is 50 mm in every direction, and as large as the box."""
    box = trimesh.creation.box((0.05, 0.05, 0.05))
    box.update_faces(box.triangles_center[:, 2] < 0.0249)
    config = ObjectConfig(mesh=ColoredMesh.from_trimesh(box), size=0.05, splat_count=300, surface_count=100)
    found = object_source(config).integrate()
    np.testing.assert_allclose(np.ptp(found.bounds, axis=0), 0.05, rtol=1e-6)
    assert found.volume == pytest.approx(0.05**3, rel=1e-6)


def test_cap_holes_closes_every_rim() -> None:
    """A tube has two rims; with both capped it is closed, oriented and a prism. A closed mesh has none."""
    tube = trimesh.creation.cylinder(0.02, 0.1, sections=24)
    open_ = tube.submesh([np.abs(tube.face_normals[:, 2]) < 0.5], append=True)
    assert isinstance(open_, trimesh.Trimesh) and not open_.is_watertight
    vertices, faces, holes = cap_holes(open_.vertices, open_.faces)
    closed = trimesh.Trimesh(vertices, faces)
    assert holes == 2 and closed.is_watertight and closed.is_winding_consistent
    assert closed.volume == pytest.approx(tube.volume, rel=1e-9)
    assert cap_holes(tube.vertices, tube.faces)[2] == 0


def test_shape_comes_from_the_cache_the_second_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A second load builds nothing and gives the same object; other colours share the body, other samples do not."""
    monkeypatch.setenv("SOFTMODE_CACHE", str(tmp_path))
    first = load(task_objects.CUBE)
    monkeypatch.setattr(pipeline, "build_body", lambda *_, **__: pytest.fail("built again"))
    second = load(task_objects.CUBE)
    np.testing.assert_array_equal(first.basis, second.basis)
    np.testing.assert_array_equal(first.splats.sh, second.splats.sh)
    painted = load(replace(task_objects.CUBE, colors=((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))))
    assert painted.body.fingerprint == first.body.fingerprint
    with pytest.raises(pytest.fail.Exception, match="built again"):
        load(replace(task_objects.CUBE, surface_count=150))


def hang(thing: SoftObject, material: Material, half: float) -> np.ndarray:
    """Hold a slender body at its middle, let it come to rest; return the mean drop and reach of its ends [m]."""
    held = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]) * thing.height * 0.6

    def populate(world: newton.ModelBuilder) -> None:
        add_reduced_body(world, thing.body, material=replace(material, viscosity=0.05))
        add_pins(world, 0, held, stiffness=1e4)

    scene = Scene(populate, [thing.body], gravity=(0.0, 0.0, -GRAVITY), dt=0.02)
    scene.step(100)
    assert np.abs(scene.qd()).max() < 2e-3
    ends = np.array([[half, 0.0, 0.0], [-half, 0.0, 0.0], [0.0, 0.0, 0.0]])
    x = ends + thing.body.evaluate(ends)[0] @ scene.q()
    assert x[0, 2] == pytest.approx(x[1, 2], abs=0.02 * half)
    return np.array([x[2, 2] - x[:2, 2].mean(), 0.5 * (x[0, 0] - x[1, 0])])


def heavy_elastica(load: float, cap: float = 0.0) -> np.ndarray:
    """Return drop and reach of the tip over the length of a clamped inextensible rod under w L^3 / (E I) = load.

    EI theta'' = -W(s) cos theta with theta(0) = theta'(L) = 0, theta below the horizontal, W the weight beyond s: that
    of a cylinder whose last `cap` of the length is a half ball, which lacks a third of it and drops 3.6 % less.
    """

    def beyond(s: np.ndarray) -> np.ndarray:
        into = np.clip(s - (1.0 - cap), 0.0, None) / max(cap, 1e-12)
        return np.where(into > 0.0, cap * (2.0 / 3.0 - into + into**3 / 3.0), 1.0 - s - cap / 3.0)

    s = np.linspace(0.0, 1.0, 101)
    found = solve_bvp(
        lambda s, y: np.stack([y[1], -load * beyond(s) * np.cos(y[0])]),
        lambda a, b: np.array([a[0], b[1]]),
        s,
        np.stack([np.tanh(5.0 * s), np.zeros_like(s)]),
        tol=1e-8,
    )
    assert found.success
    angle = found.sol(np.linspace(0.0, 1.0, 2001))[0]
    return np.trapezoid(np.stack([np.sin(angle), np.cos(angle)]), dx=1.0 / 2000)


@pytest.mark.parametrize("modulus", [2.0e6, 6.0e5])
def test_rope_bends_like_a_heavy_elastica(modulus: float) -> None:
    """Ends drop by 0.28 and 0.61 of their length, the elastica's to 2 %: neither locked nor torn."""
    half, radius = 0.5 * task_objects.ROPE.extents[0], 0.5 * task_objects.ROPE.extents[1]  # type: ignore[index]
    material = replace(task_objects.ROPE_MATERIAL, youngs_modulus=modulus, density=1000.0)
    pull = 1000.0 * GRAVITY * 4.0 * half**3 / (modulus * radius**2)
    np.testing.assert_allclose(
        hang(load(task_objects.ROPE), material, half) / half, heavy_elastica(pull, radius / half), rtol=0.02
    )


def test_beam_sags_like_a_timoshenko_beam() -> None:
    """Drop of the ends: the elastica's and shear's w L^2 / (2 k G A), k = 10 (1 + nu) / (12 + 11 nu), to 4 %."""
    material, half, edge = task_objects.BEAM_MATERIAL, 0.15, 0.04
    E, nu = material.youngs_modulus, material.poissons_ratio
    weight = material.density * GRAVITY * edge**2
    bending = half * heavy_elastica(12.0 * weight * half**3 / (E * edge**4))[0]
    shear = weight * half**2 * (1.0 + nu) * (12.0 + 11.0 * nu) / (E * edge**2 * 10.0 * (1.0 + nu))
    assert hang(load(task_objects.BEAM), material, half)[0] == pytest.approx(bending + shear, rel=0.04)


@pytest.mark.parametrize("name", ["BEAM", "CUBE", "PAD", "ROPE"])
def test_presets_are_small(name: str) -> None:
    """At most 48 functions, 384 cubature points, 200 samples and 3,000 splats; centred, standing on their height."""
    config = getattr(task_objects, name)
    thing = load(config)
    assert thing.body.function_count <= 48 and thing.body.point_count <= 384
    assert thing.body.surface_count <= 200 and 1000 <= thing.splats.count <= 3000
    assert thing.height == pytest.approx(0.5 * config.extents[2], rel=0.02)


@pytest.mark.parametrize(
    "given",
    [
        {"shape": "cone", "extents": (0.1, 0.1, 0.1)},
        {"extents": (0.1, 0.1, 0.1)},
        {"shape": "box"},
        {"shape": "box", "extents": (0.1, 0.1)},
        {"shape": "box", "extents": (0.1, 0.1, float("nan"))},
        {"shape": "sphere", "extents": (0.1, 0.1, 0.2)},
        {"shape": "cylinder", "extents": (0.1, 0.2, 0.3)},
        {"shape": "capsule", "extents": (0.1, 0.1, 0.05)},
        {"shape": "box", "extents": (0.1, 0.1, 0.1), "mesh": "a.obj"},
        {"mesh": "a.obj", "splat": "a.ply"},
        {"colors": ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))},
        {"shape": "box", "extents": (0.1, 0.1, 0.1), "colors": ((0.0, 0.0, 0.0), (1.0, 1.0, 2.0))},
        {"splat_count": 0},
        {"surface_count": 0},
    ],
)
def test_what_does_not_fit_is_refused(given: dict) -> None:
    """Every contradiction is an error when the configuration is made."""
    with pytest.raises(ConfigError):
        ObjectConfig(**given)
