"""Functions chosen by elastic energy: nested, exact for affine motion, as accurate as they say, the same every time.

Builds bodies of functions chosen by elastic energy, which is what it tests.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import warnings

import newton
import numpy as np
import pytest
import trimesh

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.quadrature.quadrature import quadrature_from_box, quadrature_from_mesh
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.reduction import elastic_functions
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.elastic_functions import SPACE_ERROR, SPACE_MODE_COUNTS
from softmode.deformables.reduction.options import FUNCTION_COUNT, BuildOptions
from softmode.deformables.reduction.reduced_stiffness import reduced_stiffness
from softmode.deformables.reduction.report import report_body
from softmode.errors import ConfigError
from tests.marks import rest_but
from tests.oracle.solids import eigenvalues
from tests.shapes import SHAPES, box, together

ALL = {"cubature_count": None, "kernel_count": 200}
FEW = {"surface_count": 32}
"""Samples of the surface, which these tests do not look at: most of the time of a quadrature."""
SIZE = (0.12, 0.05, 0.03)
LEFT = Region(name="left", box=((-1.0, -1.0, -1.0), (-0.04, 1.0, 1.0)))
RIGHT = Region(name="right", box=((0.04, -1.0, -1.0), (1.0, 1.0, 1.0)))
SOFT = Region(name="foot", box=((0.02, -1.0, -1.0), (1.0, 1.0, 0.0)), stiffness=1e4)
OTHER = Region(name="other", box=((-1.0, -1.0, -1.0), (-0.03, 1.0, 0.0)), stiffness=1e3)


@functools.cache
def small_box() -> Quadrature:
    """Return the points of a box."""
    return quadrature_from_box(SIZE, point_count=1500, **FEW)


def density(points: np.ndarray) -> np.ndarray:
    """Return the density of that box, which is heavier at one end."""
    return np.where(points[:, 0] > 0.0, 3.0, 1.0)


@functools.cache
def built(**options: object) -> ReducedBody:
    """Return a box with all of its points and few kernels."""
    return build_body(small_box(), BuildOptions(**{**ALL, **options}), density_scale=density, progress=False)


@pytest.fixture(scope="module")
def bodies() -> dict[int, ReducedBody]:
    """Bodies of one box by number of functions; 48 are the default."""
    return {10: built(function_count=10), 48: built(), 80: built(function_count=80)}


def test_functions_are_nested(bodies: dict[int, ReducedBody]) -> None:
    """The functions of a smaller count are the first of a larger one."""
    points = bodies[80].cubature.points[::7]
    most = bodies[80].evaluate(points)[0]
    for count, body in bodies.items():
        np.testing.assert_allclose(body.evaluate(points)[0], most[:, :count], atol=1e-8 * np.abs(most).max())


@pytest.mark.parametrize("poissons_ratio", [0.0, 0.3, 0.49])
def test_more_functions_never_stiffen(bodies: dict[int, ReducedBody], poissons_ratio: float) -> None:
    """With all points no frequency rises with the number of functions, at any Poisson's ratio."""
    values = [eigenvalues(body, poissons_ratio) for body in bodies.values()]
    for fewer, more in itertools.pairwise(values):
        assert (more <= fewer * (1.0 + 1e-6)).all()  # gradients are stored in float32


def test_more_functions_serve_pulls(bodies: dict[int, ReducedBody], monkeypatch: pytest.MonkeyPatch) -> None:
    """Springs draw ends apart that no build was told of: 60 functions err by two thirds of what modes alone do.

    Errors are against 120 functions, in linear statics. The default 48 are the same.
    """
    most, pulled = built(function_count=120), built(function_count=60)
    monkeypatch.setattr(elastic_functions, "FAR_AFTER", 120)
    plain = build_body(small_box(), BuildOptions(**ALL, function_count=60), density_scale=density, progress=False)
    x = small_box().points
    ends = [np.abs(x[:, 0] - side) < 0.1 * SIZE[0] for side in (x[:, 0].min(), x[:, 0].max())]

    def moved(body: ReducedBody) -> np.ndarray:
        value = body.evaluate(x - body.offset)[0]
        gradient = np.float64(body.cubature.grad_basis).transpose(1, 2, 0)
        springs, load = np.zeros((body.function_count,) * 2), np.zeros((body.function_count, 3))
        for rows, sign in zip(ends, (-1.0, 1.0), strict=True):
            held = 1e6 * small_box().weights[rows, None] * value[rows]
            springs += value[rows].T @ held
            load += np.outer(held.sum(axis=0), [sign, 0.3, 0.0])
        stiffness = reduced_stiffness(gradient, body.cubature.weights, 0.4) + np.kron(np.eye(3), springs)
        return value @ np.linalg.solve(stiffness, load.T.ravel()).reshape(3, -1).T

    exact = moved(most)
    few, many = (np.linalg.norm(moved(body) - exact) for body in (pulled, plain))
    assert few < 2.0 / 3.0 * many
    start = [body.evaluate(x[::7] - body.offset)[0][:, :FUNCTION_COUNT] for body in (pulled, plain)]
    np.testing.assert_allclose(start[0], start[1], atol=1e-8 * np.abs(start[1]).max())


def test_affine_motion_is_exact(bodies: dict[int, ReducedBody]) -> None:
    """Linear coordinates give (X, Y, Z, 1) at any point, and a stretch moves it there."""
    body = bodies[48]
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3)) * SIZE - body.offset
    value, gradient = body.evaluate(points)
    np.testing.assert_allclose(value @ body.linear_coordinates, np.column_stack([points, np.ones(20)]), atol=1e-12)
    A = np.array([[1.1, 0.2, 0.0], [0.0, 0.9, 0.1], [0.3, 0.0, 1.2]])
    np.testing.assert_allclose(points + value @ body.affine(A), points @ A.T, atol=1e-12)
    np.testing.assert_allclose(np.einsum("nkj,kc->ncj", gradient, body.affine(A))[3], (A - np.eye(3)), atol=1e-9)


def test_functions_are_orthonormal_in_mass(bodies: dict[int, ReducedBody]) -> None:
    """With a density that varies, and only the first has a mean."""
    quadrature, body = small_box(), bodies[48]
    value = body.evaluate(quadrature.points - body.offset)[0]
    mass = quadrature.weights * density(quadrature.points)
    mass /= mass.sum()
    np.testing.assert_allclose(body.offset, mass @ quadrature.points, atol=1e-15)
    np.testing.assert_allclose((value * mass[:, None]).T @ value, np.eye(48), atol=1e-9)
    np.testing.assert_allclose(body.mean_basis, np.eye(48)[0], atol=1e-12)


@pytest.mark.parametrize("accuracy", rest_but([0.01], [0.2, 0.01]))
def test_accuracy_chooses_the_count(bodies: dict[int, ReducedBody], accuracy: float) -> None:
    """The fewest functions that reach it are taken, with all of a cluster, and the report says what they reach."""
    body = built(accuracy=accuracy)
    reached = body.provenance["frequency_error"]
    assert isinstance(reached, float) and 0.0 <= reached <= accuracy
    fewer = built(function_count=body.function_count - 1).provenance
    error = fewer["frequency_error"]
    assert isinstance(error, float)
    assert error > accuracy or fewer["complete_functions"] == body.function_count
    errors = {count: float(str(one.provenance["frequency_error"])) for count, one in bodies.items()}
    assert errors[80] <= errors[48] <= errors[10]
    for count, error in errors.items():  # more functions than a count are taken where that count errs by more
        assert (body.function_count > count) == (error > accuracy)


def test_accuracy_out_of_reach_is_refused() -> None:
    """The message says what the most functions reach."""
    with pytest.raises(ConfigError, match="120 functions reach"):
        built(accuracy=1e-7)


def test_a_build_says_what_makes_a_body_too_stiff() -> None:
    """A space that is not settled to 5 %, with the report's own figure; and a ratio that wants more functions."""
    plate = quadrature_from_box((0.2, 0.2, 0.004), point_count=600, **FEW)
    options = BuildOptions(kernel_count=100, poissons_ratio=0.499)
    with pytest.warns(RuntimeWarning) as told:
        body = build_body(plate, options, name="sheet", progress=False)
    texts = [str(one.message) for one in told]
    space = float(str(body.provenance["space_error"]))
    assert any("at nu = 0.499; give function_count=80" in text for text in texts)
    found = [finding for finding in report_body(body).findings if finding.name == "space"]
    assert found[0].what.startswith(f"space_error {100.0 * space:.0f} %")
    assert f"body 'sheet': {found[0].what}; {found[0].remedy}" in texts


@pytest.mark.rest
def test_the_space_grows_where_it_must() -> None:
    """A bar keeps the smaller space, a thin tube takes the larger one, and says how far from settled it is."""
    wide = 10 * (min(SPACE_MODE_COUNTS) + 1)
    assert float(str(built().provenance["space_functions"])) <= wide
    tube = trimesh.creation.annulus(0.015, 0.025, 0.12, sections=96)
    quadrature = quadrature_from_mesh(tube.vertices, tube.faces, point_count=2000, **FEW)
    options = BuildOptions(cubature_count=None, poissons_ratio=0.3)
    body = build_body(quadrature, options, progress=False)
    assert float(str(body.provenance["space_functions"])) > wide
    assert SPACE_ERROR < float(str(body.provenance["space_error"])) < 0.2
    fewer = build_body(quadrature, dataclasses.replace(options, function_count=24), progress=False)
    both = np.concatenate([body.evaluate(body.cubature.points)[0], fewer.evaluate(body.cubature.points)[0]], axis=1)
    assert np.linalg.matrix_rank(both, tol=1e-7 * np.linalg.norm(both, 2)) == body.function_count  # Still nested.


def test_functions_for_several_ratios(bodies: dict[int, ReducedBody]) -> None:
    """Functions made for 0.3 and 0.49 serve both better than those of one serve the other."""
    both, soft = built(poissons_ratio=(0.3, 0.49)), built(poissons_ratio=0.3)
    full = eigenvalues(bodies[80], 0.49)
    error = [np.sqrt(eigenvalues(body, 0.49) / full).max() - 1.0 for body in (both, soft)]
    assert error[0] < 0.5 * error[1]


def test_defaults_and_determinism() -> None:
    """48 functions, the same bits every time."""
    first, again = built(), built.__wrapped__()
    assert first.function_count == FUNCTION_COUNT
    np.testing.assert_array_equal(first.transform, again.transform)
    np.testing.assert_array_equal(first.cubature.grad_basis, again.cubature.grad_basis)


@pytest.mark.rest
def test_cubature_keeps_the_soft_modes_of_a_bar() -> None:
    """With the default number of points the lowest eigenvalues are those of all points to 0.5 %."""
    body = build_body(quadrature_from_box((0.3, 0.03, 0.03)), progress=False)
    error = body.provenance["soft_mode_error"]
    assert isinstance(error, float) and 0.0 < error < 5e-3


def test_detached_parts_move_against_each_other() -> None:
    """Two boxes without contact: more than six motions cost nothing, and each part moves alone."""
    low, faces = box((0.02, 0.02, 0.02))
    high = low + np.array([0.1, 0.0, 0.0])
    quadrature = quadrature_from_mesh(*together((low, faces), (high, faces)), point_count=1200, **FEW)
    body = build_body(
        quadrature, BuildOptions(function_count=40, kernel_count=100, cubature_count=None), progress=False
    )
    value = eigenvalues(body, 0.4, 12)
    assert (value[:6] < 1e-4 * value[-1]).all()


@functools.cache
def held(count: int | None = None, regions: tuple[Region, ...] = (LEFT,), **options: object) -> ReducedBody:
    """Return the box held in regions, with all of its points and few kernels."""
    given = BuildOptions(**{**ALL, "kernel_count": 120, "function_count": count, **options})
    return build_body(small_box(), given, regions=regions, progress=False)


@pytest.mark.parametrize(
    "regions",
    [
        pytest.param((LEFT,), marks=pytest.mark.rest),
        pytest.param((LEFT, RIGHT), marks=pytest.mark.rest),
        (LEFT, SOFT),
        pytest.param((SOFT,), marks=pytest.mark.rest),
        pytest.param((SOFT, OTHER), marks=pytest.mark.rest),
    ],
)
def test_functions_of_held_bodies_are_nested(regions: tuple[Region, ...]) -> None:
    """Functions that vanish on exact regions are the first of a larger count; all span what the larger ones span."""
    few, many = held(24, regions), held(40, regions)
    exact = sum(region.stiffness is None for region in regions)
    assert few.driven_count == many.driven_count == 4 * exact
    points = many.cubature.points[::3]
    less, more = few.evaluate(points)[0], many.evaluate(points)[0]
    free = slice(few.driven_count, 24)
    np.testing.assert_allclose(less[:, free], more[:, free], atol=1e-7 * np.abs(more).max())
    rest = less - more @ np.linalg.lstsq(more, less, rcond=None)[0]
    assert np.abs(rest).max() < 1e-7 * np.abs(less).max()


def test_held_bodies_know_their_response() -> None:
    """The linear sag under gravity is that of 80 functions with 13: four driven ones and the response's nine."""
    work = []
    for count in (13, 80):
        body = held(count)
        r, n = body.driven_count, body.function_count - body.driven_count
        slope = body.cubature.grad_basis[:, r:].astype(float).transpose(1, 2, 0)
        stiffness = reduced_stiffness(slope, body.cubature.weights * body.cubature.stiffness_scale, 0.4)
        force = np.kron([[0.0], [0.0], [1.0]], body.mean_basis[r:, None]).ravel()
        assert len(stiffness) == 3 * n
        work.append(force @ np.linalg.solve(stiffness, force))
    assert work[0] == pytest.approx(work[1], rel=2e-3)


@pytest.mark.rest
def test_accuracy_of_held_bodies() -> None:
    """Accuracy is that of the frequencies of the held body, and default bodies have 48 functions too."""
    rough, fine = held(accuracy=0.1), held(accuracy=0.01)
    assert 8 < rough.function_count < fine.function_count
    assert float(str(fine.provenance["frequency_error"])) <= 0.01 < float(str(rough.provenance["frequency_error"]))
    assert held().function_count == FUNCTION_COUNT


def test_too_few_functions_for_the_regions() -> None:
    """Affine motions of three exact regions are twelve functions; the message says how many to give."""
    middle = Region(name="middle", box=((-0.01, -1.0, -1.0), (0.01, 1.0, 1.0)))
    with pytest.raises(ConfigError, match="are 12"):
        held(12, (LEFT, middle, RIGHT))


@pytest.mark.parametrize("options", [{"static_responses": False}, {"response_derivatives": 6}])
def test_responses_of_eigenmodes_are_refused(options: dict[str, object]) -> None:
    """They belong to FreeForm's functions."""
    with pytest.raises(ConfigError, match="mode_count"):
        BuildOptions(**options)


@pytest.mark.parametrize("name", [pytest.param("star", marks=pytest.mark.slow), "hollow sphere"])
def test_clusters(name: str) -> None:
    """Symmetric bodies have functions that contribute alike: accuracy takes all of them, the report tells of cuts."""
    quadrature = SHAPES[name].quadrature(point_count=3000, **FEW)
    whole = build_body(quadrature, BuildOptions(accuracy=0.1, kernel_count=300), progress=False)
    assert whole.provenance["complete_functions"] == whole.function_count
    cut = build_body(quadrature, BuildOptions(function_count=46, kernel_count=300), progress=False)
    complete = float(str(cut.provenance["complete_functions"]))
    assert complete > 46
    found = {finding.name: finding for finding in report_body(cut).findings}
    assert ("cluster" in found) == (complete > 47)
    assert "cluster" not in found or f"--functions {complete:.0f}" in found["cluster"].remedy
    assert "cluster" not in {finding.name for finding in report_body(whole).findings}


@pytest.mark.rest
def test_the_remedy_of_a_cut_cluster() -> None:
    """As many functions as the finding names cut none."""
    quadrature = SHAPES["hollow sphere"].quadrature(point_count=3000, **FEW)
    cut = build_body(quadrature, BuildOptions(function_count=46, kernel_count=300), progress=False)
    count = int(float(str(cut.provenance["complete_functions"])))
    full = build_body(quadrature, BuildOptions(function_count=count, kernel_count=300), progress=False)
    assert full.provenance["complete_functions"] == full.function_count
    assert "cluster" not in {finding.name for finding in report_body(full).findings}


def test_a_ratio_that_varies() -> None:
    """Options for it name three ratios and take a quarter more functions, unless a ratio or eigenmodes are named."""
    varied = BuildOptions(function_count=24).for_varied_ratio()
    assert varied.poissons_ratios == (0.3, 0.45, 0.49) and varied.function_count == 30
    assert BuildOptions().for_varied_ratio().function_count == 60
    assert BuildOptions(accuracy=0.02).for_varied_ratio().function_count is None
    for named in (BuildOptions(poissons_ratio=0.3), BuildOptions(mode_count=4)):
        assert named.for_varied_ratio() is named


def test_a_ratio_far_from_the_build_is_named() -> None:
    """A body made for 0.4 warns when it is added with 0.49; one made for the ratio, or for it and another, does not."""
    with pytest.warns(RuntimeWarning, match=r"poissons_ratio=0.49"):
        add_reduced_body(newton.ModelBuilder(), built(), material=Material(poissons_ratio=0.49))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for made, ratio in ((0.3, 0.3), ((0.3, 0.49), 0.3), ((0.3, 0.49), 0.49)):
            body = built(poissons_ratio=made)
            add_reduced_body(newton.ModelBuilder(), body, material=Material(poissons_ratio=ratio))


@pytest.mark.parametrize("ratio", [0.5, -0.1, np.nan, (0.3, 0.5)])
def test_ratios_without_a_material_are_refused(ratio: float | tuple[float, ...]) -> None:
    """The error names the argument."""
    with pytest.raises(ConfigError, match="poissons_ratio"):
        BuildOptions(poissons_ratio=ratio)


@pytest.mark.rest
def test_more_functions_than_there_are() -> None:
    """What the elastic modes cannot make is told."""
    quadrature = quadrature_from_box((0.3, 0.03, 0.03), point_count=1500)
    with pytest.warns(RuntimeWarning, match="200 asked for"):
        body = build_body(quadrature, BuildOptions(function_count=200, kernel_count=200))
    assert body.function_count < 200
