"""The public faces: light packages whose names are imported when they are first used."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
import types
from importlib import import_module
from pathlib import Path

import pytest

from softmode.lazy import lazy_names

ROOT = Path(__file__).resolve().parents[1]
LAZY = tuple(
    f"softmode.{name}" for name in ("deformables", "splats", "usd", "learning", "viz", "view", "demonstrations")
)
"""Packages whose names are imported when they are first used."""


def _tree(face: str) -> ast.Module:
    """Return the source of a package."""
    return ast.parse((ROOT / Path(*face.split(".")) / "__init__.py").read_text())


@pytest.mark.parametrize("face", LAZY)
def test_the_three_lists_of_a_face_agree(face: str) -> None:
    """``__all__``, what type checkers read, and what is imported at first use list the same names and homes."""
    read_by_checkers = {
        name.name: node.module
        for block in _tree(face).body
        if isinstance(block, ast.If)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    }
    table = next(
        ast.literal_eval(node.args[1])
        for node in ast.walk(_tree(face))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "lazy_names"
    )
    assert {name: home if home[0] != "." else face + home for name, home in table.items()} == read_by_checkers
    assert sorted(import_module(face).__all__) == sorted(table)


@pytest.mark.parametrize("face", LAZY)
def test_every_name_of_a_face_is_there_and_documented(face: str) -> None:
    """A face's names can be imported, are listed by ``dir``, and each class and function has a docstring of its own."""
    module = import_module(face)
    for name in module.__all__:
        value = getattr(module, name)
        assert name in dir(module)
        if inspect.isclass(value) or inspect.isfunction(value):
            assert value.__doc__ and not value.__doc__.startswith(f"{name}("), f"{face}.{name} has no docstring"
    assert not [name for name in module.__all__ if inspect.ismodule(getattr(module, name))]


def test_faces_load_nothing_before_they_are_asked() -> None:
    """A fresh process that imports every face has loaded neither Warp nor Newton nor any extra."""
    script = f"import sys, {', '.join(LAZY)}; print(sorted({{name.partition('.')[0] for name in sys.modules}}))"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert not {"warp", "newton", "torch", "pxr", "scipy", "trimesh"} & set(ast.literal_eval(run.stdout))


def test_a_lazy_name_is_imported_once_and_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Relative and absolute homes are found, the package keeps what was imported, unknown names are refused."""
    package = types.ModuleType("email")
    monkeypatch.setitem(sys.modules, "email", package)
    get, names = lazy_names("email", {"Fraction": "fractions", "Charset": ".charset"})
    monkeypatch.setitem(sys.modules, "email.charset", types.SimpleNamespace(Charset=3))
    assert names() == sorted({*vars(package), "Fraction", "Charset"})
    assert get("Fraction")(1, 2) == 0.5 and get("Charset") == 3
    assert vars(package)["Charset"] == 3
    with pytest.raises(AttributeError, match=r"'email' has no attribute 'Nothing'"):
        get("Nothing")
