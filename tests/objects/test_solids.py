"""Solids to morph between: volumes, splats on the surface, one volume for all, bad names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from softmode.errors import AssetError
from softmode.objects.solids import filled, solid_names, solid_of
from tests.marks import rest_but


@pytest.mark.parametrize(
    ("name", "volume"),
    [
        ("sphere", np.pi / 6.0),
        ("torus", 2.0 * np.pi**2 * 0.345 * 0.155**2),
        ("cylinder", np.pi * 0.35**2),
    ],
)
def test_closed_forms(name: str, volume: float) -> None:
    """Volumes are those of geometry to 1 %, and splats lie on the surface to a hundredth of the size."""
    solid = solid_of(name)
    assert solid.volume == pytest.approx(volume, rel=0.01)
    normals = solid.splats.covariances()[:, :, :]
    assert normals.shape == (solid.splats.count, 3, 3)
    inner = solid.inside(0.97 * solid.splats.means.astype(np.float64))
    outer = solid.inside(1.03 * solid.splats.means.astype(np.float64))
    assert not outer.all() and inner.mean() > outer.mean()
    if name == "sphere":
        assert np.linalg.norm(solid.splats.means, axis=1) == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("name", rest_but(["star", "A"], ["duck", "cow", "car", "star", "A", "8"]))
def test_shapes_are_one_solid(name: str) -> None:
    """The particles of a shape hang together, fill it, and have its mass."""
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    solids, bodies = filled([solid_of(name)], spacing=None, count=3000)
    assert bodies[0].count == pytest.approx(3000, rel=0.1)
    assert bodies[0].mass == pytest.approx(bodies[0].material.density * solids[0].volume)
    near = KDTree(bodies[0].positions).sparse_distance_matrix(
        KDTree(bodies[0].positions), 1.1 * (solids[0].volume / 3000) ** (1.0 / 3.0)
    )
    assert connected_components(near, directed=False)[0] == 1


def test_files_and_names_have_one_volume(tmp_path: Path) -> None:
    """A mesh file and a shape are scaled to one volume; the mesh's particles are inside of it."""
    file = tmp_path / "egg.ply"
    mesh = trimesh.creation.icosphere(subdivisions=3)
    mesh.vertices *= [0.01, 0.01, 0.015]
    mesh.export(file)
    solids, bodies = filled([solid_of(file), solid_of("box")], spacing=None, count=2000)
    assert bodies[0].mass == pytest.approx(bodies[1].mass, rel=1e-6)
    low, high = solids[0].bounds
    at = (bodies[0].positions - 0.5 * (low + high)) / (0.5 * (high - low))
    assert np.linalg.norm(at, axis=1).max() < 1.05
    assert bodies[0].count == pytest.approx(2000, rel=0.1)


def test_bad_names(tmp_path: Path) -> None:
    """What is neither a name nor a file, and a letter that no font has, are named with what there is."""
    with pytest.raises(AssetError, match=r"neither a file nor a name.*sphere"):
        solid_of("spere")
    assert "cow" in solid_names()
    body = tmp_path / "run.npz"
    np.savez(body, header=np.zeros(3, dtype=np.uint8))
    with pytest.raises(AssetError, match="no solid to fill"):
        solid_of(body)
