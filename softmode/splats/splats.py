"""`Splats`: the validated arrays of one set of 3D Gaussian splats."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from softmode.checks import require_number
from softmode.errors import AssetError, ConfigError
from softmode.splats.principal_axes import axes_of_covariances, axes_of_gradients, nearest_rotations

SH_DC = 0.28209479177387814
"""Value of the constant spherical harmonic: colour = 0.5 + SH_DC * sh[:, 0]."""

MAX_SPLATS = 2**26
"""Largest number of splats that a reader or a `Splats` accepts."""

UpAxis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]

_UP_ROTATIONS: dict[str, list[list[float]]] = {
    "+z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-z": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "+y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "-y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "+x": [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
    "-x": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Splats:
    """One set of 3D Gaussian splats; float32, read-only, validated on construction.

    A splat is an anisotropic Gaussian with covariance R diag(scales^2) R^T. Quaternions are normalised on construction.

    Raises:
        AssetError: If an array has the wrong shape, holds NaN or infinity, or a scale is not positive.
    """

    means: np.ndarray
    """Centres [m], shape (N, 3)."""
    quats: np.ndarray
    """Unit quaternions xyzw, principal frame to asset frame, shape (N, 4)."""
    scales: np.ndarray
    """Standard deviations along the principal axes, linear [m], shape (N, 3)."""
    opacities: np.ndarray
    """Opacities 0..1, shape (N,)."""
    sh: np.ndarray
    """Spherical-harmonic coefficients of the colour, shape (N, K, 3), K = (degree + 1)^2 in {1, 4, 9, 16}."""
    name: str = "splats"
    """Where the splats come from (a file name); used in messages."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What `means` lack to the file's own coordinates [m], where these are too far out for float32."""
    notes: tuple[str, ...] = ()
    """What was read from the file in another way than it was meant."""
    dropped_count: int = 0
    """Number of splats of the file that were left out: not finite, or without rotation or size."""

    def __post_init__(self) -> None:
        """Convert, validate, normalise and freeze the arrays."""
        means = self._array("means", (None, 3))
        count = len(means)
        if count == 0:
            raise AssetError(f"{self.name}: holds no splats", hint="Export the asset again with at least one splat")
        if count > MAX_SPLATS:
            raise AssetError(f"{self.name}: {count} splats, at most {MAX_SPLATS}", hint="Decimate the asset first")
        quats = self._array("quats", (count, 4))
        scales = self._array("scales", (count, 3))
        opacities = self._array("opacities", (count,))
        sh = self._array("sh", (count, None, 3))
        if sh.shape[1] not in (1, 4, 9, 16):
            raise AssetError(
                f"{self.name}: sh holds {sh.shape[1]} coefficients per splat, expected 1, 4, 9 or 16",
                hint="Export with spherical-harmonic degree 0 to 3",
            )
        norm = np.linalg.norm(quats.astype(np.float64), axis=1, keepdims=True)
        self._require(np.asarray(norm[:, 0] > 1e-8), "quats", "a rotation quaternion of length zero")
        self._require(np.asarray((scales > 0.0).all(axis=1)), "scales", "a scale that is not positive")
        self._require((opacities >= 0.0) & (opacities <= 1.0), "opacities", "an opacity outside 0..1")
        # What is a unit quaternion to float32 rounding stays as it is, so that files and copies are equal to the bit.
        quats = (quats / np.where(np.abs(norm - 1.0) < 1.0e-7, 1.0, norm)).astype(np.float32)
        arrays = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh": sh}
        for field, value in arrays.items():
            value.setflags(write=False)
            object.__setattr__(self, field, value)

    def _array(self, field: str, shape: tuple[int | None, ...]) -> NDArray[np.float32]:
        """Return the field as a fresh contiguous float32 array of the expected shape without NaN or infinity."""
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                value = np.array(getattr(self, field), dtype=np.float32, order="C")
        except (TypeError, ValueError) as error:
            raise AssetError(f"{self.name}: {field} is no array of numbers", hint="Pass arrays of float32") from error
        expected = tuple(("K" if axis else "N") if size is None else size for axis, size in enumerate(shape))
        if value.ndim != len(shape) or any(s is not None and s != v for s, v in zip(shape, value.shape, strict=True)):
            raise AssetError(
                f"{self.name}: {field} has shape {value.shape}, expected ({', '.join(map(str, expected))})",
                hint="All arrays of one asset need the same number of splats; sh has K = 1, 4, 9 or 16 coefficients",
            )
        self._require(np.asarray(np.isfinite(value).all(axis=tuple(range(1, value.ndim)))), field, "NaN or infinity")
        return value

    def _require(self, good: np.ndarray, field: str, problem: str) -> None:
        """Raise an AssetError that counts the splats for which `good` is false."""
        if not good.all():
            bad = np.flatnonzero(~good)
            raise AssetError(
                f"{self.name}: {field} of {len(bad)} of {len(good)} splats holds {problem} (first: splat {bad[0]})",
                hint="Remove them (`softmode splat convert FILE CLEAN.ply --drop-invalid`), or export the asset again",
            )

    @property
    def count(self) -> int:
        """Number of splats N."""
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Spherical-harmonic degree, 0 to 3."""
        return int(np.sqrt(self.sh.shape[1])) - 1

    def colors(self) -> NDArray[np.float32]:
        """Return the view-independent colours 0..1 (gamma-encoded), shape (N, 3)."""
        return np.clip(0.5 + SH_DC * self.sh[:, 0], 0.0, 1.0).astype(np.float32)

    def covariances(self) -> NDArray[np.float64]:
        """Return the covariances R diag(scales^2) R^T [m^2], shape (N, 3, 3)."""
        frame = rotations_from_quats(self.quats)
        return np.einsum("nij,nj,nkj->nik", frame, self.scales.astype(np.float64) ** 2, frame)

    def discs(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the thin axes, of either sign, and the others as long as their standard deviations [m].

        Returns:
            Unit vectors, shape (N, 3), and columns, the longest first, shape (N, 3, 2).
        """
        scales = self.scales.astype(np.float64)
        order = np.argsort(-scales, axis=1, kind="stable")
        axes = np.take_along_axis(rotations_from_quats(self.quats), order[:, None], axis=2)
        return axes[:, :, 2], axes[:, :, :2] * np.take_along_axis(scales, order[:, :2], axis=1)[:, None]

    def bounds(self, *, quantile: float = 0.0) -> NDArray[np.float64]:
        """Return the axis-aligned box of the centres [m], shape (2, 3).

        Args:
            quantile: Share of splats left out at either end of each axis, 0..0.5; ignores floaters of trained assets.
        """
        return np.quantile(self.means.astype(np.float64), [quantile, 1.0 - quantile], axis=0)

    def subset(self, mask: ArrayLike) -> Splats:
        """Return the splats that a boolean mask or an index array selects, in that order."""
        index = np.asarray(mask)
        fields = ("means", "quats", "scales", "opacities", "sh")
        return replace(self, **{field: getattr(self, field)[index] for field in fields})

    def cropped(self, low: ArrayLike, high: ArrayLike) -> Splats:
        """Return the splats whose centres lie in the box between `low` and `high` [m], each of shape (3,).

        Cuts an object out of its capture, for example off the ground it was captured on. Infinite bounds are allowed;
        those of a capture with an `offset` are in its own coordinates.
        """
        low, high = (
            np.asarray(bound) - self.offset if any(self.offset) else np.asarray(bound) for bound in (low, high)
        )
        return self.subset((self.means >= low).all(axis=1) & (self.means <= high).all(axis=1))

    def with_sh_degree(self, degree: int) -> Splats:
        """Return the splats with the spherical harmonics cut to `degree` (no more than they have)."""
        require_number("degree", degree, at_least=0, at_most=3)
        return replace(self, sh=self.sh[:, : (degree + 1) ** 2])

    def transformed(
        self, rotation: ArrayLike | None = None, translation: ArrayLike = (0.0, 0.0, 0.0), scale: float = 1.0
    ) -> Splats:
        """Return the splats after x -> scale * rotation @ x + translation; view-dependent colour turns along.

        Args:
            rotation: Proper rotation matrix, shape (3, 3); None for the identity.
            translation: Offset [m], shape (3,).
            scale: Uniform factor, > 0.

        Raises:
            ConfigError: If the rotation is not proper orthogonal, or the scale is not positive and finite.
        """
        matrix = np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64)
        proper = matrix.shape == (3, 3) and np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-5)
        if not (proper and np.linalg.det(matrix) > 0.0):
            raise ConfigError("rotation must be a proper (3, 3) rotation matrix", hint="Pass scale as its own argument")
        require_number("scale", scale, above=0.0)
        means = scale * self.means.astype(np.float64) @ matrix.T + np.asarray(translation, dtype=np.float64)
        quats, sh = self.quats, self.sh
        x, y, z = (scale * matrix @ self.offset).tolist()
        if rotation is not None:
            quats = multiply_quats(quats_from_rotations(matrix), self.quats)
            sh = rotate_sh(self.sh, matrix)
        scales = self.scales * np.float32(scale)
        return replace(self, means=means, quats=quats, scales=scales, sh=sh, offset=(x, y, z))

    def deformed(self, means: ArrayLike, gradients: ArrayLike) -> Splats:
        """Return the splats after a deformation: covariances become F Sigma F^T, view-dependent colour turns along.

        With means and gradients of a rigid motion or a uniform scaling this equals `transformed`. The principal axes
        keep the order of the rest axes, so that quaternions vary smoothly over the frames of an animation.

        Args:
            means: Deformed centres [m], shape (N, 3).
            gradients: Deformation gradients F = dx/dX at the centres, shape (N, 3, 3), or (3, 3) for all.

        Raises:
            ConfigError: If an argument has another shape or is not finite.
            AssetError: If a gradient is zero and leaves nothing of a splat.
        """
        f = self._matrices("gradients", gradients)
        frames, scales = axes_of_gradients(f, rotations_from_quats(self.quats), self.scales)
        return self._placed(means, frames, scales, nearest_rotations(f))

    def with_covariances(self, means: ArrayLike, covariances: ArrayLike, rotations: ArrayLike) -> Splats:
        """Return the splats with the centres, covariances and rotations that skinning on the device leaves.

        Takes the rows of `SplatArrays` of one world as they are. Prefer `deformed` where gradients are at hand: squared
        scales in float32 blur discs thinner than a thousandth.

        Args:
            means: Deformed centres [m], shape (N, 3).
            covariances: Deformed covariances [m^2], shape (N, 3, 3), or (N, 6) as xx, xy, xz, yy, yz, zz.
            rotations: Rotations from the rest state, which turn the view-dependent colour, shape (N, 3, 3) or (3, 3),
                or quaternions xyzw, shape (N, 4) or (1, 4).

        Raises:
            ConfigError: If an argument has another shape or is not finite.
            AssetError: If a covariance is zero.
        """
        six, quats = np.asarray(covariances, dtype=np.float64), np.asarray(rotations, dtype=np.float64)
        if six.shape == (self.count, 6):
            covariances = six[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        if quats.shape in ((self.count, 4), (1, 4)):
            norm = np.linalg.norm(quats, axis=1)
            if not (np.isfinite(norm) & (norm > 1e-8)).all():
                raise ConfigError(
                    "rotations holds a quaternion of length zero or not finite",
                    hint="Launch the skinning before reading what it writes",
                )
            rotations = np.broadcast_to(rotations_from_quats(quats), (self.count, 3, 3))
        turn = self._matrices("rotations", rotations)
        sigma = self._matrices("covariances", covariances)
        frames, scales = axes_of_covariances(sigma, turn @ rotations_from_quats(self.quats))
        return self._placed(means, frames, scales, turn)

    def _matrices(self, name: str, value: ArrayLike) -> NDArray[np.float64]:
        """Return one finite (3, 3) matrix per splat."""
        matrices = np.asarray(value, dtype=np.float64)
        if matrices.shape not in ((3, 3), (self.count, 3, 3)) or not np.isfinite(matrices).all():
            raise ConfigError(
                f"{name} must be finite and of shape ({self.count}, 3, 3) or (3, 3), got shape {matrices.shape}",
                hint="Pass one matrix per splat, in the order of the splats",
            )
        return np.broadcast_to(matrices, (self.count, 3, 3))

    def _placed(
        self, means: ArrayLike, frames: NDArray[np.float64], scales: NDArray[np.float64], rotations: NDArray[np.float64]
    ) -> Splats:
        """Return the splats with new centres, frames and scales; `rotations` turn the view-dependent colour."""
        centres = np.asarray(means, dtype=np.float64)
        if centres.shape != (self.count, 3) or not np.isfinite(centres).all():
            raise ConfigError(
                f"means must be finite and of shape ({self.count}, 3), got shape {centres.shape}",
                hint="Pass one centre per splat, in the order of the splats",
            )
        # What float32 or a singular gradient flattened keeps a millionth of the largest scale: solid and invertible.
        scales = np.maximum(scales, 1e-6 * scales.max(axis=1, keepdims=True))
        sh = rotate_sh(self.sh, rotations)
        return replace(self, means=centres, quats=quats_from_rotations(frames), scales=scales, sh=sh)

    def oriented(self, up: UpAxis) -> Splats:
        """Return the splats turned so that the asset's `up` axis points along +Z.

        Trained assets mostly come in the OpenCV-like frame of their training cameras, with y down: `up="-y"`.

        Raises:
            ConfigError: If `up` is not one of "+x", "-x", "+y", "-y", "+z", "-z".
        """
        rotation = up_rotation(up)
        return self if up == "+z" else self.transformed(rotation=rotation)


def up_rotation(up: UpAxis) -> NDArray[np.float64]:
    """Return the rotation matrix, shape (3, 3), that turns the axis `up` onto +Z.

    Raises:
        ConfigError: If `up` is not one of "+x", "-x", "+y", "-y", "+z", "-z".
    """
    if up not in _UP_ROTATIONS:
        raise ConfigError(f"up must be one of {', '.join(_UP_ROTATIONS)}, got {up!r}")
    return np.array(_UP_ROTATIONS[up], dtype=np.float64)


def rotations_from_quats(quats: ArrayLike) -> NDArray[np.float64]:
    """Return rotation matrices, shape (..., 3, 3), of quaternions xyzw of any length, shape (..., 4)."""
    return Rotation.from_quat(np.asarray(quats, dtype=np.float64)).as_matrix()


def quats_from_rotations(rotations: ArrayLike) -> NDArray[np.float64]:
    """Return unit quaternions xyzw, shape (..., 4), of proper rotation matrices, shape (..., 3, 3)."""
    return Rotation.from_matrix(np.asarray(rotations, dtype=np.float64)).as_quat()


def multiply_quats(left: ArrayLike, right: ArrayLike) -> NDArray[np.float64]:
    """Return the Hamilton products left * right of quaternions xyzw; broadcasts over leading axes."""
    a, b = np.asarray(left, dtype=np.float64), np.asarray(right, dtype=np.float64)
    xyz = a[..., 3:] * b[..., :3] + b[..., 3:] * a[..., :3] + np.cross(a[..., :3], b[..., :3])
    w = a[..., 3:] * b[..., 3:] - (a[..., :3] * b[..., :3]).sum(axis=-1, keepdims=True)
    return np.concatenate([xyz, w], axis=-1)


def joined(parts: list[Splats], name: str) -> Splats:
    """Return several sets of splats as one of the highest degree among them."""
    if len(parts) == 1:
        return parts[0]
    columns = ("quats", "scales", "opacities")
    joint: dict[str, Any] = {column: np.concatenate([getattr(part, column) for part in parts]) for column in columns}
    offset = parts[0].offset
    means = [part.means + np.subtract(part.offset, offset) if part.offset != offset else part.means for part in parts]
    notes = tuple(dict.fromkeys(note for part in parts for note in part.notes))
    return Splats(means=np.concatenate(means), **joint, sh=padded_sh(parts), name=name, offset=offset, notes=notes)


def padded_sh(parts: Sequence[Splats], width: int | None = None) -> NDArray[np.float32]:
    """Return the coefficients of several sets, one after another, with zeros above the degree of each.

    Args:
        parts: The sets.
        width: Number of coefficients per splat, higher ones are cut; None for the most of any set.
    """
    width = max(part.sh.shape[1] for part in parts) if width is None else width
    cut = [part.sh[:, :width] for part in parts]
    return np.concatenate([np.pad(sh, ((0, 0), (0, width - sh.shape[1]), (0, 0))) for sh in cut])


def sh_basis(directions: ArrayLike, count: int) -> NDArray[np.float64]:
    """Return the real spherical harmonics in the order and with the signs of the splat formats, shape (M, count).

    Args:
        directions: Unit vectors from the camera to the splat, shape (M, 3).
        count: Number of functions: 1, 4, 9 or 16.
    """
    x, y, z = np.asarray(directions, dtype=np.float64).T
    xx, yy, zz = x * x, y * y, z * z
    functions: list[Callable[[], NDArray[np.float64]]] = [
        lambda: np.full_like(x, SH_DC),
        lambda: -0.4886025119029199 * y,
        lambda: 0.4886025119029199 * z,
        lambda: -0.4886025119029199 * x,
        lambda: 1.0925484305920792 * x * y,
        lambda: -1.0925484305920792 * y * z,
        lambda: 0.31539156525252005 * (2 * zz - xx - yy),
        lambda: -1.0925484305920792 * x * z,
        lambda: 0.5462742152960396 * (xx - yy),
        lambda: -0.5900435899266435 * y * (3 * xx - yy),
        lambda: 2.890611442640554 * x * y * z,
        lambda: -0.4570457994644658 * y * (4 * zz - xx - yy),
        lambda: 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        lambda: -0.4570457994644658 * x * (4 * zz - xx - yy),
        lambda: 1.445305721320277 * z * (xx - yy),
        lambda: -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return np.stack([function() for function in functions[:count]], axis=1)


def rotate_sh(sh: ArrayLike, rotation: ArrayLike) -> NDArray[np.float32]:
    """Return coefficients of the turned colour functions f'(d) = f(R^T d), shape (N, K, 3).

    Each band is closed under rotation, so sampling it in a fixed set of directions gives its rotation matrix exactly.

    Args:
        sh: Coefficients, shape (N, K, 3), K in {1, 4, 9, 16}.
        rotation: Orthogonal matrix for all splats, shape (3, 3), or one per splat, shape (N, 3, 3).
    """
    coefficients = np.asarray(sh, dtype=np.float64)
    count, turns = coefficients.shape[1], np.asarray(rotation, dtype=np.float64)
    out = coefficients.copy()
    if count == 1:
        return out.astype(np.float32)
    directions = np.random.default_rng(0).normal(size=(32, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    basis = sh_basis(directions, count)
    bands = [slice(band * band, (band + 1) ** 2) for band in range(1, int(np.sqrt(count)))]
    inverses = [np.linalg.pinv(basis[:, band]) for band in bands]
    # Splats go in blocks: 32 directions times 16 functions in float64 are 4 kB a splat.
    step = len(coefficients) if turns.ndim == 2 else 4096
    for start in range(0, len(coefficients), step):
        rows = slice(start, start + step)
        seen = directions @ (turns[None] if turns.ndim == 2 else turns[rows])
        turned = sh_basis(seen.reshape(-1, 3), count).reshape(*seen.shape[:2], count)
        for band, inverse in zip(bands, inverses, strict=True):
            out[rows, band] = inverse @ turned[..., band] @ coefficients[rows, band]
    return out.astype(np.float32)
