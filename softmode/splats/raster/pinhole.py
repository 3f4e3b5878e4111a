"""`PinholeCamera`: where a camera is and what its lens does, as a frozen description.

The frame is OpenCV's: x right, y down, z forward; pixel (0, 0) at the top left has its centre at (0.5, 0.5).
`docs/notation.md` lists the conversions from and to OpenGL, MuJoCo, USD and Newton.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.errors import ConfigError
from softmode.splats.splats import quats_from_rotations, rotations_from_quats

Vector = tuple[float, float, float]
Quat = tuple[float, float, float, float]


MAX_EDGE = 4096
"""Largest width and height of an image [px]."""


@dataclass(frozen=True, kw_only=True)
class PinholeCamera:
    """One camera of every world: fixed, carried by a body, or moved by hand through `SplatCamera.poses`.

    Build it with `look_at`, `from_matrix` (calibrated) or `from_opengl` (MuJoCo, USD, Newton).
    """

    name: str
    """Unique name; key of the images."""
    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    fx: float
    """Horizontal focal length [px]."""
    fy: float
    """Vertical focal length [px]."""
    cx: float
    """Horizontal position of the optical axis [px]."""
    cy: float
    """Vertical position of the optical axis [px]."""
    position: Vector
    """Optical centre in the frame of `body`, or in the world [m]."""
    quat: Quat
    """Rotation xyzw from the camera frame (OpenCV) to the frame of `body`, or to the world."""
    body: str | None = None
    """Label of the body that carries the camera (all of it or its last part); None for one in the world."""

    def __post_init__(self) -> None:
        """Validate the numbers."""
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.position, *self.quat)
        if not all(math.isfinite(x) for x in numbers) or self.fx <= 0.0 or self.fy <= 0.0:
            raise ConfigError(
                f"camera {self.name!r}: intrinsics and pose must be finite, focal lengths positive",
                hint="Flip the image or the pose rather than the sign of a focal length",
            )
        if not (0 < self.width <= MAX_EDGE and 0 < self.height <= MAX_EDGE):
            raise ConfigError(
                f"camera {self.name!r}: {self.width} x {self.height} px, expected 1 to {MAX_EDGE} on each side",
                hint="Scale width, height, fx, fy, cx and cy down together",
            )
        if abs(sum(x * x for x in self.quat) - 1.0) > 1e-3:
            raise ConfigError(
                f"camera {self.name!r}: quat {self.quat} is not of unit length", hint="Normalise it; the order is xyzw"
            )

    @classmethod
    def look_at(
        cls,
        name: str,
        *,
        position: Vector,
        target: Vector,
        up: Vector = (0.0, 0.0, 1.0),
        width: int = 128,
        height: int = 128,
        fov_y: float = 0.8,
        body: str | None = None,
    ) -> "PinholeCamera":
        """Return a camera at `position` that looks at `target`.

        Args:
            name: Unique name.
            position: Optical centre in the frame of `body` or the world [m].
            target: Point in the middle of the picture, in the same frame [m].
            up: Direction that points up in the picture; not parallel to the line of sight.
            width: Image width [px].
            height: Image height [px].
            fov_y: Vertical field of view [rad], in (0, pi).
            body: Label of the body that carries the camera, or None.

        Raises:
            ConfigError: If the field of view is out of range or the directions are degenerate.
        """
        forward = np.subtract(target, position).astype(np.float64)
        right = np.cross(forward, up)
        if np.linalg.norm(forward) < 1e-9 or np.linalg.norm(right) < 1e-9 * np.linalg.norm(forward):
            raise ConfigError(
                f"camera {name!r}: position, target and up do not define a view", hint="Move target or up"
            )
        forward /= np.linalg.norm(forward)
        right /= np.linalg.norm(right)
        quat = quats_from_rotations(np.stack([right, np.cross(forward, right), forward], axis=1))
        return cls.from_matrix(
            name,
            _fov_matrix(name, fov_y, width, height),
            width=width,
            height=height,
            position=position,
            quat=_quat(quat),
            body=body,
        )

    @classmethod
    def from_matrix(
        cls,
        name: str,
        matrix: ArrayLike,
        *,
        width: int,
        height: int,
        position: Vector = (0.0, 0.0, 0.0),
        quat: Quat = (0.0, 0.0, 0.0, 1.0),
        body: str | None = None,
    ) -> "PinholeCamera":
        """Return a camera with the intrinsics K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] of a calibration.

        OpenCV's calibration counts pixels from the centre of the first one; add 0.5 to its cx and cy.

        Args:
            name: Unique name.
            matrix: K [px], shape (3, 3), without skew.
            width: Image width [px].
            height: Image height [px].
            position: Optical centre in the frame of `body` or the world [m].
            quat: Rotation xyzw from the camera frame (OpenCV) to that frame.
            body: Label of the body that carries the camera, or None.

        Raises:
            ConfigError: If the matrix is not of that form.
        """
        k = np.asarray(matrix, dtype=np.float64)
        form = np.array([[0, 1, 0], [1, 0, 0], [1, 1, 0]], dtype=bool)
        if k.shape != (3, 3) or (k[form] != 0.0).any() or k[2, 2] != 1.0:
            raise ConfigError(
                f"camera {name!r}: the matrix is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]",
                hint="Undistort and rectify the images first; skew is not supported",
            )
        return cls(
            name=name,
            width=width,
            height=height,
            fx=float(k[0, 0]),
            fy=float(k[1, 1]),
            cx=float(k[0, 2]),
            cy=float(k[1, 2]),
            position=(float(position[0]), float(position[1]), float(position[2])),
            quat=_quat(quat),
            body=body,
        )

    @classmethod
    def from_opengl(
        cls,
        name: str,
        *,
        fov_y: float,
        position: Vector,
        quat: Quat,
        width: int = 128,
        height: int = 128,
        body: str | None = None,
    ) -> "PinholeCamera":
        """Return a camera described with OpenGL axes (x right, y up, looking along -z), as in MuJoCo, USD and Newton.

        MuJoCo: `fov_y=math.radians(fovy)`, and its quaternions are wxyz. USD: `fov_y=2 * math.atan(0.5 *
        verticalAperture / focalLength)`.

        Args:
            name: Unique name.
            fov_y: Vertical field of view [rad], in (0, pi).
            position: Optical centre in the frame of `body` or the world [m].
            quat: Rotation xyzw from the OpenGL camera frame to that frame.
            width: Image width [px].
            height: Image height [px].
            body: Label of the body that carries the camera, or None.

        Raises:
            ConfigError: If the field of view is out of range.
        """
        return cls.from_matrix(
            name,
            _fov_matrix(name, fov_y, width, height),
            width=width,
            height=height,
            position=position,
            quat=_half_turn(quat),
            body=body,
        )

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Intrinsics K [px], shape (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def world_to_camera(self) -> NDArray[np.float64]:
        """Rigid transform from the frame of `body`, or the world, to the camera, shape (4, 4)."""
        matrix = np.eye(4)
        matrix[:3, :3] = rotations_from_quats(self.quat).T
        matrix[:3, 3] = -matrix[:3, :3] @ np.asarray(self.position)
        return matrix

    @property
    def opengl_quat(self) -> Quat:
        """Rotation xyzw from the OpenGL camera frame to the frame of `body`, or to the world."""
        return _half_turn(self.quat)


def _quat(quat: ArrayLike) -> Quat:
    x, y, z, w = map(float, np.asarray(quat, dtype=np.float64))
    return x, y, z, w


def _half_turn(quat: Quat) -> Quat:
    """Return quat * (1, 0, 0, 0): half a turn about x swaps OpenCV's and OpenGL's axes."""
    x, y, z, w = quat
    return w, z, -y, -x


def _fov_matrix(name: str, fov_y: float, width: int, height: int) -> NDArray[np.float64]:
    """Return K of square pixels with the axis in the middle of the image."""
    if not 0.0 < fov_y < math.pi:
        raise ConfigError(f"camera {name!r}: fov_y must be in (0, pi) rad, got {fov_y}", hint="Convert degrees")
    focal = 0.5 * height / math.tan(0.5 * fov_y)
    return np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
