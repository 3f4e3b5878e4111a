"""Captures that come with softmode, by name, and whom they are by."""

from __future__ import annotations

import os
from pathlib import Path

CAPTURES = {"playbot": "PLAYBOT by Stephane Agullo (https://sa3d.fr), https://superspl.at/view?id=ee6d8bc4, CC-BY-4.0"}
"""The bundled captures by name: title, author, source and licence, to be shown where the capture is."""
_FOLDER = Path(__file__).parent


def bundled(source: str | os.PathLike[str]) -> Path | None:
    """Return the file of a bundled capture that a name stands for; None for other names, and where such a file is."""
    name = os.fspath(source)
    return _FOLDER / name / "meta.json" if name in CAPTURES and not Path(name).exists() else None


def credit(path: Path | None) -> str | None:
    """Return whom the bundled capture of a file is by; None for any other file."""
    inside = path is not None and path.resolve().is_relative_to(_FOLDER)
    return CAPTURES.get(path.resolve().parent.name) if path is not None and inside else None
