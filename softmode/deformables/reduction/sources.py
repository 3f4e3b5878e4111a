"""What a body was built from, kept with it so that it can be built again: quadrature, options, regions, fields."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.quadrature.quadrature_grid import Cells, Quadrature
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.reduction.region_samples import pieces_near, refine_at_faces
from softmode.errors import AssetError, ConfigError

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sources:
    """The arguments of a build."""

    quadrature: Quadrature
    """The object."""
    options: BuildOptions
    """How it was reduced."""
    regions: tuple[Region, ...]
    """Regions in asset coordinates."""
    stiffness_scale: Array | None
    """Relative Young's modulus per quadrature point, shape (P,), or None."""
    density_scale: Array | None
    """Relative density, likewise."""
    poissons_ratio: Array | None = None
    """Poisson's ratio, likewise."""


FIELDS = ("stiffness_scale", "density_scale", "poissons_ratio")
"""Fields of material."""


def pack_sources(sources: Sources) -> dict[str, NDArray[Any]]:
    """Return the arguments of a build as arrays by name, as :attr:`ReducedBody.sources` keeps them."""
    arrays, told = _split(sources.quadrature)
    if sources.quadrature.cells is not None:
        arrays |= {f"cells.{name}": value for name, value in _split(sources.quadrature.cells)[0].items()}
    for name in FIELDS:
        if getattr(sources, name) is not None:
            arrays[name] = np.asarray(getattr(sources, name), dtype=np.float64)
    regions = [
        {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in vars(region).items()}
        for region in sources.regions
    ]
    document = {"quadrature": told, "options": dataclasses.asdict(sources.options), "regions": regions}
    arrays["document"] = np.frombuffer(json.dumps(document).encode(), dtype=np.uint8)
    return arrays


def unpack_sources(body: ReducedBody) -> Sources:
    """Return what a body was built from.

    Raises:
        ConfigError: If the body keeps no sources.
        AssetError: If a file held something else.
    """
    if not body.sources:
        raise ConfigError(
            f"body {body.name!r} does not keep what it was built from",
            hint="build it again, or save it with sources=True",
        )
    stored = dict(body.sources)
    try:
        document = json.loads(stored.pop("document").tobytes())
        fields = {name: stored.pop(name, None) for name in FIELDS}
        cells = {name.removeprefix("cells."): stored.pop(name) for name in list(stored) if name.startswith("cells.")}
        members = {name: stored.pop(name).astype(bool) for name in ("members", "satellites") if name in stored}
        quadrature: dict[str, Any] = {**document["quadrature"], **stored, **members}
        options = document["options"]
        if isinstance(options["poissons_ratio"], list):
            options["poissons_ratio"] = tuple(options["poissons_ratio"])
        return Sources(
            quadrature=Quadrature(**quadrature, cells=Cells(**cells) if cells else None),
            options=BuildOptions(**options),
            regions=tuple(Region(**region) for region in document["regions"]),
            **fields,
        )
    except Exception as error:  # whatever fields of other types and shapes lead to
        raise AssetError(
            f"body {body.name!r}: what it was built from is damaged ({error})", hint="build it again"
        ) from error


def mass_points(body: ReducedBody) -> tuple[Array, Array]:
    """Return points of the body frame [m] (N, 3) and masses (N,) that integrate over the body's mass.

    They are those of the build where the body keeps its sources, else the cubature's, with volumes for masses.
    """
    if not body.sources:
        return body.cubature.points, body.cubature.weights
    given = unpack_sources(body)
    pieces = pieces_near(given.quadrature, given.regions)
    points, volumes, parent = refine_at_faces(body.regions.parts, pieces, body.offset)
    return points, volumes if given.density_scale is None else volumes * given.density_scale[pieces.parent[parent]]


def _split(value: Quadrature | Cells) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the arrays of a record and what else it holds that JSON can."""
    fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    arrays = {name: item for name, item in fields.items() if isinstance(item, np.ndarray)}
    arrays = {name: item.astype(np.uint8) if item.dtype == bool else item for name, item in arrays.items()}
    told = {name: item for name, item in fields.items() if name not in arrays and name != "cells" and item is not None}
    if "report" in told:
        told["report"] = {key: item for key, item in told["report"].items() if _plain(item)}
    return arrays, told


def _plain(value: Sequence[Any] | object) -> bool:
    """Return whether JSON gives a value back as it is."""
    return value is None or type(value) in (str, bool, int, float)
