"""PlenOctrees (Yu et al. 2021), the octrees of svox, as grids."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.errors import AssetError
from softmode.radiance.grid import RadianceGrid
from softmode.splats.splats import sh_basis

NAMES = ("child", "data", "data_format", "invradius3", "offset")
"""Arrays of a file that are read."""
LEVELS = 7
"""Halvings of the box that a grid keeps; what is finer is averaged."""
DIRECTIONS = 48
"""Directions in which a colour, which is a sigmoid of harmonics there, is fitted by harmonics."""
_FORMATS = {"RGBA": 1, "SH1": 1, "SH4": 4, "SH9": 9, "SH16": 16}
_OCTANTS = np.stack(np.meshgrid((0, 1), (0, 1), (0, 1), indexing="ij"), axis=-1).reshape(8, 3)


def field_of_plenoctree(arrays: dict[str, NDArray[Any]], name: str, hint: str) -> RadianceGrid:
    """Return the field of the arrays of a file, on a grid of at most 128 cells an edge.

    Raises:
        AssetError: If the arrays do not fit each other, or have a learned basis.
    """
    child, data, kind = arrays["child"], arrays["data"], str(arrays["data_format"])
    count = _FORMATS.get(kind)
    if count is None:
        raise AssetError(
            f"radiance field {name}: its colours are {kind!r}", hint=f"train with one of {', '.join(_FORMATS)}"
        )
    nodes = len(child)
    shapes = (nodes, 2, 2, 2), (nodes, 2, 2, 2, 3 * count + 1)
    if not nodes or (child.shape, data.shape) != shapes or child.dtype.kind not in "iu" or data.dtype.kind != "f":
        raise AssetError(f"radiance field {name}: child {child.shape} and data {data.shape} do not match", hint=hint)
    cells, values = _leaves(child.reshape(nodes, 8).astype(np.int64), data.reshape(nodes, 8, -1), name, hint)
    level = min(len(cells), LEVELS)
    edge, kept = 2**level, min(count, 9)
    density, sh = np.zeros(edge**3), np.zeros((edge**3, 3 * kept))
    for depth, (cell, value) in enumerate(zip(cells, values, strict=True), start=1):
        full = np.nan_to_num(value[:, -1], nan=0.0, posinf=0.0) > 0.0
        cell, value = cell[full], value[full].astype(np.float64)
        shades = _harmonics(value[:, :-1].reshape(len(value), 3, count), kept).reshape(len(value), -1)
        sigma = value[:, -1]
        for _ in range(depth, level):  # a leaf that is larger than a cell
            cell = (2 * cell[:, None] + _OCTANTS).reshape(-1, 3)
            sigma, shades = np.repeat(sigma, 8), np.repeat(shades, 8, axis=0)
        share = sigma * 0.125 ** max(depth - level, 0)
        flat = np.ravel_multi_index(tuple((cell >> max(depth - level, 0)).T), (edge,) * 3)
        np.add.at(density, flat, share)
        np.add.at(sh, flat, share[:, None] * shades)
    sh /= np.maximum(density, 1e-12)[:, None]
    size, shift = (np.broadcast_to(np.asarray(arrays[key], np.float64).ravel(), 3) for key in NAMES[3:])
    if not np.isfinite(shift).all() or not (np.isfinite(size) & (size > 0.0)).all():
        raise AssetError(f"radiance field {name}: invradius3 {size} and offset {shift} are no box", hint=hint)
    return RadianceGrid(
        density=density.reshape((edge,) * 3),
        sh=sh.reshape(*(edge,) * 3, 3, kept).swapaxes(3, 4),
        origin=(0.5 / edge - shift) / size,
        axes=np.diag(1.0 / (edge * size)),
        name=name,
    )


def _leaves(
    child: NDArray[np.int64], data: NDArray[Any], name: str, hint: str
) -> tuple[list[NDArray[np.int64]], list[NDArray[Any]]]:
    """Return the cells (M, 3) and values (M, D) of the leaves of every depth from 1 on."""
    node, corner, seen = np.zeros(1, np.int64), np.zeros((1, 3), np.int64), 1
    cells, values = [], []
    while len(node):
        ahead, cell = child[node], 2 * corner[:, None] + _OCTANTS
        leaf = ahead == 0
        cells.append(cell[leaf])
        values.append(data[node][leaf])
        node, corner = (node[:, None] + ahead)[~leaf], cell[~leaf]
        seen += len(node)
        if seen > len(child) or (ahead < 0).any() or (len(node) and node.max() >= len(child)):
            raise AssetError(f"radiance field {name}: its tree points to nodes that are not there", hint=hint)
    return cells, values


def _harmonics(logits: NDArray[np.float64], kept: int) -> NDArray[np.float64]:
    """Return coefficients (M, 3, kept) of colours that are sigmoids of harmonics with others, (M, 3, K)."""
    count = logits.shape[2]
    z = 1.0 - 2.0 * (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS
    turn, wide = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(DIRECTIONS), np.sqrt(1.0 - z * z)
    ways = np.stack([wide * np.cos(turn), wide * np.sin(turn), z], axis=1)
    basis, back = sh_basis(ways, count), np.linalg.pinv(sh_basis(ways, kept))
    found = np.empty((len(logits), 3, kept))
    for start in range(0, len(logits), 65536):
        part = slice(start, start + 65536)
        found[part] = (1.0 / (1.0 + np.exp(-np.clip(logits[part] @ basis.T, -30.0, 30.0))) - 0.5) @ back.T
    return found
