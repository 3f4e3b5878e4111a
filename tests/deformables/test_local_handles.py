"""Local handles: weights that are local along the material, through the build, regions, solver, files and exports.

Builds bodies of local handles, which is what it tests.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from numpy.typing import NDArray

from softmode.deformables import (
    BuildOptions,
    Patch,
    ReducedBody,
    Region,
    build_body,
    carry_over,
    cut_body,
    hold,
    quadrature_from_box,
    quadrature_from_mesh,
)
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.reduction.local_handles import place_kernels
from softmode.errors import ConfigError
from softmode.usd.handles import coordinates_from_handles, handles_from_coordinates
from tests.oracle.solids import SOLIDS, stiffness
from tests.shape_trials import base_of, solve_reference, try_pull, voxelise
from tests.shapes import SHAPES

Array = NDArray[np.float64]
SIZE = (0.2, 0.05, 0.04)
END = Region(name="end", box=((-1.0, -1.0, -1.0), (-0.08, 1.0, 1.0)))
TIP = ((0.09, 0.02, 0.01), 0.04)
OPTIONS = BuildOptions(handles="local", local_count=6, kernel_count=150, cubature_count=None)


@functools.cache
def box(point_count: int = 1500) -> Quadrature:
    """Return the points of the bar, with few samples of its surface."""
    return quadrature_from_box(SIZE, point_count=point_count, surface_count=200)


@pytest.fixture(scope="module")
def body() -> ReducedBody:
    """Return a bar of six local handles."""
    return build_body(box(), OPTIONS, name="bar", progress=False)


@functools.cache
def fingers() -> Quadrature:
    """Return the points of a hand."""
    return quadrature_from_mesh(*SOLIDS["hand"]().surface(), point_count=3000, surface_count=200)


@pytest.fixture(scope="module")
def hand() -> ReducedBody:
    """Return a hand of 24 local handles."""
    options = BuildOptions(handles="local", local_count=24, function_count=24, cubature_count=32)
    return build_body(fingers(), options, progress=False)


@functools.cache
def chosen(function_count: int) -> ReducedBody:
    """Return the bar of so many functions of seven local handles."""
    options = dataclasses.replace(OPTIONS, function_count=function_count, add_kernels=[TIP])
    return build_body(box(), options, progress=False)


@pytest.fixture(scope="module")
def held() -> ReducedBody:
    """Return the bar of 30 functions, held at one end after its build."""
    return hold(chosen(30), END, progress=False)


def test_weights_sum_to_one(body: ReducedBody, hand: ReducedBody) -> None:
    """Beside the constant handle: none is large or negative, all sum to one, and each of many vanishes somewhere."""
    for one, count in ((body, 6), (hand, 24)):
        weight, gradient = one.skinning_weights(np.concatenate([one.cubature.points, one.surface.points]))
        assert weight.shape[1] == count + 1 and one.mode_count == count
        np.testing.assert_allclose(weight[:, 1:].sum(axis=1), 1.0, atol=1e-12)
        np.testing.assert_allclose(gradient[:, 1:].sum(axis=1), 0.0, atol=1e-9)
        assert -0.1 < weight.min() and weight.max() < 1.1
    assert (np.abs(weight[:, 1:]).min(axis=0) < 1e-12).all()


def test_functions_are_all_of_the_handles(body: ReducedBody) -> None:
    """Ten monomials for each, orthonormal in mass, and affine motion is exact."""
    assert 54 <= body.function_count <= 60
    value = body.evaluate(body.cubature.points)[0]
    gram = (value.T * body.cubature.weights) @ value / body.volume
    np.testing.assert_allclose(gram, np.eye(len(gram)), atol=1e-9)
    rng = np.random.default_rng(0)
    X, A, t = rng.uniform(*body.bounds, (50, 3)), rng.normal(size=(3, 3)), rng.normal(size=3)
    np.testing.assert_allclose(X + body.evaluate(X)[0] @ body.affine(A, t), X @ A.T + t, atol=1e-10 * SIZE[0])


def test_handles_do_not_leak_to_the_next_finger(hand: ReducedBody) -> None:
    """The tips of two fingers share 1 % of their weights at most; bumps by straight lines, of Q-GMLS, share a third."""
    solid, quadrature = SOLIDS["hand"](), fingers()
    width, _, height = solid.pitch
    tips = np.array([[0.5 * width, width, 8.5 * height], [2.5 * width, width, 8.5 * height]])
    weight = np.abs(hand.skinning_weights(tips - hand.offset)[0][:, 1:])
    straight = place_kernels(quadrature.points, quadrature.weights, 24, np.zeros((0, 4)), seed=0)
    away = np.linalg.norm(tips[:, None] - straight.centres, axis=2)
    bump = np.maximum(1.0 - (away / straight.radii) ** 2, 0.0) ** 3
    bump /= bump.sum(axis=1)[:, None]
    assert np.minimum(*weight).sum() < 0.01 < 0.33 < np.minimum(*bump).sum()


def test_pull_of_a_held_cube() -> None:
    """Exact region, static responses, cubature and solver: at rest, and never softer than finite elements."""
    voxels = voxelise(SHAPES["cube"], 3)
    quadrature = voxels.quadrature(2000)
    loads = solve_reference(voxels, quadrature)
    options = dataclasses.replace(OPTIONS, local_count=4, cubature_count=192)
    body = build_body(quadrature, options, regions=(base_of(voxels),), progress=False)
    trial = try_pull("cube", voxels, loads, body)
    assert not trial.problems(), trial
    assert min(trial.gravity, trial.pull) > 0.95


def test_regions_hold_exactly(held: ReducedBody) -> None:
    """Free functions vanish on an exact region, the others carry its affine motion."""
    body = chosen(30)
    inside = held.regions.points
    assert np.abs(held.evaluate(inside)[0][:, held.driven_count :]).max() < 1e-9
    q, qd = carry_over(body, held, body.affine(2.0 * np.eye(3)), np.zeros((body.function_count, 3)))
    X = held.surface.points
    np.testing.assert_allclose(held.evaluate(X)[0] @ q, X + held.offset - body.offset, atol=1e-9)
    assert np.abs(qd).max() < 1e-12


def test_added_kernels_move_more_at_their_place(body: ReducedBody) -> None:
    """A force at the place does more work with a narrow handle there, that of all others stays; also from a file."""
    quadrature = box()
    more = build_body(quadrature, dataclasses.replace(OPTIONS, add_kernels=[TIP]), progress=False)
    assert more.function_count > body.function_count

    def work(one: ReducedBody, place: Array) -> float:
        force = np.outer([0.3, 0.5, 0.8], one.evaluate(place[None] - one.offset)[0][0]).ravel()
        return float(force @ np.linalg.lstsq(stiffness(one, 0.4), force, rcond=1e-11)[0])

    here = work(more, np.array(TIP[0])) / work(body, np.array(TIP[0]))
    there = work(more, np.array([-0.09, -0.02, -0.01])) / work(body, np.array([-0.09, -0.02, -0.01]))
    assert here > 1.05 > 1.01 > there


def test_functions_chosen_among_local_ones_are_nested(held: ReducedBody, tmp_path) -> None:
    """A number of functions takes them by elastic energy; a file and a late clamp keep the handles."""
    few, many = chosen(24), chosen(30)
    assert (few.function_count, many.function_count) == (24, 30)
    np.testing.assert_allclose(few.transform, many.transform[:, :24], atol=1e-8 * np.abs(few.transform).max())
    assert "space_error" not in few.provenance and float(str(few.provenance["frequency_error"])) < 0.05
    many.save(tmp_path / "bar.npz")
    read = hold(ReducedBody.load(tmp_path / "bar.npz"), END, progress=False)
    options = dataclasses.replace(OPTIONS, function_count=30, add_kernels=[TIP])
    told = build_body(box(), options, regions=[END], progress=False)
    for one in (held, read):
        assert one.fingerprint == told.fingerprint and np.array_equal(one.transform, told.transform)


def test_cut_parts_keep_their_added_kernels() -> None:
    """Either half has six local handles; the added one goes to the half that it lies in."""
    quadrature = box()
    whole = build_body(quadrature, dataclasses.replace(OPTIONS, add_kernels=[TIP]), progress=False)
    cut = cut_body(whole, Patch.plane((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)))
    assert sorted(part.mode_count for part in cut.bodies) == [6, 7]


def test_motion_goes_through_openusd_handles(body: ReducedBody) -> None:
    """Matrices and quadratic rows of the handles give the coordinates back."""
    q = np.random.default_rng(1).normal(size=(body.function_count, 3))
    np.testing.assert_allclose(coordinates_from_handles(body, *handles_from_coordinates(body, q)), q, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"local_count": 1}, "local_count"),
        ({"local_count": 10**6}, "kernels"),
        ({"local_count": float("nan")}, "local_count"),
        ({"handles": "qgmls", "local_count": 10**6}, "points"),
        ({"mode_count": 4}, "mode_count"),
        ({"handles": None, "local_count": 8}, "local_count"),
        ({"handles": "quadratic", "add_kernels": [TIP]}, "add_kernels"),
        ({"add_kernels": [((0.0, 0.0, 0.0), 0.0)]}, "radius"),
        ({"add_kernels": [((0.0, 0.0), 0.1)]}, "place"),
        ({"add_kernels": [((0.0, float("inf"), 0.0), 0.1)]}, "place"),
        ({"add_kernels": [(1.0, 2.0, 3.0)]}, "add_kernels"),
        ({"add_kernels": [((9.0, 0.0, 0.0), 0.1)]}, "away"),
        ({"add_kernels": [((0.0, 0.0, 0.0), 1e-6)]}, "holds one kernel"),
        ({"function_count": 24, "accuracy": 0.1}, "give one kind"),
        ({"function_count": 24, "static_responses": False}, "static_responses"),
    ],
)
def test_bad_options(options: dict, word: str) -> None:
    """Each is refused by name, by the options or by the build."""
    with pytest.raises(ConfigError, match=word):
        build_body(
            box(800),
            BuildOptions(**{"handles": "local", **options}),
            progress=False,
        )
