"""`RadianceGrid`: the validated arrays of one radiance field on a grid: how dense it is, and its colour from all sides.

Light along a ray is absorbed with the density sigma [1/m]: alpha = 1 - exp(-sigma ds) over a step ds. The colour is
0.5 + sum_k Y_k(d) c_k, cut to 0..1, with the spherical harmonics of the splat formats.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from softmode.checks import require_number
from softmode.errors import AssetError, ConfigError
from softmode.splats.splats import SH_DC, Splats, UpAxis, sh_basis, up_rotation

Array = NDArray[np.float64]
Field = Callable[[Array], tuple[ArrayLike, ArrayLike]]

NODE_LIMIT = 2**26
"""Most nodes of a grid times colour coefficients of a node."""
DENSITY_LIMIT = 6.0e4
"""Largest density that is kept [1/m]: what float16 holds, and opaque over a tenth of a millimetre."""
VISIBLE = 0.01
"""Opacity of a voxel below which it is empty."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RadianceGrid:
    """One radiance field; float16, read-only, validated on construction. Nodes lie at `origin + axes @ (i, j, k)`.

    Raises:
        AssetError: If an array has the wrong shape, holds NaN or infinity, a density is negative, the field is empty
            or the same everywhere, or there are too many nodes.
    """

    density: np.ndarray
    """Density [1/m], zero or more, shape (nx, ny, nz); what exceeds `DENSITY_LIMIT` is cut to it."""
    sh: np.ndarray
    """Spherical-harmonic coefficients of the colour, shape (nx, ny, nz, K, 3), K in {1, 4, 9}."""
    origin: Array
    """Place of the first node [m], shape (3,)."""
    axes: Array
    """Steps between nodes as columns [m], a rotation times positive lengths, shape (3, 3)."""
    name: str = "radiance field"
    """Where it comes from; used in messages."""
    metres: float | None = None
    """Metres of one unit of its lengths, if its file says so; then an object of it has its size. None if not known."""
    contradicted: float | None = None
    """Share of its surface in the largest patch that the pictures it was trained on contradict. None if not known."""
    allowed: float | None = None
    """Volume of its solid and of what thick parts those pictures allow beside it, over that of its solid. None if not
    known."""

    def __post_init__(self) -> None:
        """Convert, validate and freeze the arrays."""
        density = self._numbers("density", self.density)
        _require_nodes(self.name, density.shape)
        shape = np.shape(self.sh)
        if len(shape) != 5 or shape[:3] != density.shape or shape[3:] not in ((1, 3), (4, 3), (9, 3)):
            raise AssetError(
                f"{self.name}: sh has shape {shape}, expected {density.shape} and (K, 3) with K = 1, 4 or 9",
                hint="give spherical harmonics of degree 0, 1 or 2",
            )
        check_size(self.name, density.size, shape[3])
        sh = self._numbers("sh", self.sh)
        if (density < 0.0).any():
            raise AssetError(f"{self.name}: density is negative, {density.min():.3g}", hint="clip it at zero")
        if not (density > 0.0).any():
            raise AssetError(f"{self.name}: the field is empty", hint="export it again, or widen the crop")
        if density.min() == density.max():
            hint = "give a field with empty space around an object"
            raise AssetError(f"{self.name}: density is {density.max():.3g} 1/m everywhere", hint=hint)
        if self.metres is not None and not (np.isfinite(self.metres) and self.metres > 0.0):
            raise AssetError(f"{self.name}: a unit of {self.metres} metres", hint="give a positive number, or none")
        for name in ("contradicted", "allowed"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value >= 0.0):
                raise AssetError(f"{self.name}: {name} is {value}", hint="give zero or a positive number, or none")
        origin, axes = np.array(self.origin, dtype=np.float64), np.array(self.axes, dtype=np.float64)
        lengths = np.linalg.norm(axes, axis=0) if axes.shape == (3, 3) else np.zeros(3)
        proper = axes.shape == (3, 3) and origin.shape == (3,) and np.isfinite([*axes.ravel(), *origin]).all()
        if not proper or not (lengths > 0.0).all() or not _is_rotation(axes / lengths):
            raise AssetError(
                f"{self.name}: the nodes' axes are no rotation times lengths", hint="export it without shear or mirror"
            )
        values = {
            "density": np.minimum(density, DENSITY_LIMIT).astype(np.float16, copy=False),
            "sh": np.clip(sh, -DENSITY_LIMIT, DENSITY_LIMIT).astype(np.float16, copy=False),
            "origin": origin,
            "axes": axes,
        }
        for name, value in values.items():
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    def _numbers(self, field: str, value: ArrayLike) -> NDArray[Any]:
        """Return a finite array of floats."""
        array = np.asarray(value)
        if array.dtype.kind not in "fiu" or not np.isfinite(array).all():
            raise AssetError(f"{self.name}: {field} holds NaN, infinity or no numbers", hint="export it again")
        return array if array.dtype.kind == "f" else array.astype(np.float32)

    # -- where it comes from ------------------------------------------------------------------------------------------

    @classmethod
    def from_bounds(
        cls,
        density: ArrayLike,
        sh: ArrayLike,
        bounds: ArrayLike,
        *,
        name: str = "radiance field",
        metres: float | None = None,
    ) -> RadianceGrid:
        """Return the field whose first and last node lie at the corners of a box [m], shape (2, 3)."""
        box, shape = _corners(name, bounds), np.shape(density)
        _require_nodes(name, shape)
        return cls(density=np.asarray(density), sh=np.asarray(sh), origin=box[0],
                   axes=np.diag((box[1] - box[0]) / (np.array(shape) - 1)), name=name, metres=metres)  # fmt: skip

    @classmethod
    def from_function(
        cls, field: Field, bounds: ArrayLike, *, resolution: int = 96, name: str = "radiance field"
    ) -> RadianceGrid:
        """Sample a field once, such as a trained network.

        Args:
            field: Maps points (N, 3) [m] to densities (N,) [1/m], and to colours 0..1 (N, 3) or spherical-harmonic
                coefficients (N, K, 3).
            bounds: Corners of a box that holds the object [m], shape (2, 3).
            resolution: Nodes along its longest edge.
            name: Where it comes from; used in messages.

        Raises:
            AssetError: If the field is none, as for the class.
            ConfigError: If the resolution is out of range.
        """
        require_number("resolution", resolution, at_least=8, at_most=512)
        box = _corners(name, bounds)
        edge = float((box[1] - box[0]).max()) / (resolution - 1)
        shape = np.maximum(np.round((box[1] - box[0]) / edge).astype(int) + 1, 2)
        axes = [np.linspace(box[0, d], box[1, d], shape[d]) for d in range(3)]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        density, color = [], []
        for part in np.array_split(nodes, max(len(nodes) // 262_144, 1)):
            values, shades = (np.asarray(found) for found in field(part))
            if values.shape != (len(part),) or shades.shape[0] != len(part) or shades.ndim not in (2, 3):
                raise AssetError(
                    f"{name}: field returned shapes {values.shape} and {shades.shape} for {len(part)} points",
                    hint="return densities (N,) and colours (N, 3) or coefficients (N, K, 3)",
                )
            density.append(values)
            color.append(sh_of_colors(shades)[:, None] if shades.ndim == 2 else shades)
        shades = np.concatenate(color)
        return cls.from_bounds(
            np.concatenate(density).reshape(shape), shades.reshape(*shape, *shades.shape[1:]), box, name=name
        )

    @classmethod
    def from_splats(cls, splats: Splats, *, resolution: int = 96) -> RadianceGrid:
        """Return the field of splats, without their view-dependent colour.

        The opacities o exp(-d^2 / 2) of all splats, widened by half a voxel, are summed at the nodes and taken as the
        opacity of a voxel.

        Args:
            splats: The splats.
            resolution: Nodes along the longest edge of their box.

        Raises:
            ConfigError: If the resolution is out of range.
        """
        require_number("resolution", resolution, at_least=8, at_most=512)
        low, high = splats.bounds()
        wide = float(np.quantile(splats.scales.max(axis=1), 0.9))
        low, high = low - 2.5 * wide, high + 2.5 * wide
        edge = float((high - low).max()) / (resolution - 1)
        shape = np.ceil((high - low) / edge).astype(int) + 1
        covariances = splats.covariances() + np.eye(3) * (0.45 * edge) ** 2
        inverses, reach = np.linalg.inv(covariances), 2.5 * np.sqrt(np.einsum("nii->ni", covariances))
        weight, color = np.zeros(shape), np.zeros((*shape, 3))
        first = np.clip(np.floor((splats.means - reach - low) / edge).astype(int), 0, shape)
        last = np.clip(np.ceil((splats.means + reach - low) / edge).astype(int) + 1, 0, shape)
        for k, shade in enumerate(splats.colors()):
            lines = [low[d] + edge * np.arange(first[k, d], last[k, d]) - splats.means[k, d] for d in range(3)]
            x = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
            share = splats.opacities[k] * np.exp(-0.5 * np.einsum("...i,ij,...j", x, inverses[k], x))
            here = tuple(slice(a, b) for a, b in zip(first[k], last[k], strict=True))
            weight[here] += share
            color[here] += share[..., None] * shade
        color /= np.maximum(weight, 1e-9)[..., None]
        density = -np.log1p(-np.minimum(weight, 0.98)) / edge
        box = np.stack([low, low + edge * (shape - 1)])
        return cls.from_bounds(density, sh_of_colors(color)[..., None, :], box, name=splats.name)

    # -- what it is ---------------------------------------------------------------------------------------------------

    @property
    def shape(self) -> tuple[int, int, int]:
        """Nodes along the axes."""
        return self.density.shape  # type: ignore[return-value]

    @property
    def sh_degree(self) -> int:
        """Spherical-harmonic degree, 0 to 2."""
        return int(np.sqrt(self.sh.shape[3])) - 1

    @property
    def spacing(self) -> float:
        """Distance between nodes, the geometric mean of the three [m]."""
        return float(np.linalg.det(self.axes) ** (1.0 / 3.0))

    @property
    def rotation(self) -> Array:
        """Rotation from the frame of the colours to that of the field, shape (3, 3)."""
        lengths = np.sqrt((self.axes**2).sum(axis=0))
        return self.axes / lengths

    @cached_property
    def occupied(self) -> NDArray[np.bool_]:
        """Nodes that are not empty: a voxel of theirs is opaque by `VISIBLE`, shape (nx, ny, nz)."""
        return np.asarray(self.density.astype(np.float32) * self.spacing > -np.log1p(-VISIBLE))

    @cached_property
    def bounds(self) -> Array:
        """Corners of the box around the nodes that are not empty [m], shape (2, 3)."""
        index = np.argwhere(self.occupied if self.occupied.any() else self.density > 0.0)
        low, high = index.min(axis=0), index.max(axis=0)
        corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), axis=-1).reshape(-1, 3)
        places = self.origin + corners @ self.axes.T
        return np.stack([places.min(axis=0), places.max(axis=0)])

    @property
    def surroundings(self) -> Array:
        """Corners of a box a step wider than `bounds` on every side [m], shape (2, 3)."""
        return self.bounds + np.array([[-1.0], [1.0]]) * self.spacing

    def _index(self, points: ArrayLike) -> Array:
        """Return where points (N, 3) [m] lie among the nodes, shape (3, N)."""
        found: Any = np.linalg.solve(self.axes, (np.asarray(points, dtype=np.float64) - self.origin).T)
        return found

    def densities(self, points: ArrayLike) -> Array:
        """Return the density at points (N, 3) [m], trilinear between nodes, 0 outside [1/m], shape (N,)."""
        density = self._float_density
        return ndimage.map_coordinates(density, self._index(points), order=1, output=np.float64)

    @cached_property
    def _float_density(self) -> NDArray[np.float32]:
        return self.density.astype(np.float32)

    def coefficients(self, points: ArrayLike) -> Array:
        """Return the colour coefficients at the nodes nearest to points (N, 3) [m], shape (N, K, 3)."""
        node = np.clip(np.rint(self._index(points)).astype(int).T, 0, np.array(self.shape) - 1)
        return self.spread_sh[tuple(node.T)].astype(np.float64)

    @cached_property
    def spread_sh(self) -> np.ndarray:
        """`sh`, where empty nodes have the colour of the nearest node that is not; so that rims are not dark."""
        if self.occupied.all() or not self.occupied.any():
            return self.sh
        nearest: Any = ndimage.distance_transform_edt(~self.occupied, return_distances=False, return_indices=True)
        return self.sh[tuple(nearest)]

    # -- other fields -------------------------------------------------------------------------------------------------

    def transformed(
        self, rotation: ArrayLike | None = None, translation: ArrayLike = (0.0, 0.0, 0.0), scale: float = 1.0
    ) -> RadianceGrid:
        """Return the field after x -> scale * rotation @ x + translation; it looks the same from as much farther.

        Raises:
            ConfigError: If the rotation is none, or the scale is not positive.
        """
        matrix = np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64)
        require_number("scale", scale, above=0.0)
        if not _is_rotation(matrix):
            raise ConfigError("rotation must be a proper (3, 3) rotation matrix", hint="pass scale as its own argument")
        return replace(
            self,
            density=self._float_density / np.float32(scale),
            metres=None if self.metres is None else self.metres / scale,
            origin=scale * matrix @ self.origin + np.asarray(translation, dtype=np.float64),
            axes=scale * matrix @ self.axes,
        )

    def oriented(self, up: UpAxis) -> RadianceGrid:
        """Return the field turned so that its `up` axis points along +Z."""
        return self if up == "+z" else self.transformed(up_rotation(up))

    def cropped(self, low: ArrayLike, high: ArrayLike) -> RadianceGrid:
        """Return the field with nothing outside a box [m], and without the empty planes around the rest.

        Raises:
            AssetError: If nothing is left.
        """
        index = np.stack(np.meshgrid(*map(np.arange, self.shape), indexing="ij"), axis=-1).reshape(-1, 3)
        place = self.origin + index @ self.axes.T
        inside = ((place >= np.asarray(low)) & (place <= np.asarray(high))).all(axis=1).reshape(self.shape)
        density = np.where(inside, self.density, np.float16(0.0))
        full = np.argwhere(density > 0.0)
        if not len(full):
            raise AssetError(f"{self.name}: nothing is left of the field", hint=f"it fills {self.bounds.tolist()} m")
        first = np.maximum(full.min(axis=0) - 1, 0)
        part = tuple(slice(a, b + 2) for a, b in zip(first, full.max(axis=0), strict=True))
        return replace(self, density=density[part], sh=self.sh[part], origin=self.origin + self.axes @ first)

    def colors(self, points: ArrayLike, directions: ArrayLike) -> Array:
        """Return the colour 0..1 at the nodes nearest to points, seen along unit directions, each of shape (N, 3)."""
        seen = np.asarray(directions, dtype=np.float64) @ self.rotation
        basis = sh_basis(seen, self.sh.shape[3])
        return np.clip(0.5 + np.einsum("nk,nkc->nc", basis, self.coefficients(points)), 0.0, 1.0)


def _require_nodes(name: str, shape: tuple[int, ...]) -> None:
    """Refuse a density that is on no grid."""
    if len(shape) != 3 or min(shape) < 2:
        raise AssetError(
            f"{name}: density has shape {shape}, expected (nx, ny, nz) of at least 2 nodes each",
            hint="give numbers on the nodes of a box",
        )


def _corners(name: str, bounds: ArrayLike) -> Array:
    """Return the corners of a box [m], shape (2, 3), or refuse what are none."""
    box = np.array(bounds, dtype=np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[1] > box[0]).all():
        raise AssetError(f"{name}: bounds are no corners (2, 3) with upper > lower", hint="give metres")
    return box


def sh_of_colors(colors: ArrayLike) -> Array:
    """Return the constant coefficients of colours 0..1."""
    return (np.asarray(colors, dtype=np.float64) - 0.5) / SH_DC


def check_size(name: str, nodes: int, coefficients: int) -> None:
    """Refuse a grid that is too large.

    Raises:
        AssetError: If it has more than `NODE_LIMIT` colours.
    """
    if nodes * coefficients > NODE_LIMIT:
        raise AssetError(
            f"{name}: {nodes} nodes of {coefficients} colours, at most {NODE_LIMIT} together",
            hint="export it at a lower resolution or degree, or crop it",
        )


def _is_rotation(matrix: Array) -> bool:
    """Return whether a matrix is proper orthogonal."""
    proper = matrix.shape == (3, 3) and np.allclose(matrix.T @ matrix, np.eye(3), atol=1e-5)
    return bool(proper and np.linalg.det(matrix) > 0.0)
