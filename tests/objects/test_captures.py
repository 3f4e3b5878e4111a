"""Captures of known solids: do they come out whole?"""

from __future__ import annotations

import numpy as np
import pytest

from tests.captures import CAPTURES, SHELLS, render_shell

EXACT = {
    "sphere": 4.0 / 3.0 * np.pi * 0.04**3,
    "torus": 2.0 * np.pi**2 * 0.03 * 0.01**2,
    "slab": 0.08**2 * 0.01,
    "cup": np.pi * (0.03**2 * 0.08 - 0.026**2 * 0.076),
    "bowl": 2.0 / 3.0 * np.pi * (0.04**3 - 0.035**3),
    "plate": 0.08**2 * 0.002,
    "ring": 2.0 * np.pi**2 * 0.0375 * 0.0025**2,
    "tube": np.pi * (0.015**2 - 0.011**2) * 0.08,
}


@pytest.mark.parametrize("name", SHELLS)
def test_shells_are_what_they_say(name: str) -> None:
    """The counted volume is the closed form's; splats lie on the surface with the scatter that was asked for."""
    solid = SHELLS[name]()
    assert solid.volume == pytest.approx(EXACT[name], rel=4e-3)
    splats = render_shell(solid, 3000, jitter=1e-4)
    away = solid.level(splats.means.astype(np.float64))
    assert np.std(away) == pytest.approx(1e-4, rel=0.1) and abs(away.mean()) < 1e-5
    assert (splats.means.min(axis=0) > solid.bounds[0] - 6e-4).all()
    np.testing.assert_allclose(np.ptp(splats.means, axis=0), np.ptp(solid.bounds, axis=0), atol=1.5e-3)


def test_every_capture_holds_its_object() -> None:
    """In the units of the file some splats lie within a millimetre of every side of the object."""
    for name, capture in CAPTURES.items():
        if name == "dense":
            continue
        splats = capture.scene().oriented(capture.options.get("up", "+z"))
        unit = 1000.0 if name == "millimetres" else 1.0
        low, high = capture.solid().bounds
        means = splats.means / unit
        if "mirrored" in name:
            continue
        inside = means[((means > low - 1e-3) & (means < high + 1e-3)).all(axis=1)]
        assert len(inside) > 900, name
        np.testing.assert_allclose(np.stack([inside.min(axis=0), inside.max(axis=0)]), [low, high], atol=2e-3)
