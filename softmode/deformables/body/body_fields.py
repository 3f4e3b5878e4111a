"""The fields of a body's file: flat, by name, as every version of the format has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
}
"""Arrays that only the file of a body has whose kernels do not act across gaps, or go around corners."""
PLACES = {
    "name": "name",
    "points": "cubature.points",
    "weights": "cubature.weights",
    "grad_basis": "cubature.grad_basis",
    "stiffness_scale": "cubature.stiffness_scale",
    "surface_points": "surface.points",
    "surface_normals": "surface.normals",
    "surface_areas": "surface.areas",
    "surface_basis": "surface.basis",
    "volume": "volume",
    "mean_basis": "mean_basis",
    "linear_coordinates": "linear_coordinates",
    "eigenvalues": "eigenvalues",
    "bounds": "bounds",
    "offset": "offset",
    "centres": "",
    "radii": "",
    "kernel": "",
    "handles": "handles.coefficients",
    "handle_degrees": "handles.degrees",
    "handle_regions": "handles.blends",
    "transform": "transform",
    "length": "length",
    "driven_count": "driven_count",
    "region_names": "",
    "region_stiffness": "",
    "region_radii": "",
    "region_cores": "",
    "core_index": "",
    "region_points": "regions.points",
    "region_index": "regions.index",
    "region_weights": "regions.weights",
    "drive": "regions.drive",
    "drive_affine": "regions.drive_affine",
    "fingerprint": "fingerprint",
    "provenance": "provenance",
    "build_seconds": "build_seconds",
    "envelope_length": "regions.envelope_length",
    "material_points": "",
    "hidden_pairs": "",
    "material_frame": "",
    "detour_pairs": "",
    "detour_lengths": "",
}
"""Where a body has each field, in the order of the files; empty for what `made_fields` makes of kernels and regions."""
GAPS: dict[str, Any] = {
    "material_points": np.zeros((0, 3)),
    "hidden_pairs": np.zeros(0, dtype=np.int64),
    "material_frame": np.eye(3),
    "detour_pairs": np.zeros(0, dtype=np.int64),
    "detour_lengths": np.zeros(0, dtype=np.float32),
}
"""What stands for tables that a file does not have."""
QGMLS = "qgmls"
"""In place of the bell of reproducing kernels: the functions are those of Q-GMLS."""


def made_fields(kernels: BasisRKPM | BasisQGMLS, regions: Sequence[Region]) -> dict[str, Any]:
    """Return the fields of kernels, those of gaps and corners among them, and of regions."""
    cores = [region.cores for region in regions]
    found = {
        **GAPS,
        "centres": kernels.centres,
        "radii": kernels.radii,
        "kernel": kernels.kernel if isinstance(kernels, BasisRKPM) else QGMLS,
        "region_names": tuple(region.name for region in regions),
        "region_stiffness": np.array([region.stiffness or 0.0 for region in regions], dtype=np.float64),
        "region_radii": np.array([region.radius for region in regions], dtype=np.float64),
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
    if fields["kernel"] == QGMLS:
        return BasisQGMLS(centres=fields["centres"], radii=fields["radii"])
    points, visibility, detours = fields["material_points"], None, None
    if len(fields["hidden_pairs"]):
        visibility = Visibility(points=points, hidden=fields["hidden_pairs"])
    if len(pairs := fields["detour_pairs"]):
        frame, lengths = fields["material_frame"], fields["detour_lengths"]
        detours = Detours(points=points, frame=frame, pairs=pairs, lengths=lengths)
    place = {"centres": fields["centres"], "radii": fields["radii"]}
    return BasisRKPM(**place, kernel=fields["kernel"], visibility=visibility, detours=detours)


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
