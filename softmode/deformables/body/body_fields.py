"""The fields of a body's file: flat, by name, as every version of the format has them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from softmode.deformables.body.detours import Detours
from softmode.deformables.body.qgmls import BasisQGMLS
from softmode.deformables.body.records import BodyCubature, BodyRegions, BodySurface
from softmode.deformables.body.regions import Region
from softmode.deformables.body.rkpm import BasisRKPM
from softmode.deformables.body.skinning_weights import SkinningWeights
from softmode.deformables.body.visibility import Visibility

TABLES = {
    "hidden_pairs": {"material_points", "hidden_pairs"},
    "detour_pairs": {"material_points", "material_frame", "detour_pairs", "detour_lengths"},
    "lame_ratio": {"lame_ratio"},
}
"""Arrays that only the file of a body has whose kernels do not act across gaps, or go around corners, or whose
Poisson's ratio varies."""
_ORDER = (
    ("", "name"),
    ("cubature.", "points weights grad_basis stiffness_scale lame_ratio"),
    ("surface.", "surface_points:points surface_normals:normals surface_areas:areas surface_basis:basis"),
    ("", "volume mean_basis linear_coordinates eigenvalues bounds offset"),
    (None, "centres radii kernel"),
    ("handles.", "handles:coefficients handle_degrees:degrees handle_regions:blends"),
    ("", "transform length driven_count"),
    (None, "region_names region_stiffness region_radii region_cores core_index"),
    ("regions.", "region_points:points region_index:index region_weights:weights drive drive_affine"),
    ("", "fingerprint provenance build_seconds"),
    ("regions.", "envelope_length gap_blends"),
    (None, "material_points hidden_pairs material_frame detour_pairs detour_lengths"),
)
"""Fields in the order of the files by their record, with its own name of a field after a colon; None if made."""
PLACES = {
    name: "" if record is None else record + (own or name)
    for record, fields in _ORDER
    for name, _, own in (field.partition(":") for field in fields.split())
}
"""Where a body has each field, in the order of the files; empty for what `made_fields` makes of kernels and regions."""
GAPS: dict[str, Any] = {
    "lame_ratio": np.zeros(0),
    "material_points": np.zeros((0, 3)),
    "hidden_pairs": np.zeros(0, dtype=np.int64),
    "material_frame": np.eye(3),
    "detour_pairs": np.zeros(0, dtype=np.int64),
    "detour_lengths": np.zeros(0, dtype=np.float32),
}
"""What stands for tables that a file does not have."""
QGMLS = "qgmls"
"""In place of the bell of reproducing kernels: the functions are those of Q-GMLS."""


def made_fields(kernels: BasisRKPM | BasisQGMLS, regions: BodyRegions) -> dict[str, Any]:
    """Return the fields of kernels, those of gaps and corners among them, and of regions."""
    cores = [region.cores for region in regions.parts]
    found = {
        **GAPS,
        "centres": kernels.centres,
        "radii": kernels.radii,
        "kernel": kernels.kernel if isinstance(kernels, BasisRKPM) else QGMLS,
        "region_names": regions.names,
        "region_stiffness": regions.stiffness,
        "region_radii": np.array([region.radius for region in regions.parts], dtype=np.float64),
        "region_cores": np.concatenate([np.zeros((0, 2, 3)), *cores]),
        "core_index": np.repeat(np.arange(len(cores), dtype=np.int64), [len(core) for core in cores]),
    }
    if isinstance(kernels, BasisRKPM) and kernels.visibility is not None:
        found |= {"material_points": kernels.visibility.points, "hidden_pairs": kernels.visibility.hidden}
    if isinstance(kernels, BasisRKPM) and (table := kernels.detours) is not None:
        found |= {"material_points": table.points, "material_frame": table.frame}
        found |= {"detour_pairs": table.pairs, "detour_lengths": table.lengths}
    return found


def records_of(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of a `ReducedBody` that has these fields.

    Raises:
        BasisError: If centres or radii of kernels are out of range.
        ConfigError: If a region or the bell of the kernels is.
    """
    parts: dict[str, dict[str, Any]] = {}
    for name, place in PLACES.items():
        if place:
            record, _, field = place.rpartition(".")
            parts.setdefault(record, {})[field] = fields[name]
    regions = tuple(_region(fields, i) for i in range(len(fields["region_names"])))
    return {
        **parts[""],
        "cubature": BodyCubature(**parts["cubature"]),
        "surface": BodySurface(**parts["surface"]),
        "kernels": _kernels(fields),
        "handles": SkinningWeights(**parts["handles"]),
        "regions": BodyRegions(parts=regions, **parts["regions"]),
    }


def _kernels(fields: Mapping[str, Any]) -> BasisRKPM | BasisQGMLS:
    """Return the kernels."""
    place = {"centres": fields["centres"], "radii": fields["radii"]}
    if fields["kernel"] == QGMLS:
        return BasisQGMLS(**place)
    points, hidden, pairs = fields["material_points"], fields["hidden_pairs"], fields["detour_pairs"]
    tables: dict[str, Any] = {"visibility": Visibility(points=points, hidden=hidden) if len(hidden) else None}
    if len(pairs):
        frame, lengths = fields["material_frame"], fields["detour_lengths"]
        tables["detours"] = Detours(points=points, frame=frame, pairs=pairs, lengths=lengths)
    return BasisRKPM(**place, kernel=fields["kernel"], **tables)


def _region(fields: Mapping[str, Any], i: int) -> Region:
    """Return region i."""
    core = fields["region_cores"][fields["core_index"] == i]
    solid = len(core) == 1 and (core[0, 1] > core[0, 0]).any()
    return Region(
        name=fields["region_names"][i],
        radius=float(fields["region_radii"][i]),
        stiffness=float(fields["region_stiffness"][i]) or None,
        **({"box": core[0]} if solid else {"points": core[:, 0]}),
    )
