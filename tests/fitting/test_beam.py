"""The real beam of silicone: E from its sag, from its motion, and loads that the fit has not seen.

Builds the beam with its clamp, 3,000 samples for the load at its tip.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from softmode.deformables import Material
from softmode.errors import ConfigError, FitError
from softmode.fitting.holding import Held, held_object
from softmode.fitting.marker_fit import MarkerFit, MarkerPlaces, fit_markers
from softmode.fitting.tables import read_markers
from softmode.objects import load
from softmode.splats.colored_mesh import ColoredMesh

DATA = Path(__file__).parent / "silicone_beam"
AUTHORS = 263_824.0
"""E that the authors of the measurement found [Pa]."""
LOADS = {"load_52g": 0.51012, "load_102g": 1.00062}
"""Loads at the tip [N]."""
PLACES = MarkerPlaces(
    points={"m0": (0.055, 0.0, 0.03), "m1": (0.055, -0.015, 0.024), "m2": (0.055, 0.015, 0.006)},
    axes=("+z", "-y", "+x"),
)


@pytest.mark.rest
def test_beam() -> None:
    """E from the sag is within 6 % of the authors', larger in motion, as silicone is; unseen loads within 8 %.

    No single E serves the three loads better than about 3 %: each alone gives another, by 7 %.
    """
    made = Material(poissons_ratio=0.49, density=1070.0)
    mesh = ColoredMesh.from_trimesh(trimesh.creation.box((0.11, 0.03, 0.03)))
    beam = load(mesh, size=0.11, pose="captured", surface_count=3000, splat_count=200, material=made)
    thing = held_object(beam, Held.parse("-x:0.01"))
    found = fit_markers(thing, read_markers(DATA / "own_weight_1.csv"), PLACES, material=made)
    still, moving = found["youngs_modulus"].value, found["youngs_modulus_in_motion"].value
    assert still == pytest.approx(AUTHORS, rel=0.06)
    assert 1.02 < moving / still < 1.12 and any("stiffer in motion" in note for note in found.notes)
    assert 1.5e-3 < found["viscosity"].value < 4e-3
    for name, ways in json.loads((DATA / "loads.json").read_text()).items():
        places = replace(PLACES, load=(0.0, 0.0, -LOADS[name]), load_at=(0.055, 0.0, 0.03))
        sag = MarkerFit(thing, places, material=made).sag(still)[0, :, 2].mean()
        assert sag == pytest.approx(np.mean(ways, axis=(0, 1))[0], rel=0.08)  # gravity is -x in the capture
    with pytest.raises(ConfigError, match="m0 lies"):
        MarkerFit(thing, replace(PLACES, points={"m0": (0.2, 0.0, 0.0)}), material=made)
    with pytest.raises(FitError, match="no marker m9"):
        fit_markers(
            thing,
            read_markers(DATA / "own_weight_1.csv"),
            replace(PLACES, points={"m9": (0.055, 0.0, 0.03)}),
            material=made,
        )
