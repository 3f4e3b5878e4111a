"""Kernels act on what is connected to their centre within their support, not across gaps."""

from __future__ import annotations

import dataclasses
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
from softmode.deformables.build.visibility import Material, divide_at_gaps, find_visibility, material_of
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
    """Return kernels that act on all they reach, and those that do not act across gaps."""
    assert quadrature.cells is not None
    whole = make_basis(quadrature.points, kernel_count, spacing=quadrature.spacing)
    material = material_of(quadrature.cells, np.zeros(3))
    assert material is not None
    return whole, divide_at_gaps(whole, material, quadrature.points, quadrature.spacing)


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
    found = find_visibility(material, points[:1], np.array([2.05]))
    assert found is not None and found.hidden.tolist() == [4]
    assert find_visibility(material, points[:1], np.array([2.3])) is None
    two = dataclasses.replace(material, part=np.array([0, 0, 0, 0, 1]))
    assert find_visibility(two, points[:1], np.array([2.05])) is None


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


def test_convex_objects_have_nothing_hidden() -> None:
    """The kernels of a bar are the same object."""
    whole, kernels = divided(integrate(np.ones((8, 2, 2), dtype=bool)))
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
        assert kernels is whole


def test_thin_walls_get_kernels_of_their_own() -> None:
    """Two sheets closer than kernels are apart: each is covered by kernels of its own."""
    mask = np.zeros((24, 12, 5), dtype=bool)
    mask[:, :, [0, 1, 3, 4]] = mask[:2] = True
    quadrature = integrate(mask, 6000)
    whole, kernels = divided(quadrature, 60)
    assert kernels.kernel_count > whole.kernel_count and kernels.visibility is not None
    assert kernels.conditions(quadrature.points).max() < 1e5


def test_file_round_trip(body: ReducedBody, tmp_path: Path) -> None:
    """A body with gaps comes back with the same values anywhere; one without stores nothing of them."""
    path = tmp_path / "fork.npz"
    body.save(path)
    loaded = ReducedBody.load(path)
    x = body.bounds[0] + np.random.default_rng(0).random((500, 3)) * np.ptp(body.bounds, axis=0)
    assert len(body.hidden_pairs) > 1000
    np.testing.assert_array_equal(body.evaluate(x)[0], loaded.evaluate(x)[0])
    bar = build_body(integrate(np.ones((8, 2, 2), dtype=bool)), BuildOptions(function_count=20), progress=False)
    bar.save(path)
    with np.load(path) as file:
        assert not {"material_points", "hidden_pairs"} & set(file.files)
    assert ReducedBody.load(path).kernels.visibility is None


@pytest.mark.parametrize("change", ["order", "range", "negative", "alone", "nan"])
def test_damaged_tables_are_refused(body: ReducedBody, tmp_path: Path, change: str) -> None:
    """Pairs out of order or range, points that are missing or no numbers, are named."""
    path = tmp_path / "fork.npz"
    body.save(path)
    with np.load(path) as file:
        stored = {name: file[name] for name in file.files}
    pairs, points = stored["hidden_pairs"].copy(), stored["material_points"].copy()
    if change == "order":
        pairs[[0, 1]] = pairs[[1, 0]]
    elif change == "range":
        pairs[-1] = len(points) * len(body.centres)
    elif change == "negative":
        pairs[0] = -1
    elif change == "nan":
        points[3] = np.nan
    stored |= {"hidden_pairs": pairs, "material_points": points}
    if change == "alone":
        del stored["material_points"]
    np.savez(path, **stored)
    with pytest.raises(AssetError, match=r"hidden_pairs|material_points"):
        ReducedBody.load(path)


def test_affine_motion_is_exact_anywhere(body: ReducedBody) -> None:
    """In the gap and around the fork too, where the nearest material decides which kernels act."""
    x = body.bounds[0] + np.random.default_rng(1).random((2000, 3)) * np.ptp(body.bounds, axis=0)
    value = body.evaluate(x)[0]
    assert np.abs(value @ body.linear_coordinates[:, :3] - x).max() < 1e-9
    with pytest.raises(BasisError):
        body.evaluate(x + 1.0, outside="raise")
