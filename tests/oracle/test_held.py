"""Held bodies as users build them, beside finite elements whose mesh ends on the face of the region."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from benchmarks.accuracy_runner import Row, run
from softmode.deformables.build.hold import hold
from softmode.deformables.build.options import BuildOptions
from tests.marks import rest_but
from tests.oracle.held import RATIOS, SOLIDS, TETRAHEDRA, against_elements, build_held

GRAVITY = {("plate, one edge", 0.45): 0.93, ("plate, two edges", 0.45): 0.93, ("helix", 0.45): 0.93}
"""Least work of gravity over that of finite elements; at nu = 0.49 0.9, of all others 0.95."""
CASES = [(name, ratio) for name in SOLIDS for ratio in RATIOS.get(name, (0.3, 0.45))]


@pytest.mark.parametrize(("name", "poissons_ratio"), rest_but([("plate, one edge", 0.3)], CASES))
def test_loads_and_frequencies(name: str, poissons_ratio: float) -> None:
    """Gravity along every axis, loads spread over the end, and the first frequencies are those of finite elements."""
    if name in TETRAHEDRA:
        pytest.importorskip("manifold3d", reason="pip install manifold3d")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*space_error", RuntimeWarning)
        body = build_held(name, poissons_ratio)
    works, frequencies = against_elements(body, name, poissons_ratio)
    least = GRAVITY.get((name, poissons_ratio), 0.9 if poissons_ratio > 0.45 else 0.95)
    assert least < works[:3].min() and works[:3].max() < 1.05
    assert np.abs(frequencies[:3] - 1.0).max() < 0.06
