"""The logo is what its script draws."""

from __future__ import annotations

import re
import xml.etree.ElementTree

import numpy as np

from tests.documentation.pages import ROOT
from tests.modules import load

IMAGES = ROOT / "docs" / "images"


LOGO = load(ROOT / "docs" / "logo.py")


def test_the_gradient_is_that_of_the_motion() -> None:
    """F = dx/dX by central differences; the motion is quadratic, so that they are exact to rounding."""
    X = np.array([[0.3, -0.2], [-0.7, 0.4], [0.0, 0.9]])
    h = 1e-3
    _, F = LOGO.bend(X)
    for k in range(2):
        forth, back = LOGO.bend(X + h * np.eye(2)[k])[0], LOGO.bend(X - h * np.eye(2)[k])[0]
        np.testing.assert_allclose(F[:, :, k], (forth - back) / (2.0 * h), atol=1e-12)


def test_images_are_what_the_script_writes(tmp_path, monkeypatch) -> None:
    """Both files are SVG and equal what is drawn anew, to the last digit that is written."""
    monkeypatch.setattr(LOGO, "IMAGES", tmp_path)
    LOGO.main()
    for name in ("logo.svg", "favicon.svg"):
        kept, drawn = (IMAGES / name).read_text(), (tmp_path / name).read_text()
        assert xml.etree.ElementTree.fromstring(kept).tag == "{http://www.w3.org/2000/svg}svg"
        numbers = [np.array(re.findall(r"-?\d+\.?\d*", text), dtype=float) for text in (kept, drawn)]
        np.testing.assert_allclose(*numbers, atol=1.0)  # angles are whole degrees, places tenths
