"""The inventories of other projects hold what their script says, and its names are right for the installed versions."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import zlib
from types import ModuleType
from typing import Any

import pytest

from tests.documentation.pages import ROOT

FOLDER = ROOT / "docs" / "inventories"


def load() -> ModuleType:
    """Return the script as a module."""
    spec = importlib.util.spec_from_file_location("make_inventories", FOLDER / "make_inventories.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules.setdefault(spec.name, module)
    spec.loader.exec_module(module)
    return module


MAKE = load()


def unpacked(data: bytes) -> tuple[bytes, str]:
    """Return header and entries of an inventory; compressed bytes may differ between builds of zlib."""
    *header, body = data.split(b"\n", 4)
    return b"\n".join(header), zlib.decompress(body).decode()


def resolve(name: str) -> Any:
    """Return what a dotted name stands for, None if there is no such thing; skip where its package is absent."""
    parts = name.split(".")
    pytest.importorskip(parts[0])
    found: Any = None
    for count in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            found = getattr(found, part, None)
        break
    return found


@pytest.mark.parametrize("title", MAKE.PROJECTS)
def test_files_are_what_the_script_writes(title: str) -> None:
    """Each inventory equals the one that the script makes, and no other lies beside them."""
    project = MAKE.PROJECTS[title]
    assert unpacked((FOLDER / f"{title}.inv").read_bytes()) == unpacked(MAKE.content(title, project))
    assert {path.stem for path in FOLDER.glob("*.inv")} == set(MAKE.PROJECTS)


def test_sphinx_reads_them() -> None:
    """Sphinx finds a class under its public name and under the one that annotations show, with one address."""
    pytest.importorskip("sphinx", reason="needs the extra [docs]")
    from sphinx.util.inventory import InventoryFile

    url = MAKE.PROJECTS["newton"].url
    found = InventoryFile.loads((FOLDER / "newton.inv").read_bytes(), uri=url)
    public, private = found["py:class", "newton.State"], found["py:class", "newton._src.sim.state.State"]
    assert public.uri == private.uri == f"{url}api/_generated/newton.State.html#newton.State"


@pytest.mark.parametrize("title", ["numpy", "scipy", "gymnasium", "warp", "newton", "torch"])
def test_names_exist(title: str) -> None:
    """Every name can be imported; a class is listed under the name of its definition, which annotations show."""
    for entry in MAKE.PROJECTS[title].names:
        found = resolve(entry.name)
        assert found is not None, entry.name
        if entry.role == "class" and isinstance(found, type) and "typing" not in entry.name:
            assert f"{found.__module__}.{found.__qualname__}" in (entry.name, *entry.aliases)
