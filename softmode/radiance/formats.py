"""Files of radiance fields: .npz (ours, plain ones, of Plenoxels and PlenOctree) and NanoVDB."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.errors import AssetError
from softmode.files import array_names, damage_errors, read_arrays, read_file, write_compressed
from softmode.radiance.grid import RadianceGrid, check_size, sh_of_colors
from softmode.radiance.nanovdb import checked
from softmode.radiance.nanovdb_kernels import read_values
from softmode.radiance.plenoctree import NAMES as PLENOCTREE
from softmode.radiance.plenoctree import field_of_plenoctree
from softmode.splats.formats.others import refuse_others

SUFFIXES = (".npz", ".nvdb")
"""What fields are read from."""
_OURS = ("density", "sh", "origin", "axes")
_NUMBERS = ("metres", "contradicted", "allowed")
_PLAIN = ("density", "bounds")
_PLENOXELS = ("links", "density_data", "sh_data", "radius", "center")
_HINT = "export it again"
_FREE, _DENSE_FREE = 128 << 20, 256 << 20


def is_radiance(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is a radiance field, by its suffix and, for .npz, the names in it.

    Raises:
        AssetError: If an .npz is damaged.
    """
    file = Path(path)
    if file.suffix.lower() == ".nvdb":
        return True
    if file.suffix.lower() != ".npz":
        return False
    names = array_names(file, hint=_HINT)
    return any(names >= set(some) for some in (_PLAIN[:1], _PLENOXELS[:3], PLENOCTREE))


def read_radiance(path: str | os.PathLike[str]) -> RadianceGrid:
    """Read a radiance field.

    `.npz`: `density` [1/m] with `bounds`, corners of first and last node [m] (2, 3), and colours `rgb` (..., 3) or
    coefficients `sh` (..., K, 3), and `metres`, those of a unit of length, if they are known; or what `write_radiance`
    wrote; or a checkpoint of Plenoxels (Fridovich-Keil et al. 2022), of which background and learned bases are not
    read; or a PlenOctree, see `field_of_plenoctree`. `.nvdb`: the first grid of numbers is the density, one of vectors
    the colour 0..1, if there is one, else it is grey.

    Raises:
        AssetError: If the file is missing, damaged, too large, of another kind, or holds no field.
    """
    file = Path(path)
    refuse_others(file)
    if file.suffix.lower() not in SUFFIXES:
        raise AssetError(f"radiance field {file}: cannot read {file.suffix or 'no suffix'!r}",
                         hint=f"readable are {', '.join(SUFFIXES)}")  # fmt: skip
    with damage_errors(f"radiance field {file}", hint=_HINT):
        return _read_nanovdb(file) if file.suffix.lower() == ".nvdb" else _read_npz(file)


def _read_npz(file: Path) -> RadianceGrid:
    """Return the field of an .npz."""
    names = {*_OURS, *_PLAIN, *_PLENOXELS, *PLENOCTREE, "rgb", "basis_type", *_NUMBERS}
    arrays = read_arrays(file, names, what="radiance field", hint=_HINT, free=_FREE)
    name = file.name
    known = {key: float(arrays[key]) if key in arrays else None for key in _NUMBERS}
    if set(arrays) >= set(_OURS):
        density, sh, origin, axes = (arrays[key] for key in _OURS)
        return RadianceGrid(density=density, sh=sh, origin=origin, axes=axes, name=name, **known)
    if set(arrays) >= set(_PLENOXELS):
        return _plenoxels(arrays, name)
    if set(arrays) >= set(PLENOCTREE):
        return field_of_plenoctree(arrays, name, _HINT)
    if not set(arrays) >= set(_PLAIN) or not ({"sh", "rgb"} & set(arrays)):
        raise AssetError(
            f"radiance field {name}: holds {sorted(arrays) or 'none of the known keys'}",
            hint="give density, bounds and rgb or sh; or links, density_data, sh_data, radius and center of Plenoxels;"
            " or child, data, data_format, invradius3 and offset of a PlenOctree",
        )
    sh = arrays["sh"] if "sh" in arrays else _colors(arrays["rgb"], name)
    return RadianceGrid.from_bounds(arrays["density"], sh, arrays["bounds"], name=name, metres=known["metres"])


def write_radiance(path: str | os.PathLike[str], field: RadianceGrid) -> None:
    """Write a field as an .npz, compressed unless it is nearly empty; the file appears whole or not at all.

    Raises:
        AssetError: If the suffix is another.
        StorageError: If it cannot be written.
    """
    if Path(path).suffix.lower() != ".npz":
        raise AssetError(f"radiance field {path}: cannot write this kind", hint="name it like toy.npz")
    known = {name: np.array(getattr(field, name)) for name in _NUMBERS if getattr(field, name) is not None}
    write_compressed(path, {name: getattr(field, name) for name in _OURS} | known, "radiance field")


def _colors(rgb: NDArray[Any], name: str) -> NDArray[np.float16]:
    """Return the coefficients of colours 0..1, shape (nx, ny, nz, 1, 3), with little memory beside them."""
    if rgb.ndim != 4 or rgb.shape[3] != 3 or rgb.dtype.kind not in "fiu":
        raise AssetError(f"radiance field {name}: rgb has shape {rgb.shape}, expected (nx, ny, nz, 3)", hint=_HINT)
    found = np.empty((*rgb.shape[:3], 1, 3), np.float16)
    for slab, of in zip(found, rgb, strict=True):
        slab[...] = sh_of_colors(of / 255.0 if rgb.dtype == np.uint8 else of)[..., None, :]
    return found


def _check_dense(name: str, nodes: int, each: int, stored: int) -> None:
    """Refuse what lies apart in so large a box that most of the grid would be empty.

    Raises:
        AssetError: If nodes of so many bytes each take much more than what is stored of them.
    """
    if nodes * each > max(_DENSE_FREE, 8 * stored):
        raise AssetError(
            f"radiance field {name}: {stored} bytes fill a grid of {nodes} nodes, {nodes * each} bytes",
            hint="crop it, or export it at a lower resolution",
        )


def _plenoxels(arrays: dict[str, NDArray[Any]], name: str) -> RadianceGrid:
    """Return the field of a checkpoint: voxel centres in a box of `radius` around `center`, -1 links to nothing."""
    links, density, sh = (arrays[key] for key in _PLENOXELS[:3])
    if int(arrays.get("basis_type", np.int64(1))) != 1:
        raise AssetError(
            f"radiance field {name}: its colours have a learned basis",
            hint="train with spherical harmonics (--basis_type sh)",
        )
    kept = len(density)
    if links.ndim != 3 or links.dtype.kind not in "iu" or density.size != kept or len(sh) != kept or sh.ndim != 2:
        raise AssetError(
            f"radiance field {name}: links {links.shape}, density {density.shape} and sh {sh.shape} do not match",
            hint=_HINT,
        )
    if sh.shape[1] not in (3, 12, 27):
        raise AssetError(
            f"radiance field {name}: sh_data has {sh.shape[1]} columns, expected 3, 12 or 27",
            hint="train with spherical harmonics of degree 0, 1 or 2",
        )
    check_size(name, links.size, sh.shape[1] // 3)
    _check_dense(name, links.size, 8 + 4 * sh.shape[1], sum(array.nbytes for array in arrays.values()))
    if kept and (links.max() >= kept or links.min() < -1):
        raise AssetError(f"radiance field {name}: links point to voxels that are not there", hint=_HINT)
    radius = np.broadcast_to(np.asarray(arrays["radius"], np.float64).ravel(), 3)
    center = np.broadcast_to(np.asarray(arrays["center"], np.float64).ravel(), 3)
    full = links >= 0
    dense = np.zeros(links.shape, np.float32)
    dense[full] = np.maximum(density.ravel()[links[full]], 0.0)  # as their renderer does
    coefficients = np.zeros((*links.shape, sh.shape[1] // 3, 3), np.float16)
    coefficients[full] = sh.reshape(kept, 3, -1).transpose(0, 2, 1)[links[full]]
    edge = 2.0 * radius / np.array(links.shape)
    return RadianceGrid(
        density=dense, sh=coefficients, origin=center - radius + 0.5 * edge, axes=np.diag(edge), name=name
    )


def _read_nanovdb(file: Path) -> RadianceGrid:
    """Return the field of the grids of a NanoVDB file, on its active voxels and a rim around them."""
    content = checked(read_file(file, "radiance field", hint=_HINT))
    volumes = [wp.Volume.load_from_nvdb(content, device="cpu")]
    while (following := volumes[-1].load_next_grid()) is not None:
        volumes.append(following)
    scalars = [volume for volume in volumes if volume.dtype == wp.float32]
    vectors = [volume for volume in volumes if volume.dtype == wp.vec3f]
    active = scalars[0].get_voxels().numpy() if scalars else np.zeros((0, 3), np.int32)
    if not len(active):
        hint = "write the density as a grid of 32-bit floats"
        raise AssetError(f"radiance field {file}: no grid of numbers with active voxels", hint=hint)
    low, high = active.min(axis=0).astype(np.int64) - 1, active.max(axis=0).astype(np.int64) + 2
    shape = tuple(int(n) for n in high - low)
    check_size(file.name, math.prod(shape), 1)
    _check_dense(file.name, math.prod(shape), 32, len(content))
    info = scalars[0].get_grid_info()
    axes = np.array(info.transform_matrix, dtype=np.float64).reshape(3, 3)
    values = wp.zeros(shape, dtype=wp.float32, device="cpu")
    colors = wp.full(shape, wp.vec3(0.7, 0.7, 0.7), dtype=wp.vec3, device="cpu")
    given = [scalars[0].id, vectors[0].id if vectors else wp.uint64(0), wp.vec3i(*low.tolist())]
    wp.launch(read_values, shape, inputs=given, outputs=[values, colors], device="cpu")
    origin = np.array(info.translation, dtype=np.float64) + axes @ low
    density = np.maximum(values.numpy(), 0.0)
    return RadianceGrid(
        density=density, sh=_colors(colors.numpy(), file.name), origin=origin, axes=axes, name=file.name
    )
