"""From what a person names to a soft object: a configuration, a file, or a saved body."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from softmode.deformables.body import ReducedBody
from softmode.deformables.skinning import average_basis
from softmode.envs.objects import ObjectConfig, SoftObject, load_object
from softmode.envs.primitives import KEY_LIGHT
from softmode.errors import AssetError, ConfigError
from softmode.splats import Splats
from softmode.splats.splats import SH_DC, quats_from_rotations

MESHES = (".glb", ".gltf", ".obj", ".stl", ".off", ".3mf", ".dae")
"""Suffixes of mesh files; .ply files are splats."""
HANDLES_MAX = 64
"""Most eigenmodes that `LiveSession.set_handles` builds."""


@dataclass(frozen=True, kw_only=True)
class ObjectSource:
    """Where an object comes from, and how to make it with other handles."""

    config: ObjectConfig | None
    """What it is; None for a saved body."""
    body: ReducedBody | None = None
    """The saved body."""

    @classmethod
    def of(cls, source: ObjectConfig | str | Path | None, size: float | None) -> ObjectSource:
        """Return the source that a person names.

        Raises:
            ConfigError: If a size is given for what has one.
            AssetError: If a saved body cannot be read.
        """
        if isinstance(source, ObjectConfig):
            config = source
        elif source is None:
            config = ObjectConfig()
        else:
            path = Path(source)
            if not path.exists():
                raise AssetError(f"{path} does not exist", hint="give a splat, a mesh or a saved body")
            if path.suffix.lower() == ".npz":
                if size is not None:
                    raise ConfigError(f"size given for the saved body {path}", hint="leave it out, or build it anew")
                return cls(config=None, body=ReducedBody.load(path))
            config = ObjectConfig(mesh=path) if path.suffix.lower() in MESHES else ObjectConfig(splat=path)
        if size is not None:
            if config.extents is not None:
                raise ConfigError(f"size given for a {config.shape} of {config.extents} m", hint="leave it out")
            config = replace(config, size=size)
        return cls(config=config)

    @property
    def handles(self) -> int:
        """Number of eigenmodes."""
        return self.body.mode_count if self.config is None and self.body else self._checked().build.mode_count

    def with_handles(self, count: int) -> ObjectSource:
        """Return the same with another number of eigenmodes.

        Raises:
            ConfigError: If it is a saved body, or the count is out of range.
        """
        if not isinstance(count, int | np.integer) or not 0 <= count <= HANDLES_MAX:
            raise ConfigError(f"handles must be a whole number in 0..{HANDLES_MAX}, got {count!r}")
        config = self._checked()
        return ObjectSource(config=replace(config, build=replace(config.build, mode_count=int(count))))

    def load(self, progress: Any = None) -> SoftObject:
        """Make the object."""
        if self.config is None and self.body is not None:
            return body_object(self.body)
        return load_object(self._checked(), progress)

    def _checked(self) -> ObjectConfig:
        if self.config is None:
            raise ConfigError("a saved body cannot be given other handles", hint="open what it was built from")
        return self.config


def body_object(body: ReducedBody) -> SoftObject:
    """Return an object that shows a body by a flat splat on each of its surface samples."""
    n = body.surface_normals
    side = np.cross(n, np.where(np.abs(n[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
    frames = np.stack([side, np.cross(n, side), n], axis=2)
    radius = 0.6 * np.sqrt(body.surface_areas)
    light = 0.74 + 0.12 * n[:, 2] + 0.14 * np.clip(n @ np.asarray(KEY_LIGHT), 0.0, 1.0)
    colors = np.array([0.93, 0.55, 0.22]) * light[:, None]
    splats = Splats(
        means=body.surface_points,
        quats=quats_from_rotations(frames),
        scales=np.stack([radius, radius, 0.1 * radius], axis=1),
        opacities=np.full(len(n), 0.95),
        sh=((colors - 0.5) / SH_DC)[:, None],
        name=body.name,
    )
    basis, grad_basis = average_basis(lambda x: body.evaluate(x)[0], splats.means, splats.covariances())
    return SoftObject(body, splats, basis, grad_basis, float(-body.surface_points[:, 2].min()))
