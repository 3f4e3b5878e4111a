"""Dents: how far a surface gives under a patch of pressure that the functions of its body are too few to carry.

n functions in a volume V resolve patches of the size h = (V / n)^(1/3). What a narrower patch would press in beyond
their motion is, per pressure,

    w = 0.35 h (1 - nu^2) / E (1 - c^2),

a bed of springs (Winkler) of the scale that is missing, in series with the penalty of contact, less with the share c of
the neighbourhood that touches: what presses on a whole face, the functions carry. It was fitted to pairs
of opposite discs on cubes, beams, pads and spheres of 28 to 68 functions against 2,000 kernels. A wall is no
softer than itself: h is bounded by a share of its thickness.

What is drawn of a body lies on its skin. It follows the dents that a step leaves at the samples near it, and less the
deeper it lies: see `dent_weights`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.contact.cell_kernels import Surface
from softmode.deformables.contact.pairs import thickness
from softmode.deformables.model.struct_kernels import VANISHING, PointConstraints
from softmode.deformables.model.tables import allocate

Array = NDArray[np.float64]

DENT_FACTOR = 0.35
"""Dent over the size of what the functions resolve, under the pressure E / (1 - nu^2), where nothing around is touched.
"""
WALL_SHARE = 0.6
"""Bound of that size as a share of the thickness below a sample."""
COVER = 1.6
"""Radius over the resolved size of the neighbourhood whose touched share a dent is less by. A wall does not cut it."""
CARRIED = 0.99
"""c where all of the neighbourhood touches. What is left of the dent softens a squeeze by 1 %
at most; without it, a dent that comes and goes with gaps of micrometres costs a grasp iterations."""
CELL_NEIGHBOURS = 24
"""Nearest samples that bound a cell, those on the other side of a sheet among them."""
RAYS = 64
"""Rays from a sample to the bound of its cell: of a ball of 800 its moments are then within 0.3 % of those of dense
points, but for what its sample's area differs by."""
THIN = 3.0
"""Thicknesses below which a body is thin: contact then sinks in by a share of them, not of its size."""
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


def neighbourhoods(body: ReducedBody) -> list[tuple[NDArray[np.int64], Array]]:
    """Return the samples around each that face the same way within 60 degrees, and their weights, of sum CARRIED."""
    x, n, area = body.surface.points, body.surface.normals, body.surface.areas
    radius = np.maximum(COVER * resolved_size(body), 1.5 * np.sqrt(area))
    found = []
    for s, near in enumerate(KDTree(x).query_ball_point(x, radius)):
        same = np.array(near)[n[near] @ n[s] > 0.5]
        weight = area[same] * np.maximum(1.0 - ((x[same] - x[s]) ** 2).sum(axis=1) / radius[s] ** 2, 1e-3)
        found.append((same, CARRIED * weight / weight.sum()))
    return found


def mean_curvature(body: ReducedBody) -> Array:
    """Return the mean curvature at the samples [1/m], from the eight nearest whose normals are within 45 degrees."""
    x, n = body.surface.points, body.surface.normals
    near = KDTree(x).query(x, min(9, len(x)))[1].reshape(len(x), -1)[:, 1:]
    d, dn = x[near] - x[:, None], n[near] - n[:, None]
    same = np.einsum("ik,ijk->ij", n, n[near]) > 0.7
    return (same * (d * dn).sum(-1)).sum(1) / np.maximum((same * (d * d).sum(-1)).sum(1), 1e-30)


def nearest_samples(body: ReducedBody) -> NDArray[np.intp]:
    """Return the samples around each that bound its cell, itself first, shape (N, K)."""
    x = body.surface.points
    return KDTree(x).query(x, min(CELL_NEIGHBOURS + 1, len(x)))[1].reshape(len(x), -1)


def cells(body: ReducedBody) -> tuple[Array, Array]:
    """Return the middles of the samples' cells from the samples (N, 3) [m], and 12 second moments about them [m^2].

    A cell is what is nearer to its sample than to any other in the plane there, up to where that meets the faces of
    those that face another way. It is as large as the area of its sample.
    """
    x, n, area = body.surface.points, body.surface.normals, np.maximum(body.surface.areas, 1e-30)
    near = nearest_samples(body)[:, 1:]
    arm, other = x[near] - x[:, None], n[near]
    same = np.einsum("ik,ijk->ij", n, other) > 0.5
    beyond = np.einsum("ijk,ijk->ij", arm, other)
    across = np.where(same[..., None], arm, np.sign(beyond)[..., None] * other)
    bound = np.where(same, 0.5 * (arm**2).sum(axis=2), np.abs(beyond))
    first = np.cross(n, np.eye(3)[np.abs(n).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    angle = 2.0 * np.pi / RAYS * np.arange(RAYS)[:, None]
    ray = np.cos(angle) * first[:, None] + np.sin(angle) * np.cross(n, first)[:, None]
    along = ray @ across.transpose(0, 2, 1)
    reach = np.where(along > 0.0, bound[:, None] / np.maximum(along, 1e-30), np.inf).min(axis=2, initial=np.inf)
    reach = np.minimum(reach, np.sqrt(area)[:, None])
    reach *= np.sqrt(area / (np.pi * (reach**2).mean(axis=1)))[:, None]
    share = 2.0 * np.pi / RAYS / area[:, None]
    middle = np.einsum("ir,irk->ik", share * reach**3 / 3.0, ray)
    moments = np.einsum("ir,irk,irl->ikl", share * reach**4 / 4.0, ray, ray)
    return middle, 12.0 * (moments - middle[:, :, None] * middle[:, None])


def insets(body: ReducedBody) -> Array:
    """Return how far the square that stands for a cell lies from its sample, as it ends at the body's edges [m]."""
    x, n, side = body.surface.points, body.surface.normals, np.sqrt(body.surface.areas)
    near = nearest_samples(body)
    height = np.einsum("ik,ijk->ij", n, n[near])
    toward = n[near] - height[..., None] * n[:, None]
    steep = np.maximum(np.linalg.norm(toward, axis=2), 1e-30)
    toward /= steep[..., None]
    edge = np.einsum("ijk,ijk->ij", x[near] - x[:, None], n[near]) / steep
    edge = np.where((height < 0.5) & (steep > 0.5) & (edge >= 0.0), edge, 1e30)
    shift = np.zeros_like(x)
    for _ in range(2):  # the nearest edge, and the nearest across
        nearest = edge.argmin(axis=1)
        first, way = edge.min(axis=1), toward[np.arange(len(x)), nearest]
        along = np.einsum("ijk,ik->ij", toward, way)
        behind = np.where(along < -0.5, edge, 1e30).min(axis=1)
        shift -= np.maximum(np.minimum(0.5 * side - first, 0.5 * (behind - first)), 0.0)[:, None] * way
        edge = np.where(np.abs(along) > 0.5, 1e30, edge)
    return shift


def surface_table(
    bodies: Sequence[ReducedBody], stiffness: Array, first_row: int, row_max: int, device: wp.Device
) -> Surface:
    """Return what contact knows of the surfaces of all bodies.

    Args:
        bodies: The bodies.
        stiffness: Shear modulus at all samples relative to that of their body.
        first_row: First of the rows at centres of pressure.
        row_max: Such rows of an instance.
        device: Where the table lies.
    """
    around = [pair for body in bodies for pair in neighbourhoods(body)]
    cell = [cells(body) for body in bodies]
    given = {
        "relative_stiffness": stiffness,
        "dent_length": np.concatenate([dent_lengths(body) for body in bodies]),
        "slenderness": np.concatenate([slenderness(body) for body in bodies]),
        "curvature": np.concatenate([mean_curvature(body) for body in bodies]),
        "middle": np.concatenate([middle for middle, _moments in cell]),
        "moments": np.concatenate([moments for _middle, moments in cell]),
        "inset": np.concatenate([insets(body) for body in bodies]),
        "start": np.cumsum([0, *(len(samples) for samples, _weights in around)]),
        "neighbour": np.concatenate([samples for samples, _weights in around]),
        "weight": np.concatenate([weights for _samples, weights in around]),
        "first_row": first_row,
        "row_max": row_max,
    }
    return allocate(Surface, "", {}, device, given=given)


def sample_room(body: ReducedBody, margin: float) -> int:
    """Return how many contacts the samples of a body may have at a time where they are found within so many sizes.

    Two where both sides of a thin part may be near what touches one of them.
    """
    thin = thickness(body) < 4.0 * margin * np.linalg.norm(np.ptp(body.bounds, axis=0))
    return body.surface_count + int(thin.sum())


def slenderness(body: ReducedBody) -> Array:
    """Return the size of a body over the smaller of it and THIN thicknesses, at its samples."""
    return np.maximum(np.linalg.norm(np.ptp(body.bounds, axis=0)) / (THIN * thickness(body)), 1.0)


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

    At the samples; of two soft bodies the sum. Counts for contacts; pins and what lies beyond the count of an instance
    mean nothing. Reads from the device.
    """
    total = constraints.offset.numpy() + constraints.displacement.numpy()
    sunk = -np.einsum("nek,nek->ne", constraints.normal.numpy(), total) - constraints.lead.numpy()
    ratio = constraints.stiffness.numpy() * constraints.dent_compliance.numpy()
    return ratio / (1.0 + ratio) * np.maximum(sunk, 0.0)
