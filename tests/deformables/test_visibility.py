"""Kernels see distances through the material: not across gaps and cuts, and around inner corners.

Builds forks whose prongs see each other or not, which is what it tests.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.rkpm import BasisRKPM, make_basis
from softmode.deformables.quadrature.octants import octants_of
from softmode.deformables.quadrature.quadrature import quadrature_from_implicit, quadrature_from_mesh
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.cut import cut_body
from softmode.deformables.reduction.kernel_detours import find_detours
from softmode.deformables.reduction.kernel_visibility import Material, divide_at_gaps, hidden_points, material_of
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.reduction.patch import Patch
from softmode.deformables.reduction.sources import unpack_sources
from softmode.errors import AssetError, BasisError
from softmode.files import write_archive
from softmode.objects.shapes.primitives import scaled, turned
from tests.bodies import brick, changed
from tests.marks import rest_but
from tests.shapes import voxels

EDGE = 0.01


def fork(gap: int = 1) -> np.ndarray:
    """Return bricks of two fingers, 2 x 2 bricks thick, on a palm, `gap` bricks apart."""
    mask = np.zeros((4 + gap, 2, 8), dtype=bool)
    mask[:, :, :2] = True
    mask[:2] = mask[2 + gap :] = True
    return mask


def integrate(mask: np.ndarray, point_count: int = 1000) -> Quadrature:
    """Return points of bricks."""
    return quadrature_from_mesh(*voxels(mask, (EDGE,) * 3), point_count=point_count, surface_count=200)


def divided(quadrature: Quadrature, kernel_count: int = 200) -> tuple[BasisRKPM, BasisRKPM]:
    """Return kernels whose distances are straight lines, and those whose distances run through the material."""
    assert quadrature.cells is not None
    whole = make_basis(quadrature.points, kernel_count, spacing=quadrature.spacing)
    material = material_of(quadrature.cells, np.zeros(3))
    assert material is not None
    octants = octants_of(quadrature.cells, np.zeros(3))
    assert octants is not None
    return whole, divide_at_gaps(whole, material, quadrature.points, quadrature.spacing, octants)


@pytest.fixture(scope="module")
def body() -> ReducedBody:
    """A fork of few functions."""
    options = BuildOptions(function_count=24, cubature_count=96)
    return build_body(integrate(fork()), options, progress=False)


def test_a_kernel_acts_within_its_support_on_what_is_connected_there() -> None:
    """On a U of five points, the kernel at one end sees the other only if its support holds the whole way."""
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [1.0, 0.0, -1.0], [2.0, 0.0, 0.0], [2.0, 0.0, 1.0]])
    links = np.array([[0, 1], [1, 2], [2, 3], [3, 4]])
    material = Material(points=points, first=np.arange(5), links=links, part=np.zeros(5, dtype=np.intp), step=0.1)
    assert np.concatenate(hidden_points(material, points[:1], np.array([2.05]))).tolist() == [4]
    assert not hidden_points(material, points[:1], np.array([2.3]))
    two = dataclasses.replace(material, part=np.array([0, 0, 0, 0, 1]))
    assert not hidden_points(two, points[:1], np.array([2.05]))


def test_ways_around_an_inner_corner() -> None:
    """Across the corner of an L of full bricks the way is |a - c| + |c - b|, and counts as its third power."""
    mask = np.zeros((4, 2, 4), dtype=bool)
    mask[:2] = mask[:, :, :2] = True
    quadrature = integrate(mask, 2000)
    assert quadrature.cells is not None
    octants = octants_of(quadrature.cells, np.zeros(3))
    assert octants is not None
    centre, corner = quadrature.points[((quadrature.points - [0.018, 0.01, 0.026]) ** 2).sum(axis=1).argmin()], 0.02
    found = find_detours(octants, centre[None], np.array([0.03]))
    assert found is not None
    added = np.zeros(len(octants.points))
    added[found.pairs] = found.lengths
    x, z = octants.points[:, 0], octants.points[:, 2]
    way = np.hypot(centre[0] - corner, centre[2] - corner) + np.hypot(x - corner, z - corner)
    way = np.hypot(way, octants.points[:, 1] - centre[1])
    straight = np.linalg.norm(octants.points - centre, axis=1)
    beside = (x - centre[0]) * (corner - centre[2]) > (corner - centre[0]) * (z - centre[2])
    shadow = (added > 1e-3) & (straight * (way / straight) ** 3 < 0.03)
    assert shadow.sum() > 20 and (x[shadow] > corner).all()
    # A way turns in the octants at the corner, less than half an octant from it.
    length = straight * (1.0 + added / straight) ** (1.0 / 3.0)
    assert np.abs(length - way)[shadow].max() < 0.3 * octants.steps.max()
    lit = (z > corner) | (x < centre[0])
    assert (added[lit] == 0.0).all() and not beside[lit & (added > 0.0)].any()


def test_detours_turn_and_scale_with_the_object() -> None:
    """An object that was laid down and enlarged after it was integrated has the same ways, and kernels, there."""
    quadrature = integrate(fork(), 2000)
    rotation = Rotation.from_rotvec([0.3, -0.7, 1.1]).as_matrix()
    large = scaled(quadrature, 2.5)
    other = turned(large, rotation, large.surface_points)
    centres = quadrature.points[::9]
    found = []
    for one, at, size in ((quadrature, centres, 1.0), (other, 2.5 * centres @ rotation.T, 2.5)):
        assert one.cells is not None
        octants = octants_of(one.cells, at[0])
        assert octants is not None
        detours = find_detours(octants, at - at[0], np.full(len(at), 0.03 * size))
        assert detours is not None
        found.append((detours, at - at[0], one.points - at[0]))
    (here, _, x), (there, _, y) = found
    np.testing.assert_array_equal(here.pairs, there.pairs)
    np.testing.assert_allclose(2.5 * here.lengths, there.lengths, atol=1e-6)
    first, second = (
        table.added(places, len(centres), slopes=True)
        for table, places in ((here, x + 1e-4), (there, y + 2.5e-4 * rotation.sum(axis=1)))
    )
    np.testing.assert_allclose(2.5 * first[0].toarray(), second[0].toarray(), atol=1e-6)
    slopes = [np.stack([along.toarray() for along in one[1:]], axis=2) for one in (first, second)]
    np.testing.assert_allclose(slopes[0] @ rotation.T, slopes[1], atol=1e-3)


def test_functions_go_on_into_a_gap() -> None:
    """Between two leaves, where a point is within reach of a kernel that does not act there, evaluation goes on.

    Values are finite, and affine motions come back exactly.
    """
    leaves = [trimesh.creation.box((0.08, 0.03, 0.003)) for _ in range(2)]
    for leaf, angle in zip(leaves, (-0.25, 0.25), strict=True):
        leaf.apply_translation((0.036, 0.0, 0.0))
        leaf.apply_transform(trimesh.transformations.rotation_matrix(angle, (0.0, 1.0, 0.0)))
    mesh: Any = trimesh.util.concatenate(leaves)
    quadrature = quadrature_from_mesh(mesh.vertices, mesh.faces, point_count=1500, surface_count=200)
    found = build_body(quadrature, BuildOptions(function_count=24, cubature_count=96), progress=False)
    low, high = found.bounds
    x = np.random.default_rng(0).uniform(1.2 * low - 0.2 * high, 1.2 * high - 0.2 * low, (3000, 3))
    ratio, centre = found.raw.reach(x)
    clamped = centre + (x - centre) / np.maximum(ratio, 1.0)[:, None]
    assert not found.raw.covered(clamped).all()
    stretch = np.diag([1.1, 1.2, 0.9])
    back = found.evaluate(x)[0] @ found.affine(stretch)
    np.testing.assert_allclose(back, x @ (stretch - np.eye(3)), atol=1e-10)


def test_fingers_share_no_kernel_and_linear_functions_are_reproduced() -> None:
    """At the tips of a fork no kernel acts on both fingers; sums and gradients are those of X and of 1."""
    quadrature = integrate(fork())
    whole, kernels = divided(quadrature)
    x = quadrature.points
    tip = x[:, 2] > 6 * EDGE
    left, right = tip & (x[:, 0] < 2.5 * EDGE), tip & (x[:, 0] > 2.5 * EDGE)

    def shared(basis: BasisRKPM) -> int:
        value = basis.evaluate(x).value
        return len(np.intersect1d(value[left].indices, value[right].indices))

    assert shared(whole) > 20 and shared(kernels) == 0
    found, h = kernels.evaluate(x), float(kernels.support.mean())
    assert np.abs(found.value.sum(axis=1) - 1.0).max() < 1e-12
    assert np.abs(found.value @ kernels.centres - x).max() < 1e-12
    for d, gradient in enumerate(found.gradient):
        assert np.abs(gradient @ kernels.centres - np.eye(3)[d]).max() < 1e-10 / h


def test_gradients_beside_a_gap_are_those_of_the_values() -> None:
    """Central differences of step 1e-5 h agree at points of the material and of its surface."""
    quadrature = integrate(fork())
    kernels = divided(quadrature)[1]
    h = float(kernels.radii.mean())
    probe = np.concatenate([quadrature.points[::31], quadrature.surface_points[::17]]) + 1e-4 * EDGE
    found, step = kernels.evaluate(probe), 1e-5 * h
    for d in range(3):
        shift = step * np.eye(3)[d]
        difference = (kernels.evaluate(probe + shift).value - kernels.evaluate(probe - shift).value) / (2.0 * step)
        assert np.abs((difference - found.gradient[d]).toarray()).max() < 1e-6 / h


@pytest.mark.parametrize("count", rest_but([300], [300, 2000, 5000]))
@pytest.mark.parametrize("solid", ["bar", "ball", "tilted", "rod", "cone", "implicit"])
def test_convex_objects_have_straight_lines(solid: str, count: int) -> None:
    """The kernels of convex solids, along the axes of the grid or not, are the same object."""
    if solid == "bar":
        quadrature = integrate(np.ones((8, 2, 2), dtype=bool), count)
    elif solid == "implicit":
        quadrature = quadrature_from_implicit(
            lambda x: np.linalg.norm(x, axis=1) - 0.03, np.array([[-0.031] * 3, [0.031] * 3]), point_count=count
        )
    else:
        meshes: dict[str, Any] = {
            "ball": trimesh.creation.icosphere(radius=0.03),
            "tilted": trimesh.creation.box((0.2, 0.05, 0.04)),
            "rod": trimesh.creation.cylinder(0.01, 0.3),
            "cone": trimesh.creation.cone(0.03, 0.1),
        }
        mesh = meshes[solid]
        mesh.apply_transform(trimesh.transformations.rotation_matrix(0.6, (0.3, 1.0, 0.2)))
        quadrature = quadrature_from_mesh(mesh.vertices, mesh.faces, point_count=count)
    whole, kernels = divided(quadrature, 60)
    assert kernels is whole


def test_bricks_that_share_an_edge_touch() -> None:
    """As nodes of finite elements are shared there; bricks that share nothing are parts, which kernels hold."""

    def boxes(apart: float) -> Quadrature:
        def distance(x: np.ndarray) -> np.ndarray:
            away = [np.abs(x - sign * np.array([0.01 + apart, 0.0, 0.01])).max(axis=1) - 0.01 for sign in (1, -1)]
            return np.minimum(*away)

        bounds = (0.021 + apart) * np.array([[-1.0] * 3, [1.0] * 3])
        return quadrature_from_implicit(distance, bounds, point_count=1000, surface_count=100)

    for apart in (0.0, 0.004):
        quadrature = boxes(apart)
        assert quadrature.cells is not None
        material = material_of(quadrature.cells, np.zeros(3))
        assert material is not None and material.part.max() == (apart > 0.0)
        whole, kernels = divided(quadrature, 80)
        assert (kernels is whole) == (apart > 0.0)


def test_thin_walls_are_apart() -> None:
    """Two sheets closer than kernels are wide: each is covered by kernels of its own."""
    mask = np.zeros((24, 12, 5), dtype=bool)
    mask[:, :, [0, 1, 3, 4]] = mask[:2] = True
    quadrature = integrate(mask, 6000)
    _, kernels = divided(quadrature, 60)
    x, value = quadrature.points, kernels.evaluate(quadrature.points).value
    far = x[:, 0] > 14 * EDGE
    sheets = [value[far & (x[:, 2] < 2.5 * EDGE)], value[far & (x[:, 2] > 2.5 * EDGE)]]
    assert not len(np.intersect1d(*(np.unique(sheet.indices) for sheet in sheets)))
    assert kernels.conditions(quadrature.points).max() < 1e5


@pytest.fixture(scope="module")
def slit() -> ReducedBody:
    """An L whose leg along x is slit from its end: it has an inner corner, and a gap that no distance sees."""
    mask = np.zeros((8, 2, 5), dtype=bool)
    mask[:2] = mask[:, :, :2] = True
    options = BuildOptions(function_count=24, cubature_count=96)
    whole = build_body(integrate(mask, 2000), options, progress=False)
    (cut,) = cut_body(
        whole, Patch.stroke((0.03, -1.0, EDGE), (1.0, -1.0, EDGE), (0.03, 1.0, EDGE)), progress=False
    ).bodies
    return cut


def test_a_slit_beside_a_corner(slit: ReducedBody) -> None:
    """Kernels go around the corner and act on one lip alone, functions reproduce linear ones, gradients agree."""
    assert len(slit.flat()["detour_pairs"]) > 1000 and len(slit.flat()["hidden_pairs"]) > 1000
    lips = np.array([[0.078, 0.01, EDGE + side * 0.003] for side in (-1.0, 1.0)]) - slit.offset
    value = slit.reproducing_kernels.evaluate(lips).value.toarray()
    assert (value != 0.0).sum(axis=1).min() >= 4 and not (value[0] * value[1]).any()
    cells = unpack_sources(slit).quadrature.cells
    assert cells is not None
    x, h = cells.octants - slit.offset, float(slit.reproducing_kernels.support.mean())
    found = slit.reproducing_kernels.evaluate(x)
    assert np.abs(found.value @ slit.kernels.centres - x).max() < 1e-12
    for d, gradient in enumerate(found.gradient):
        assert np.abs(gradient @ slit.kernels.centres - np.eye(3)[d]).max() < 1e-9 / h


def test_file_round_trip(body: ReducedBody, slit: ReducedBody, tmp_path: Path) -> None:
    """Bodies with corners and slits come back with the same values anywhere; others store nothing of them."""
    path = tmp_path / "body.npz"
    assert len(body.flat()["detour_pairs"]) > 1000 and not len(body.flat()["hidden_pairs"])
    for one in (body, slit):
        one.save(path)
        loaded = ReducedBody.load(path)
        x = one.bounds[0] + np.random.default_rng(0).random((500, 3)) * np.ptp(one.bounds, axis=0)
        np.testing.assert_array_equal(one.evaluate(x)[0], loaded.evaluate(x)[0])
    brick().save(path)
    with np.load(path) as file:
        assert not {"material_points", "material_frame", "hidden_pairs", "detour_pairs", "detour_lengths"} & set(
            file.files
        )
    assert (
        ReducedBody.load(path).reproducing_kernels.visibility is None
        and ReducedBody.load(path).reproducing_kernels.detours is None
    )


def test_files_of_version_2_are_read(slit: ReducedBody, tmp_path: Path) -> None:
    """What an earlier version wrote, with hidden pairs and without, has the functions that it had."""
    path = tmp_path / "old.npz"
    none = np.zeros(0, dtype=np.int64)
    for hidden in (slit.flat()["hidden_pairs"], none):
        old = changed(
            slit,
            hidden_pairs=hidden,
            material_points=slit.flat()["material_points"][: len(hidden) and None],
            material_frame=np.eye(3),
            detour_pairs=none,
            detour_lengths=np.zeros(0, dtype=np.float32),
        )
        header, arrays = old.fields()
        assert ("hidden_pairs" in arrays) == (len(hidden) > 0) and "detour_pairs" not in arrays
        write_archive(path, header | {"version": 2}, arrays)
        loaded = ReducedBody.load(path)
        np.testing.assert_array_equal(loaded.evaluate(old.cubature.points)[0], old.evaluate(old.cubature.points)[0])
    write_archive(path, header | {"version": 1}, arrays)
    with pytest.raises(AssetError, match="version 1, this softmode reads 2"):
        ReducedBody.load(path)


@pytest.mark.parametrize("change", ["order", "range", "negative", "alone", "nan", "sign", "lengths", "pairs"])
@pytest.mark.parametrize("table", ["hidden_pairs", "detour_pairs"])
def test_damaged_tables_are_refused(slit: ReducedBody, tmp_path: Path, change: str, table: str) -> None:
    """Pairs out of order or range, points and lengths that are missing or no numbers, are named."""
    path = tmp_path / "slit.npz"
    slit.save(path)
    with np.load(path) as file:
        stored = {name: file[name] for name in file.files}
    pairs, points = stored[table].copy(), stored["material_points"].copy()
    if change == "order":
        pairs[[0, 1]] = pairs[[1, 0]]
    elif change == "range":
        pairs[-1] = len(points) * len(slit.kernels.centres)
    elif change == "negative":
        pairs[0] = -1
    elif change == "sign":
        stored["detour_lengths"] = -stored["detour_lengths"]
    elif change == "nan":
        points[3] = np.nan
    stored |= {table: pairs, "material_points": points}
    if change == "alone":
        del stored["material_points"]
    elif change == "lengths":
        del stored["detour_lengths"]
    elif change == "pairs":
        del stored["detour_pairs"]
    np.savez(path, **stored)
    with pytest.raises(AssetError, match=r"hidden_pairs|detour_pairs|material_points|detour_lengths"):
        ReducedBody.load(path)


@pytest.mark.parametrize("cut", [False, True])
def test_affine_motion_is_exact_anywhere(body: ReducedBody, slit: ReducedBody, cut: bool) -> None:
    """In the gap and around the body too, where the nearest material decides which kernels act."""
    one = slit if cut else body
    x = one.bounds[0] + np.random.default_rng(1).random((2000, 3)) * np.ptp(one.bounds, axis=0)
    value = one.evaluate(x)[0]
    assert np.abs(value @ one.linear_coordinates[:, :3] - x).max() < 1e-9
    with pytest.raises(BasisError):
        one.evaluate(x + 1.0, outside="raise")
