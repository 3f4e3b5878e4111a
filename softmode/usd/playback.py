"""`read_animation`: what `UsdAnimation` recorded, as states of the bodies and splats in any frame."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.errors import AssetError, ConfigError
from softmode.files import REEXPORT, damage_errors
from softmode.foreign import process
from softmode.objects.soft_object import SoftObject
from softmode.objects.stage.bundle import body_of
from softmode.scenes.binding import splats_of_states
from softmode.splats.formats.usd import splats_from_prim
from softmode.splats.splats import MAX_SPLATS, Splats
from softmode.usd.dents import NO_DENTS, Dents
from softmode.usd.handles import coordinates_from_handles, world_coordinates

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class PlayedBody:
    """A soft body over the frames of an animation."""

    path: str
    """Path of its prim."""
    object: SoftObject
    """The body with its splats."""
    times: Array
    """When the frames are [s], shape (F,)."""
    coordinates: Array
    """Reduced coordinates in the world, as in `state.softmode.q` [m], shape (F, n, 3)."""
    dents: tuple[Dents, ...]
    """What contact dented in each frame, in the world; as `state.softmode.dent` by `dents_at`."""

    def splats_at(self, frame: int) -> Splats:
        """Return its splats in the world in one frame.

        Raises:
            ConfigError: If there is no such frame, or the body has no splats.
        """
        if not -len(self.times) <= frame < len(self.times):
            raise ConfigError(f"frame is {frame}, there are {len(self.times)}")
        return next(splats_of_states(self.object, self.coordinates[frame][None], self.dents_at(frame)[None]))

    def points_at(self, frame: int) -> Array:
        """Return its surface samples in the world in one frame, dents in [m], shape (S, 3)."""
        body = self.object.body
        moved = body.surface.basis.astype(np.float64) @ self.coordinates[frame]
        return body.surface.points + moved + self.dents_at(frame)

    def dents_at(self, frame: int) -> NDArray[np.float32]:
        """Return the dents of its surface samples in the world in one frame [m], shape (S, 3)."""
        return self.dents[frame].full(self.object.body.surface_count)


@dataclass(frozen=True, kw_only=True, eq=False)
class UsdPlayback:
    """An animation that was read back."""

    fps: float
    """Time codes per second [1/s]."""
    bodies: tuple[PlayedBody, ...]
    """The soft bodies, in the order of the stage."""


def read_animation(path: str | os.PathLike[str]) -> UsdPlayback:
    """Read an animation that `UsdAnimation` wrote, in metres with z up.

    The stage is opened in a process of its own with limited memory and time.

    Args:
        path: The file.

    Raises:
        AssetError: If the file is damaged, or holds no body with handles.
        MissingExtraError: If the extra `[usd]` is not installed.
    """
    name = f"OpenUSD file {path}"
    answer = process.read("animation", path, name=name, most=MAX_SPLATS)
    stage = answer.described
    if stage["up"] != "Z" or stage["meters"] != 1.0:
        raise AssetError(
            f"{name}: upAxis {stage['up'][:20]!r}, metersPerUnit {stage['meters']}",
            hint="Read the file that softmode wrote, which has z up and metres",
        )
    if not stage["bodies"]:
        raise AssetError(
            f"{name}: holds no animated body of softmode",
            hint="Write it with softmode.usd.UsdAnimation; splats that other tools animate are read by read_splats",
        )
    rate = float(stage["rate"])
    if not (np.isfinite(rate) and rate > 0.0):
        raise AssetError(f"{name}: timeCodesPerSecond is {rate}", hint="Set it to the number of time codes in a second")
    with damage_errors(name):
        bodies = tuple(_played(sent, answer.arrays, rate, name) for sent in stage["bodies"])
    return UsdPlayback(fps=rate, bodies=bodies)


def _played(sent: dict[str, Any], arrays: list[NDArray[Any]], rate: float, name: str) -> PlayedBody:
    """Return one body from what the process sent."""
    source = f"{name}: {sent['path']}"
    bundle = {**sent["bundle"]["values"], **{key: arrays[k] for key, k in sent["bundle"]["arrays"].items()}}
    body = body_of(bundle, source)
    codes, places = arrays[sent["codes"]], arrays[sent["places"]].reshape(-1, 4, 4)
    curved = int((body.handles.degrees == 2).sum())
    matrices = np.array([arrays[k] for k in sent["handles"]]).reshape(len(codes), len(body.handles.degrees), 4, 4)
    quadratic = np.array([arrays[k] for k in sent["quadratic"]]).reshape(len(codes), curved, 6, 3)
    if not all(np.isfinite(values).all() for values in (codes, places, matrices, quadratic)):
        raise AssetError(f"{source}: its time samples are not all finite", hint=REEXPORT)
    dents = _dents(sent["dents"], arrays, body.surface_count, len(codes), source)
    local = coordinates_from_handles(body, matrices, quadratic)
    linear = places[:, :3, :3].transpose(0, 2, 1)
    scale = np.cbrt(np.linalg.det(linear))
    if not (scale > 0.0).all():
        raise AssetError(f"{source}: its place is mirrored or flat", hint=REEXPORT)
    world = [
        world_coordinates(body, q, matrix / s, place[3, :3], float(s))
        for q, matrix, s, place in zip(local, linear, scale, places, strict=True)
    ]
    return PlayedBody(
        path=sent["path"],
        object=SoftObject(
            body=body, splats=None if sent["splats"] is None else splats_from_prim(sent["splats"], arrays, source)
        ),
        times=codes / rate,
        coordinates=np.array(world),
        dents=tuple(one.mapped(place[:3, :3].T) for one, place in zip(dents, places, strict=True)),
    )


def _dents(sent: list[list[int]], arrays: list[NDArray[Any]], count: int, frames: int, source: str) -> list[Dents]:
    """Return the dents of each frame from what the process sent, in the frame of the body; none where it sent none.

    Raises:
        AssetError: If they are not finite, or those of samples that the body does not have.
    """
    if not sent:
        return [NO_DENTS] * frames
    none: NDArray[Any] = np.zeros(0, np.int32)
    found = [[none if k < 0 else arrays[k] for k in pair] for pair in sent]
    dents = [Dents(samples=samples, vectors=vectors.reshape(-1, 3)) for samples, vectors in found]
    for one in dents:
        known = len(one.samples) == len(one.vectors) and bool(((one.samples >= 0) & (one.samples < count)).all())
        if not known or not np.isfinite(one.vectors).all():
            raise AssetError(f"{source}: its dents are not those of {count} samples", hint=REEXPORT)
    return dents
