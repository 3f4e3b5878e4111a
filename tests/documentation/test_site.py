"""The site builds offline without a warning, and shows what it should."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.documentation.pages import ROOT

BUILD = """
import sys
import furo
from sphinx.cmd.build import main
furo._compute_navigation_tree = lambda context: ""
sys.exit(main(sys.argv[1:]))
"""
"""Sphinx without the tree of all pages beside each of 237, which `make docs` draws: it is half of the time."""


def test_nothing_is_fetched() -> None:
    """No option of the site refers to another machine; inventories of other projects are files of the repository."""
    assert "http" not in (ROOT / "docs" / "conf.py").read_text()
    assert len(list((ROOT / "docs" / "inventories").glob("*.inv"))) >= 5


def test_formulas_are_understood() -> None:
    """Every formula of the method is one that docutils can write as MathML."""
    latex = pytest.importorskip("docutils.utils.math.latex2mathml", reason="needs the extra [docs]")
    text = (ROOT / "docs" / "method.md").read_text()
    blocks = re.findall(r"^\$\$\n(.*?)^\$\$$", text, re.M | re.S)
    lines = re.findall(r"(?<!\$)\$(?!\$)([^$\n]+)\$", re.sub(r"^\$\$\n.*?^\$\$$", "", text, flags=re.M | re.S))
    assert len(blocks) >= 8 and len(lines) >= 20
    for formula in (*blocks, *lines):
        assert latex.tex2mathml(formula, as_block=formula in blocks).startswith("<math"), formula


@pytest.mark.sphinx
def test_the_site_builds(tmp_path: Path) -> None:
    """`make docs`: no warning, a page per source, formulas as MathML, and no script or style from elsewhere."""
    for module in ("sphinx", "furo", "myst_parser"):
        pytest.importorskip(module, reason="needs the extra [docs]")
    command = [sys.executable, "-c", BUILD, "--fail-on-warning", "--keep-going", "-q", "-b", "html"]
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "http_proxy": "http://127.0.0.1:9",
        "https_proxy": "http://127.0.0.1:9",
    }
    done = subprocess.run(
        [*command, str(ROOT / "docs"), str(tmp_path)], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    for page in (ROOT / "docs").rglob("*.md"):
        assert (tmp_path / page.relative_to(ROOT / "docs").with_suffix(".html")).is_file()
    method = (tmp_path / "method.html").read_text()
    assert method.count("<math") > 10 and "ERROR" not in method
    reference = (tmp_path / "api" / "deformables.html").read_text()
    for name in (
        "softmode.deformables.build_body",
        "softmode.deformables.SolverReduced.step",
    ):
        assert f'id="{name}"' in reference
    assert reference.count("[source]") > 40 and '<table class="autosummary' in reference
    for html in tmp_path.rglob("*.html"):
        assert not re.search(r"<(?:script|link)[^>]+(?:src|href)=\"https?:", html.read_text()), html
