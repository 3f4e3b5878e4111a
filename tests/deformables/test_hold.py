"""Clamps told late: the body that a build told of the region gives, its motion, its sources in a file, the warning.

Builds bodies that were told of a region, to compare with those held later.
"""

from __future__ import annotations

import dataclasses
import warnings

import newton
import numpy as np
import pytest

from softmode.deformables import (
    BuildOptions,
    ReducedBody,
    Region,
    SolverReduced,
    add_pins,
    add_reduced_body,
    build_body,
    carry_over,
    hold,
    quadrature_from_box,
)
from softmode.errors import AssetError, ConfigError

SIZE = (0.2, 0.05, 0.04)
END = Region(name="end", box=((-1.0, -1.0, -1.0), (-0.08, 1.0, 1.0)))
OTHER = Region(name="other", box=((0.08, -1.0, -1.0), (1.0, 1.0, 1.0)), stiffness=1.0e4)
OPTIONS = BuildOptions(mode_count=4, kernel_count=150, cubature_count=96)


@pytest.fixture(scope="module")
def quadrature():
    """A bar."""
    return quadrature_from_box(SIZE, point_count=1500, surface_count=400)


@pytest.fixture(scope="module")
def scales(quadrature):
    """Relative moduli, densities and Poisson's ratios of the bar."""
    x = quadrature.points[:, 0]
    ratio = np.where(x > 0.0, 0.45, 0.2)
    return {"stiffness_scale": np.where(x > 0.0, 4.0, 1.0), "density_scale": 1.0 + np.abs(x), "poissons_ratio": ratio}


@pytest.fixture(scope="module")
def free(quadrature, scales):
    """The bar, built free."""
    return build_body(quadrature, OPTIONS, name="bar", **scales)


@pytest.fixture(scope="module")
def held(free):
    """The bar, held at one end after its build."""
    return hold(free, END)


def test_is_the_body_that_was_told(free, held, quadrature, scales, tmp_path):
    """Bit for bit, one region after the other, and after a way through a file."""
    told = build_body(quadrature, OPTIONS, name="bar", regions=(END, OTHER), **scales)
    held.save(tmp_path / "bar.npz")
    again = hold(ReducedBody.load(tmp_path / "bar.npz"), OTHER)
    assert again.regions.names == ("end", "other") and told.fingerprint == again.fingerprint
    for field in dataclasses.fields(told):
        a, b = getattr(told, field.name), getattr(again, field.name)
        if isinstance(a, np.ndarray):
            assert np.array_equal(a, b), field.name
    assert told.provenance.keys() == again.provenance.keys()


@pytest.mark.rest
def test_a_number_of_functions_is_kept(quadrature):
    """A body of 24 functions chosen by elastic energy is held as one of 24."""
    options = BuildOptions(function_count=24, kernel_count=150)
    told = build_body(quadrature, options, regions=(END,))
    assert told.function_count == 24
    assert np.array_equal(hold(build_body(quadrature, options), END).transform, told.transform)


def test_what_others_noted_stays(free):
    """Provenance that was added after the build is that of the held body too."""
    noted = dataclasses.replace(free, provenance={**free.provenance, "turn": "[1]"})
    assert hold(noted, END).provenance["turn"] == "[1]"


def test_affine_motion_goes_over(free, held):
    """A turned, stretched and moving body is that after it is held."""
    rng = np.random.default_rng(0)
    A, t, B, v = rng.normal(size=(3, 3)), rng.normal(size=3), rng.normal(size=(3, 3)), rng.normal(size=3)
    q, qd = carry_over(free, held, free.affine(A, t), free.affine(np.eye(3) + B, v))
    X, before = held.surface.points, held.surface.points + held.offset - free.offset
    np.testing.assert_allclose(X + held.evaluate(X)[0] @ q, before @ A.T + t, atol=1e-9)
    np.testing.assert_allclose(held.evaluate(X)[0] @ qd, before @ B.T + v, atol=1e-9)


def test_momentum_goes_over(free, held):
    """A projection in mass keeps the momentum of a motion, up to quadrature, and makes no kinetic energy."""
    qd = np.zeros((free.function_count, 3))
    qd[:8] = np.random.default_rng(1).normal(size=(8, 3))
    found = carry_over(free, held, 0.0 * qd, qd)[1]
    np.testing.assert_allclose(held.mean_basis @ found, free.mean_basis @ qd, atol=1e-3 * np.linalg.norm(qd))
    assert np.linalg.norm(found) < np.linalg.norm(qd) * (1.0 + 1e-3)


def test_sources_may_be_left_out(free, tmp_path):
    """The file is then smaller, and says what is missing."""
    free.save(tmp_path / "with.npz")
    free.save(tmp_path / "without.npz", sources=False)
    assert (tmp_path / "without.npz").stat().st_size < (tmp_path / "with.npz").stat().st_size
    bare = ReducedBody.load(tmp_path / "without.npz")
    with pytest.raises(ConfigError, match="does not keep what it was built from"):
        hold(bare, END)
    assert np.array_equal(bare.transform, free.transform)


def test_errors(free):
    """No region, a region twice, damaged sources, motion of another body."""
    with pytest.raises(ConfigError, match="none given"):
        hold(free)
    with pytest.raises(ConfigError, match="end"):
        hold(free, END, END)
    damaged = dataclasses.replace(free, sources={**free.sources, "document": np.zeros(3, dtype=np.uint8)})
    with pytest.raises(AssetError, match="damaged"):
        hold(damaged, END)
    q = np.zeros((3, 3))
    with pytest.raises(ConfigError, match="q and qd"):
        carry_over(free, free, q, q)


def solver_of(body, points):
    """Return a solver of a body that is pinned at rest points."""
    builder = newton.ModelBuilder()
    instance = add_reduced_body(builder, body)
    add_pins(builder, instance, points, stiffness=1e3)
    return SolverReduced(builder.finalize(device="cpu"), [body])


def test_pins_that_the_build_was_not_told_of(free, held):
    """Pins on an end warn by the body's name; not where the build knew, nor at single points."""
    end = free.surface.points[free.surface.points[:, 0] < -0.085]
    with pytest.warns(UserWarning, match=r"'bar'.*hold\(body"):
        solver_of(free, end)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solver_of(held, end)
        solver_of(free, end[:1])
