"""Kernels see distances through the material: not across gaps, and around inner corners."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.rkpm import BasisRKPM, make_basis
from softmode.deformables.build.build_body import build_body
from softmode.deformables.build.options import BuildOptions
from softmode.deformables.build.quadrature import quadrature_from_implicit, quadrature_from_mesh
from softmode.deformables.build.quadrature_grid import Quadrature
from softmode.deformables.build.visibility import find_detours, follow_material, material_of
from softmode.errors import AssetError, BasisError
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
    return whole, follow_material(whole, material, quadrature.points, quadrature.spacing)


@pytest.fixture(scope="module")
def body() -> ReducedBody:
    """A fork of few functions."""
    options = BuildOptions(function_count=24, cubature_count=96)
    return build_body(integrate(fork()), options, progress=False)


def test_ways_around_an_inner_corner() -> None:
    """Across the corner of an L of full bricks the way is |a - c| + |c - b|, and counts as its third power."""
    mask = np.zeros((4, 2, 4), dtype=bool)
    mask[:2] = mask[:, :, :2] = True
    quadrature = integrate(mask, 2000)
    assert quadrature.cells is not None
    material = material_of(quadrature.cells, np.zeros(3))
    assert material is not None
    centre, corner = quadrature.points[((quadrature.points - [0.018, 0.01, 0.026]) ** 2).sum(axis=1).argmin()], 0.02
    found = find_detours(material, centre[None], np.array([0.03]))
    assert found is not None
    added = np.zeros(len(material.points))
    added[found.pairs] = found.lengths
    x, z = material.points[:, 0], material.points[:, 2]
    way = np.hypot(centre[0] - corner, centre[2] - corner) + np.hypot(x - corner, z - corner)
    way = np.hypot(way, material.points[:, 1] - centre[1])
    straight = np.linalg.norm(material.points - centre, axis=1)
    beside = (x - centre[0]) * (corner - centre[2]) > (corner - centre[0]) * (z - centre[2])
    shadow = (added > 1e-3) & (straight * (way / straight) ** 3 < 0.03)
    assert shadow.sum() > 20 and (x[shadow] > corner).all()
    # A way turns in the octants at the corner, less than half an octant from it.
    step = material.steps.max()
    length = straight * (1.0 + added / straight) ** (1.0 / 3.0)
    assert np.abs(length - way)[shadow].max() < 0.3 * step
    lit = (z > corner) | (x < centre[0])
    assert (added[lit] == 0.0).all() and not beside[lit & (added > 0.0)].any()


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


@pytest.mark.parametrize("solid", ["bar", "ball", "tilted", "implicit"])
def test_convex_objects_have_straight_lines(solid: str) -> None:
    """The kernels of a bar, a ball, a bar along no axis and a ball by its level set are the same object."""
    if solid == "bar":
        quadrature = integrate(np.ones((8, 2, 2), dtype=bool))
    elif solid == "implicit":
        quadrature = quadrature_from_implicit(
            lambda x: np.linalg.norm(x, axis=1) - 0.03, np.array([[-0.031] * 3, [0.031] * 3]), point_count=2000
        )
    else:
        mesh: Any = (
            trimesh.creation.icosphere(radius=0.03) if solid == "ball" else trimesh.creation.box((0.2, 0.05, 0.04))
        )
        mesh.apply_transform(trimesh.transformations.rotation_matrix(0.6, (0.3, 1.0, 0.2)))
        quadrature = quadrature_from_mesh(mesh.vertices, mesh.faces, point_count=2000)
    whole, kernels = divided(quadrature)
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


def test_file_round_trip(body: ReducedBody, tmp_path: Path) -> None:
    """A body with gaps comes back with the same values anywhere; one without stores nothing of them."""
    path = tmp_path / "fork.npz"
    body.save(path)
    loaded = ReducedBody.load(path)
    x = body.bounds[0] + np.random.default_rng(0).random((500, 3)) * np.ptp(body.bounds, axis=0)
    assert len(body.detour_pairs) > 1000
    np.testing.assert_array_equal(body.evaluate(x)[0], loaded.evaluate(x)[0])
    bar = build_body(integrate(np.ones((8, 2, 2), dtype=bool)), BuildOptions(function_count=20), progress=False)
    bar.save(path)
    with np.load(path) as file:
        assert not {"material_points", "material_steps", "detour_pairs", "detour_lengths"} & set(file.files)
    assert ReducedBody.load(path).kernels.detours is None


@pytest.mark.parametrize("change", ["order", "range", "negative", "alone", "nan", "sign"])
def test_damaged_tables_are_refused(body: ReducedBody, tmp_path: Path, change: str) -> None:
    """Pairs out of order or range, points that are missing or no numbers, are named."""
    path = tmp_path / "fork.npz"
    body.save(path)
    with np.load(path) as file:
        stored = {name: file[name] for name in file.files}
    pairs, points = stored["detour_pairs"].copy(), stored["material_points"].copy()
    if change == "order":
        pairs[[0, 1]] = pairs[[1, 0]]
    elif change == "range":
        pairs[-1] = len(points) * len(body.centres)
    elif change == "negative":
        pairs[0] = -1
    elif change == "sign":
        stored["detour_lengths"] = -stored["detour_lengths"]
    elif change == "nan":
        points[3] = np.nan
    stored |= {"detour_pairs": pairs, "material_points": points}
    if change == "alone":
        del stored["material_points"]
    np.savez(path, **stored)
    with pytest.raises(AssetError, match=r"detour_pairs|material_points|detour_lengths"):
        ReducedBody.load(path)


def test_affine_motion_is_exact_anywhere(body: ReducedBody) -> None:
    """In the gap and around the fork too, where the nearest material decides which kernels act."""
    x = body.bounds[0] + np.random.default_rng(1).random((2000, 3)) * np.ptp(body.bounds, axis=0)
    value = body.evaluate(x)[0]
    assert np.abs(value @ body.linear_coordinates[:, :3] - x).max() < 1e-9
    with pytest.raises(BasisError):
        body.evaluate(x + 1.0, outside="raise")
