"""Bodies, splats and states that the tests of the export share."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.splats import Splats
from tests import bodies
from tests.splats.test_splats import random_splats

KINDS = ("affine", "quadratic", "regions")
MATERIAL = Material(
    youngs_modulus=34567.8,
    poissons_ratio=0.41,
    density=271.3,
    viscosity=0.0037,
    mass_damping=0.1,
    friction=0.55,
    model=MaterialModel.COROTATED,
)
"""A material of which no number but the first is a float32."""
TURN = np.array([[0.0, -0.6, 0.8], [1.0, 0.0, 0.0], [0.0, 0.8, 0.6]])


@functools.cache
def small_body(kind: str) -> ReducedBody:
    """Return a small body with one kind of handles: affine, quadratic, or with a region and static responses."""
    made = {"affine": lambda: bodies.two_modes(0.1), "quadratic": bodies.quadratic_box, "regions": bodies.clamped}
    return dataclasses.replace(made[kind](), name=f"bar {kind}")


def small_splats(coefficients: int = 1) -> Splats:
    """Return splats in the bodies."""
    splats = random_splats(count=50, coefficients=coefficients)
    low, high = splats.bounds()
    inside = (splats.means - low) / (high - low) - 0.5
    return dataclasses.replace(splats, means=inside * (0.06, 0.04, 0.03), scales=np.full((50, 3), (3e-3, 2e-3, 1e-3)))


def some_state(body: ReducedBody, seed: int = 7, scale: float = 1.0) -> np.ndarray:
    """Return coordinates of a bent and turned body."""
    rng = np.random.default_rng(seed)
    return body.affine(scale * TURN, (0.3, -0.2, 0.5)) + 0.003 * rng.normal(size=(body.function_count, 3))


assert_same = functools.partial(bodies.assert_same, skip=("sources",))
"""Assert that two bodies are equal to the bit, but for what they were built from, which no stage has."""


def assert_same_splats(one: Splats, other: Splats) -> None:
    """Assert that two sets of splats are equal to the bit."""
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
