"""The bodies of the tests: small ones, each built once and kept while the sources that build are the same.

A test of what a body *does* takes one of these. A test of the *build* builds its own, and its file says why in a
paragraph of its docstring that begins with "Builds".
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ParamSpec, cast

import numpy as np

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.quadrature.quadrature import quadrature_from_box, quadrature_from_sphere
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.quadrature.quadrature_implicit import quadrature_from_implicit
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.cache import cached_body
from softmode.deformables.reduction.options import BuildOptions

Given = ParamSpec("Given")
BODIES: dict[str, Callable[..., ReducedBody]] = {}
"""The functions that return a body, by name."""
RECIPES: dict[str, Callable[..., Recipe]] = {}
"""The functions that return its recipe."""
EVERYWHERE = np.array([[-np.inf] * 3, [np.inf] * 3])


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What a body is built from."""

    name: str
    shape: Callable[..., Quadrature] = quadrature_from_box
    """Integrates the object, with what follows."""
    of: tuple
    """Its dimensions."""
    points: int
    """About how many quadrature points."""
    samples: int
    """Samples of the surface."""
    options: BuildOptions
    regions: tuple[Region, ...] = ()

    def integrate(self) -> Quadrature:
        """Return the quadrature of the object."""
        return self.shape(*self.of, point_count=self.points, surface_count=self.samples)

    def build(self) -> ReducedBody:
        """Build the body."""
        return build_body(self.integrate(), self.options, name=self.name, regions=self.regions, progress=False)


def kept(recipe: Callable[Given, Recipe]) -> Callable[Given, ReducedBody]:
    """Make a function that returns a recipe return its body, from memory or from the cache of bodies."""

    @functools.cache
    @functools.wraps(recipe)
    def body(*args: Given.args, **kwargs: Given.kwargs) -> ReducedBody:
        made = recipe(*args, **kwargs)
        key = {f.name: getattr(made, f.name) for f in dataclasses.fields(made)} | {"shape": made.shape.__name__}
        return cached_body(("bodies of the tests", Path(__file__), key), made.build)

    BODIES[recipe.__name__], RECIPES[recipe.__name__] = body, recipe
    return cast(Callable[Given, ReducedBody], body)


def freeform(mode_count: int, kernel_count: int, cubature_count: int) -> BuildOptions:
    """Return options of a small body of FreeForm's functions."""
    return BuildOptions(mode_count=mode_count, kernel_count=kernel_count, cubature_count=cubature_count)


def _split_ring(opening: float, **counts: int) -> Quadrature:
    """Integrate a ring of square section about Z, cut open at +X by twice an opening [m]."""

    def distance(x: np.ndarray) -> np.ndarray:
        d = np.maximum(np.abs(np.hypot(x[:, 0], x[:, 1]) - 0.05) - 0.012, np.abs(x[:, 2]) - 0.015)
        cut = np.maximum(np.abs(x[:, 1]) - opening, -x[:, 0])
        return np.maximum(d, -cut) if opening > 0.0 else d

    return quadrature_from_implicit(distance, np.array([[-0.07, -0.07, -0.02], [0.07, 0.07, 0.02]]), **counts)


def changed(body: ReducedBody, **fields: object) -> ReducedBody:
    """Return a body with some of its fields, by the names of its file, in place of its own."""
    return ReducedBody.from_flat({**body.flat(), **fields}, sources=body.sources)


def assert_same(one: ReducedBody, other: ReducedBody, *, skip: tuple[str, ...] = ()) -> None:
    """Assert that two bodies are equal field by field, to the bit."""
    twin = other.flat()
    for name, a in one.flat().items():
        b = twin[name]
        if name in skip:
            continue
        if isinstance(a, np.ndarray):
            assert a.dtype == b.dtype and a.shape == b.shape, name
            assert a.tobytes() == b.tobytes(), name
        else:
            assert a == b and type(a) is type(b), name
    if "sources" not in skip:
        a, b = one.sources, other.sources
        assert (a is None) == (b is None)
        assert a is None or b is None or (a.keys() == b.keys() and all(np.array_equal(a[n], b[n]) for n in a))


# -- free bodies ------------------------------------------------------------------------------------------------------


@kept
def cube(edge: float = 0.1, mode_count: int = 4, surface_count: int = 150) -> Recipe:
    """Return a small cube: few functions and points, so that a step costs little."""
    options = freeform(mode_count, 150, 128)
    of = ((edge,) * 3,)
    return Recipe(name=f"cube {edge}", of=of, points=1000, samples=surface_count, options=options)


@kept
def bar(length: float = 0.4, edge: float = 0.1) -> Recipe:
    """Return a bar along X of square section."""
    of = ((length, edge, edge),)
    return Recipe(name="bar", of=of, points=2000, samples=200, options=freeform(6, 200, 200))


@kept
def brick() -> Recipe:
    """Return a box of three different moments of inertia."""
    of = ((0.2, 0.12, 0.06),)
    return Recipe(name="brick", of=of, points=1000, samples=150, options=freeform(4, 150, 128))


@kept
def default_box() -> Recipe:
    """Return a box of 6 x 5 x 4 cm as users get one, with the default options."""
    return Recipe(name="box", of=((0.06, 0.05, 0.04),), points=4000, samples=800, options=BuildOptions())


@kept
def default_cube() -> Recipe:
    """Return a cube of 10 cm as users get one."""
    return Recipe(name="cube", of=((0.1,) * 3,), points=4000, samples=800, options=BuildOptions())


@kept
def default_ball(poissons_ratio: float = 0.3) -> Recipe:
    """Return a ball of 5 cm radius as users get one, with functions for a Poisson's ratio."""
    options = BuildOptions(poissons_ratio=poissons_ratio)
    return Recipe(name="ball", shape=quadrature_from_sphere, of=(0.05,), points=3000, samples=800, options=options)


@kept
def small_box() -> Recipe:
    """Return the same box of few functions, points and samples."""
    options = freeform(4, 120, 96)
    return Recipe(name="box", of=((0.06, 0.05, 0.04),), points=1500, samples=200, options=options)


@kept
def quadratic_box() -> Recipe:
    """Return a box of all functions of two quadratic handles."""
    options = BuildOptions(mode_count=2, kernel_count=120, handles="quadratic", cubature_count=64)
    return Recipe(name="quadratic box", of=((0.06, 0.05, 0.04),), points=1200, samples=40, options=options)


@kept
def slab() -> Recipe:
    """Return a slab of 24 x 12 x 2 cm."""
    of = ((0.24, 0.12, 0.02),)
    return Recipe(name="slab", of=of, points=2000, samples=500, options=freeform(3, 150, 120))


@kept
def sheet() -> Recipe:
    """Return a thin square sheet."""
    of = ((0.12, 0.12, 0.004),)
    return Recipe(name="sheet", of=of, points=2000, samples=400, options=freeform(6, 150, 150))


@kept
def ball(radius: float = 0.03, surface_count: int = 150) -> Recipe:
    """Return a small ball."""
    options = freeform(3, 120, 100)
    name, shape = f"ball {surface_count}", quadrature_from_sphere
    return Recipe(name=name, shape=shape, of=(radius,), points=800, samples=surface_count, options=options)


@kept
def smooth_ball(mode_count: int = 8, surface_count: int = 1500) -> Recipe:
    """Return a ball of 5 cm radius with many samples, for contact patches."""
    options = freeform(mode_count, 250, 300)
    return Recipe(
        name="ball", shape=quadrature_from_sphere, of=(0.05,), points=3000, samples=surface_count, options=options
    )


@kept
def ring(opening: float = 0.01) -> Recipe:
    """Return a ring of square section about Z, cut open at +X by twice ``opening`` [m]; 0 leaves it closed."""
    options = freeform(6, 250, 200)
    return Recipe(name=f"ring {opening}", shape=_split_ring, of=(opening,), points=2000, samples=400, options=options)


@kept
def long_bar() -> Recipe:
    """Return a bar along X, 1 m long, of the functions that users get, with every quadrature point."""
    options = BuildOptions(function_count=48, cubature_count=None)
    of = ((1.0, 0.2, 0.2),)
    return Recipe(name="long bar", of=of, points=4000, samples=800, options=options)


@kept
def many_functions(function_count: int) -> Recipe:
    """Return a bar of so many functions of FreeForm's, about."""
    options = freeform(-(-function_count // 4), 300, 160)
    of = ((0.3, 0.1, 0.1),)
    name = f"bar of {function_count}"
    return Recipe(name=name, of=of, points=1500, samples=120, options=options)


@kept
def two_modes(edge: float = 1.0) -> Recipe:
    """Return a cube of the fewest functions; `tests/deformables/affine_body.py` takes the four affine ones of it."""
    of = ((edge,) * 3,)
    return Recipe(name=f"affine {edge}", of=of, points=1000, samples=96, options=freeform(2, 64, 8))


# -- held bodies ------------------------------------------------------------------------------------------------------


@kept
def held_bar(stiffness: float | None = None, ends: int = 1) -> Recipe:
    """Return a bar of 40 cm whose first (and last) 5 cm are a region."""
    left, right = EVERYWHERE.copy(), EVERYWHERE.copy()
    left[1, 0], right[0, 0] = -0.15, 0.15
    both = (Region(name="left", box=left, stiffness=stiffness), Region(name="right", box=right, stiffness=stiffness))
    options, regions = freeform(2, 200, 200), both[:ends]
    of = ((0.4, 0.1, 0.1),)
    return Recipe(name="held bar", of=of, points=2000, samples=150, options=options, regions=regions)


@kept
def held_cube() -> Recipe:
    """Return a small cube whose top is held exactly, by driven functions."""
    top = Region(name="top", box=[[-np.inf, -np.inf, 0.035], [np.inf] * 3])
    options, regions = freeform(4, 150, 128), (top,)
    of = ((0.1,) * 3,)
    return Recipe(name="held cube", of=of, points=1000, samples=100, options=options, regions=regions)


@kept
def clamped() -> Recipe:
    """Return a short bar whose first 3 cm are held exactly."""
    regions = (Region(name="clamp", box=np.array([[-np.inf] * 3, [-0.07, np.inf, np.inf]])),)
    options, of = freeform(3, 150, 160), ((0.2, 0.08, 0.06),)
    return Recipe(name="clamped", of=of, points=1000, samples=120, options=options, regions=regions)
