"""Pictures with poses: folders with a `transforms.json`, as nerfstudio, instant-ngp and NeRF have them, and lenses."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from scipy import ndimage

from softmode.errors import AssetError, ConfigError
from softmode.files import damage_errors, read_json
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.splats import quats_from_rotations

Array = NDArray[np.float64]

_HINT = "export it again, or give the folder of its pictures"
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_ROUNDS = 20
"""Fixed-point steps that take a lens off; OpenCV takes five."""


@dataclass(frozen=True, kw_only=True)
class Lens:
    """What a lens does to x = X / Z, y = Y / Z, by OpenCV's coefficients: radial k1, k2, k3, tangential p1, p2."""

    k1: float = 0.0
    """Of r^2."""
    k2: float = 0.0
    """Of r^4."""
    p1: float = 0.0
    """First tangential one."""
    p2: float = 0.0
    """Second tangential one."""
    k3: float = 0.0
    """Of r^6."""

    def distorted(self, x: ArrayLike) -> Array:
        """Return where the lens shows points (..., 2) of a pinhole."""
        a, b = np.moveaxis(np.asarray(x, dtype=np.float64), -1, 0)
        r2 = a * a + b * b
        f = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        return np.stack([
            a * f + 2.0 * self.p1 * a * b + self.p2 * (r2 + 2.0 * a * a),
            b * f + self.p1 * (r2 + 2.0 * b * b) + 2.0 * self.p2 * a * b,
        ], axis=-1)  # fmt: skip

    def undistorted(self, x: ArrayLike) -> Array:
        """Return the points of a pinhole that the lens shows at (..., 2)."""
        shown = np.asarray(x, dtype=np.float64)
        found = shown.copy()
        for _ in range(_ROUNDS):
            found += shown - self.distorted(found)
        return found


@dataclass(frozen=True, kw_only=True)
class PosedPicture:
    """One picture of a folder, with its camera."""

    camera: PinholeCamera
    """Where it was taken, in the frame and unit of the folder, and its lens without distortion."""
    lens: Lens
    """What the lens adds."""
    file: Path
    """The picture."""

    def pixels(self) -> NDArray[np.float32]:
        """Return the picture, 0..1, shape (height, width, 3), or 4 with an alpha channel.

        Raises:
            AssetError: If it is missing or damaged, or of another size than its camera.
        """
        with damage_errors(f"picture {self.file}", hint=_HINT), Image.open(self.file) as image:
            alpha = "A" in image.getbands() or "transparency" in image.info
            found = np.asarray(image.convert("RGBA" if alpha else "RGB"), dtype=np.float32) / 255.0
        wanted = (self.camera.height, self.camera.width)
        if found.shape[:2] != wanted:
            raise AssetError(
                f"picture {self.file}: {found.shape[1]} x {found.shape[0]} px, its pose file says"
                f" {wanted[1]} x {wanted[0]}",
                hint="give the pictures that the poses were found for, or scale w, h, fl_x, fl_y, cx and cy",
            )
        return found

    def rays(self) -> Array:
        """Return the unit directions of the pixels in the frame of the folder, lens off, shape (height, width, 3)."""
        c = self.camera
        flat = self.lens.undistorted(_pixel_places(c))
        ways = np.concatenate([flat, np.ones((*flat.shape[:2], 1))], axis=-1) @ c.world_to_camera[:3, :3]
        return ways / np.linalg.norm(ways, axis=-1, keepdims=True)

    def project(self, points: ArrayLike) -> Array:
        """Return where the lens shows points (..., 3) of the frame of the folder [px], shape (..., 2)."""
        c = self.camera
        x = np.asarray(points, dtype=np.float64) @ c.world_to_camera[:3, :3].T + c.world_to_camera[:3, 3]
        return self.lens.distorted(x[..., :2] / x[..., 2:]) * (c.fx, c.fy) + (c.cx, c.cy)

    def undistorted(self) -> NDArray[np.float32]:
        """Return the picture as the pinhole sees it, same shape."""
        return _resampled(self.camera, self.pixels(), self.lens.distorted)


def _pixel_places(camera: PinholeCamera) -> NDArray[Any]:
    """Return x = X / Z and y = Y / Z of a pinhole's pixels, shape (height, width, 2)."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=-1)


def _resampled(camera: PinholeCamera, picture: NDArray[Any], lens: Any) -> NDArray[np.float32]:
    """Return a picture (height, width, C) whose pixels are looked up where a map of x and y says."""
    at = lens(_pixel_places(camera))
    place = np.stack([at[..., 1] * camera.fy + camera.cy - 0.5, at[..., 0] * camera.fx + camera.cx - 0.5])
    parts = [ndimage.map_coordinates(part, place, order=1, mode="nearest") for part in np.moveaxis(picture, -1, 0)]
    return np.stack(parts, axis=-1).astype(np.float32)


def read_transforms(path: str | os.PathLike[str]) -> tuple[PosedPicture, ...]:
    """Read the poses, intrinsics and lens of a folder of pictures.

    Poses are OpenGL's camera-to-world matrices. Intrinsics, `fl_x`, `fl_y`, `cx`, `cy`, `w`, `h` or `camera_angle_x`,
    and the lens, `k1`, `k2`, `k3`, `p1`, `p2`, are those of the file or of a frame.

    Args:
        path: The folder, or its .json.

    Raises:
        AssetError: If the file is missing, damaged or has no frames, a picture is missing, a pose is none, or the
            camera is no pinhole with such a lens, such as a fisheye.
    """
    file = Path(path)
    file = file / "transforms.json" if file.is_dir() else file
    told: Any = read_json(file, "pose file", hint=_HINT)
    with damage_errors(f"pose file {file}", hint=_HINT):
        frames = told.get("frames", [])
        if not frames:
            raise AssetError(f"pose file {file}: no frames", hint=_HINT)
        return tuple(_posed(file, {**told, **frame}) for frame in frames)


def _posed(file: Path, told: dict[str, Any]) -> PosedPicture:
    """Return the picture of a frame."""
    path = file.parent / str(told["file_path"])
    if not path.suffix and not path.exists():
        path = path.with_suffix(".png")  # as NeRF's own sets have it
    if not path.is_file():
        raise AssetError(f"pose file {file}: no picture {path}", hint=_HINT)
    model = told.get("camera_model", "OPENCV")
    if model not in _MODELS or told.get("is_fisheye") or told.get("k4"):
        raise AssetError(f"pose file {file}: a camera of model {model!r}", hint=f"undistort to one of {_MODELS}")
    if "w" in told:
        width, height = int(told["w"]), int(told["h"])
    else:
        with Image.open(path) as image:
            width, height = image.size
    focal = told.get("fl_x") or 0.5 * width / math.tan(0.5 * float(told["camera_angle_x"]))
    pose = np.array(told["transform_matrix"], dtype=np.float64)
    turn = pose[:3, :3] if pose.shape in ((3, 4), (4, 4)) else np.zeros((3, 3))
    if not np.allclose(turn.T @ turn, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0.0:
        raise AssetError(f"pose file {file}: the matrix of {path.name} is no rotation and place", hint=_HINT)
    x, y, z, w = quats_from_rotations(turn @ _FLIP[:3, :3]).tolist()
    camera = PinholeCamera(
        name=path.stem,
        width=width,
        height=height,
        fx=float(focal),
        fy=float(told.get("fl_y") or focal),
        cx=float(told.get("cx", 0.5 * width)),
        cy=float(told.get("cy", 0.5 * height)),
        position=tuple(pose[:3, 3].tolist()),  # type: ignore[arg-type]
        quat=(x, y, z, w),
    )
    lens = Lens(**{key: float(told[key]) for key in ("k1", "k2", "p1", "p2", "k3") if key in told})
    return PosedPicture(camera=camera, lens=lens, file=path)


def write_transforms(
    folder: str | os.PathLike[str], cameras: Sequence[PinholeCamera], pictures: ArrayLike, lens: Lens | None = None
) -> None:
    """Write pictures of pinholes, bent as a lens would, with their poses, as `read_transforms` reads them.

    Args:
        folder: Where; made if it is not there.
        cameras: One for each picture, in the world.
        pictures: 0..1, shape (V, height, width, 3).
        lens: The lens; none if None.

    Raises:
        ConfigError: If the pictures do not fit the cameras.
    """
    place, given = Path(folder), np.asarray(pictures, dtype=np.float32)
    sizes = {(len(cameras), camera.height, camera.width, 3) for camera in cameras}
    if sizes != {given.shape}:
        raise ConfigError(f"pictures have shape {given.shape}, expected {sizes}", hint="give one for each camera")
    lens = lens or Lens()
    (place / "images").mkdir(parents=True, exist_ok=True)
    frames = []
    for camera, picture in zip(cameras, given, strict=True):
        bent = _resampled(camera, picture, lens.undistorted)
        name = f"images/{camera.name}.png"
        Image.fromarray(np.round(255.0 * np.clip(bent, 0.0, 1.0)).astype(np.uint8)).save(place / name)
        frames.append({
            "file_path": name,
            "transform_matrix": (np.linalg.inv(camera.world_to_camera) @ _FLIP).tolist(),
            **{"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy},
            **{"w": camera.width, "h": camera.height},
        })  # fmt: skip
    told = {"camera_model": "OPENCV", **asdict(lens), "frames": frames}
    (place / "transforms.json").write_text(json.dumps(told, indent=1))
