"""Triangles, and the colour of every surface point, of what trimesh has read."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .limits import Refused

GREY = 0.6
"""Colour of a mesh that names none; gamma-encoded."""
MAX_TEXELS = 2**26
"""Most pixels of all textures of a mesh or scene."""
FAR = 100.0
"""Coordinates farther out than so many extents are centred before they become float32."""
_AGAIN = "Export the mesh again"


def near_zero(points: NDArray[Any]) -> tuple[NDArray[Any], tuple[float, float, float]]:
    """Return points (N, 3) and an offset [m] that leaves them to float32: none unless they lie `FAR` extents away."""
    few = np.asarray(points[:: max(1, len(points) // 10_000)], dtype=np.float64)
    low, high = np.quantile(few, [0.01, 0.99], axis=0) if len(few) > 3 else np.zeros((2, 3))
    extent = float((high - low).max())
    if not 0.0 < FAR * extent < np.abs([low, high]).max():
        return points, (0.0, 0.0, 0.0)
    step = 10.0 ** np.ceil(np.log10(extent))
    x, y, z = (step * np.round(0.5 * (low + high) / step)).tolist()
    return points.astype(np.float64) - (x, y, z), (x, y, z)


def gathered(source: Any, *, spent: bool = False) -> dict[str, Any]:
    """Return the fields of a `softmode.splats.ColoredMesh` by name: arrays, `textures` (its pictures), and `offset`.

    Args:
        source: A `trimesh.Trimesh` or `trimesh.Scene`.
        spent: Whether its pictures may be closed once they are decoded, which they are one by one.

    Raises:
        Refused: If there are no triangles, a face names no vertex, or the textures are too large or damaged.
    """
    parts: list[tuple[Any, NDArray[np.float64]]] = [(source, np.eye(4))]
    if hasattr(source, "geometry"):
        nodes = [source.graph[node] for node in source.graph.nodes_geometry]
        parts = [(source.geometry[key], np.asarray(transform)) for transform, key in nodes]
    found: list[tuple[NDArray[Any], ...]] = []
    textures: list[NDArray[np.uint8]] = []
    known: dict[int, int] = {}
    for mesh, transform in parts:
        if not len(getattr(mesh, "faces", ())):
            continue
        faces = np.asarray(mesh.faces)
        if faces.min() < 0 or faces.max() >= len(mesh.vertices):
            raise Refused(f"a face names a vertex that is none of {len(mesh.vertices)}", _AGAIN)
        placed = np.asarray(mesh.vertices) @ transform[:3, :3].T + transform[:3, 3]
        color, uv, image = _appearance(mesh)
        chosen = -1
        if image is not None:
            chosen = known.setdefault(id(image), len(textures))
            if chosen == len(textures):
                textures.append(decoded(image, MAX_TEXELS - sum(texture.size // 3 for texture in textures)))
                if spent:
                    image.close()
        found.append((placed[faces], color, uv, np.full(len(faces), chosen, np.int32)))
    if not found:
        raise Refused("holds no triangles", "Export a triangle mesh, not points or curves")
    names = ("corners", "corner_colors", "corner_uvs", "texture_index")
    columns = (values[0] if len(values) == 1 else np.concatenate(values) for values in zip(*found, strict=True))
    fields: dict[str, Any] = dict(zip(names, columns, strict=True))
    corners, offset = near_zero(fields["corners"].reshape(-1, 3))
    fields["corners"] = corners.astype(np.float32).reshape(-1, 3, 3)
    return {**fields, "textures": tuple(textures), "offset": offset}


def _appearance(mesh: Any) -> tuple[NDArray[np.float32], NDArray[np.float32], Any]:
    """Return corner colours (F, 3, 3), corner texture coordinates (F, 3, 2) and the image or None."""
    faces = np.asarray(mesh.faces)
    color, uv, image = np.ones((len(faces), 3, 3), np.float32), np.zeros((len(faces), 3, 2), np.float32), None
    visual = mesh.visual
    if visual.kind == "vertex":
        color *= _unit(visual.vertex_colors)[faces][..., :3]
    elif visual.kind == "face":
        color *= _unit(visual.face_colors)[:, None, :3]
    elif visual.kind == "texture":
        material = visual.material
        factor = getattr(material, "baseColorFactor", None)
        if hasattr(material, "baseColorTexture"):
            image = material.baseColorTexture
            if factor is not None:
                color *= _gamma_encoded(np.asarray(factor)[:3] / 255.0)
            vertex = visual.vertex_attributes.get("color") if hasattr(visual, "vertex_attributes") else None
            if vertex is not None and len(vertex) == len(mesh.vertices):
                color *= _unit(vertex)[faces][..., :3]
            if image is None and factor is None and vertex is None:
                color *= GREY
        else:
            image = getattr(material, "image", None)
            if image is None:
                color *= np.asarray(material.diffuse)[:3] / 255.0
        if image is not None and visual.uv is None:
            image = None
        if image is not None:
            at = np.asarray(visual.uv, np.float32)
            if at.shape != (len(mesh.vertices), 2):
                raise Refused(f"texture coordinates have shape {at.shape}, expected ({len(mesh.vertices)}, 2)", _AGAIN)
            uv = at[faces]
    else:
        color *= GREY
    return color, uv, image


def _unit(values: ArrayLike) -> NDArray[np.float32]:
    """Return colours stored as integers or as numbers of 0..1, as the latter."""
    array = np.asarray(values)
    scale = np.iinfo(array.dtype).max if np.issubdtype(array.dtype, np.integer) else 1.0
    return array.astype(np.float32) / np.float32(scale)


def _gamma_encoded(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sRGB code values 0..1 of linear light (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def decoded(image: Any, left: int) -> NDArray[np.uint8]:
    """Decode an image of at most so many pixels."""
    if image.width * image.height > left:
        text = f"a texture of {image.width} x {image.height} px, with the others more than {MAX_TEXELS} px"
        raise Refused(text, "Scale the textures down: splats of this size cannot show them")
    try:
        return np.ascontiguousarray(np.asarray(image if image.mode == "RGB" else image.convert("RGB"), dtype=np.uint8))
    except (OSError, ValueError, SyntaxError) as error:
        raise Refused(f"a texture cannot be decoded ({error})", _AGAIN) from error
