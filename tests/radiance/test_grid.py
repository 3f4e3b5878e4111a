"""Radiance grids: validation, sampling, transforms, sources and files, which are fuzzed."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from softmode.errors import AssetError, ConfigError
from softmode.radiance import RadianceGrid, read_radiance, write_radiance
from softmode.radiance.formats import is_radiance
from softmode.radiance.grid import DENSITY_LIMIT, sh_of_colors
from softmode.splats import make_plush
from tests.radiance.fields import SIGMA, block, block_field

NODES = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


def small(**changes) -> dict[str, np.ndarray]:
    """Return the arrays of a valid field of 4 x 5 x 6 nodes."""
    density = np.zeros((4, 5, 6))
    density[1:3, 1:4, 2:4] = 100.0
    arrays = {"density": density, "sh": np.zeros((4, 5, 6, 1, 3)), "origin": np.zeros(3), "axes": 0.01 * np.eye(3)}
    return arrays | changes


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"density": np.full((4, 5, 6), np.nan)}, "NaN"),
        ({"density": -small()["density"]}, "negative"),
        ({"density": np.zeros((4, 5, 6))}, "empty"),
        ({"density": np.full((4, 5, 6), 3.0)}, "everywhere"),
        ({"density": np.ones((4, 5))}, "shape"),
        ({"density": np.full((4, 5, 6), "a")}, "no numbers"),
        ({"sh": np.zeros((4, 5, 6, 16, 3))}, "degree 0, 1 or 2"),
        ({"sh": np.zeros((4, 5, 7, 1, 3))}, "shape"),
        ({"sh": np.full((4, 5, 6, 1, 3), np.inf)}, "infinity"),
        ({"axes": np.diag([1.0, 1.0, -1.0])}, "mirror"),
        ({"axes": np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])}, "shear"),
        ({"axes": np.zeros((3, 3))}, "rotation"),
        ({"origin": np.zeros(2)}, "rotation"),
    ],
)
def test_what_is_no_field(changes, word):
    """A field is refused by what is wrong with it."""
    with pytest.raises(AssetError, match=word):
        RadianceGrid(**small(**changes))


def test_too_large(monkeypatch):
    """A field beyond the limit of memory is refused, before its colours are looked at."""
    monkeypatch.setattr("softmode.radiance.grid.NODE_LIMIT", 100)
    with pytest.raises(AssetError, match="lower resolution"):
        RadianceGrid(**small())


def test_density_between_nodes():
    """Trilinear between nodes, exact for a linear field, zero outside; what float16 cannot hold is cut."""
    x, y, z = np.meshgrid(*(np.arange(n, dtype=float) for n in (4, 5, 6)), indexing="ij")
    field = RadianceGrid(**small(density=1.0 + x + 2.0 * y + 3.0 * z))
    points = 0.01 * np.random.default_rng(0).uniform(0.0, 1.0, (50, 3)) * (3, 4, 5)
    np.testing.assert_allclose(field.densities(points), 1.0 + 100.0 * points @ [1.0, 2.0, 3.0], rtol=1e-6)
    np.testing.assert_array_equal(field.densities(NODES - 1.0), 0.0)
    opaque = RadianceGrid(**small(density=1e9 * small()["density"]))
    assert opaque.density.max() == np.float16(DENSITY_LIMIT)


def test_transforms_keep_what_is_seen():
    """Density times length, and colour along the turned direction, are those before; boxes and crops follow."""
    field, turn = block_field(2), Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()
    moved = field.transformed(turn, (1.0, 2.0, 3.0), 2.5)
    points = np.random.default_rng(0).uniform(-0.02, 0.02, (40, 3))
    places = 2.5 * points @ turn.T + (1.0, 2.0, 3.0)
    np.testing.assert_allclose(2.5 * moved.densities(places), field.densities(points), rtol=2e-3)
    ahead = points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(moved.colors(places, ahead @ turn.T), field.colors(points, ahead), atol=1e-3)
    upright = field.oriented("+x")
    np.testing.assert_allclose(np.ptp(upright.bounds, axis=0), np.ptp(field.bounds, axis=0)[[2, 1, 0]], atol=1e-9)
    part = field.cropped((0.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    assert part.bounds[0, 0] >= -1e-9 and part.shape[0] < 0.6 * field.shape[0]
    right = points[points[:, 0] > 0.003]
    np.testing.assert_allclose(part.densities(right), field.densities(right), rtol=1e-9)
    with pytest.raises(AssetError, match="nothing is left"):
        field.cropped((1.0, 1.0, 1.0), (2.0, 2.0, 2.0))
    with pytest.raises(ConfigError, match="rotation"):
        field.transformed(np.diag([1.0, 1.0, -1.0]))


def test_fields_of_functions_and_splats():
    """A sampled function is itself at the nodes; splats become dense where they are, in their colour."""
    field = block_field()
    node = np.array([40, 20, 20])
    place = field.origin + field.axes @ node
    density, color = block(place[None])
    assert field.densities(place[None])[0] == pytest.approx(density[0], rel=1e-3)
    np.testing.assert_allclose(field.colors(place[None], [[0.0, 0.0, 1.0]]), color, atol=1e-3)
    assert field.densities([[0.0, 0.0, 0.0]])[0] == pytest.approx(SIGMA, rel=1e-3)
    splats = make_plush()
    found = RadianceGrid.from_splats(splats, resolution=48)
    np.testing.assert_allclose(found.bounds, splats.bounds(), atol=2.5 * found.spacing)
    seen = found.colors(splats.means, np.tile([0.0, 0.0, 1.0], (splats.count, 1)))
    assert np.abs(seen - splats.colors()).mean() < 0.05
    with pytest.raises(AssetError, match="returned shapes"):
        RadianceGrid.from_function(lambda x: (x, x), [[0, 0, 0], [1, 1, 1]], resolution=8)
    with pytest.raises(AssetError, match="bounds"):
        RadianceGrid.from_function(block, [[0, 0, 0], [1, 1, 0]])


def test_round_trip(tmp_path):
    """A written field reads back to the bit; plain keys, colours as bytes too, are read."""
    field = block_field(2)
    write_radiance(tmp_path / "field.npz", field)
    read = read_radiance(tmp_path / "field.npz")
    for name in ("density", "sh", "origin", "axes"):
        np.testing.assert_array_equal(getattr(read, name), getattr(field, name))
    arrays = small()
    rgb = np.random.default_rng(0).integers(0, 256, (4, 5, 6, 3), dtype=np.uint8)
    np.savez(tmp_path / "plain.npz", density=arrays["density"], bounds=[[0, 0, 0], [3, 4, 5]], rgb=rgb)
    plain = read_radiance(tmp_path / "plain.npz")
    np.testing.assert_allclose(plain.axes, np.eye(3))
    np.savez(tmp_path / "flat.npz", density=arrays["density"].ravel(), bounds=[[0, 0, 0], [3, 4, 5]], rgb=rgb)
    with pytest.raises(AssetError, match="density has shape") as caught:
        read_radiance(tmp_path / "flat.npz")
    assert caught.value.hint
    np.testing.assert_allclose(plain.sh[..., 0, :], sh_of_colors(rgb / 255.0), atol=2e-3)
    assert is_radiance(tmp_path / "plain.npz") and is_radiance(tmp_path / "field.npz")
    with pytest.raises(AssetError, match="Name it like"):
        write_radiance(tmp_path / "field.ply", field)


def plenoxels(**changes) -> dict[str, np.ndarray]:
    """Return a checkpoint in Plenoxels' layout: 4 x 4 x 4 voxels, of which eight are there."""
    links = np.full((4, 4, 4), -1, dtype=np.int32)
    links[1:3, 1:3, 1:3] = np.arange(8).reshape(2, 2, 2)
    sh = np.random.default_rng(0).normal(size=(8, 27)).astype(np.float16)
    density = np.linspace(-1.0, 30.0, 8, dtype=np.float32)[:, None]
    arrays = {"links": links, "density_data": density, "sh_data": sh, "radius": np.ones(3), "center": np.zeros(3)}
    return arrays | {"basis_type": np.array(1)} | changes


def test_plenoxels(tmp_path):
    """Voxel i lies at ((i + 1/2) / n 2 - 1) radius + center; coefficients come colour by colour."""
    arrays = plenoxels(center=np.array([0.0, 0.0, 0.5]))
    np.savez_compressed(tmp_path / "ckpt.npz", **arrays)
    field = read_radiance(tmp_path / "ckpt.npz")
    places = field.origin + np.array([[1, 1, 1], [2, 2, 2], [0, 0, 0]]) @ field.axes.T
    np.testing.assert_allclose(places, [[-0.25, -0.25, 0.25], [0.25, 0.25, 0.75], [-0.75, -0.75, -0.25]])
    np.testing.assert_allclose(field.densities(places), [0.0, 30.0, 0.0])
    np.testing.assert_allclose(field.sh[2, 2, 2, 4], arrays["sh_data"][7, [4, 13, 22]])


def plenoctree(**changes) -> dict[str, np.ndarray]:
    """Return an octree in svox's layout: an eighth of the box is split again, and full of one colour."""
    child = np.zeros((2, 2, 2, 2), np.int32)
    child[0, 1, 0, 1] = 1
    data = np.zeros((2, 2, 2, 2, 28), np.float16)
    data[0, 0, 1, 0, -1], data[0, 0, 1, 0, 0] = 5.0, 2.0  # sigma; red's constant coefficient
    data[1, 1, 1, 0, -1] = 40.0
    arrays = {"child": child, "data": data, "data_format": np.array("SH9"), "invradius3": np.full(3, 0.5)}
    return arrays | {"offset": np.full(3, 0.5), "depth_limit": np.array(10)} | changes


def test_plenoctree(tmp_path):
    """Cell i lies at ((i + 1/2) / n - offset) / invradius; larger leaves fill several; colours are sigmoids."""
    np.savez_compressed(tmp_path / "tree.npz", **plenoctree())
    assert is_radiance(tmp_path / "tree.npz")
    field = read_radiance(tmp_path / "tree.npz")
    assert field.shape == (4, 4, 4)
    places = field.origin + np.array([[3, 1, 2], [0, 2, 0], [1, 3, 1], [0, 0, 0]]) @ field.axes.T
    np.testing.assert_allclose(places[:2], [[0.75, -0.25, 0.25], [-0.75, 0.25, -0.75]])
    np.testing.assert_allclose(field.densities(places), [40.0, 5.0, 5.0, 0.0])
    sigmoid = 1.0 / (1.0 + np.exp(-2.0 * 0.28209479))
    shades = field.colors(places[:2], np.array([[1.0, 0.0, 0.0], [0.6, 0.0, 0.8]]))
    np.testing.assert_allclose(shades, [[0.5, 0.5, 0.5], [sigmoid, 0.5, 0.5]], atol=1e-3)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"data_format": np.array("SG25")}, "SG25"),
        ({"data": np.zeros((2, 2, 2, 2, 4), np.float16)}, "match"),
        ({"child": np.ones((2, 2, 2, 2), np.int32)}, "not there"),
        ({"child": -np.ones((2, 2, 2, 2), np.int32)}, "not there"),
        ({"invradius3": np.zeros(3)}, "box"),
    ],
)
def test_damaged_plenoctrees(tmp_path, changes, word):
    """What is no tree, or has a learned basis, is refused."""
    np.savez(tmp_path / "tree.npz", **plenoctree(**changes))
    with pytest.raises(AssetError, match=word):
        read_radiance(tmp_path / "tree.npz")


def test_metres_and_large_packed_files(tmp_path):
    """A field says the metres of its unit, through files and scale; one that packs to a tenth is read."""
    field = RadianceGrid(**small(), metres=0.5)
    write_radiance(tmp_path / "a.npz", field)
    assert read_radiance(tmp_path / "a.npz").metres == 0.5
    assert field.transformed(scale=0.5).metres == 1.0
    with pytest.raises(AssetError, match="metres"):
        RadianceGrid(**small(), metres=-1.0)
    density = np.zeros((160,) * 3, np.float32)
    density[60:90, 60:90, 60:90] = 100.0
    box, rgb = np.array([[-1.0] * 3, [1.0] * 3]), np.zeros((*density.shape, 3), np.float32)
    np.savez_compressed(tmp_path / "b.npz", density=density, rgb=rgb, bounds=box, metres=np.array(1.0))
    found = read_radiance(tmp_path / "b.npz")
    assert found.metres == 1.0 and found.shape == density.shape


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"sh_data": np.zeros((8, 48), np.float16)}, "27"),
        ({"sh_data": np.zeros((7, 27), np.float16)}, "match"),
        ({"links": np.full((4, 4, 4), 9, np.int32)}, "not there"),
        ({"links": np.zeros(64, np.int32)}, "match"),
        ({"basis_type": np.array(4)}, "learned basis"),
        ({"density_data": np.zeros((8, 1), np.float32)}, "empty"),
    ],
)
def test_damaged_plenoxels(tmp_path, changes, word):
    """What does not belong together is refused by name."""
    np.savez(tmp_path / "ckpt.npz", **plenoxels(**changes))
    with pytest.raises(AssetError, match=word):
        read_radiance(tmp_path / "ckpt.npz")


def test_unknown_keys_and_kinds(tmp_path):
    """Files that hold something else say what would do."""
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(AssetError, match="links, density_data"):
        read_radiance(tmp_path / "other.npz")
    for name in ("field.ply", "field.npz"):
        with pytest.raises(AssetError):
            read_radiance(tmp_path / name)
    assert not is_radiance(tmp_path / "other.npz") and not is_radiance(tmp_path / "field.ply")


def test_headers_that_promise_too_much(tmp_path):
    """An array of a terabyte is refused by its header; nothing is allocated."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f4", "fortran_order": False, "shape": (2**13, 2**13, 2**12)}
    )
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w") as archive:
        archive.writestr("density.npy", header.getvalue())
    with pytest.raises(AssetError, match="another size"):
        read_radiance(tmp_path / "bomb.npz")


def test_nanovdb(tmp_path):
    """A grid of numbers is read with its transform, on its active voxels."""
    values = np.zeros((8, 8, 8), np.float32)
    values[2:6, 3:6, 1:7] = 40.0
    volume = wp.Volume.load_from_numpy(values, min_world=(1.0, 2.0, 3.0), voxel_size=0.5, bg_value=0.0, device="cpu")
    volume.save_to_nvdb(str(tmp_path / "smoke.nvdb"))
    field = read_radiance(tmp_path / "smoke.nvdb")
    np.testing.assert_allclose(field.bounds, [[2.0, 3.5, 3.5], [3.5, 4.5, 6.0]], atol=0.26)
    assert field.densities(field.bounds.mean(axis=0)[None])[0] == 40.0
    assert field.density.astype(float).sum() == 40.0 * 4 * 3 * 6
    content = (tmp_path / "smoke.nvdb").read_bytes()
    (tmp_path / "cut.nvdb").write_bytes(content[: len(content) // 2])
    with pytest.raises(AssetError):
        read_radiance(tmp_path / "cut.nvdb")
