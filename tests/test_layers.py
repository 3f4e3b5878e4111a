"""Rooms stand on floors: imports go down only, and in no circle. Imports inside functions and for types count."""

from __future__ import annotations

import ast
import functools
import graphlib
import tomllib
from importlib.util import resolve_name
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FLOORS = (
    "softmode errors",
    "leftovers interrupts stages",
    "files checks lanes lazy pause quiet vector_check versions",
    "cluster deformables foreign",
    "splats robots mpm",
    "radiance",
    "objects",
    "scenes",
    "envs usd viz",
    "demonstrations fitting learning",
    "view testing",
    "cli",
    "__main__",
)
"""Rooms of the package from the ground; those of one floor do not import each other."""
PARTS = (
    "body materials skinning",
    "quadrature model",
    "reduction",
    "contact",
    "system",
    "potential",
    "newton",
    "solver",
    "coupling",
    "gradients tools",
    "deformables",
)
"""Parts of deformables from the ground; the last is the package's public face."""


@functools.cache
def imports() -> dict[str, set[str]]:
    """Return the modules that each module of the package imports."""
    files = {path: path.relative_to(ROOT).with_suffix("").parts for path in (ROOT / "softmode").rglob("*.py")}
    names = {path: ".".join(parts).removesuffix(".__init__") for path, parts in files.items()}
    found: dict[str, set[str]] = {}
    for path, name in names.items():
        targets = []
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                package = name if path.stem == "__init__" else name.rpartition(".")[0]
                start = resolve_name("." * node.level + (node.module or ""), package)
                targets += [(f"{start}.{alias.name}", start) for alias in node.names]
            elif isinstance(node, ast.Import):
                targets += [(alias.name, alias.name) for alias in node.names]
        modules = {longer if longer in names.values() else shorter for longer, shorter in targets}
        found[name] = {module for module in modules if module.partition(".")[0] == "softmode"} - {name}
    return found


def upward(arrows: dict[str, set[str]], floors: tuple[str, ...], depth: int, within: str) -> list[str]:
    """Return the imports that do not go down, between the rooms that module names have at a depth."""
    floor = {room: k for k, rooms in enumerate(floors) for room in rooms.split()}

    def room(module: str) -> str:
        """Return the room of a module; a package itself is its own face."""
        parts = module.split(".")
        return parts[min(depth, len(parts) - 1)]

    return [
        f"{start} -> {end}"
        for start, ends in sorted(arrows.items())
        for end in sorted(ends)
        if start.startswith(within) and end.startswith(within) and room(start) != room(end)
        if floor[room(start)] <= floor[room(end)]
    ]


def test_imports_go_down() -> None:
    """A room imports rooms of lower floors only, so that there is no circle of rooms, and nothing imports `cli`."""
    assert not upward(imports(), FLOORS, 1, "softmode")


def test_imports_go_down_within_deformables() -> None:
    """The parts of the core stand on each other in the order of the method."""
    assert not upward(imports(), PARTS, 2, "softmode.deformables")


def test_modules_form_no_circle() -> None:
    """There is an order in which every module comes after all that it imports."""
    arrows = dict(imports())
    circles = []
    while True:
        try:
            graphlib.TopologicalSorter(arrows).prepare()
            break
        except graphlib.CycleError as error:
            circle = error.args[1]
            circles.append(" <- ".join(circle))
            arrows[circle[1]] = arrows[circle[1]] - {circle[0]}
    assert not circles


def test_arrows_up_and_circles_are_seen() -> None:
    """The rules find an arrow up, one between neighbours, and leave those down and within a room alone."""
    arrows = {
        "softmode.splats.a": {"softmode.foreign.b", "softmode.splats.c", "softmode.robots", "softmode.cli.main"},
        "softmode.deformables": {"softmode.deformables.solver.x"},
        "softmode.deformables.solver.x": {"softmode.deformables", "softmode.deformables.body.y"},
    }
    assert upward(arrows, FLOORS, 1, "softmode") == [
        "softmode.splats.a -> softmode.cli.main",
        "softmode.splats.a -> softmode.robots",
    ]
    assert upward(arrows, PARTS, 2, "softmode.deformables") == ["softmode.deformables.solver.x -> softmode.deformables"]


def test_every_module_is_on_a_floor() -> None:
    """Every file and folder of the package, and every part of deformables, has its floor."""
    for folder, floors in ((ROOT / "softmode", FLOORS), (ROOT / "softmode" / "deformables", PARTS)):
        found = {path.stem for path in folder.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
        assert found - {"__init__"} | {folder.name} == set(" ".join(floors).split())


def test_device_code_is_known_by_its_name() -> None:
    """pyproject.toml tells device code by patterns, and lists no file."""
    tool = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
    entries = [*tool["pyright"]["ignore"], *tool["ruff"]["lint"]["per-file-ignores"]]
    assert not [entry for entry in entries if entry.endswith(".py") and "*" not in entry]
