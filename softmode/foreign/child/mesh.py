"""Read what trimesh reads: a surface with its colours, a surface alone, or points."""

from __future__ import annotations

import os
import re
from typing import Any

import numpy as np
import PIL.Image
import trimesh
from trimesh.resolvers import FilePathResolver

from .answer import Arrays
from .layers import inside
from .limits import Budget, Refused
from .surface import gathered

PIL.Image.preinit()  # loads the readers of pictures, before anything is counted


def read(budget: Budget, request: dict[str, Any], arrays: Arrays) -> dict[str, Any]:
    """Return what is wanted of a file.

    Args:
        budget: Allowed for each file that the file refers to.
        request: `want`: "colors" for the arrays of a coloured mesh, "surface" for one mesh in the unit and the axes of
            robots (metres, as they are).
        arrays: Takes the arrays.
    """
    path, want = request["file"], request["want"]
    kind = os.path.splitext(path)[1].lower().lstrip(".")
    known = sorted(set(trimesh.available_formats()))
    if kind not in known:
        hint = f"Readable here are {', '.join('.' + kind for kind in known)}; convert others to .glb"
        raise Refused(f"unknown kind {'.' + kind if kind else '(no suffix)'!r}", hint)
    resolver = _Resolver(path, request["root"], budget)
    with open(path, "rb") as file:
        loaded = trimesh.load_scene(file, file_type=kind, resolver=resolver)
    if resolver.refused:
        raise resolver.refused
    if want == "colors":
        found = gathered(loaded, spent=True)
        numbers: dict[str, Any] = {"textures": [arrays.add(picture) for picture in found.pop("textures")]}
        numbers["offset"] = found.pop("offset")
        return numbers | {name: arrays.add(np.ascontiguousarray(value)) for name, value in found.items()}
    mesh = loaded.to_mesh()
    sent: list[Any] = [np.ascontiguousarray(mesh.vertices, np.float64), np.ascontiguousarray(mesh.faces, np.int64)]
    sent[0] *= _collada_unit(path) if kind == "dae" else 1.0
    return {"sent": [arrays.add(array) for array in sent]}


class _Resolver(FilePathResolver):
    """Finds files inside a folder; what lies outside is refused at the end, as trimesh passes over errors."""

    def __init__(self, path: str, root: str, budget: Budget) -> None:
        """Begin with nothing refused."""
        super().__init__(path)
        self.root, self.budget, self.path = root, budget, path
        self.refused: Refused | None = None

    def get(self, name: str) -> bytes:
        """Return the bytes of a file."""
        name = name.strip()
        for candidate in (name, name.lstrip("/"), os.path.basename(name)):
            file = os.path.join(os.path.dirname(self.path), candidate)
            if not os.path.isfile(file):
                continue
            if inside(file, self.root):
                self.budget.add(os.stat(file).st_size)
                with open(file, "rb") as source:
                    return source.read()
            hint = "Keep everything that the mesh needs inside its folder"
            self.refused = Refused(f"refers to {name[:200]}, outside {self.root}", hint)
            raise self.refused
        raise FileNotFoundError(name)


def _collada_unit(path: str) -> float:
    """Return the metres of a Collada file's unit. Its up axis is ignored, as other readers of robots do."""
    with open(path, "rb") as file:
        found = re.search(rb"<unit\b[^>]*\bmeter\s*=\s*[\"']([0-9.eE+-]+)[\"']", file.read())
    return float(found.group(1)) if found else 1.0
