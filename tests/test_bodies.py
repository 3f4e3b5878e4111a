"""The bodies of the tests are what their recipes say, and no others are built without a reason."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from softmode.deformables.body.reduced_body import ReducedBody

TESTS = Path(__file__).resolve().parent


@pytest.mark.parametrize("name", ["cube", "clamped"])
def test_two_builds_give_the_same_bits(name: str) -> None:
    """A body from the cache, which another process may have built, is to the bit the one that is built anew."""
    from tests import bodies

    kept: ReducedBody = bodies.BODIES[name]()
    again = bodies.RECIPES[name]().build()
    bodies.assert_same(kept, again, skip=("provenance", "build_seconds"))
    told = [{k: v for k, v in body.provenance.items() if not k.startswith("seconds_")} for body in (kept, again)]
    assert told[0] == told[1]  # all but the clock


def builds_bodies(tree: ast.Module) -> bool:
    """Return whether a file calls what builds a body."""
    names = {"build_body", "build_object"}
    calls = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
    return any(getattr(call, "id", getattr(call, "attr", None)) in names for call in calls)


def test_every_other_body_has_its_reason() -> None:
    """A file that builds bodies of its own says why in a paragraph of its docstring that begins with "Builds"."""
    trees = {path: ast.parse(path.read_text()) for path in TESTS.rglob("*.py")}
    silent = [
        path.relative_to(TESTS).as_posix()
        for path, tree in trees.items()
        if builds_bodies(tree) and "\n\nBuilds " not in (ast.get_docstring(tree) or "") and path.stem != "bodies"
    ]
    assert not silent, "take a body of tests/bodies.py, or say why another is needed"
