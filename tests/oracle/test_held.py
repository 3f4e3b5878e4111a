"""Held bodies as users build them, beside finite elements whose mesh ends on the face of the region."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest

from tests.marks import rest_but
from tests.oracle.held import STORED, TETRAHEDRA, against_elements, build_held

RATIOS = (0.3, 0.49)
"""Poisson's ratios of the tests; ``python -m benchmarks.modes --held`` has what lies between."""
CASES = [
    (name, float(ratio))
    for name, ratios in json.loads(STORED.read_text()).items()
    for ratio in ratios
    if float(ratio) in RATIOS
]


REST = {(name, 0.3) for name in ("plate, two edges", "spiral, points", "ribbon", "Y", "hand")}
"""Cases that `make test-rest` runs: a plate, points, a twist, a branch, a mesh of tetrahedra. The others are slow."""


@pytest.mark.parametrize(
    ("name", "poissons_ratio"), rest_but([("plate, one edge", 0.3)], CASES, slow=set(CASES) - REST)
)
def test_loads_and_frequencies(name: str, poissons_ratio: float) -> None:
    """Gravity along every axis, loads spread over the end, and the first frequencies are those of finite elements."""
    if name in TETRAHEDRA:
        pytest.importorskip("manifold3d", reason="pip install manifold3d")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*(space|driven)_error", RuntimeWarning)
        body = build_held(name, poissons_ratio)
    works, frequencies = against_elements(body, name, poissons_ratio)
    assert 0.95 < works[:3].min() and works[:3].max() < 1.05
    # Loads on a thin lid, and in the plane in the middle between two edges, want more than 48 functions.
    least = {"plate, two edges": 0.91, "hollow box": 0.9}.get(name, 0.95)
    assert least < works[6:].min() and works[6:].max() < 1.05
    assert np.abs(frequencies[:5] - 1.0).max() < 0.05
    if name.startswith("plate"):
        assert abs(frequencies[5] - 1.0) < 0.06
