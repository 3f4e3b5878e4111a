"""`LiveRecording`: the coordinates of a session over time, in a file that can be shown again."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softmode.checks import require_number
from softmode.deformables.model.namespaces import soft
from softmode.errors import ConfigError
from softmode.files import damage_errors, read_arrays, write_compressed
from softmode.scenes.scene import Scene

_FORMAT = "softmode live recording 2"


@dataclass(frozen=True, kw_only=True)
class LiveRecording:
    """Coordinates of a session over time."""

    times: NDArray[np.float64]
    """Simulated time of each frame [s], shape (T,)."""
    q: NDArray[np.float64]
    """Reduced coordinates of all objects, one after another [m], shape (T, functions, 3)."""
    dent: NDArray[np.float32]
    """Dents of their surface samples, as in `state.softmode.dent` [m], shape (T, samples, 3)."""
    body_q: NDArray[np.float32]
    """Poses of the rigid bodies, position [m] and quaternion xyzw, shape (T, B, 7)."""
    fingerprints: tuple[str, ...]
    """Fingerprints of the bodies."""

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> LiveRecording:
        """Read a file that a session recorded.

        Raises:
            AssetError: If the file is missing, damaged or foreign.
        """
        hint = "record it again"
        names = ("format", "times", "q", "dent", "body_q", "fingerprints")
        data = read_arrays(path, names, what="recording", hint=hint)
        kinds = {"times": np.float64, "q": np.float64, "dent": np.float32, "body_q": np.float32}
        with damage_errors(f"recording {path}", hint=hint):
            columns = {name: data[name].astype(kind, copy=False) for name, kind in kinds.items()}
            shapes = {"times": (), "q": (-1, 3), "dent": (-1, 3), "body_q": (-1, 7)}
            if str(data["format"]) != _FORMAT or data["fingerprints"].ndim != 1:
                raise ValueError("it is not one of a live session")
            for name, shape in shapes.items():
                found = columns[name].shape
                wanted = (
                    columns["times"].size,
                    *(have if want < 0 else want for want, have in zip(shape, found[1:], strict=True)),
                )
                if found != wanted or not np.isfinite(columns[name]).all():
                    raise ValueError(f"{name} has shape {found}, expected {wanted}, or is not finite")
            return cls(fingerprints=tuple(map(str, data["fingerprints"])), **columns)

    def check(self, scene: Scene, index: int) -> None:
        """Raise unless it is of the objects of a scene, and has a frame.

        Raises:
            ConfigError: If it is of other objects, or has no such frame.
        """
        own = tuple(thing.body.fingerprint for thing in scene.objects)
        state = soft(scene.state)
        shapes = (self.q.shape[1], self.dent.shape[1]), (state.q.shape[0], state.dent.shape[0])
        if self.fingerprints != own or shapes[0] != shapes[1]:
            raise ConfigError("the recording is of other objects", hint="open the objects that were recorded")
        require_number("index", index, at_least=0, at_most=len(self.times) - 1)

    def show(self, scene: Scene, index: int) -> None:
        """Put everything of a scene where a frame has it, at rest."""
        state = soft(scene.state)
        state.q.assign(self.q[index])
        state.dent.assign(self.dent[index])
        state.qd.zero_()
        state.dt_before.zero_()
        poses = scene.state.body_q
        if poses is not None and self.body_q.shape[1] == poses.shape[0]:
            poses.assign(self.body_q[index])
        scene.solver.update_particles(scene.state)

    def save(self, path: Path) -> None:
        """Write it to a file."""
        arrays = {"format": np.array(_FORMAT), **vars(self), "fingerprints": np.array(self.fingerprints)}
        write_compressed(path, arrays, "recording")
