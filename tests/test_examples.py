"""Every example runs: each file of examples/ in its own process, forked from one that has imported the simulator."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.program_server import ProgramServer

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
NEEDS = {
    "behaviour_cloning": "torch",
    "train_cleanrl": "torch",
    "train_field": "torch",
    "train_own_toy": "torch",
    "train_rsl_rl": "rsl_rl",
    "train_sb3": "stable_baselines3",
    "train_skrl": "skrl",
    "rerun_episode": "rerun",
    "usd_in_usd_out": "pxr",
}
"""Optional packages of examples; the others run with the extras demo, data and robots."""

NEWTONS = {"newton_example": ("--viewer", "null", "--test", "--num-frames", "180")}
"""Examples in the shape of Newton's own, which ``newton.examples.run`` runs; the others take ``--short``."""


IMPORTED = (
    *("newton", "mujoco_warp", "networkx", "PIL.Image"),
    *("softmode.scenes.splat_scene", "softmode.scenes.table_scene", "softmode.objects.loader", "softmode.viz.film"),
    *("softmode.envs.soft_vector_env", "softmode.envs.scripted", "softmode.envs.tasks.lift_soft.task"),
)
"""What nearly all of them import at last: 12 of the 21 s of processor time that an example takes on its own."""

ROOMS = {
    "deformables": "newton_example",
    "splats": "deform_splats",
    "robots": "robot_by_name",
    "mpm": "morph_topology",
    "radiance": "radiance_field",
    "objects": "jelly_squeeze",
    "scenes": "drop_a_splat",
    "envs": "lift_a_toy",
    "usd": "usd_in_usd_out",
    "viz": "rerun_episode",
    "demonstrations": "record_and_replay",
    "learning": "behaviour_cloning",
}
"""The cheapest example of each room, which every test run plays; the others play with the rest."""

SLOW = {"train_own_toy", "plinko"}
"""One checks, trains, evaluates and films by four commands, as test_cli_objects.py does one at a time: 80 s. The other
has eighteen toys where `toys_in_container` has thirteen."""


def test_there_are_examples():
    """The folder is where this file looks for it, and so are those that it names; each room's example imports it."""
    assert {path.stem for path in EXAMPLES} >= {*NEEDS, *NEWTONS, *SLOW}
    for room, name in ROOMS.items():
        assert re.search(rf"softmode(?:\.| import ){room}\b", (ROOT / "examples" / f"{name}.py").read_text()), name


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_reads_well(path: Path):
    """A header with the command, a test_final that main calls, at most 120 lines, no work on import."""
    text = path.read_text()
    tree = ast.parse(text)
    assert f"python examples/{path.name}" in (ast.get_docstring(tree) or "")
    assert "def test_final" in text and (text.count("test_final(") >= 2 or "newton.examples.run(" in text)
    assert len(text.splitlines()) <= 120
    allowed = (ast.Import, ast.ImportFrom, ast.FunctionDef, ast.ClassDef, ast.Assign, ast.AnnAssign, ast.Expr, ast.If)
    assert all(isinstance(node, allowed) for node in tree.body)
    guards = [ast.unparse(node.test) for node in tree.body if isinstance(node, ast.If)]
    assert guards == ["__name__ == '__main__'"]
    # the process that runs it has registered the environments already
    assert "gym.make" not in text or re.search(r"^(?:import|from) softmode", text, re.MULTILINE)


@pytest.fixture(scope="module")
def server() -> Iterator[ProgramServer]:
    """Return what runs programs."""
    with ProgramServer(*IMPORTED) as started:
        yield started


def _marks(name: str) -> list[pytest.MarkDecorator]:
    """Return what keeps an example out of a short run."""
    return [pytest.mark.slow] if name in SLOW else [] if name in ROOMS.values() else [pytest.mark.rest]


@pytest.mark.parametrize(
    "path", [pytest.param(path, marks=_marks(path.stem)) for path in EXAMPLES], ids=lambda path: path.stem
)
def test_example_runs(path: Path, server: ProgramServer, tmp_path: Path):
    """The short version ends without error; its test_final asserts the physics."""
    if path.stem in NEEDS:
        pytest.importorskip(NEEDS[path.stem])
    done = server.run(path, NEWTONS.get(path.stem, ("--short",)), tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.strip()
