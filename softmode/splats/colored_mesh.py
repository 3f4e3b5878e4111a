"""`ColoredMesh`: the triangles of a mesh file or scene with one rule for the colour of every surface point."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.errors import AssetError
from softmode.files import damage_errors
from softmode.foreign.child.surface import GREY as GREY
from softmode.foreign.child.surface import gathered

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, kw_only=True, eq=False)
class ColoredMesh:
    """Triangles whose surface colour is corner colour times texture, both gamma-encoded, opaque and without lighting.

    Corner colours are interpolated linearly over a triangle. A texture is looked up bilinearly at the interpolated
    texture coordinates, v up, repeated outside 0..1. All parts of a scene are one such mesh.
    """

    corners: NDArray[np.float32]
    """Corner positions [m], shape (F, 3, 3)."""
    corner_colors: NDArray[np.float32]
    """Colour at each corner, 0..1, shape (F, 3, 3)."""
    corner_uvs: NDArray[np.float32]
    """Texture coordinates at each corner, shape (F, 3, 2)."""
    texture_index: NDArray[np.int32]
    """Texture of each triangle, -1 for none, shape (F,)."""
    textures: tuple[NDArray[np.uint8], ...]
    """Images, first row at v = 1, each of shape (height, width, 3)."""
    name: str = "mesh"
    """Where the mesh comes from; used in messages."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What the corners lack to the file's own coordinates [m], where these are too far out for float32."""
    notes: tuple[str, ...] = ()
    """What was read from the file in another way than it was meant."""

    def __post_init__(self) -> None:
        """Refuse what has no surface."""
        if not len(self.corners):
            raise AssetError(f"{self.name}: holds no triangles", hint="Export a triangle mesh, not points or curves")
        if not (np.isfinite(self.corners).all() and np.isfinite(self.corner_uvs).all()):
            raise AssetError(f"{self.name}: holds NaN or infinity", hint="Export the mesh again")
        if not self.area > 0.0:
            raise AssetError(f"{self.name}: its triangles have no area", hint="Export the mesh again at another scale")

    @classmethod
    def from_trimesh(cls, source: trimesh.Trimesh | trimesh.Scene, *, name: str = "mesh") -> ColoredMesh:
        """Gather the triangles and colours of a mesh, or of all meshes that a scene places.

        The colour is, in this order: the material's texture (glTF: times its base colour and the vertex colours), the
        vertex or face colours, the material's colour, grey. glTF's base colour is linear and becomes gamma-encoded;
        vertex colours are taken as they are. Transparency, lighting and further maps are left out.

        Args:
            source: The mesh or scene.
            name: Where it comes from; used in messages.

        Raises:
            AssetError: If there are no triangles, they have no area, a number is not finite, or a part is damaged.
        """
        with damage_errors(name):
            return cls(**gathered(source), name=name)

    @property
    def area(self) -> float:
        """Area of all triangles [m^2]."""
        return float(self.areas().sum())

    def normalized(self) -> tuple[ColoredMesh, NDArray[np.float64], float]:
        """Return the mesh moved and scaled into the unit sphere, its old centre [m], shape (3,), and radius [m]."""
        points = self.corners.astype(np.float64)
        center = 0.5 * (points.min(axis=(0, 1)) + points.max(axis=(0, 1)))
        radius = float(np.linalg.norm(points - center, axis=2).max())
        return replace(self, corners=((points - center) / radius).astype(np.float32)), center, radius

    def normals(self) -> NDArray[np.float64]:
        """Return the cross products of the edges, twice the area long [m^2], shape (F, 3)."""
        a, b, c = np.swapaxes(self.corners.astype(np.float64), 0, 1)
        return np.cross(b - a, c - a)

    def areas(self) -> NDArray[np.float64]:
        """Return the area of each triangle [m^2], shape (F,)."""
        return 0.5 * np.linalg.norm(self.normals(), axis=1)

    def colors_at(self, faces: ArrayLike, barycentric: ArrayLike) -> NDArray[np.float64]:
        """Return the surface colour 0..1, shape (N, 3).

        Args:
            faces: Triangle of each point, shape (N,).
            barycentric: Weights of its three corners, shape (N, 3).
        """
        face, weights = np.asarray(faces), np.asarray(barycentric, dtype=np.float64)
        color = np.einsum("nk,nkc->nc", weights, self.corner_colors[face])
        uv = np.einsum("nk,nkc->nc", weights, self.corner_uvs[face])
        for i, texture in enumerate(self.textures):
            here = self.texture_index[face] == i
            color[here] *= _bilinear(texture, uv[here])
        return color


def _bilinear(texture: NDArray[np.uint8], uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return colours 0..1 between the centres of the four nearest texels, repeated at the rims, shape (N, 3)."""
    height, width = texture.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1.0 - uv[:, 1]) * height - 0.5
    left, top = np.floor(x), np.floor(y)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    i, j = left.astype(np.int64) % width, top.astype(np.int64) % height
    k, l = (i + 1) % width, (j + 1) % height
    upper = texture[j, i] * (1.0 - fx) + texture[j, k] * fx
    lower = texture[l, i] * (1.0 - fx) + texture[l, k] * fx
    return (upper * (1.0 - fy) + lower * fy) / 255.0
