"""Files of soft objects: a body with the splats that show it, one .npz that `ReducedBody.load` reads as well."""

from __future__ import annotations

import os

import numpy as np

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.errors import AssetError
from softmode.splats.point_cloud import splats_from_points
from softmode.splats.splats import Splats
from softmode.stages import tokens

_FIELDS = ("means", "quats", "scales", "opacities", "sh")
_LIGHT = np.array([0.37, 0.29, 0.88])


def write_object(path: str | os.PathLike[str], body: ReducedBody, splats: Splats | None = None) -> None:
    """Write a body with its splats; the file appears complete or not at all.

    Args:
        path: The .npz to write.
        body: The body.
        splats: Its splats in the body frame; None writes the body alone, as `ReducedBody.save` does.
    """
    fields = {} if splats is None else {f"splats.{name}": getattr(splats, name) for name in _FIELDS}
    body.save(path, beside=fields)


def read_object(path: str | os.PathLike[str]) -> tuple[ReducedBody, Splats | None]:
    """Read a file written by `write_object` or `ReducedBody.save`, or a stage with one body from `usd.write_usd`.

    Returns:
        The body, and its splats in the body frame, or None if the file has none.

    Raises:
        AssetError: If the file is missing, damaged, foreign, or of another version.
    """
    if os.fspath(path).lower().endswith(tokens.SUFFIXES):
        from softmode.objects.stage_asset import read_usd_body

        return read_usd_body(path)
    body, stored = ReducedBody.load_with(path)
    if not stored:
        return body, None
    missing = {f"splats.{name}" for name in _FIELDS} ^ set(stored)
    if missing:
        raise AssetError(f"body file {path}: {sorted(missing)} do not match", hint="Build the body again.")
    return body, Splats(**{name: stored[f"splats.{name}"] for name in _FIELDS}, name=f"body file {path}")


def surface_cover(body: ReducedBody, color: tuple[float, float, float] = (0.55, 0.63, 0.75)) -> Splats:
    """Return splats on the surface samples of a body, lit from above, for a body that has none of its own."""
    light = 0.7 + 0.3 * np.clip(body.surface_normals @ _LIGHT, -1.0, 1.0)
    return splats_from_points(
        body.surface_points, body.surface_normals, light[:, None] * np.asarray(color), name=body.name
    )
