"""Dents: how far a surface gives under a patch of pressure that the functions of its body are too few to carry.

n functions in a volume V resolve patches of the size h = (V / n)^(1/3). What a narrower patch would press in beyond
their motion is, per pressure,

    w = 0.30 h (1 - nu^2) / E,

a bed of springs (Winkler) of the scale that is missing, in series with the penalty of contact. It was fitted to pairs
of opposite discs on cubes, beams, pads and spheres of 28 to 68 functions against 2,000 kernels: radii of 12 to 18 mm on
bodies of 100 mm then give 0.88 to 1.1 of the fine compliance, where the functions alone give 0.3 to 0.7. A wall is no
softer than itself: h is bounded by a share of its thickness.

What is drawn of a body lies on its skin. It follows the dents that a step leaves at the samples near it, and less the
deeper it lies: see `dent_weights`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.contact.pairs import thickness
from softmode.deformables.model.struct_kernels import VANISHING, PointConstraints

Array = NDArray[np.float64]

DENT_FACTOR = 0.30
"""Dent over the size of what the functions resolve, under the pressure E / (1 - nu^2)."""
WALL_SHARE = 0.6
"""Bound of that size as a share of the thickness below a sample."""
NEAREST = 4
"""Surface samples whose dents move a point: a plush on its feet then shows 0.18 mm below the floor, with three 0.24,
with eight 0.17."""
ACROSS = 3.0
"""Distance along the normal of a sample over that along the surface, so that the other side of a thin wall is far."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DentWeights:
    """By how much of the dents of which surface samples each of N points moves."""

    samples: NDArray[np.int32]
    """Indices of samples, shape (N, k)."""
    weights: NDArray[np.float32]
    """Shares of their dents, shape (N, k)."""


def resolved_size(body: ReducedBody) -> float:
    """Return the size of the patches that a body's functions resolve, (V / n)^(1/3) [m].

    n counts the functions that deform the body. Those that move its exact regions do not: they say nothing of the rest.
    """
    return (body.volume / max(body.function_count - body.driven_count, 1)) ** (1.0 / 3.0)


def dent_lengths(body: ReducedBody) -> Array:
    """Return w E / (1 - nu^2) at the surface samples of a body, shape (surface_count,) [m].

    Zero on exact regions, which are where they are driven to, and rigid.
    """
    free = (np.abs(body.surface.basis[:, body.driven_count :]) > VANISHING).any(axis=1)
    return np.where(free, DENT_FACTOR * np.minimum(resolved_size(body), WALL_SHARE * thickness(body)), 0.0)


def dent_weights(body: ReducedBody, points: ArrayLike) -> DentWeights:
    """Return how points of a body follow the dents of its surface samples.

    On the skin they take the dents of the nearest samples, weighted as by Franke and Nielson 1980
    (doi:10.1002/nme.1620151110), ((R - r) / (R r))^2 with R the distance to the first that does not count: exact at the
    samples. Below it they follow less, by exp(-depth / h), h the size that the functions resolve: the width of a patch
    is how deep its pressure reaches.

    Args:
        body: The body.
        points: Rest points in the body frame [m], shape (N, 3).
    """
    x, surface, normals = np.asarray(points, dtype=np.float64), body.surface.points, body.surface.normals
    near = KDTree(surface).query(x, min(4 * NEAREST, len(surface)))[1]
    arm = x[:, None] - surface[near]
    height = np.einsum("nkd,nkd->nk", arm, normals[near])
    distance = np.sqrt((arm**2).sum(axis=2) + (ACROSS**2 - 1.0) * height**2)
    order = np.argsort(distance, axis=1)[:, : NEAREST + 1]
    near, height, distance = (np.take_along_axis(a, order, axis=1) for a in (near, height, distance))
    reach, distance = distance[:, -1:], np.maximum(distance, 1e-6 * distance[:, -1:])[:, :NEAREST]
    share = ((reach - distance) / distance) ** 2
    share /= share.sum(axis=1, keepdims=True)
    deep = np.exp(-np.maximum(-height[:, :1], 0.0) / resolved_size(body))
    return DentWeights(samples=near[:, :NEAREST].astype(np.int32), weights=(share * deep).astype(np.float32))


def contact_dents(constraints: PointConstraints) -> Array:
    """Return how far the bodies give way at the contacts of the last step [m], shape (instance_count, constraint_max).

    Of two soft bodies the sum. Counts for contacts; pins and what lies beyond the count of an instance mean nothing.
    Reads from the device.
    """
    pressed = np.einsum("nek,nek->ne", constraints.normal.numpy(), constraints.force.numpy())
    give = constraints.dent_compliance.numpy() * np.maximum(pressed, 0.0)
    return np.minimum(give, constraints.dent_depth.numpy())  # from there on the stiffer penalty carries
