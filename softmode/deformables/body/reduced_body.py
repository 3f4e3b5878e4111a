"""ReducedBody: the frozen, saveable product of the build.

x(X) = X + sum_k b_k(X) q_k in the body frame (origin: centre of mass). The functions b_k are combinations of raw
functions, skinning weights W_j times monomials or those of Q-GMLS, orthonormal in the mass inner product (1 / V) sum_p
V_p rho_p b_k b_l = delta_kl.
So the kinetic energy is mass / 2 |qdot|^2 and |q| is the rms displacement in metres. Every affine motion is exact.

Without exact regions b_0 = 1, b_1..b_3 are linear, and the others are free of mean and linear moment. With them the
first `driven_count` functions span every motion of the regions and the others vanish there: to hold or move a region
exactly is to prescribe the first coordinates.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from softmode.deformables.body.body_fields import GAPS, PLACES, TABLES, made_fields, records_of
from softmode.deformables.body.check import check_fields
from softmode.deformables.body.qgmls import BasisQGMLS
from softmode.deformables.body.raw_functions import QuadraticFunctions, RawFunctions, SkinningFunctions
from softmode.deformables.body.records import BodyCubature, BodyRegions, BodySurface
from softmode.deformables.body.regions import Envelope
from softmode.deformables.body.rkpm import BasisRKPM
from softmode.deformables.body.skinning_weights import SkinningWeights
from softmode.errors import AssetError, BasisError, ConfigError
from softmode.files import damage_errors, read_archive, write_archive

Array = NDArray[np.float64]
Scalar = str | int | float | bool | None

FORMAT, FORMAT_VERSION = "softmode.ReducedBody", 5
"""Kind and version of a body's file."""
READABLE = (2, 3, 4, 5)
"""Versions that are read. Bodies of version 2 have no detours, those of 2 and 3 a wide envelope, those before 5 blends
that change beside the faces; all keep the functions that they had."""
_HINT = "build the body again"
RATIO_HARMLESS = 0.45
"""Poisson's ratio up to which functions made for any other serve."""
_SOURCES = "sources."
"""What the names of the sources begin with in a file."""
_CHUNK = 2048


@dataclass(frozen=True, kw_only=True)
class ReducedBody:
    """A deformable body ready to simulate: five records and what belongs to none; body frame, SI units, float64."""

    name: str
    """Name for messages and reports."""
    cubature: BodyCubature
    """Points at which elastic energy is summed."""
    surface: BodySurface
    """Samples of the surface."""
    kernels: BasisRKPM | BasisQGMLS
    """Kernels that the raw functions are made of."""
    handles: SkinningWeights
    """Weights W_j in the kernels: constant handle, regions, eigenmodes, responses."""
    regions: BodyRegions
    """Regions that were known when it was built."""
    volume: float
    """Volume [m^3]."""
    mean_basis: Array
    """(1/V) sum V_p rho_p b_k over the full quadrature, shape (n,); gravity acts as mass * g * mean_basis_k."""
    linear_coordinates: Array
    """Coefficients c (n, 4) with sum_k b_k c_kj = (X, Y, Z, 1)_j for every X."""
    eigenvalues: Array
    """Eigenvalues of the skinning eigenmodes [1/m^2], the constant handle's 0 first, shape (m + 1,); of local handles
    the mean square of the gradient over that of the weight, likewise. Beside exact regions most modes of functions that
    are chosen by elastic energy are those of the free body, 0 first again."""
    bounds: Array
    """Corners of the bounding box in the body frame [m], shape (2, 3)."""
    offset: Array
    """Origin of the body frame in asset coordinates [m]: X_body = X_asset - offset, shape (3,)."""
    transform: Array
    """b = (W_0 Z, ..., W_J Z) @ transform, Z monomials in (X, Y, Z) over `length`; shape (raw functions, n). Those of
    Q-GMLS follow after the Z of the constant handle."""
    length: float
    """Unit of length of the raw functions [m]."""
    driven_count: int
    """Number r of driven functions: the first r take every value on the exact regions, the others vanish there."""
    fingerprint: str
    """sha256 of the quadrature, the fields, the options and the regions."""
    provenance: dict[str, Scalar]
    """What went in, what was measured, what was lost."""
    build_seconds: float
    """Wall time of the build [s]."""
    sources: Mapping[str, NDArray[Any]] | None = dataclasses.field(default=None, repr=False, compare=False)
    """What it was built from, for :func:`softmode.deformables.hold`, or None; see ``reduction.sources``."""

    @property
    def narrow(self) -> float:
        """Width [m] over which the functions hardly bend, a quarter of the kernels' radius; see `average_basis`.

        Gradients at the centre of splats so wide are off by 2 % of the mean gradient, by 5 % of one splat in a hundred.
        """
        return 0.25 * float(np.median(self.kernels.radii))

    @property
    def function_count(self) -> int:
        """Number of scalar functions n."""
        return self.cubature.grad_basis.shape[1]

    def serves_ratio(self, poissons_ratio: float) -> bool:
        """Return whether functions chosen by elastic energy were made for about this Poisson's ratio.

        It matters above 0.45: a plate of 0.49 whose functions were made for 0.4 is 28 % too stiff.
        """
        if "frequency_error" not in self.provenance:
            return True
        made = str(self.provenance["option_poissons_ratio"] or 0.0).split()
        return poissons_ratio <= max(RATIO_HARMLESS, *(float(ratio) + 0.02 for ratio in made))

    @property
    def mode_count(self) -> int:
        """Number of skinning eigenmodes m, or of local handles, without the constant handle."""
        return len(self.eigenvalues) - 1

    @property
    def point_count(self) -> int:
        """Number of cubature points P."""
        return len(self.cubature.points)

    @property
    def surface_count(self) -> int:
        """Number of surface samples S."""
        return len(self.surface.points)

    @property
    def skinned(self) -> bool:
        """Whether the functions are products of skinning weights; those of Q-GMLS are none."""
        return isinstance(self.kernels, BasisRKPM)

    @cached_property
    def raw(self) -> RawFunctions:
        """What the functions are combinations of."""
        if isinstance(self.kernels, BasisQGMLS):
            return QuadraticFunctions(kernels=self.kernels, length=self.length)
        return self._skinning

    @cached_property
    def _skinning(self) -> SkinningFunctions:
        return SkinningFunctions(
            kernels=self.reproducing_kernels, skin=self.handles, envelope=self._envelope, length=self.length
        )

    @cached_property
    def _envelope(self) -> Envelope | None:
        return self.regions.envelope(self.length)

    @property
    def reproducing_kernels(self) -> BasisRKPM:
        """The kernels of a body that is skinned.

        Raises:
            ConfigError: If the functions are those of Q-GMLS.
        """
        if isinstance(self.kernels, BasisRKPM):
            return self.kernels
        raise ConfigError(
            f"body {self.name!r}: functions of Q-GMLS are made of no skinning weights and reproducing kernels",
            hint="build it with other handles, such as handles='local'",
        )

    @property
    def _divided(self) -> bool:
        kernels = self.kernels
        return isinstance(kernels, BasisRKPM) and not (kernels.visibility is None and kernels.detours is None)

    def evaluate(self, points: ArrayLike, *, outside: str = "clamp") -> tuple[Array, Array]:
        """Evaluate the functions and their gradients at rest points of the body frame.

        Args:
            points: Rest positions [m], shape (N, 3).
            outside: "clamp" continues the functions beyond the kernels' reach: affine motions exactly, all that is
                orthogonal to them (in the coordinates) constant, from the nearest point within reach; "raise" refuses
                such points.

        Returns:
            Values (N, n) and gradients [1/m] (N, n, 3).

        Raises:
            BasisError: If points are not finite, or out of reach with outside="raise".
        """
        if outside not in ("clamp", "raise"):
            raise ConfigError(f"outside: expected 'clamp' or 'raise', got {outside!r}")
        x, inner, at, far = self._within_reach(points)
        if far.any() and outside == "raise":
            raise BasisError(
                f"points: {int(far.sum())} of {len(x)} lie outside the body (first: row {int(far.argmax())})",
                hint="Drop them, or pass outside='clamp'.",
            )
        return self._evaluated(x, inner, at, far, axes=3)

    def values(self, points: ArrayLike) -> Array:
        """Evaluate the functions alone, (N, n), at rest points (N, 3) [m]: as `evaluate` in less than half the time.

        Raises:
            BasisError: If points are not finite.
        """
        return self._evaluated(*self._within_reach(points), axes=0)[0]

    def _evaluated(
        self, x: Array, inner: Array, at: Array, far: NDArray[np.bool_], *, axes: int
    ) -> tuple[Array, Array]:
        """Return values and gradients, (N, n, axes), at points of which some are taken within reach."""
        value = np.empty((len(x), self.function_count))
        gradient = np.empty((*value.shape, axes))
        for i in range(0, len(x), _CHUNK):
            some = slice(i, i + _CHUNK)
            raw, slopes = self.raw.evaluate(inner[some], at[some], gradients=axes > 0)
            value[some] = raw @ self.transform
            for d in range(axes):
                gradient[some, :, d] = slopes[:, :, d] @ self.transform
        if far.any():
            # The functions' content of (X, Y, Z, 1): rows of the left inverse of the linear coordinates.
            content = np.linalg.solve(self.linear_coordinates.T @ self.linear_coordinates, self.linear_coordinates.T)
            value[far] += (x[far] - at[far]) @ content[:3]
            gradient[far & (x != at).any(axis=1)] = content[:3].T[:, :axes]
        return value, gradient

    def skinning_weights(self, points: ArrayLike) -> tuple[Array, Array]:
        """Evaluate the skinning weights W_j and their gradients at rest points of the body frame.

        With T_j the map that handle j applies, x(X) = X + sum_j W_j(X) T_j(X) for points within the kernels' reach;
        beyond it the weights are those of the nearest point within, but for exact regions, where all is known.

        Args:
            points: Rest positions [m], shape (N, 3).

        Returns:
            Weights (N, J), the constant handle's first, and gradients [1/m] (N, J, 3).

        Raises:
            BasisError: If points are not finite.
            ConfigError: If the functions are those of Q-GMLS.
        """
        skinning, (_, inner, at, _) = self._skinning, self._within_reach(points)
        weight = np.empty((len(inner), len(self.handles.degrees)))
        gradient = np.empty((*weight.shape, 3))
        for i in range(0, len(inner), _CHUNK):
            weight[i : i + _CHUNK], gradient[i : i + _CHUNK] = skinning.weights(
                inner[i : i + _CHUNK], at[i : i + _CHUNK]
            )
        return weight, gradient

    def _within_reach(self, points: ArrayLike) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """Return the points, the nearest ones to them within the kernels' reach, and which differ.

        Third the nearest ones where kernels count: in exact regions they vanish, and points are what they are.
        """
        x = np.asarray(points, dtype=np.float64)
        if x.ndim != 2 or x.shape[1] != 3 or not np.isfinite(x).all():
            raise BasisError(f"points: expected finite positions of shape (N, 3), got shape {x.shape}")
        ratio, centre = self.raw.reach(x)
        far = ratio > 1.0
        inner = np.where(far[:, None], centre + (x - centre) / np.maximum(ratio, 1.0)[:, None], x)
        # Between two leaves what is within reach of a kernel may be nearest to material that it does not act on.
        bare = np.arange(len(x)) if self._divided else np.flatnonzero(far)
        for nearer in (0.5, 0.5, 0.5, 0.0):
            bare = bare[~self.raw.covered(inner[bare])]
            inner[bare] = centre[bare] + nearer * (inner[bare] - centre[bare])
            far[bare] = True
        at = inner
        if self._envelope is not None and far.any():
            at = np.where((far & self._envelope.holds(x))[:, None], x, inner)
        return x, inner, at, far

    def covers(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Return which points (N, 3) the kernels reach, that is, which `evaluate` does not clamp."""
        return self.raw.reach(np.asarray(points, dtype=np.float64))[0] <= 1.0

    def holds(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Return which points (N, 3) belong to the body: within the kernels' reach, or on the sampled surface.

        Kernels sit inside the body, so that corners of its own surface may lie a little beyond their reach.
        """
        apart = KDTree(self.surface.points).query(points)[0]
        return self.covers(points) | (apart <= np.sqrt(self.surface.areas.mean()))

    def affine(self, matrix: ArrayLike, translation: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
        """Return the coordinates q (n, 3) of x = A X + t, with A (3, 3) and t (3,) [m] in the body frame."""
        a, t = np.asarray(matrix, dtype=np.float64), np.asarray(translation, dtype=np.float64)
        if a.shape != (3, 3) or t.shape != (3,):
            raise ConfigError(f"matrix (3, 3) and translation (3,): got shapes {a.shape} and {t.shape}")
        return self.linear_coordinates @ np.vstack([(a - np.eye(3)).T, t])

    def project(self, field: Callable[[Array], ArrayLike]) -> Array:
        """Return the coordinates (n, 3) of the vector field, of the functions' span, that is nearest to a given one.

        Nearest in the mean square over the volume, summed over the cubature points. A field of the span comes back as
        it is, affine ones among them.

        Args:
            field: Vectors (N, 3) at rest points of the body frame [m], shape (N, 3).

        Raises:
            ConfigError: If the vectors are not finite or of another shape.
            BasisError: If the cubature points are too few to tell the functions apart.
        """
        vectors = np.asarray(field(self.cubature.points), dtype=np.float64)
        if vectors.shape != self.cubature.points.shape or not np.isfinite(vectors).all():
            raise ConfigError(f"field: expected finite vectors {self.cubature.points.shape}, got shape {vectors.shape}")
        return self.fit(vectors, self.cubature.points, self.cubature.weights)

    def fit(self, values: Array, points: Array, weights: Array) -> Array:
        """Return the coordinates (n, C) of the functions of the span that are nearest to values in the mean square.

        Args:
            values: Values at the points, shape (N, C).
            points: Rest points of the body frame [m], shape (N, 3).
            weights: What each of them counts, shape (N,).

        Raises:
            BasisError: If the points are too few to tell the functions apart.
        """
        root = np.sqrt(weights / weights.sum())[:, None]
        solved: Any = np.linalg.lstsq(root * self.evaluate(points)[0], root * values, rcond=None)
        found, _, rank, _ = solved
        if rank < self.function_count:
            raise BasisError(
                f"{len(points)} cubature points tell {rank} of {self.function_count} functions apart",
                hint="build the body with a larger cubature_count",
            )
        return found

    def fields(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return what is no array, with the format and its version, ready for JSON, and the arrays by name."""
        values = self.flat()
        empty = set().union(*(names for name, names in TABLES.items() if not len(values[name])))
        if self._divided:
            empty -= {"material_points"}
        arrays = {name: v for name, v in values.items() if isinstance(v, np.ndarray) and name not in empty}
        told = {name: value for name, value in values.items() if not isinstance(value, np.ndarray)}
        return {"format": FORMAT, "version": FORMAT_VERSION, **told}, arrays

    @classmethod
    def from_fields(
        cls, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], source: str, *, hint: str = _HINT
    ) -> ReducedBody:
        """Return the body of what :meth:`fields` returned, checked.

        Args:
            header: What is no array, without format and version.
            arrays: The arrays by name.
            source: Where they come from, for messages.
            hint: The remedy.

        Raises:
            AssetError: If they are not those of a body.
        """
        header = {"envelope_length": 0.0, "gap_blends": False, **header}
        names = {*PLACES}
        for table in TABLES.values():
            if not arrays.keys() & (table - {"material_points"}):
                names -= table
        if arrays.keys() & (set().union(*TABLES.values()) - {"lame_ratio"}):
            names |= {"material_points"}
        if set(header) | set(arrays) != names or set(header) & set(arrays):
            wrong = sorted(names ^ (set(header) | set(arrays)))
            raise AssetError(f"{source}: fields {wrong} do not match", hint=hint)
        with damage_errors(source, hint=hint):
            return cls.from_flat({**header, **arrays, "region_names": tuple(header["region_names"])})

    def flat(self) -> dict[str, Any]:
        """Return all that makes up the body, without its sources, by the names and in the order that its file has."""
        made = made_fields(self.kernels, self.regions)
        return {name: attrgetter(place)(self) if place else made[name] for name, place in PLACES.items()}

    @classmethod
    def from_flat(cls, values: Mapping[str, Any], **own: Any) -> Self:
        """Return the body of what :meth:`flat` returned, checked.

        Args:
            values: Its fields by name.
            own: Its sources, and fields that a class of its own adds.

        Raises:
            BasisError: If any is wrong.
            ConfigError: If a region is.
        """
        values = {**GAPS, **values}
        check_fields(values)
        return cls(**records_of(values), **own)

    def save(
        self, path: str | os.PathLike[str], *, beside: Mapping[str, NDArray[Any]] | None = None, sources: bool = True
    ) -> None:
        """Write an .npz without pickle; the file appears complete or not at all.

        Args:
            path: The file; its folder is made if it is missing.
            beside: Arrays to store beside the body, by names with a dot; `load` skips them.
            sources: Whether to keep what the body was built from, if it has that: `hold` needs it.

        Raises:
            StorageError: If it cannot be written.
        """
        header, arrays = self.fields()
        kept = {_SOURCES + name: array for name, array in (self.sources or {}).items()} if sources else {}
        write_archive(path, header, {**arrays, **kept, **(beside or {})}, "body file")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> ReducedBody:
        """Read a file written by `save`.

        Raises:
            AssetError: If the file is missing, damaged, foreign, or of another version.
        """
        return cls.load_with(path)[0]

    @classmethod
    def load_with(cls, path: str | os.PathLike[str]) -> tuple[ReducedBody, dict[str, NDArray[Any]]]:
        """Read a file written by `save`, and the arrays that it carries beside the body.

        Raises:
            AssetError: If the file is missing, damaged, foreign, or of another version.
        """
        header, arrays = read_archive(path, FORMAT, READABLE, what="body file", hint=_HINT)
        own = {name: array for name, array in arrays.items() if "." not in name}
        body = cls.from_fields(header, own, f"body file {path}")
        sources = {n.removeprefix(_SOURCES): a for n, a in arrays.items() if n.startswith(_SOURCES)}
        beside = {n: a for n, a in arrays.items() if n not in own and not n.startswith(_SOURCES)}
        return dataclasses.replace(body, sources=sources or None), beside

    def check(self) -> None:
        """Verify shapes, dtypes, finiteness and the weights' sum.

        Raises:
            BasisError: If any is wrong.
        """
        check_fields(self.flat())
