"""ReducedBody: the frozen, saveable product of the build, and the way to it.

x(X) = X + sum_k b_k(X) q_k in the body frame (origin: centre of mass). The functions b_k are combinations of the
skinning products W_j (X, Y, Z, 1), orthonormal in the mass inner product (1 / V) sum_p V_p rho_p b_k b_l = delta_kl:
b_0 = 1, b_1..b_3 linear, the others free of mean and linear moment and ordered by the mean square of their gradient.
So the kinetic energy is mass / 2 |qdot|^2 and |q| is the rms displacement in metres.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree
from threadpoolctl import threadpool_limits

from softmode.atomic import atomic_write
from softmode.deformables.cubature import select_cubature
from softmode.deformables.eigenmodes import solve_eigenmodes
from softmode.deformables.quadrature import Quadrature
from softmode.deformables.rkpm import BasisRKPM, KernelName, make_basis
from softmode.errors import AssetError, BasisError, ConfigError, MaterialError

Array = NDArray[np.float64]
Scalar = str | int | float | bool | None
Progress = Callable[[str, float], None]

FORMAT = "softmode.ReducedBody"
FORMAT_VERSION = 1
RANK_TOLERANCE = 1e-5
"""Directions of the scaled mass Gram matrix under this fraction of the largest are dropped. That is an amplitude of
0.3 %, the error of the eigenmodes themselves: on a sphere, where x W_y = y W_x, 8 of 36 functions are such noise.
Dropping them changes the compliance of a clamped sphere by 0.1 % and cuts the cubature's force error tenfold.
Rougher functions above the bound matter: a bound of 1e-3 makes a clamped beam half again as stiff."""
REACH = 0.35
"""How far from its nearest kernel centre a point may lie, as a fraction of the kernel's support. Inside an object the
ratio stays under 0.3; beyond, the functions grow as extrapolated polynomials do (tenfold at 0.5), so they are held
constant."""


@dataclass(frozen=True, kw_only=True)
class BuildOptions:
    """How a body is reduced."""

    mode_count: int = 8
    """Skinning eigenmodes beside the constant handle; up to 4 (mode_count + 1) functions."""
    kernel_count: int = 400
    """Reproducing kernels; 400 give the first 16 eigenvalues of a box to 0.3 % in about 0.1 s."""
    kernel: KernelName = "cubic"
    """Bell of the reproducing kernels."""
    cubature_count: int | None = 384
    """Points at which a step evaluates stress; None keeps all. Measured force errors at 256 points: 0.4-0.6 % (box,
    sphere, beam), 1.5 % (bear, robot); at 384: 0.2-0.3 % and 0.8 %. `provenance` has the body's own at this and at
    smaller counts."""
    seed: int = 0
    """Seed of every random choice of the build."""

    def __post_init__(self) -> None:
        """Check ranges."""
        if self.mode_count < 1:
            raise ConfigError(f"mode_count: expected at least 1, got {self.mode_count}")
        if self.kernel_count <= self.mode_count + 4:
            raise ConfigError(f"kernel_count: expected more than mode_count + 4, got {self.kernel_count}")
        if self.cubature_count is not None and self.cubature_count < 8:
            raise ConfigError(f"cubature_count: expected at least 8 or None, got {self.cubature_count}")


@dataclass(frozen=True, kw_only=True)
class ReducedBody:
    """A deformable body ready to simulate: arrays only, float64 unless said, body frame, SI units."""

    name: str
    """Name for messages and reports."""
    points: Array
    """Cubature points [m], shape (P, 3)."""
    weights: Array
    """Their volumes [m^3], > 0, sum = `volume`, shape (P,)."""
    grad_basis: NDArray[np.float32]
    """Gradients of the functions at the cubature points [1/m], shape (P, n, 3), float32."""
    stiffness_scale: Array
    """Young's modulus relative to the body's, shape (P,)."""
    surface_points: Array
    """Surface samples [m], shape (S, 3)."""
    surface_normals: Array
    """Outward unit normals, shape (S, 3)."""
    surface_areas: Array
    """Areas [m^2], sum = surface area, shape (S,)."""
    surface_basis: NDArray[np.float32]
    """Functions at the surface samples, shape (S, n), float32."""
    volume: float
    """Volume [m^3]."""
    mean_basis: Array
    """(1/V) sum V_p rho_p b_k over the full quadrature, shape (n,); gravity acts as mass * g * mean_basis_k."""
    linear_coordinates: Array
    """Coefficients c (n, 4) with sum_k b_k c_kj = (X, Y, Z, 1)_j for every X."""
    eigenvalues: Array
    """Eigenvalues of the skinning weights [1/m^2], the constant handle's 0 first, shape (m + 1,)."""
    bounds: Array
    """Corners of the bounding box in the body frame [m], shape (2, 3)."""
    offset: Array
    """Origin of the body frame in asset coordinates [m]: X_body = X_asset - offset, shape (3,)."""
    centres: Array
    """Kernel centres [m], shape (K, 3)."""
    radii: Array
    """Nominal kernel radii [m], shape (K,)."""
    kernel: KernelName
    """Bell of the kernels."""
    handles: Array
    """Coefficients of the weights W_j in the kernels, shape (K, m + 1)."""
    transform: Array
    """b = (W_0 Z, W_1 Z, ..., W_m Z) @ transform with Z = (X, Y, Z, 1) in units of `length`; shape (4 (m + 1), n)."""
    length: float
    """Unit of length of the raw functions [m]."""
    fingerprint: str
    """sha256 of the quadrature, the fields and the options."""
    provenance: dict[str, Scalar]
    """What went in, what was measured, what was lost."""
    build_seconds: float
    """Wall time of the build [s]."""

    @property
    def function_count(self) -> int:
        """Number of scalar functions n."""
        return self.grad_basis.shape[1]

    @property
    def mode_count(self) -> int:
        """Number of skinning eigenmodes m, without the constant handle."""
        return len(self.eigenvalues) - 1

    @property
    def point_count(self) -> int:
        """Number of cubature points P."""
        return len(self.points)

    @property
    def surface_count(self) -> int:
        """Number of surface samples S."""
        return len(self.surface_points)

    def evaluate(self, points: ArrayLike, *, outside: str = "clamp") -> tuple[Array, Array]:
        """Evaluate the functions and their gradients at rest points of the body frame.

        Args:
            points: Rest positions [m], shape (N, 3).
            outside: "clamp" gives points beyond the kernels' reach the value of the nearest point within reach, with
                gradient zero, in all functions but the affine ones, which stay exact; "raise" refuses them.

        Returns:
            Values (N, n) and gradients [1/m] (N, n, 3).

        Raises:
            BasisError: If points are not finite, or out of reach with outside="raise".
        """
        x = np.asarray(points, dtype=np.float64)
        if x.ndim != 2 or x.shape[1] != 3 or not np.isfinite(x).all():
            raise BasisError(f"points: expected finite positions of shape (N, 3), got shape {x.shape}")
        if outside not in ("clamp", "raise"):
            raise ConfigError(f"outside: expected 'clamp' or 'raise', got {outside!r}")
        basis = BasisRKPM(centres=self.centres, radii=self.radii, kernel=self.kernel)
        distance, nearest = KDTree(self.centres).query(x)
        ratio = distance / (REACH * basis.support[nearest])
        far = ratio > 1.0
        if far.any() and outside == "raise":
            raise BasisError(
                f"points: {int(far.sum())} of {len(x)} lie outside the body (first: row {int(far.argmax())})",
                hint="Drop them, or pass outside='clamp'.",
            )
        inner = np.where(
            far[:, None], self.centres[nearest] + (x - self.centres[nearest]) / np.maximum(ratio, 1.0)[:, None], x
        )
        shape = basis.evaluate(inner)
        weight = shape.value @ self.handles
        slope = np.stack([g @ self.handles for g in shape.gradient], axis=2)
        raw, raw_gradient = _skinning_products(weight, slope, inner, self.length)
        value, gradient = raw @ self.transform, np.einsum("nrd,rk->nkd", raw_gradient, self.transform, optimize=True)
        if far.any():
            value[far, :4] = np.column_stack([x[far] / self.length, np.ones(int(far.sum()))]) @ self.transform[:4, :4]
            gradient[far, 4:] = 0.0
        return value, gradient

    def covers(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Return which points (N, 3) the kernels reach, that is, which `evaluate` does not clamp."""
        basis = BasisRKPM(centres=self.centres, radii=self.radii, kernel=self.kernel)
        distance, nearest = KDTree(self.centres).query(np.asarray(points, dtype=np.float64))
        return distance <= REACH * basis.support[nearest]

    def affine(self, matrix: ArrayLike, translation: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
        """Return the coordinates q (n, 3) of x = A X + t, with A (3, 3) and t (3,) [m] in the body frame."""
        a, t = np.asarray(matrix, dtype=np.float64), np.asarray(translation, dtype=np.float64)
        if a.shape != (3, 3) or t.shape != (3,):
            raise ConfigError(f"matrix (3, 3) and translation (3,): got shapes {a.shape} and {t.shape}")
        return self.linear_coordinates @ np.vstack([(a - np.eye(3)).T, t])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an .npz without pickle; the file appears complete or not at all."""
        target = Path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        header: dict[str, Any] = {"format": FORMAT, "version": FORMAT_VERSION}
        arrays: dict[str, Any] = {}
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            if isinstance(value, np.ndarray):
                arrays[f.name] = value
            else:
                header[f.name] = value
        arrays["header"] = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
        with atomic_write(target) as file:
            np.savez(file, **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> ReducedBody:
        """Read a file written by `save`.

        Raises:
            AssetError: If the file is missing, damaged, foreign, or of another version.
        """
        hint = "Build the body again."
        try:
            with np.load(path, allow_pickle=False) as file:
                stored = {key: file[key] for key in file.files}
        except FileNotFoundError as error:
            raise AssetError(f"body file {path}: does not exist", hint=hint) from error
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, NotImplementedError, MemoryError) as error:
            raise AssetError(f"body file {path}: damaged or not an .npz ({error})", hint=hint) from error
        except Exception as error:  # zlib and struct errors of a damaged archive have no common base.
            raise AssetError(f"body file {path}: damaged ({type(error).__name__}: {error})", hint=hint) from error
        try:
            header = json.loads(stored.pop("header").tobytes().decode())
        except (KeyError, ValueError) as error:
            raise AssetError(f"body file {path}: not a softmode body", hint=hint) from error
        if not isinstance(header, dict) or header.pop("format", None) != FORMAT:
            raise AssetError(f"body file {path}: not a softmode body", hint=hint)
        version = header.pop("version", None)
        if version != FORMAT_VERSION:
            raise AssetError(
                f"body file {path}: format version {version}, this softmode reads {FORMAT_VERSION}", hint=hint
            )
        names = {f.name for f in dataclasses.fields(cls)}
        if set(header) | set(stored) != names:
            raise AssetError(
                f"body file {path}: fields {sorted(names ^ (set(header) | set(stored)))} do not match", hint=hint
            )
        try:
            body = cls(**header, **stored)
            body.check()
        except BasisError as error:
            raise AssetError(f"body file {path}: {error.message}", hint=hint) from error
        except (TypeError, IndexError, AttributeError) as error:
            raise AssetError(f"body file {path}: a field has another type or shape ({error})", hint=hint) from error
        return body

    def check(self) -> None:
        """Verify shapes, dtypes, finiteness and the weights' sum.

        Raises:
            BasisError: If any is wrong.
        """
        kinds = {"name": str, "volume": float, "kernel": str, "length": float, "fingerprint": str, "provenance": dict}
        for name, kind in (kinds | {"build_seconds": float}).items():
            if not isinstance(getattr(self, name), kind):
                raise BasisError(f"{name}: expected {kind.__name__}, got {type(getattr(self, name)).__name__}")
        p, s, n, k, m = (
            len(v) for v in (self.points, self.surface_points, self.mean_basis, self.centres, self.eigenvalues)
        )
        expected = {
            "points": (p, 3),
            "weights": (p,),
            "grad_basis": (p, n, 3),
            "stiffness_scale": (p,),
            "surface_points": (s, 3),
            "surface_normals": (s, 3),
            "surface_areas": (s,),
            "surface_basis": (s, n),
            "mean_basis": (n,),
            "linear_coordinates": (n, 4),
            "eigenvalues": (m,),
            "bounds": (2, 3),
            "offset": (3,),
            "centres": (k, 3),
            "radii": (k,),
            "handles": (k, m),
            "transform": (4 * m, n),
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            dtype = np.float32 if name in ("grad_basis", "surface_basis") else np.float64
            if value.shape != shape or value.dtype != dtype:
                raise BasisError(f"{name}: expected {np.dtype(dtype)} {shape}, got {value.dtype} {value.shape}")
            if not np.isfinite(value).all():
                raise BasisError(f"{name}: not all finite")
        if not (
            self.volume > 0.0 and (self.weights >= 0.0).all() and abs(self.weights.sum() / self.volume - 1.0) < 1e-6
        ):
            raise BasisError(f"weights: expected >= 0 with sum {self.volume}, got sum {self.weights.sum()}")


def build_body(
    quadrature: Quadrature,
    options: BuildOptions | None = None,
    *,
    name: str = "body",
    stiffness_scale: ArrayLike | None = None,
    density_scale: ArrayLike | None = None,
    progress: bool | Progress | None = None,
) -> ReducedBody:
    """Reduce an object: kernels, eigenmodes, orthonormal functions, cubature.

    Args:
        quadrature: The object.
        options: Sizes and seed; defaults when None.
        name: Name for messages and reports.
        stiffness_scale: Young's modulus per quadrature point relative to the body's, shape (P,); ones when None.
        density_scale: Density per quadrature point relative to any common reference, shape (P,); normalised to volume
            mean 1.
        progress: True or False shows a bar or not; None shows one on a terminal when the build exceeds two seconds; a
            callable receives (stage, fraction done).

    Returns:
        The body, in the frame of its centre of mass.

    Raises:
        MaterialError: If a scale is not finite and positive.
        BasisError: If the basis cannot be built.
        ConfigError: If options do not fit the object.
    """
    # One BLAS thread: the matrices are small, threads that compete for a busy core cost tenfold, and their number would
    # decide the last bits of the result.
    with threadpool_limits(limits=1, user_api="blas"):
        return _build(quadrature, options or BuildOptions(), name, stiffness_scale, density_scale, progress)


def _build(
    quadrature: Quadrature,
    options: BuildOptions,
    name: str,
    stiffness_scale: ArrayLike | None,
    density_scale: ArrayLike | None,
    progress: bool | Progress | None,
) -> ReducedBody:
    """Do what :func:`build_body` says."""
    start = time.perf_counter()
    stiffness = _positive_field("stiffness_scale", stiffness_scale, len(quadrature.points))
    density = _positive_field("density_scale", density_scale, len(quadrature.points))
    fingerprint = fingerprint_of(FORMAT_VERSION, quadrature, options, name, stiffness, density)
    density = density * (quadrature.volume / (quadrature.weights @ density))
    mass = quadrature.weights * density / quadrature.volume
    offset = mass @ quadrature.points
    points = quadrature.points - offset
    length = float(np.sqrt(mass @ (points**2).sum(axis=1)))
    seconds: dict[str, float] = {}
    with _reporter(progress, name) as report:

        def stage(label: str, fraction: float) -> None:
            seconds[label] = time.perf_counter() - start - sum(seconds.values())
            report(label, fraction)

        basis = make_basis(
            points, options.kernel_count, kernel=options.kernel, spacing=quadrature.spacing, seed=options.seed
        )
        shape = basis.evaluate(points)
        stage("kernels", 0.15)
        modes = solve_eigenmodes(shape, quadrature.weights, options.mode_count, stiffness_scale=stiffness)
        stage("eigenmodes", 0.35)
        value = shape.value @ modes.coefficients
        gradient = np.stack([g @ modes.coefficients for g in shape.gradient], axis=2)
        raw, raw_gradient = _skinning_products(value, gradient, points, length)
        transform = _orthonormalise(raw, raw_gradient, mass, quadrature.weights * stiffness / quadrature.volume)
        grad_basis = np.einsum("nrd,rk->nkd", raw_gradient, transform, optimize=True)
        stage("functions", 0.5)
        count = len(points) if options.cubature_count is None else options.cubature_count
        chosen = select_cubature(quadrature.weights, grad_basis, count, stiffness_scale=stiffness, seed=options.seed)
        stage("cubature", 0.95)
        function_count = transform.shape[1]
        linear = np.zeros((function_count, 4))
        linear[:4] = np.linalg.inv(transform[:4, :4]) @ np.diag([1.0, 1.0, 1.0, 1.0]) * np.array([length] * 3 + [1.0])
        body = ReducedBody(
            name=name,
            points=points[chosen.index],
            weights=chosen.weights,
            grad_basis=grad_basis[chosen.index].astype(np.float32),
            stiffness_scale=stiffness[chosen.index],
            surface_points=quadrature.surface_points - offset,
            surface_normals=quadrature.surface_normals.copy(),
            surface_areas=quadrature.surface_areas.copy(),
            surface_basis=np.zeros((len(quadrature.surface_points), function_count), dtype=np.float32),
            volume=quadrature.volume,
            mean_basis=np.eye(1, function_count)[0],
            linear_coordinates=linear,
            eigenvalues=modes.eigenvalues,
            bounds=quadrature.bounds - offset,
            offset=offset,
            centres=basis.centres,
            radii=basis.radii,
            kernel=options.kernel,
            handles=modes.coefficients,
            transform=transform,
            length=length,
            fingerprint=fingerprint,
            provenance={},
            build_seconds=0.0,
        )
        surface = body.evaluate(body.surface_points)[0]
        stage("surface", 1.0)
    provenance: dict[str, Scalar] = {
        **{f"quadrature_{key}": v for key, v in quadrature.report.items() if isinstance(v, str | int | float | bool)},
        **{f"option_{key}": v for key, v in dataclasses.asdict(options).items()},
        **{f"seconds_{key}": v for key, v in seconds.items()},
        "quadrature_count": len(points),
        "function_count": function_count,
        "dropped_functions": 4 * (options.mode_count + 1) - function_count,
        "heterogeneous": stiffness_scale is not None or density_scale is not None,
        "cubature_count": len(chosen.index),
        "cubature_force_error": chosen.force_error,
        "cubature_stiffness_error": chosen.stiffness_error,
        **{f"cubature_force_error_{size}": error for size, error in chosen.trade_off.items()},
    }
    return dataclasses.replace(
        body,
        surface_basis=surface.astype(np.float32),
        provenance=provenance,
        build_seconds=time.perf_counter() - start,
    )


def cached_body(
    key: tuple[Any, ...], build: Callable[[], ReducedBody], *, directory: str | os.PathLike[str] | None = None
) -> ReducedBody:
    """Return the body stored under a key, building it once when it is absent or damaged.

    Processes that ask for one key at a time wait for the first: a lock file guards the build, an atomic rename
    publishes it.

    Args:
        key: Everything the result depends on; see `fingerprint_of` for what can be hashed.
        build: Called without arguments when the cache has no usable entry.
        directory: Cache folder; default is `cache_directory()` / "bodies".

    Returns:
        The body.
    """
    folder = Path(directory) if directory is not None else cache_directory() / "bodies"
    path = folder / f"{fingerprint_of(FORMAT_VERSION, *key)}.npz"
    with contextlib.suppress(AssetError):
        return ReducedBody.load(path)
    folder.mkdir(parents=True, exist_ok=True)
    with _locked(path.with_suffix(".lock")):
        with contextlib.suppress(AssetError):
            return ReducedBody.load(path)
        body = build()
        body.save(path)
    return body


def cache_directory() -> Path:
    """Return the user's cache folder: the environment variable SOFTMODE_CACHE, or ~/.cache/softmode."""
    override = os.environ.get("SOFTMODE_CACHE")
    return Path(override) if override else Path.home() / ".cache" / "softmode"


def fingerprint_of(*values: Any) -> str:
    """Return the sha256 of nested scalars, strings, bytes, files (paths), arrays, dataclasses, sequences, mappings."""
    digest = hashlib.sha256()
    for value in values:
        _feed(digest, value)
    return digest.hexdigest()


def _feed(digest: Any, value: Any) -> None:
    if isinstance(value, np.ndarray):
        digest.update(f"array {value.dtype.str} {value.shape};".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, Path):
        digest.update(f"file {value.stat().st_size};".encode())
        digest.update(value.read_bytes())
    elif isinstance(value, bytes):
        digest.update(f"bytes {len(value)};".encode() + value)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        digest.update(f"{type(value).__name__};".encode())
        for f in dataclasses.fields(value):
            _feed(digest, f.name)
            _feed(digest, getattr(value, f.name))
    elif isinstance(value, dict):
        digest.update(f"dict {len(value)};".encode())
        for key in sorted(value, key=str):
            _feed(digest, str(key))
            _feed(digest, value[key])
    elif isinstance(value, list | tuple):
        digest.update(f"sequence {len(value)};".encode())
        for item in value:
            _feed(digest, item)
    elif value is None or isinstance(value, str | bool | int | float | np.generic):
        item = value.item() if isinstance(value, np.generic) else value
        digest.update(f"{type(item).__name__} {item!r};".encode())
    else:
        raise ConfigError(f"key: cannot take the fingerprint of a {type(value).__name__}")


def _positive_field(name: str, value: ArrayLike | None, count: int) -> Array:
    if value is None:
        return np.ones(count)
    found = np.array(value, dtype=np.float64)
    if found.shape != (count,):
        raise MaterialError(f"{name}: expected one value per quadrature point, shape ({count},), got {found.shape}")
    if not (np.isfinite(found).all() and (found > 0.0).all()):
        bad = int(np.flatnonzero(~(np.isfinite(found) & (found > 0.0)))[0])
        raise MaterialError(f"{name}: expected finite values > 0, got {found[bad]} at row {bad}")
    return found


def _skinning_products(value: Array, gradient: Array, points: Array, length: float) -> tuple[Array, Array]:
    """Return W_j Z_c (N, 4 (m+1)) and gradients (N, 4 (m+1), 3), with Z = (x, y, z, 1), x in units of `length`."""
    count, handles = value.shape
    value[:, 0], gradient[:, 0] = 1.0, 0.0  # Exact, so that affine motion is; the kernels give it to rounding only.
    z = np.concatenate([points / length, np.ones((count, 1))], axis=1)
    product = value[:, :, None] * z[:, None, :]
    slope = gradient[:, :, None, :] * z[:, None, :, None]
    for d in range(3):
        slope[:, :, d, d] += value / length
    return product.reshape(count, 4 * handles), slope.reshape(count, 4 * handles, 3)


def _orthonormalise(raw: Array, raw_gradient: Array, mass: Array, stiff: Array) -> Array:
    """Return the mass-orthonormal transform (R, n): 1, linear, then the rest by ascending mean square gradient."""
    gram = raw.T @ (mass[:, None] * raw)
    total = len(gram)
    # Handle 0 is constant, so raw functions 0..3 are exactly (x, y, z, 1). Order (1, x, y, z) for Cholesky.
    lead = [3, 0, 1, 2]
    transform = np.zeros((total, 4))
    transform[np.ix_(lead, range(4))] = np.linalg.inv(np.linalg.cholesky(gram[np.ix_(lead, lead)])).T
    rest = np.eye(total)[:, 4:]
    for _ in range(2):
        rest = rest - transform @ (transform.T @ (gram @ rest))
    inner = rest.T @ gram @ rest
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram)[4:], 1e-300))
    value, vector = np.linalg.eigh(inner * scale[:, None] * scale)
    keep = value > RANK_TOLERANCE * value[-1]
    if not keep.any():
        raise BasisError("the eigenmodes add nothing to affine motion", hint="Use more modes or kernels.")
    rest = rest @ (scale[:, None] * vector[:, keep] / np.sqrt(value[keep]))
    # One pass against the actual functions repairs what the squared condition number of the Gram matrix cost.
    both = np.concatenate([transform, rest], axis=1)
    lower = np.linalg.cholesky((raw @ both).T @ (mass[:, None] * (raw @ both)))
    both = both @ np.linalg.inv(lower).T
    flat = np.einsum("nrd,rk->dnk", raw_gradient, both[:, 4:], optimize=True)
    energy = sum(g.T @ (stiff[:, None] * g) for g in flat)
    rotation = np.linalg.eigh(energy)[1]
    rotation *= np.sign(rotation[np.abs(rotation).argmax(axis=0), np.arange(rotation.shape[1])])
    return np.concatenate([both[:, :4], both[:, 4:] @ rotation], axis=1)


@contextlib.contextmanager
def _reporter(progress: bool | Progress | None, name: str) -> Iterator[Progress]:
    if callable(progress):
        yield progress
        return
    shown = progress if progress is not None else sys.stderr.isatty()
    if not shown:
        yield lambda stage, fraction: None
        return
    from tqdm import tqdm

    with tqdm(total=100, desc=f"build {name}", delay=0.0 if progress else 2.0, unit="%", leave=False) as bar:

        def report(stage: str, fraction: float) -> None:
            bar.set_postfix_str(stage, refresh=False)
            bar.update(round(100.0 * fraction) - bar.n)

        yield report


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold an exclusive lock on a file; the system releases it if the process dies."""
    with open(path, "a+b") as file:
        if sys.platform == "win32":
            import msvcrt

            while True:
                try:
                    msvcrt.locking(file.fileno(), msvcrt.LK_LOCK, 1)
                    break
                except OSError:
                    time.sleep(0.05)
            try:
                yield
            finally:
                file.seek(0)
                msvcrt.locking(file.fileno(), msvcrt.LK_UNLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
            try:
                yield
            finally:
                fcntl.flock(file, fcntl.LOCK_UN)
