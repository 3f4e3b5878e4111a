"""Fingerprints of the files that objects come from: what runs and datasets keep, so that the object is found again."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from softmode.errors import AssetError
from softmode.files import damage_errors, open_file, read_file, read_json
from softmode.foreign.child.layers import inside

_INDEX = (".json", ".gltf")
"""Suffixes of files that name others beside them: SOG v2, glTF."""


def file_fingerprint(path: Path) -> str:
    """Return the sha256 of a file's content, and of the files beside it that a `meta.json` or `.gltf` names.

    Layers that an OpenUSD stage refers to and materials of an .obj are not followed.

    Args:
        path: The file, or the folder of a SOG v2 asset.

    Raises:
        AssetError: If it cannot be read.
    """
    with damage_errors(f"object file {path}", hint="check the path"):
        file = path / "meta.json" if path.is_dir() else path
        return _fingerprint(file, file.stat().st_mtime_ns, file.stat().st_size)


def find_file(path: Path, fingerprint: str, *folders: Path) -> Path | None:
    """Return the file of a fingerprint: the one at a path, or one of its name in a folder; None if there is none."""
    for candidate in (path, *(folder / path.name for folder in folders)):
        if candidate.exists() and file_fingerprint(candidate) == fingerprint:
            return candidate.resolve()
    return None


@functools.lru_cache(maxsize=64)
def _fingerprint(file: Path, changed: int, size: int) -> str:
    """Return the fingerprint of a file as it was at a time."""
    with open_file(file, "object file") as stream:
        digest = hashlib.file_digest(stream, "sha256")
    if file.suffix.lower() in _INDEX:
        named = {name for name in _strings(read_json(file, "object file")) if Path(name).name == name}
        for name in sorted(named):
            beside = file.parent / name
            if name and not inside(str(beside), str(file.parent)):
                raise AssetError(f"object file {file}: {name} leads outside of its folder", hint="copy it there")
            if name and beside.is_file():
                digest.update(read_file(beside, "object file"))
    return digest.hexdigest()


def _strings(tree: Any) -> Iterator[str]:
    """Yield every string of a JSON value."""
    if isinstance(tree, str):
        yield tree
    elif isinstance(tree, dict | list):
        for part in tree.values() if isinstance(tree, dict) else tree:
            yield from _strings(part)
