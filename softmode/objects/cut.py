"""Cut objects: the parts of a body with the splats that show them, and the faces that a knife has opened."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_ndtr

from softmode.deformables.reduction.cut import Cut, cut_body
from softmode.deformables.reduction.patch import Patch
from softmode.objects.object_file import stored_material
from softmode.objects.shapes.primitives import Color
from softmode.objects.soft_object import SoftObject
from softmode.splats.point_cloud import splats_from_points
from softmode.splats.splats import Splats, joined

Array = NDArray[np.float64]

STRADDLE = 2.0
"""Splats nearer to the patch than so many standard deviations are split."""
_FACE_LEAST = 4


def cut_object(
    thing: SoftObject,
    patch: Patch,
    q: ArrayLike | None = None,
    *,
    inside: Color | None = None,
    progress: bool | Callable[[str, float], None] | None = None,
) -> tuple[tuple[SoftObject, ...], Cut]:
    """Cut an object by a patch, see :func:`softmode.deformables.cut_body`.

    A splat goes to the side of its centre. One that straddles the patch becomes two: what the patch leaves of a
    Gaussian on either side, by its mean and covariance, as opaque as the splat was there. The faces that are opened are
    covered with flat splats.

    Args:
        thing: The object.
        patch: What cuts: in asset coordinates; with ``q`` in the world that ``q`` puts the object in.
        q: Coordinates [m] of its body where it is cut, shape (n, 3); None cuts it at rest.
        inside: Colour of the opened faces; None for the mean of the splats.
        progress: As for :func:`softmode.deformables.build_body`.

    Returns:
        The parts, the heaviest first, or the object itself where the patch misses it; and the cut.

    Raises:
        ConfigError: If the body keeps no sources or no grid, or the patch cuts an exact region.
        BasisError: If a part is too small for a body, or held as a whole.
    """
    cut = cut_body(thing.body, patch, q, progress=progress)
    if cut.missed:
        return (thing,), cut
    shown, owner, color = thing.splats, np.zeros(0, dtype=np.intp), np.zeros(3)
    if shown is not None:
        shown = split_splats(shown, *cut.levels(shown.means.astype(np.float64)))
        owner = cut.owners(shown.means.astype(np.float64))
        color = shown.opacities @ shown.colors() / shown.opacities.sum() if inside is None else np.array(inside)
    parts = []
    for number, (body, density, face) in enumerate(zip(cut.bodies, cut.densities, cut.faces, strict=True)):
        stored = stored_material(body)
        if "density" in stored:
            stored["density"] *= density
            body = replace(body, provenance={**body.provenance, "material": json.dumps(stored)})
        material = thing.material and replace(thing.material, density=thing.material.density * density)
        splats = None
        if shown is not None:
            own, cover = np.flatnonzero(owner == number), []
            if len(own):
                cover.append(shown.subset(own).transformed(translation=thing.body.offset - body.offset))
            if len(face[0]) >= _FACE_LEAST:
                cover.append(splats_from_points(*face, np.broadcast_to(color, face[0].shape)))
            splats = joined(cover, body.name) if cover else None
        parts.append(replace(thing, body=body, splats=splats, material=material, radiance=None, config=None))
    return tuple(parts), cut


def split_splats(splats: Splats, level: Array, normal: Array) -> Splats:
    """Return splats with those that straddle a surface split in two.

    Of a Gaussian of standard deviation s along the normal, whose centre lies z s in front of the surface, the part in
    front has its centre l s further out and the variance s^2 (1 - z l - l^2), with l = phi(z) / Phi(z); its opacity is
    the splat's there, exp(-l^2 / 2) of that at the centre. Behind likewise, with -z.

    Args:
        splats: The splats.
        level: Distance of each centre in front of the surface [m], infinite far from it, shape (N,).
        normal: Unit normals of the surface, shape (N, 3).
    """
    C = splats.covariances()
    along = np.einsum("nij,nj->ni", C, normal)
    s = np.sqrt(np.maximum((along * normal).sum(axis=1), 0.0))
    rows = np.flatnonzero(np.isfinite(level) & (s > 0.0) & (np.abs(level) < STRADDLE * s))
    if not len(rows):
        return splats
    parts, rest = [], np.setdiff1d(np.arange(splats.count), rows)
    if len(rest):
        parts.append(splats.subset(rest))
    chosen, C, along, s = splats.subset(rows), C[rows], along[rows] / s[rows, None], s[rows]
    for side in (1.0, -1.0):
        z = side * level[rows] / s
        shift = np.exp(-(z**2) / 2.0 - np.log(np.sqrt(2.0 * np.pi)) - log_ndtr(z))
        variance = 1.0 - z * shift - shift**2
        means = chosen.means.astype(np.float64) + side * shift[:, None] * along
        kept = C - (1.0 - variance)[:, None, None] * along[:, :, None] * along[:, None]
        faint = replace(chosen, opacities=chosen.opacities * np.exp(-0.5 * shift**2))
        parts.append(faint.with_covariances(means, kept, np.eye(3)))
    return joined(parts, splats.name)
