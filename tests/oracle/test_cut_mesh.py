"""Elements that a mesh cuts: moments, uniform stretch, a turned box beside elements that follow its faces."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.oracle.cut_mesh import CutMesh
from tests.oracle.fem import Mesh, Minimiser, Solid

Array = NDArray[np.float64]

SIZE = np.array([1.0, 0.5, 0.4])
TURN = Rotation.from_rotvec([0.4, 0.7, 0.2]).as_matrix()
KAPPA, LOAD = 1.0e6, np.array([0.0, 2.0, -3.0])
"""Springs per volume of the part x < 0.2 [N/m^4], and gravity [m/s^2]."""


def box_mesh() -> tuple[Array, NDArray[np.int64]]:
    """Return a box whose lower corner is the origin."""
    box = trimesh.creation.box(extents=SIZE)
    return np.asarray(box.vertices) + 0.5 * SIZE, np.asarray(box.faces)


def test_moments_are_those_of_the_mesh() -> None:
    """Of a ball: sum w = V, sum w x = V c, sum w x x^T, to the rays' 1e-3, with positive weights."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    ball.apply_translation([0.3, 0.1, -0.2])
    mesh = CutMesh(ball.vertices, ball.faces, 5)
    assert (mesh.weights >= 0.0).all() and (mesh.fill < 1.0).any() and (mesh.fill > 1.0 - 1e-9).any()
    weight, points = mesh.weights.ravel(), mesh.points.reshape(-1, 3)
    assert weight.sum() == pytest.approx(ball.volume, rel=1e-3)
    centre = weight @ points / weight.sum()
    np.testing.assert_allclose(centre, ball.center_mass, atol=1e-3)
    second = (weight[:, None] * (points - centre)).T @ (points - centre)
    expected = np.asarray(ball.moment_inertia)
    np.testing.assert_allclose(second, 0.5 * np.trace(expected) * np.eye(3) - expected, atol=2e-3 * second.max())


def test_a_box_has_whole_elements() -> None:
    """Where faces follow the grid, elements are those of `Mesh`."""
    cut = CutMesh(*box_mesh(), 5)
    lines = tuple(np.linspace(0.0, size, n + 1) for size, n in zip(SIZE, (5, 2, 2), strict=True))
    plain = Mesh(lines, np.ones((5, 2, 2), bool))  # type: ignore[arg-type]
    assert (cut.fill > 1.0 - 1e-9).all()
    tangents = [Solid(mesh, youngs_modulus=1e5, poissons_ratio=0.4).tangent(mesh.nodes) for mesh in (cut, plain)]
    np.testing.assert_allclose(tangents[0], tangents[1], rtol=1e-9, atol=1e-9 * np.abs(tangents[1]).max())
    assert cut.membrane(1e5).nnz == 0 or np.abs(cut.membrane(1e5)).max() == 0.0


def test_uniform_stretch_has_its_energy() -> None:
    """U(x = A X) = V Psi(A) with the mesh's own volume."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    mesh = CutMesh(ball.vertices, ball.faces, 4)
    solid = Solid(mesh, youngs_modulus=1e5, poissons_ratio=0.4)
    A = np.array([[1.2, 0.1, 0.0], [0.0, 0.9, 0.2], [0.1, 0.0, 1.1]])
    one = solid.energy.value(np.broadcast_to(A, (*mesh.weights.shape, 3, 3)))[0, 0]
    assert solid.potential(mesh.nodes @ A.T) == pytest.approx(mesh.weights.sum() * one, rel=1e-9)


def sagged(mesh: Mesh, turn: Array) -> Array:
    """Return the displacement of four points of a box held by springs, turned back."""
    solid = Solid(mesh, youngs_modulus=1e5, poissons_ratio=0.4)
    rest = np.stack(np.meshgrid([0.05, 0.15], np.linspace(0.05, 0.45, 5), np.linspace(0.05, 0.35, 4)), axis=-1)
    rest = rest.reshape(-1, 3)
    at = mesh.interpolation(rest @ turn.T)
    springs = at.T @ at * (KAPPA * 0.2 * SIZE[1] * SIZE[2] / len(rest))
    membrane = mesh.membrane(1e5) if isinstance(mesh, CutMesh) else 0.0 * springs
    minimise = Minimiser(solid, springs + membrane, np.zeros(len(mesh.nodes), bool))
    load = solid.body_force(turn @ LOAD) + (springs + membrane) @ mesh.nodes
    x, _ = minimise(mesh.nodes, load, 1e-6)
    points = np.array([[0.5, 0.25, 0.2], [0.95, 0.1, 0.1], [0.95, 0.4, 0.3], [0.7, 0.4, 0.1]])
    return mesh.interpolation(points @ turn.T) @ (x - mesh.nodes) @ turn


def test_a_turned_box_sags_as_a_straight_one() -> None:
    """Under gravity that turns with it, to 2 %: what so few elements differ by."""
    vertices, faces = box_mesh()
    lines = tuple(np.linspace(0.0, size, n + 1) for size, n in zip(SIZE, (5, 3, 2), strict=True))
    straight = sagged(Mesh(lines, np.ones((5, 3, 2), bool)), np.eye(3))  # type: ignore[arg-type]
    turned = sagged(CutMesh(vertices @ TURN.T, faces, 5), TURN)
    assert np.abs(straight).max() > 0.03
    np.testing.assert_allclose(turned, straight, atol=0.02 * np.abs(straight).max())


def test_an_open_mesh_is_refused() -> None:
    """Without a triangle of its top, a ray enters it and does not leave."""
    vertices, faces = box_mesh()
    top = (vertices[faces][:, :, 2] > 0.9 * SIZE[2]).all(axis=1)
    with pytest.raises(ValueError, match="close it"):
        CutMesh(vertices, np.delete(faces, np.flatnonzero(top)[0], axis=0), 4)
