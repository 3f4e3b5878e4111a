"""The bodies of the tests are what their recipes say, and no others are built without a reason."""

from __future__ import annotations

import ast
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from softmode.deformables.body.reduced_body import ReducedBody

TESTS = Path(__file__).resolve().parent


@pytest.mark.parametrize("name", ["cube", "clamped"])
def test_two_builds_give_the_same_bits(name: str) -> None:
    """A body from the cache, which another process may have built, is to the bit the one that is built anew."""
    from tests import bodies

    kept: ReducedBody = bodies.BODIES[name]()
    again = bodies.RECIPES[name]().build()
    for field in dataclasses.fields(kept):
        one, other = getattr(kept, field.name), getattr(again, field.name)
        if field.name == "sources":
            assert one.keys() == other.keys() and all(np.array_equal(one[key], other[key]) for key in one)
        elif field.name == "provenance":  # all but the clock
            assert {k: v for k, v in one.items() if not k.startswith("seconds_")} == {
                k: v for k, v in other.items() if not k.startswith("seconds_")
            }
        elif field.name != "build_seconds":
            np.testing.assert_array_equal(one, other, err_msg=field.name)


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
