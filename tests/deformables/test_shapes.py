"""Objects of very different form: builds against exact moments, pulls against finite elements, falls in pieces.

Builds bodies of many shapes: the build has to stand all of them.
"""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from tests.marks import rest_but
from tests.shape_trials import Voxels, base_of, drop, solve_reference, try_build, try_pull, voxelise
from tests.shapes import SHAPES

FAST = ("plate 40:1", "torus", "L-shape", "star", "helix", "letters on a rule", "hollow sphere", "L-shape, points")
"""A form of every kind: sheet, ring, corner, spikes, coil, edges, cavity, cloud."""
SMALL = BuildOptions(mode_count=4, kernel_count=200, cubature_count=128)


@pytest.mark.parametrize("name", rest_but(["plate 40:1"], FAST))
def test_small_build_meets_exact_moments(name: str) -> None:
    """Volume, centre and second moments of a build are the object's; M = mass * 1; nothing is NaN."""
    trial = try_build(SHAPES[name], SMALL, point_count=3000)
    assert not trial.problems(SHAPES[name]), trial


@pytest.mark.slow
@pytest.mark.parametrize("name", SHAPES)
def test_build_meets_exact_moments(name: str) -> None:
    """The same at the default size, for every shape."""
    trial = try_build(SHAPES[name], BuildOptions())
    assert not trial.problems(SHAPES[name]), trial


@pytest.mark.parametrize("name", [name for name in SHAPES if SHAPES[name].source != "implicit" and name in FAST])
def test_meshes_are_closed(name: str) -> None:
    """A shape's mesh is watertight, oriented outward and one metre long."""
    mesh = trimesh.Trimesh(*SHAPES[name].geometry(), process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0.0
    assert 0.5 <= np.ptp(mesh.vertices, axis=0).max() <= 1.05


@pytest.mark.parametrize(
    ("static_responses", "gravity", "pull"), rest_but([(True, 0.97, 0.9)], [(True, 0.97, 0.9), (False, 0.8, 0.7)])
)
def test_pull_against_finite_elements(static_responses: bool, gravity: float, pull: float) -> None:
    """A cube held at its base: the work of the loads is nearly that of FEM and not more, nearest with responses."""
    voxels = voxelise(SHAPES["cube"], 3)
    quadrature = voxels.quadrature(3000)
    loads = solve_reference(voxels, quadrature)
    options = BuildOptions(mode_count=4, kernel_count=200, cubature_count=None, static_responses=static_responses)
    body = build_body(quadrature, options, regions=(base_of(voxels),), progress=False)
    trial = try_pull("cube", voxels, loads, body)
    assert not trial.problems(), trial
    assert trial.gravity > gravity and trial.pull > pull


def test_reference_agrees_with_a_column_under_its_own_weight() -> None:
    """FEM: int rho u dV = A rho^2 g h^3 / (3 E), less what the held base confines, of the order of nu^2 edge / h."""
    edge, height, density, modulus, nu = 0.125, 1.0, 1000.0, 1.0e5, 0.4
    lines = (np.linspace(0.0, edge, 3), np.linspace(0.0, edge, 3), np.linspace(-edge, height, 10))
    voxels = Voxels(lines=lines, filled=np.ones((2, 2, 9), dtype=bool), axis=2)
    quadrature = voxels.quadrature(500)
    assert quadrature.volume == pytest.approx(edge**2 * (height + edge), rel=1e-12)
    found = solve_reference(voxels, quadrature, direction=(0.0, 0.0, 1.0)).gravity
    exact = edge**2 * density**2 * height**3 / (3.0 * modulus)
    assert 1.0 - 2.0 * nu**2 * edge / height < found / exact < 1.0


def test_pieces_fall_freely() -> None:
    """A body in eight pieces has no force between them that gravity could excite."""
    body = build_body(SHAPES["scattered balls"].quadrature(1500, 100), SMALL, progress=False)
    assert drop(body, steps=5) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, shape in SHAPES.items() if shape.connected])
def test_pull(name: str) -> None:
    """Every voxel relative: never softer than finite elements, not absurdly stiff, and at rest under a large load."""
    voxels = voxelise(SHAPES[name], 8)
    quadrature = voxels.quadrature()
    loads = solve_reference(voxels, quadrature)
    body = build_body(quadrature, BuildOptions(), regions=(base_of(voxels),), progress=False)
    trial = try_pull(name, voxels, loads, body)
    assert not trial.problems(), trial
    assert min(trial.gravity, trial.pull) > 0.35, trial


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, shape in SHAPES.items() if not shape.connected])
def test_all_pieces_fall_freely(name: str) -> None:
    """The same at the default size, for every shape in pieces."""
    assert drop(build_body(SHAPES[name].quadrature(), BuildOptions(), progress=False)) < 1e-6
