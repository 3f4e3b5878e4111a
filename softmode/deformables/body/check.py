"""What must hold of a reduced body's fields, whoever made them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from softmode.deformables.body.qgmls import FUNCTIONS
from softmode.errors import BasisError

_KINDS = {
    str: "name kernel fingerprint",
    float: "volume length envelope_length build_seconds",
    int: "driven_count",
    bool: "gap_blends",
    tuple: "region_names",
    dict: "provenance",
}
_FLOAT32 = ("grad_basis", "surface_basis", "detour_lengths")
_INDICES = ("handle_degrees", "handle_regions", "core_index", "region_index", "hidden_pairs", "detour_pairs")


def check_fields(body: Mapping[str, Any]) -> None:
    """Verify types, shapes, dtypes, ranges, finiteness and the weights' sum of a body's fields.

    Args:
        body: The fields of a `ReducedBody` by name.

    Raises:
        BasisError: If any is wrong.
    """
    for kind, names in _KINDS.items():
        for name in names.split():
            if not isinstance(body[name], kind):
                raise BasisError(f"{name}: expected {kind.__name__}, got {type(body[name]).__name__}")

    def count(*names: str) -> list[int]:
        return [len(body[name]) for name in names]

    p, s, n, k = count("points", "surface_points", "mean_basis", "centres")
    m, j, raw = count("eigenvalues", "handle_degrees", "transform")
    material, hidden, detours = count("material_points", "hidden_pairs", "detour_pairs")
    regions, cores, samples = count("region_names", "core_index", "region_index")
    r, volume, weights = body["driven_count"], body["volume"], body["weights"]
    expected = {
        "points": (p, 3),
        "weights stiffness_scale": (p,),
        "lame_ratio": (p,) if len(body["lame_ratio"]) else (0,),
        "grad_basis": (p, n, 3),
        "surface_points surface_normals": (s, 3),
        "surface_areas": (s,),
        "surface_basis": (s, n),
        "mean_basis": (n,),
        "linear_coordinates": (n, 4),
        "eigenvalues": (m,),
        "bounds": (2, 3),
        "offset": (3,),
        "centres": (k, 3),
        "radii": (k,),
        "handles": (k, j),
        "handle_degrees handle_regions": (j,),
        "transform": (raw, n),
        "material_points": (material, 3),
        "hidden_pairs": (hidden,),
        "material_frame": (3, 3),
        "detour_pairs detour_lengths": (detours,),
        "region_stiffness region_radii": (regions,),
        "region_cores": (cores, 2, 3),
        "core_index": (cores,),
        "region_points": (samples, 3),
        "region_index region_weights": (samples,),
        "drive": (r, samples),
        "drive_affine": (regions, r, 4),
    }
    for name, shape in ((name, shape) for names, shape in expected.items() for name in names.split()):
        value = body[name]
        dtype = np.float32 if name in _FLOAT32 else np.int64 if name in _INDICES else np.float64
        if value.shape != shape or value.dtype != dtype:
            raise BasisError(f"{name}: expected {np.dtype(dtype)} {shape}, got {value.dtype} {value.shape}")
        if not np.isfinite(value).all():
            raise BasisError(f"{name}: not all finite")
    if not (volume > 0.0 and (weights >= 0.0).all() and abs(weights.sum() / volume - 1.0) < 1e-6):
        raise BasisError(f"weights: expected >= 0 with sum {volume}, got sum {weights.sum()}")
    if not 0 <= r <= n:
        raise BasisError(f"driven_count: expected 0..{n}, got {r}")
    exact = int((body["region_stiffness"] == 0.0).sum())
    ranges = {
        "handle_degrees": (0, 2),
        "handle_regions": (-1, exact - 1),
        "core_index": (0, regions - 1),
        "region_index": (0, regions - 1),
        "hidden_pairs": (0, k * material - 1),
        "detour_pairs": (0, k * material - 1),
    }
    for name, (low, high) in ranges.items():
        value = body[name]
        if len(value) and not (low <= value.min() and value.max() <= high):
            raise BasisError(f"{name}: expected {low}..{high}, got {value.min()}..{value.max()}")
    for name in ("hidden_pairs", "detour_pairs"):
        if (np.diff(body[name]) <= 0).any():
            raise BasisError(f"{name}: not in ascending order")
    if not (body["detour_lengths"] > 0.0).all():
        raise BasisError(f"detour_lengths: expected > 0, got {body['detour_lengths'].min()}")
    if not np.linalg.det(body["material_frame"]):
        raise BasisError("material_frame: takes different places to one")
    own = FUNCTIONS * k if body["kernel"] == "qgmls" else 0
    counts = np.array([1, 4, 10])[body["handle_degrees"]]
    if counts.sum() + own != raw or set(body["core_index"]) != set(range(regions)):
        raise BasisError(f"transform: expected {counts.sum() + own} rows and a core for each region, got {raw} rows")
