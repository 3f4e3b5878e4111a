"""Stored displacements of the oracle: written by `make_frames`, read by whoever compares with it.

A motion of many nodes over many steps has few independent shapes. A file holds those (proper orthogonal decomposition)
rounded to integers, and their amplitudes at every step; `error` says what that lost. The mesh is not
stored: it follows from the scene.
"""

from __future__ import annotations

import functools
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tests.oracle.fem import Mesh
from tests.oracle.scenes import SCENES, Scene

Array = NDArray[np.float64]

FOLDER = Path(__file__).parent / "frames"
RESOLUTION = 1.0e-6
"""Step of the quantisation, relative to the largest edge of the bounding box."""
TRUNCATION = 1.0e-6
"""Root mean square over nodes and frames of what the omitted shapes hold, relative to the largest edge."""


@dataclass(frozen=True)
class Frames:
    """The motion of one scene."""

    scene: Scene
    """The scene."""
    mesh: Mesh
    """Its mesh."""
    shapes: Array
    """Nodal displacement shapes [m], (R, N, 3)."""
    amplitudes: Array
    """Amplitude of every shape at every step, (steps + 1, R)."""
    error: float
    """Root mean square of the loss over nodes and frames [m]."""

    @property
    def times(self) -> Array:
        """Times of the frames [s], (steps + 1,)."""
        return self.scene.dt * np.arange(len(self.amplitudes), dtype=np.float64)

    def nodal(self, step: int) -> Array:
        """Return the nodal displacements [m] at a step, (N, 3)."""
        return np.einsum("r,rnc->nc", self.amplitudes[step], self.shapes)

    def displacement(self, points: ArrayLike, steps: slice | ArrayLike = slice(None)) -> Array:
        """Return displacements [m] at rest points (P, 3) at the chosen steps, (T, P, 3), by the shape functions."""
        matrix = self.mesh.interpolation(points)
        shapes = np.stack([matrix @ shape for shape in self.shapes])
        amplitudes = self.amplitudes[steps]
        return (amplitudes @ shapes.reshape(len(shapes), -1)).reshape(len(amplitudes), -1, 3)


def save(scene: Scene, displacement: Array, folder: Path = FOLDER) -> tuple[Path, float, int]:
    """Store displacements (steps + 1, N, 3) [m] of a scene's mesh; return path, error [m] and number of shapes."""
    count, nodes = displacement.shape[:2]
    flat = displacement.reshape(count, -1)
    left, strength, right = np.linalg.svd(flat, full_matrices=False)
    lost = np.sqrt(np.maximum(np.cumsum((strength**2)[::-1])[::-1], 0.0) / (count * nodes))
    rank = max(int((lost > TRUNCATION * scene.edge).sum()), 1)
    size = np.abs(left[:, :rank] * strength[:rank]).max(axis=0)
    shapes = right[:rank] * size[:, None]
    scale = RESOLUTION * scene.edge
    integers = np.round(shapes / scale).astype(np.int32)
    # Differences along the node order, byte by byte: neighbours are alike, so they compress well.
    delta = np.diff(integers.reshape(rank, nodes, 3), axis=1, prepend=np.int32(0)).transpose(0, 2, 1)
    packed = np.ascontiguousarray(np.moveaxis(np.ascontiguousarray(delta)[..., None].view(np.uint8), -1, 0))
    rounded = integers * scale
    amplitudes = np.linalg.lstsq(rounded.T, flat.T, rcond=None)[0].T.astype(np.float32)
    error = float(np.sqrt(((amplitudes @ rounded - flat) ** 2).sum() / (count * nodes)))
    path = folder / f"{scene.name}.npz"
    nodes_sum = _checksum(Mesh.of(scene))
    np.savez_compressed(path, packed=packed, scale=scale, amplitudes=amplitudes, error=error, nodes=nodes_sum)
    return path, error, rank


@functools.cache
def load(name: str) -> Frames:
    """Return the stored frames of a scene.

    Raises:
        FileNotFoundError: If they were never made.
        ValueError: If they belong to another mesh or number of steps than the scene has now.
    """
    scene = SCENES[name]
    with np.load(FOLDER / f"{name}.npz") as file:
        stored = {key: file[key] for key in file.files}
    mesh = Mesh.of(scene)
    delta = np.ascontiguousarray(np.moveaxis(stored["packed"], 0, -1)).view(np.int32)[..., 0].transpose(0, 2, 1)
    amplitudes = stored["amplitudes"].astype(float)
    if int(stored["nodes"]) != _checksum(mesh) or len(amplitudes) != scene.steps + 1:
        raise ValueError(f"frames of {name} do not fit the scene: run `python -m tests.oracle.make_frames {name}`")
    shapes = np.cumsum(delta, axis=1) * float(stored["scale"])
    return Frames(scene, mesh, shapes, amplitudes, float(stored["error"]))


def _checksum(mesh: Mesh) -> int:
    """Return a number that changes with the rest positions (to a micrometre) or the order of the nodes."""
    return zlib.crc32(np.round(mesh.nodes * 1e6).astype(np.int64).tobytes())
