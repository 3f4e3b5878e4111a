"""Fields of material: Young's modulus, Poisson's ratio and density at points, as a file gives them."""

from __future__ import annotations

import functools
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from softmode.deformables.reduction.build_body import require_ratios
from softmode.errors import AssetError, MaterialError
from softmode.files import UNPACKED_FREE, damage_errors, read_arrays
from softmode.foreign import process, tokens
from softmode.objects.fingerprint import file_fingerprint
from softmode.splats.formats.usd import UP_AXES
from softmode.splats.splats import up_rotation

Array = NDArray[np.float64]

PROPERTIES = ("youngs_modulus", "poissons_ratio", "density")
MISSED_LIMIT = 1.0 / 3.0
"""Share of an object that a field may miss: there it has the values of the nearest point."""
REACH = 2.0
"""Distance beyond which a point says nothing, over the spacing of the points: 1.7 in the corner of a cubic grid."""
CONTRAST = 1.0e6
"""Largest Young's modulus or density over the least."""
_PRIMVARS = {
    "youngs_modulus": ("youngs_modulus", "youngsModulus"),
    "poissons_ratio": ("poissons_ratio", "poissonsRatio"),
    "density": ("density",),
}
_LIMITS = process.Limits(memory=128 * 2.0**20, memory_per_byte=16.0, seconds=1.0)
_HINT = "give an .npz with points (N, 3) [m] and youngs_modulus [Pa], poissons_ratio or density [kg/m^3], each (N,)"


@dataclass(frozen=True, kw_only=True)
class MaterialField:
    """Properties of a material at points; a place has those of the nearest one."""

    name: str
    """Its file, for messages."""
    points: Array
    """Where the object stands [m], shape (N, 3)."""
    values: dict[str, Array]
    """Some of `PROPERTIES` in SI units, shape (N,) each."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        x = self.points
        if x.ndim != 2 or x.shape[1] != 3 or not len(x) or not np.isfinite(x).all():
            raise MaterialError(f"{self.name}: expected points (N > 0, 3), finite, got {x.shape}", hint=_HINT)
        if not self.values:
            raise MaterialError(f"{self.name}: holds no property of a material", hint=_HINT)
        for name, values in self.values.items():
            what = f"{self.name}: {name}"
            if values.shape != (len(x),):
                raise MaterialError(f"{what}: expected one for each of {len(x)} points, got {values.shape}", hint=_HINT)
            if name == "poissons_ratio":
                require_ratios(what, values)
                continue
            bad = np.flatnonzero(~(np.isfinite(values) & (values > 0.0)))
            if len(bad):
                raise MaterialError(f"{what}: expected > 0, got {values[bad[0]]} at row {bad[0]}", hint="use SI units")
            if values.max() > CONTRAST * values.min():
                text = f"{what}: {values.min():g} to {values.max():g}, a contrast above {CONTRAST:g}"
                raise MaterialError(text, hint="leave rigid parts to regions, and air out of the field")

    @property
    def means(self) -> dict[str, float]:
        """The means over the points: what the body as a whole is said to be made of, as fields of `Material`."""
        return {name: float(values.mean()) for name, values in self.values.items()}

    @functools.cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.points)

    def at(self, name: str, places: Array) -> Array | None:
        """Return a property at places (M, 3) [m], shape (M,); None where the field does not say it, or is even."""
        values = self.values.get(name)
        if values is None or values.max() == values.min():
            return None
        return values[np.asarray(self._tree.query(places)[1])]

    def missed(self, places: Array, weights: Array) -> float:
        """Return the share of places (M, 3), by their volumes (M,), that lie beyond all points.

        Raises:
            MaterialError: If they are more than a third.
        """
        apart = self._tree.query(self.points, min(2, len(self.points)))[0]
        spacing = np.inf if apart.ndim == 1 else float(np.quantile(apart[:, 1], 0.95))
        far = self._tree.query(places)[0] > REACH * spacing
        share = float(weights @ far / weights.sum())
        if share > MISSED_LIMIT:
            low, high = np.round([places.min(axis=0), places.max(axis=0)], 4).tolist()
            raise MaterialError(
                f"{self.name}: its points miss {100.0 * share:.0f} % of the object, which fills {low} to {high} m",
                hint="give points where the object stands: z up, centred over the origin, standing on z = 0, in metres",
            )
        return share


def read_material(path: str | os.PathLike[str]) -> MaterialField:
    """Read a field of material in SI units: an .npz with `points` (N, 3) and some of `PROPERTIES`, (N,) each.

    Or an OpenUSD stage whose `Points` prims have primvars of these names, or `youngsModulus` and `poissonsRatio`. The
    stage's unit of length and its up axis are applied to the points.

    Raises:
        AssetError: If the file is missing or damaged, or holds no points.
        MaterialError: If its arrays do not fit, or a value lies outside its range.
    """
    return _read(path, file_fingerprint(Path(path)))


@functools.lru_cache(maxsize=8)
def _read(path: str | os.PathLike[str], _fingerprint: str) -> MaterialField:
    """Read a file of a content: an object is built, dressed and weighed with the same field."""
    name = f"material {path}"
    if os.fspath(path).lower().endswith(tokens.SUFFIXES):
        arrays = _stage_arrays(Path(path), name)
    else:
        arrays = read_arrays(path, ("points", *PROPERTIES), what="material", hint=_HINT, free=UNPACKED_FREE // 2)
    if "points" not in arrays:
        raise AssetError(f"{name}: holds {sorted(arrays)}", hint=_HINT)
    with damage_errors(name, hint=_HINT):
        found = {key: np.asarray(value, dtype=np.float64) for key, value in arrays.items()}
    return MaterialField(name=name, points=found.pop("points"), values=found)


def _stage_arrays(file: Path, name: str) -> dict[str, NDArray[Any]]:
    """Return the points of a stage's `Points` prims [m], z up, and what their primvars say; nothing if there are none.

    Raises:
        AssetError: If the stage cannot be read, or its prims have different properties.
    """
    answer = process.read("field", file, name=name, limits=_LIMITS, primvars=_PRIMVARS)
    stage, sent = answer.described, answer.arrays
    prims = stage["prims"]
    if not prims:
        return {}
    if any(prim["values"].keys() != prims[0]["values"].keys() for prim in prims) or stage["up"] not in UP_AXES:
        raise AssetError(f"{name}: its Points prims have different primvars, or an unknown up axis", hint=_HINT)
    upright = float(stage["meters"]) * up_rotation(UP_AXES[stage["up"]])
    with damage_errors(name, hint=_HINT):
        points = []
        for prim in prims:
            matrix = np.array(prim["matrix"]).reshape(4, 4)
            points.append((sent[prim["points"]].reshape(-1, 3) @ matrix[:3, :3] + matrix[3, :3]) @ upright.T)
        values = {key: np.concatenate([sent[prim["values"][key]] for prim in prims]) for key in prims[0]["values"]}
        return {"points": np.concatenate(points), **values}
