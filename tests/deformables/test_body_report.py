"""The report on a body: good bodies are clean, every kind of defect is named, measures agree with closed forms.

Builds bodies with the faults that a report names.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.rkpm import make_basis
from softmode.deformables.model.lane_kernels import LANES
from softmode.deformables.quadrature.interior import interior_from_quadrature, interior_from_surface, winding_numbers
from softmode.deformables.quadrature.quadrature import quadrature_from_box
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.quadrature.quadrature_mesh import quadrature_from_mesh
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.reduction.report import FAST_FUNCTIONS, BodyReport, object_findings, report_body
from softmode.deformables.solver.step_tables import ONE_LAUNCH_BLOCKS
from softmode.envs.tasks.place_in_bin import task as place_in_bin
from softmode.envs.tasks.push_soft import task as push_soft
from softmode.envs.tasks.shape_soft import config as shape_soft
from softmode.errors import BasisError, ConfigError
from softmode.objects import ObjectConfig, load, task_objects
from softmode.objects.source import object_source
from tests.bodies import RECIPES, changed, sheet, slab, small_box
from tests.marks import rest_but

GOOD = {
    "plush": ObjectConfig(),
    "beam": task_objects.BEAM,
    "cube": task_objects.CUBE,
    "pad": task_objects.PAD,
    "rope": task_objects.ROPE,
    "toy": place_in_bin.TOY,
    "ball": place_in_bin.BALL,
    "disc": place_in_bin.DISC,
    "post": shape_soft.POST,
    "puck": push_soft.PUCK,
}
SMALL = BuildOptions(mode_count=4, kernel_count=120, cubature_count=96)


def names(report: BodyReport, severity: str | None = None) -> set[str]:
    """Return the names of the findings."""
    return {finding.name for finding in report.findings if severity in (None, finding.severity)}


@pytest.fixture(scope="module")
def quadrature() -> Quadrature:
    """Return a box."""
    return RECIPES["small_box"]().integrate()


@pytest.fixture(scope="module")
def body() -> ReducedBody:
    """Return a good body."""
    return small_box()


def test_many_functions_are_noted(quadrature: Quadrature, body: ReducedBody) -> None:
    """A body too large for one launch on a GPU is as good as others, with a note; the limit is the solver's own."""
    assert FAST_FUNCTIONS == LANES * ONE_LAUNCH_BLOCKS
    large = build_body(quadrature, BuildOptions(mode_count=16, kernel_count=200, cubature_count=384))
    assert large.function_count > FAST_FUNCTIONS >= body.function_count
    report = report_body(large, quadrature=quadrature)
    assert report.severity == 0 and "many functions" in names(report, "note")
    (finding,) = (finding for finding in report.findings if finding.name == "many functions")
    assert f"with {large.function_count} functions" in finding.what
    assert "many functions" not in names(report_body(body, quadrature=quadrature))


@pytest.mark.parametrize("name", rest_but(["plush", "cube"], GOOD))
def test_good_bodies_are_clean(name: str) -> None:
    """Nothing is found on the plush and on every preset by their files, nor on some with what they were built from."""
    config = GOOD[name]
    thing = load(config)
    alone = report_body(thing.body, splats=thing.visible_splats.means)
    assert not alone.findings and alone.severity == 0
    if name not in ("cube", "rope", "post"):
        return
    whole = report_body(thing.body, quadrature=object_source(config).integrate(), splats=thing.visible_splats.means)
    assert not whole.findings
    assert whole.measure("error of orthonormality in mass") < (0.1 if config.clamped_height else 1e-9)
    # What the build itself measured, on the same points; a held body was refined at the face of its region.
    error = whole.measure("error of soft modes by cubature")
    if not config.clamped_height:
        assert error == pytest.approx(float(str(thing.body.provenance["soft_mode_error"])), rel=0.3, abs=2e-4)


def test_measures_of_a_box(body: ReducedBody, quadrature: Quadrature) -> None:
    """Volume, area, thickness 2 V / A, extents are those of the box; the surface is closed."""
    report = report_body(body, quadrature=quadrature)
    volume, area = 0.06 * 0.05 * 0.04, 2.0 * (0.06 * 0.05 + 0.05 * 0.04 + 0.04 * 0.06)
    assert report.measure("volume") == pytest.approx(volume, rel=1e-9)
    assert report.measure("surface area") == pytest.approx(area, rel=1e-9)
    assert report.measure("mean thickness over size") == pytest.approx(2.0 * volume / area / 0.06, rel=1e-9)
    assert report.measure("volume by surface samples over volume") == pytest.approx(1.0, abs=0.02)
    assert report.measure("extent z") == pytest.approx(0.04, rel=1e-9)
    # The samples' hull misses the box's edges by half of their pitch.
    assert 1.0 < report.measure("volume over convex hull") < 1.1


def test_fingers_too_narrow_for_the_samples_are_named(body: ReducedBody, quadrature: Quadrature) -> None:
    """Three of S samples on an area A lie under a finger of sqrt(3 A / S); a narrower one needs 3 A / width^2."""
    area, count = body.surface.areas.sum(), body.surface_count
    width = np.sqrt(3.0 * area / count)
    for finger, needed in ((1.01 * width, None), (0.5 * width, 4 * count)):
        found = [f for f in report_body(body, quadrature=quadrature, finger=finger).findings if f.name == "samples"]
        assert [f.remedy for f in found] == ([] if needed is None else [f"build it with --surface {needed}"])
    with pytest.raises(ConfigError, match="finger"):
        report_body(body, finger=0.0)


def test_winding_numbers_tell_inside_from_outside(body: ReducedBody) -> None:
    """1 inside, 0 outside, half a pitch and more from the surface."""
    rng = np.random.default_rng(0)
    inside = rng.uniform(-0.5, 0.5, size=(200, 3)) * (np.array([0.06, 0.05, 0.04]) - 0.012)
    away = rng.normal(size=(200, 3))
    away *= 0.06 / np.linalg.norm(away, axis=1, keepdims=True)
    surface = (body.surface.points, body.surface.normals, body.surface.areas)
    np.testing.assert_allclose(winding_numbers(inside, *surface), 1.0, atol=0.15)
    np.testing.assert_allclose(winding_numbers(away, *surface), 0.0, atol=0.05)


def test_interior_is_filled_anew_from_the_surface(body: ReducedBody, quadrature: Quadrature) -> None:
    """Its second moments are those of the box, L^2 / 12, to the layer of cells that the samples blur."""
    interior = interior_from_surface(body)
    assert interior.weights.sum() == pytest.approx(body.volume)
    second = interior.weights @ interior.points**2 / body.volume
    np.testing.assert_allclose(second, np.array([0.06, 0.05, 0.04]) ** 2 / 12.0, rtol=0.05)
    exact = interior_from_quadrature(body, quadrature)
    np.testing.assert_allclose(exact.points.mean(axis=0), 0.0, atol=1e-9)
    assert interior.parts().max() == exact.parts().max() == 0


def test_quadrature_of_another_body_is_refused(body: ReducedBody) -> None:
    """What a body was not built from would make its mass look wrong."""
    with pytest.raises(BasisError, match="quadrature"):
        report_body(body, quadrature=quadrature_from_box((0.06, 0.05, 0.05), point_count=500))


def test_condition_numbers_are_those_of_dense_matrices() -> None:
    """M = sum_k phi_k P P^T in coordinates over the mean support; infinite where nothing reaches."""
    x = np.random.default_rng(1).uniform(size=(300, 3))
    basis = make_basis(x, 40)
    points = np.concatenate([x[:20], [[9.0, 9.0, 9.0]]])
    found = basis.conditions(points)
    for point, value in zip(points[:20], found, strict=False):
        offset = (point - basis.centres) / basis.support.mean()
        q = np.linalg.norm(point - basis.centres, axis=1) / basis.support
        bell = np.where(q < 1.0, 4.0 / 3.0 * (1.0 - q) ** 3 - 16.0 / 3.0 * np.maximum(0.5 - q, 0.0) ** 3, 0.0)
        poly = np.column_stack([np.ones(len(offset)), offset])
        assert value == pytest.approx(np.linalg.cond((poly * bell[:, None]).T @ poly, 1), rel=1e-6)
    assert found[20] == np.inf


def plate(size: tuple[float, float, float]) -> ReducedBody:
    """Return a plate."""
    return build_body(quadrature_from_box(size, point_count=1500, surface_count=400), SMALL)


def beam(options: BuildOptions) -> ReducedBody:
    """Return a beam 5:1."""
    return build_body(quadrature_from_box((0.10, 0.02, 0.02), point_count=1500, surface_count=200), options)


def two_spheres(gap: float) -> Quadrature:
    """Return two spheres of 2 cm radius with a gap between them."""
    ball = trimesh.creation.icosphere(3, 0.02)
    other = ball.copy()
    other.apply_translation((0.04 + gap, 0.0, 0.0))
    vertices = np.concatenate([ball.vertices, other.vertices])
    faces = np.concatenate([ball.faces, other.faces + len(ball.vertices)])
    return quadrature_from_mesh(vertices, faces, point_count=2000, surface_count=200)


@pytest.mark.parametrize(("gap", "found"), [(0.06, {"separate parts", "loose parts"}), (0.008, {"separate parts"})])
def test_separate_parts_are_found(gap: float, found: set[str]) -> None:
    """Far apart they drift freely; near each other kernels glue them together, and only the points tell."""
    q = two_spheres(gap)
    report = report_body(build_body(q, SMALL), quadrature=q)
    assert names(report) - {"slender"} == found
    assert report.measure("separate parts") == 2
    assert report.severity == (2 if "loose parts" in found else 1)


@pytest.mark.parametrize(
    ("make", "found"),
    [
        (lambda: plate((0.10, 0.10, 0.0004)), "thin"),
        (slab, "slender"),
        pytest.param(lambda: beam(BuildOptions(mode_count=4)), "slender", marks=pytest.mark.rest),
        pytest.param(lambda: beam(BuildOptions(mode_count=4, handles="quadratic")), "slender", marks=pytest.mark.rest),
    ],
    ids=["sheet", "slab", "beam", "beam of quadratic handles"],
)
def test_thin_and_slender_bodies_are_told_what_to_do(make: Callable[[], ReducedBody], found: str) -> None:
    """A sheet is no solid; a beam wants quadratic handles and a low rank tolerance."""
    assert found in names(report_body(make()), "warning")


@pytest.mark.rest
def test_a_beam_with_quadratic_handles_is_clean() -> None:
    """The remedy that a slender body is told cures it."""
    options = BuildOptions(mode_count=4, handles="quadratic", rank_tolerance=1e-9)
    assert not report_body(build_body(quadrature_from_box((0.10, 0.02, 0.02)), options)).findings


def few_points(body: ReducedBody) -> ReducedBody:
    """Keep five cubature points."""
    weights = body.cubature.weights[:5] * body.volume / body.cubature.weights[:5].sum()
    cut = {name: body.flat()[name][:5] for name in ("points", "grad_basis", "stiffness_scale")}
    return changed(body, weights=weights, **cut)


def heavier(body: ReducedBody) -> ReducedBody:
    """Halve the functions, tables and all, so that they are linear still but not of unit mass."""
    return changed(
        body,
        transform=0.5 * body.transform,
        grad_basis=0.5 * body.cubature.grad_basis,
        surface_basis=0.5 * body.surface.basis,
        linear_coordinates=2.0 * body.linear_coordinates,
        mean_basis=0.5 * body.mean_basis,
    )


def uneven(body: ReducedBody) -> ReducedBody:
    """Give the cubature points of one half a thousandth of the weight of the others."""
    share = np.where(body.cubature.points[:, 0] > 0.0, 1e-3, 1.0)
    return replace(body, cubature=replace(body.cubature, weights=share * body.cubature.weights * 1.998))


DEFECTS: dict[str, tuple[Callable[[ReducedBody], ReducedBody], str, str]] = {
    "surface table of another body": (
        lambda b: changed(b, surface_basis=b.surface.basis[::-1].copy()),
        "tables",
        "broken",
    ),
    "gradients of another body": (
        lambda b: changed(b, grad_basis=b.cubature.grad_basis[::-1].copy()),
        "tables",
        "broken",
    ),
    "centre of mass moved": (lambda b: changed(b, mean_basis=b.mean_basis + 0.01), "tables", "broken"),
    "functions not of unit mass": (heavier, "mass", "broken"),
    "five cubature points": (few_points, "motions without energy", "broken"),
    "volume tripled": (
        lambda b: changed(b, volume=3.0 * b.volume, weights=3.0 * b.cubature.weights),
        "volume",
        "broken",
    ),
    "surface inside out": (lambda b: changed(b, surface_normals=-b.surface.normals), "open surface", "broken"),
    "surface half missing": (
        lambda b: changed(
            b,
            surface_points=b.surface.points[b.surface.points[:, 2] > 0.0],
            surface_normals=b.surface.normals[b.surface.points[:, 2] > 0.0],
            surface_areas=b.surface.areas[b.surface.points[:, 2] > 0.0],
            surface_basis=b.surface.basis[b.surface.points[:, 2] > 0.0],
        ),
        "volume",
        "broken",
    ),
    "cubature uneven": (
        uneven,
        "cubature",
        "warning",
    ),
}


@pytest.mark.parametrize("name", DEFECTS)
def test_every_defect_is_named(name: str, body: ReducedBody) -> None:
    """A body with one thing wrong is found out, by its file alone, and told a remedy."""
    change, found, severity = DEFECTS[name]
    report = report_body(change(body))
    assert found in names(report, severity), report.findings
    assert report.severity >= {"warning": 1, "broken": 2}[severity]
    assert all(finding.remedy for finding in report.findings)
    assert not report_body(body).findings


def test_splats_without_body_and_surface_without_splats(body: ReducedBody) -> None:
    """Splats far outside, and a side of the body that no splat shows, are found; splats inside are not."""
    rng = np.random.default_rng(0)
    cover = rng.uniform(-0.5, 0.5, size=(3000, 3))
    cover[range(3000), np.arange(3000) % 3] = np.where(np.arange(3000) % 2, -0.5, 0.5)
    cover *= [0.06, 0.05, 0.04]
    inside = 0.3 * cover
    floaters = np.array([0.06, 0.0, 0.0]) + 0.002 * rng.normal(size=(10, 3))
    assert not report_body(body, splats=np.concatenate([cover, inside])).findings
    report = report_body(body, splats=np.concatenate([cover, floaters]))
    assert names(report) == {"splats without body"}
    assert report.measure("splats away from the body") == pytest.approx(10 / 3010)
    report = report_body(body, splats=cover[cover[:, 2] > -0.0199])
    assert names(report) == {"surface without splats"}
    bottom = 0.06 * 0.05 / (2.0 * (0.06 * 0.05 + 0.05 * 0.04 + 0.04 * 0.06))
    assert 0.3 * bottom < report.measure("surface without splats") < bottom


def told(body: ReducedBody, **options: float) -> dict[str, str]:
    """Return what the user of an object is told, by name."""
    return {finding.name: f"{finding.what}. {finding.remedy}" for finding in object_findings(body, **options)}


def test_what_matters_is_told(body: ReducedBody) -> None:
    """A box of 60 x 50 x 40 mm: its size against what was asked, with the remedy."""
    longest = float(np.ptp(body.bounds, axis=0).max())
    assert not told(body, size=longest)
    size = told(body, size=0.075)["size"]
    assert "60 mm where 75 mm were asked for" in size and f"--size {0.075**2 / longest:.3g}" in size
    assert not told(body, size=1.04 * longest) and not told(body, size=0.96 * longest)
    report = report_body(body, size=0.075)
    assert "size" in names(report, "warning") and report.measure("longest edge over the size asked for") < 0.82


def test_thin_walls_are_told() -> None:
    """A plate of 1 mm has them, one of 4 mm none, unless it was filled on a grid too coarse to resolve it."""
    thin, thick = plate((0.06, 0.05, 0.001)), sheet()
    assert "mm: they may come out" in (said := told(thin)["thin walls"]) and said.endswith("thicken them")
    assert report_body(thin).measure("surface that bounds thin walls") > 0.8
    assert not told(thick) and report_body(thick).measure("surface that bounds thin walls") == 0.0
    coarse = replace(thick, provenance={**thick.provenance, "quadrature_voxel": 0.002})
    assert told(coarse)["thin walls"].endswith("raise --resolution")
