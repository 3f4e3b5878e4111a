"""Fits of made films, markers and forces: E within what is promised.

Builds a bar and a beam with an end held, of more functions for the truth than for the fit.
"""

from __future__ import annotations

import functools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from softmode.deformables import BuildOptions, Material
from softmode.errors import FitError
from softmode.fitting.film import Clip
from softmode.fitting.film_fit import fit_film
from softmode.fitting.holding import Held, held_object
from softmode.fitting.least_squares import Space, minimise
from softmode.objects import SoftObject, load
from softmode.splats.colored_mesh import ColoredMesh
from tests.fitting.films import Trouble, make_film
from tests.needs import needs

pytestmark = needs("cv2")
TRUE = Material(youngs_modulus=9.0e4, viscosity=5.0e-3, poissons_ratio=0.35, density=300.0)
HELD = Held.parse("-x:0.03")


@functools.cache
def bar(functions: int) -> SoftObject:
    """Return a coloured bar of 20 x 5 x 4 cm with its first 3 cm held."""
    mesh: Any = trimesh.creation.box((0.2, 0.05, 0.04)).subdivide_to_size(0.012)
    stripes = (40 + 180 * (np.sin(90 * mesh.vertices[:, :1] + [0, 2, 4]) > 0)).astype(np.uint8)
    mesh.visual.vertex_colors = np.hstack([stripes, np.full((len(stripes), 1), 255, np.uint8)])
    made = BuildOptions(function_count=functions, kernel_count=300, cubature_count=128)
    told = {"size": 0.2, "splat_count": 1200, "surface_count": 120, "pose": "captured"}
    return held_object(load(ColoredMesh.from_trimesh(mesh), build=made, material=TRUE, **told), HELD)


def test_film(tmp_path: Path) -> None:
    """E is within two bars and 8 % of the truth with all troubles at once, and comes back with the twin's file.

    A fit that was cut off goes on where it was, and ends with the same bits.
    """
    frames, plate, camera = make_film(bar(36), TRUE, Trouble(), seed=5, seconds=0.6, size=96)
    clip = Clip(frames=frames, times=np.arange(len(frames)) / 30.0)
    thing = bar(24)
    unknown = replace(TRUE, youngs_modulus=1.0e5, viscosity=0.0)
    found, residuals, _ = fit_film(thing, clip, camera, material=unknown, plate=plate)
    modulus = found["youngs_modulus"]
    error = np.log(modulus.value / TRUE.youngs_modulus)
    assert modulus.observable and abs(error) < min(0.08, 2.0 * np.log(modulus.high / modulus.value))
    assert len(residuals.tracks) > 5 and found.details["followed"] > 0.8
    found.write(tmp_path / "fit.json")
    told = json.loads((tmp_path / "fit.json").read_text())
    assert set(told["parameters"]["viscosity"]) == {"value", "low", "high", "observable", "unit", "reason"}
    found.save(tmp_path / "toy.npz", thing)
    again = load(tmp_path / "toy.npz")
    assert again.material is not None and again.material.youngs_modulus == pytest.approx(modulus.value)
    assert json.loads(str(again.body.provenance["fit_bars"]))["youngs_modulus"] == [modulus.low, modulus.high]

    def cut(stage: str, fraction: float) -> None:
        if stage == "fitting with tracks":
            raise KeyboardInterrupt

    part = tmp_path / "part.json"
    with pytest.raises(KeyboardInterrupt):
        fit_film(thing, clip, camera, material=unknown, plate=plate, keep=part, progress=cut)
    gone_on, late, _ = fit_film(thing, clip, camera, material=unknown, plate=plate, keep=part)
    assert gone_on.estimates == found.estimates and not part.exists()
    assert late.worlds.steps < 0.6 * residuals.worlds.steps
    with pytest.raises(FitError, match="overlap"):
        aside = replace(camera, position=(camera.position[0] + 1.0, *camera.position[1:]))
        fit_film(thing, clip, aside, material=unknown, plate=plate)


def test_least_squares() -> None:
    """A line's two numbers come out with the deviations of the normal equations, whatever a far start says."""
    r = np.random.default_rng(3)
    t = np.linspace(0.0, 1.0, 200)
    seen = 2.0 + 3.0 * t + r.normal(size=200)
    wide, one = np.full(2, 100.0), np.ones(2)
    space = Space(names=("a", "b"), mean=0 * one, prior=wide, step=0.1 * one, low=-50 * one, high=50 * one)

    def residuals(sets: np.ndarray) -> np.ndarray:
        return sets[:, :1] + sets[:, 1:] * t - seen

    found = minimise(residuals, space, np.array([20.0, -20.0]), ("a", "b"), rounds=30)
    design = np.stack([np.ones(200), t], axis=1)
    spread = np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    deviations = found.deviations(np.array_split(np.arange(200), 20))
    assert (np.abs(found.x - [2.0, 3.0]) < 3.0 * spread).all()
    assert (deviations > 0.8 * spread).all() and (deviations < 2.5 * spread).all()
