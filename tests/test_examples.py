"""Every example runs: each file of examples/ in its own process."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
NEEDS = {
    "behaviour_cloning": "torch",
    "train_cleanrl": "torch",
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


def test_there_are_examples():
    """The folder is where this file looks for it."""
    assert EXAMPLES


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


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(path: Path, tmp_path: Path):
    """The short version ends without error; its test_final asserts the physics."""
    if path.stem in NEEDS:
        pytest.importorskip(NEEDS[path.stem])
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, str(path), *NEWTONS.get(path.stem, ("--short",))],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.strip()
