"""Clamps and fields told late: the body that a build told of further regions, or of other stiffness, would have given.

Smooth functions cannot be held hard where the build was not told of it: stiffer springs make such a body move less and
less, whatever its functions. A body keeps what it was built from, so that it can be built again with the region, and
the motion of one body is carried over to the other.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.reduction.build_body import Field, build_body, positive_field, ratio_field
from softmode.deformables.reduction.sources import Sources, mass_points, unpack_sources
from softmode.errors import ConfigError

Array = NDArray[np.float64]


def hold(
    body: ReducedBody, *regions: Region, progress: bool | Callable[[str, float], None] | None = None
) -> ReducedBody:
    """Return the body that a build told of further regions would have given.

    It takes as long as the build. Motion goes over by :func:`carry_over`.

    Args:
        body: A body that keeps its sources: one that was built, or read from a file that was saved with them.
        regions: Regions in asset coordinates, as for :func:`build_body`; a point X of the body frame is at X + `offset`
            there.
        progress: As for :func:`build_body`.

    Raises:
        ConfigError: If the body keeps no sources, no region is given, or two have one name.
        BasisError: If a region holds too few points or overlaps another.
        AssetError: If the sources are damaged.
    """
    if not regions:
        raise ConfigError("regions: none given", hint="name what is to be held, such as Region(name='end', box=...)")
    given = unpack_sources(body)
    return _again(body, dataclasses.replace(given, regions=(*given.regions, *regions)), progress)


def paint(
    body: ReducedBody,
    *,
    stiffness_scale: Field | None = None,
    density_scale: Field | None = None,
    poissons_ratio: Field | None = None,
    progress: bool | Callable[[str, float], None] | None = None,
) -> ReducedBody:
    """Return the body that a build with other fields would have given.

    Args:
        body: As for :func:`hold`.
        stiffness_scale: Relative Young's modulus, as for :func:`build_body`; None leaves what it has.
        density_scale: Relative density, likewise.
        poissons_ratio: Poisson's ratio, likewise.
        progress: As for :func:`build_body`.

    Raises:
        ConfigError: If the body keeps no sources.
        MaterialError: If a scale is not finite and positive, or a Poisson's ratio lies outside 0 <= nu < 0.5.
        AssetError: If the sources are damaged.
    """
    given = unpack_sources(body)
    points = given.quadrature.points
    fields = {"stiffness_scale": stiffness_scale, "density_scale": density_scale}
    changed = {name: positive_field(name, value, points) for name, value in fields.items() if value is not None}
    if poissons_ratio is not None:
        changed["poissons_ratio"] = ratio_field(poissons_ratio, points)
    return _again(body, dataclasses.replace(given, **changed), progress)


def _again(body: ReducedBody, given: Sources, progress: bool | Callable[[str, float], None] | None) -> ReducedBody:
    """Build a body again from sources like its own."""
    made = build_body(
        given.quadrature,
        given.options,
        name=body.name,
        regions=given.regions,
        stiffness_scale=given.stiffness_scale,
        density_scale=given.density_scale,
        poissons_ratio=given.poissons_ratio,
        progress=progress,
    )
    return dataclasses.replace(made, provenance={**body.provenance, **made.provenance})


def carry_over(old: ReducedBody, new: ReducedBody, q: ArrayLike, qd: ArrayLike) -> tuple[Array, Array]:
    """Return the motion of one body in the functions of another of the same asset, by projection in mass.

    Affine motions stay exactly what they are, and so does the momentum. The distance in place and in velocity,
    averaged over the mass, is the least that the other body's functions allow.

    Args:
        old: The body that moves.
        new: The other.
        q: Coordinates [m], shape (n, 3).
        qd: Their velocities [m/s], likewise.

    Returns:
        Coordinates [m] and velocities [m/s] of the other body, shape (n', 3).

    Raises:
        ConfigError: If shapes do not fit the first body.
    """
    place, rate = np.asarray(q, dtype=np.float64), np.asarray(qd, dtype=np.float64)
    if place.shape != (old.function_count, 3) or rate.shape != place.shape:
        raise ConfigError(f"q and qd: expected shape ({old.function_count}, 3), got {place.shape} and {rate.shape}")
    X, mass = mass_points(new)
    shift = new.offset - old.offset  # X of the new body is X + shift of the old one
    before = old.evaluate(X + shift)[0]
    values = np.hstack([before @ place + shift, before @ rate])
    found = new.fit(values, X, mass)
    # Where a point lies beyond the kernels' reach, the mean of the build is not that of `evaluate`: to rounding again.
    found = found + new.linear_coordinates[:, 3:] * (mass @ values / mass.sum() - new.mean_basis @ found)
    return found[:, :3], found[:, 3:]
