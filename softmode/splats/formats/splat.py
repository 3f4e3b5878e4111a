"""The `.splat` file of the first web viewers (read, write): 32 bytes a splat, no header, colour of degree 0.

Reference:
    K. Kwok, "splat: WebGL 3D Gaussian Splat Viewer" (antimatter15/splat, convert.py).
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from softmode.files import open_file, whole_file
from softmode.splats.formats.common import check_count, read_exactly, sh_from_colors, sound_splats, unreadable
from softmode.splats.splats import SH_DC, Splats

_RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("wxyz", "u1", 4)])


def read_splat(path: str | os.PathLike[str]) -> Splats:
    """Read a `.splat` file.

    Raises:
        AssetError: If its size is no multiple of 32 bytes, or it holds no usable splats.
    """
    file_path = Path(path)
    with open_file(file_path, "splat file") as file:
        size = os.fstat(file.fileno()).st_size
        if size % _RECORD.itemsize:
            raise unreadable(file_path, f"{size} bytes are no multiple of 32")
        count = check_count(size // _RECORD.itemsize, str(file_path))
        table = np.frombuffer(read_exactly(file, count * _RECORD.itemsize, file_path), dtype=_RECORD)
    wxyz = (table["wxyz"].astype(np.float64) - 128.0) / 128.0
    return sound_splats(
        f"splat file {file_path}",
        means=table["mean"],
        quats=wxyz[:, [1, 2, 3, 0]],
        scales=table["scale"],
        opacities=table["rgba"][:, 3] / 255.0,
        sh=sh_from_colors(table["rgba"][:, :3] / 255.0),
    )


def write_splat(path: str | os.PathLike[str], splats: Splats) -> None:
    """Write a `.splat` file; the file appears complete or not at all.

    Positions and scales keep float32, rotations are rounded to 1/128 in a component, colours (clipped to 0..1) and
    opacities to 1/255; view-dependent colour is dropped.

    Args:
        path: File to write; its folder must exist.
        splats: What to write, in its own frame.

    Raises:
        StorageError: If the file cannot be written.
    """
    table = np.empty(splats.count, dtype=_RECORD)
    table["mean"], table["scale"] = splats.means, splats.scales
    rgba = np.column_stack([0.5 + SH_DC * splats.sh[:, 0], splats.opacities])
    table["rgba"] = np.rint(np.clip(rgba, 0.0, 1.0) * 255.0)
    # Only 127 of 128 steps exist on the positive side, so the sign that leaves the largest component negative is exact.
    wxyz = splats.quats[:, [3, 0, 1, 2]]
    largest = np.take_along_axis(wxyz, np.abs(wxyz).argmax(axis=1)[:, None], axis=1)
    table["wxyz"] = np.clip(np.rint(np.where(largest > 0.0, -wxyz, wxyz) * 128.0 + 128.0), 0, 255)
    with whole_file(path, "splat file", make_folders=False) as file:
        file.write(table.tobytes())
