"""The public faces: light packages whose names are imported when they are first used."""

from __future__ import annotations

import ast
import inspect
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from tests.documentation.pages import PAGES, fences

ROOT = Path(__file__).resolve().parents[1]
ROOMS = (
    "deformables",
    "splats",
    "robots",
    "mpm",
    "radiance",
    "objects",
    "scenes",
    "fitting",
    "envs",
    "usd",
    "viz",
    "demonstrations",
    "learning",
    "view",
    "testing",
)
FACES = tuple(f"softmode.{room}" for room in ROOMS)
"""Packages that offer public names; what lies in their modules is not for users."""


def _tree(face: str) -> ast.Module:
    """Return the source of a package."""
    return ast.parse((ROOT / Path(*face.split(".")) / "__init__.py").read_text())


@pytest.mark.parametrize("face", FACES)
def test_a_face_offers_what_type_checkers_read(face: str) -> None:
    """Each name that is imported for them stands under its own name there, and is what its home has."""
    read_by_checkers = {
        name.name: node.module
        for block in _tree(face).body
        if isinstance(block, ast.If)
        for node in block.body
        if isinstance(node, ast.ImportFrom) and node.module
        for name in node.names
        if name.asname == name.name
    }
    module = import_module(face)
    assert module.__all__ == sorted(read_by_checkers)
    for name, home in read_by_checkers.items():
        assert getattr(module, name) is getattr(import_module(home), name)


@pytest.mark.parametrize("face", FACES)
def test_every_name_of_a_face_is_there_and_documented(face: str) -> None:
    """A face's names can be imported, are listed by ``dir``, and each class and function has a docstring of its own."""
    module = import_module(face)
    for name in module.__all__:
        value = getattr(module, name)
        assert name in dir(module)
        if inspect.isclass(value) or inspect.isfunction(value):
            assert value.__doc__ and not value.__doc__.startswith(f"{name}("), f"{face}.{name} has no docstring"
    modules = {path.stem for path in (ROOT / Path(*face.split("."))).iterdir()}
    assert not modules & set(module.__all__), f"{face} cannot offer a name that is also its module's"


def private_imports(source: str) -> list[str]:
    """Return the imports of softmode that go past its faces."""
    public = {"softmode", "softmode.errors", *FACES}
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.partition(".")[0] == "softmode":
            names = [alias.name for alias in node.names]
            offered = getattr(import_module(node.module), "__all__", names) if node.module in public else []
            found += [f"{node.module}: {name}" for name in names if name not in offered]
        elif isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name.partition(".")[0] == "softmode"]
    return [name for name in found if name not in public]


@pytest.mark.parametrize("example", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.stem)
def test_examples_import_from_faces_alone(example: Path) -> None:
    """What an example imports is public, so that a user can write the same."""
    assert not private_imports(example.read_text())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_pages_import_from_faces_alone(page: Path) -> None:
    """What the Python of a page imports is public."""
    assert not [name for fence in fences(page, "python") for name in private_imports(fence.text)]


def test_private_imports_are_seen() -> None:
    """Modules past a face and names that a face does not offer are found; faces, errors and other packages pass."""
    source = """
import numpy, softmode, softmode.splats.plush
from softmode.deformables import build_body, build, numpy
from softmode.deformables.model.authoring import add_pins
from softmode.errors import ConfigError
from softmodel import x
"""
    assert private_imports(source) == [
        "softmode.splats.plush",
        "softmode.deformables: build",
        "softmode.deformables: numpy",
        "softmode.deformables.model.authoring: add_pins",
    ]


@pytest.mark.parametrize("face", FACES)
def test_every_name_of_a_face_is_in_the_reference(face: str) -> None:
    """The reference shows the table of its names, and an entry of each, once."""
    page = "\n".join(page.read_text() for page in sorted((ROOT / "docs" / "api").glob("*.md")))
    blocks = re.findall(rf"^```\{{entries\}} {face}\n(.*?)^```$", page, re.M | re.S)
    assert f"```{{summary}} {face}\n```" in page and page.count(f"{{summary}} {face}\n") == 1 and blocks
    if blocks != [""]:  # an empty block shows all
        assert sorted(" ".join(blocks).split()) == sorted(import_module(face).__all__)


def test_faces_load_nothing_before_they_are_asked() -> None:
    """A fresh process that imports every face has loaded neither Warp nor Newton nor any extra."""
    script = f"import sys, {', '.join(FACES)}; print(sorted({{name.partition('.')[0] for name in sys.modules}}))"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert not {"warp", "newton", "torch", "pxr", "scipy", "trimesh"} & set(ast.literal_eval(run.stdout))


@pytest.mark.parametrize("rewritten", [False, True], ids=["plain", "rewritten"])
def test_a_lazy_name_is_imported_once_and_kept(
    rewritten: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Relative and absolute homes are found, the package keeps what was imported, unknown names are refused.

    So too where pytest's own loader imports the package, as it does with the packages of installed plug-ins.
    """
    shop = "rewritten_shop" if rewritten else "shop"
    if rewritten:
        pytest.register_assert_rewrite(shop)
    (tmp_path / shop).mkdir()
    (tmp_path / shop / "fruit.py").write_text("APPLE = 3\n")
    (tmp_path / shop / "__init__.py").write_text(
        "from typing import TYPE_CHECKING\n"
        "from softmode.lazy import lazy_names\n"
        "if TYPE_CHECKING:\n    from fractions import Fraction as Fraction\n    from .fruit import APPLE as APPLE\n"
        "__getattr__, __dir__ = lazy_names(__name__)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    package = import_module(shop)
    assert not {"APPLE", "Fraction"} & set(vars(package))
    assert dir(package) == sorted({*vars(package), "Fraction", "APPLE"})
    assert package.__all__ == ["APPLE", "Fraction"]
    assert package.Fraction(1, 2) == 0.5 and package.APPLE == 3
    assert vars(package)["APPLE"] == 3
    with pytest.raises(AttributeError, match=rf"'{shop}' has no attribute 'Nothing'"):
        package.Nothing  # noqa: B018
