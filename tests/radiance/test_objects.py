"""Soft objects of radiance fields: loaded, built, simulated and drawn, as splats and as fields.

Builds objects from fields, which is what it tests.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from softmode.cli.main import main
from softmode.errors import AssetError, ConfigError
from softmode.objects import ObjectConfig, ObjectSet, Placed, build_object, load, write_object
from softmode.objects.object_file import file_kind, read_object
from softmode.radiance import read_radiance, write_radiance
from softmode.scenes import SplatScene, TableScene, TableSceneConfig
from softmode.splats import PinholeCamera, read_splats
from tests.radiance.fields import SIZE, block_field, psnr

LENGTH = 0.1
OPTIONS = {"size": LENGTH, "splat_count": 1500, "surface_count": 200, "pose": "captured"}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """Return the file of the block."""
    path = tmp_path_factory.mktemp("fields") / "block.npz"
    write_radiance(path, block_field())
    return path


def test_a_field_becomes_an_object(file):
    """Its solid has the volume of the block at its size, its splats and its field lie around the body, upright."""
    assert file_kind(file) == "radiance"
    thing = load(file, **OPTIONS)
    scale = LENGTH / np.ptp(block_field().bounds, axis=0).max()
    # The faces fade over 4 mm, and the surface is where half of the light is lost over two voxels.
    assert np.prod(SIZE) < thing.body.volume / scale**3 < np.prod(np.array(SIZE) + 0.0045)
    assert thing.radiance is not None
    for bounds in (thing.radiance.bounds, thing.visible_splats.bounds()):
        np.testing.assert_allclose(bounds, thing.body.bounds, atol=2.5 * thing.radiance.spacing)
    assert np.ptp(thing.body.bounds, axis=0).max() == pytest.approx(LENGTH, rel=5e-3)
    again = load(ObjectConfig(radiance=file, **OPTIONS).pinned())
    np.testing.assert_array_equal(again.visible_splats.means, thing.visible_splats.means)
    turned = load(block_field(), **OPTIONS | {"up": "+x"})
    assert np.ptp(turned.body.bounds, axis=0).argmax() == 2
    assert turned.radiance is not None and np.ptp(turned.radiance.bounds, axis=0).argmax() == 2
    built, _ = build_object(file, **OPTIONS)
    assert built.radiance is not None and built.body.provenance["asset_kind"] == "radiance"


def test_a_field_keeps_its_metres():
    """One that says them is as large as it is, and `field_pose` takes its places to where the object has them."""
    given = replace(block_field(), metres=0.5)
    thing = load(given, **OPTIONS | {"size": None, "up": "+x"})
    assert thing.radiance is not None and thing.field_pose is not None and not thing.findings()
    assert np.prod(SIZE) < 8.0 * thing.body.volume < np.prod(np.array(SIZE) + 0.0045)
    places = np.random.default_rng(0).uniform(-0.02, 0.02, (50, 3))
    there = places @ thing.field_pose[:3, :3].T + thing.field_pose[:3, 3]
    np.testing.assert_allclose(thing.radiance.densities(there), 2.0 * given.densities(places), rtol=2e-3)
    np.testing.assert_allclose(np.cbrt(np.linalg.det(thing.field_pose[:3, :3])), 0.5)


def test_sampled_functions(tmp_path, monkeypatch, capsys):
    """A function in Python comes to a grid around its object; what has no end, is empty or no function is refused."""
    (tmp_path / "my_nerf.py").write_text(
        "import numpy as np\n"
        "def ball(x):\n    return 300.0 * (np.linalg.norm(x - 3.0, axis=1) < 0.5), 0.0 * x\n"
        "def space(x):\n    return np.abs(x[:, 0]), 0.0 * x\n"
        "def nothing(x):\n    return 0.0 * x[:, 0], 0.0 * x\n"
    )
    monkeypatch.chdir(tmp_path)
    assert (
        main(["radiance", "sample", "my_nerf:ball", "ball.npz", "--bounds", *"2 2 2 4 4 4".split(), "--metres", "1"])
        == 0
    )
    found = read_radiance("ball.npz")
    assert found.metres == 1.0
    np.testing.assert_allclose(found.bounds, [[2.5] * 3, [3.5] * 3], atol=0.07)
    for name, said in (("space", "no end"), ("nothing", "empty"), ("none", "no attribute"), ("", "MODULE:FUNCTION")):
        assert main(["radiance", "sample", f"my_nerf:{name}" if name else "my_nerf", "x.npz"]) == 2
        assert said in capsys.readouterr().err
    for suffix in (".ingp", ".vdb", ".th"):
        (tmp_path / f"a{suffix}").write_bytes(b"x")
        assert main(["radiance", "info", f"a{suffix}"]) == 2
        assert "Convert it: " in capsys.readouterr().err


def test_the_file_of_an_object_keeps_its_field(file, tmp_path):
    """Body, splats and field come back to the bit, also through `load`; a file with half a field is refused."""
    thing = load(file, **OPTIONS)
    assert thing.radiance is not None
    write_object(tmp_path / "block.npz", thing.body, thing.splats, thing.radiance)
    assert file_kind(tmp_path / "block.npz") == "body"
    for found in (read_object(tmp_path / "block.npz"), load(tmp_path / "block.npz")):
        assert found.radiance is not None and found.body.fingerprint == thing.body.fingerprint
        np.testing.assert_array_equal(found.visible_splats.means, thing.visible_splats.means)
        for name in ("density", "sh", "origin", "axes"):
            np.testing.assert_array_equal(getattr(found.radiance, name), getattr(thing.radiance, name))
    thing.body.save(tmp_path / "half.npz", beside={"radiance.density": thing.radiance.density})
    with pytest.raises(AssetError, match=r"radiance\.sh"):
        read_object(tmp_path / "half.npz")


def test_scenes_march_fields(file):
    """A falling, turned block looks the same marched as in splats, among meshes, from captured graphs; 27 dB."""
    thing = load(file, **OPTIONS)
    camera = PinholeCamera.look_at("c", position=(0.05, -0.2, 0.15), target=(0.0, 0.0, 0.03), width=96, height=96,
                                   fov_y=0.7)  # fmt: skip
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    placed = Placed(object=thing, position=(0.0, 0.0, 0.05), rotation=turn)
    other = Placed(object=load(shape="sphere", extents=(0.03,) * 3, splat_count=500), position=(0.03, -0.05, 0.04))
    pictures = {}
    for march in (False, True):
        scene = SplatScene([], [placed, other], cameras=[camera], march=march)
        scene.draw()
        for _ in range(2):
            scene.step()
        pictures[march] = scene.draw() / 255.0
    assert psnr(pictures[True], pictures[False]) > 27.0
    alone = SplatScene([], [replace(placed, object=load(file, **OPTIONS | {"march": True}))], cameras=[camera])
    assert alone.fields is not None and alone.fields.hides == (0,)
    first = alone.draw()
    alone.step()
    assert not np.array_equal(first, alone.draw())
    with pytest.raises(ConfigError, match="no object has a radiance field"):
        SplatScene([], [other], cameras=[camera], march=True)


def test_environments_march_fields(file):
    """Pictures of an observation and of a film, of two worlds, march the field that its object says; 27 dB to splats.

    Worlds that hold the same look the same.
    """
    eye = PinholeCamera.look_at("eye", position=(0.75, 0.1, 0.3), target=(0.45, 0.0, 0.05), width=64, height=64)
    seen = {}
    for march in (False, True):
        thing = ObjectConfig(radiance=file, march=march, **OPTIONS)
        scene = TableScene(TableSceneConfig(object=thing), world_count=2, cameras=[eye], film=[eye])
        drawn = scene.render((64, 64)).images("eye").numpy() / 255.0, scene.draw_film().numpy() / 255.0
        assert (scene.fields is not None) == march
        for pictures in drawn:
            np.testing.assert_allclose(*pictures, atol=2.0 / 255.0)
        seen[march] = drawn
    for marched, baked in zip(seen[True], seen[False], strict=True):
        assert 27.0 < psnr(marched, baked) < 60.0
    several = ObjectSet([ObjectConfig(radiance=file, march=True, **OPTIONS), "ball"])
    with pytest.raises(ConfigError, match="different objects"):
        TableScene(TableSceneConfig(objects=several), world_count=2, cameras=[eye])


def test_configurations():
    """A field excludes other files; an empty crop is refused, and marching what has no field."""
    with pytest.raises(ConfigError, match="no radiance field"):
        ObjectConfig(preset="bear", march=True)
    with pytest.raises(ConfigError, match="radiance"):
        ObjectConfig(radiance=block_field(), mesh="toy.glb")
    with pytest.raises(AssetError, match="nothing is left"):
        load(block_field(), **OPTIONS, crop=(1.0, 1.0, 1.0, 2.0, 2.0, 2.0))


def test_commands(file, tmp_path, capsys):
    """`radiance info` prints what is in the file, `bake` writes splats; what is wrong ends with 2 and a remedy."""
    assert main(["radiance", "info", str(file)]) == 0
    said = capsys.readouterr().out
    assert "sh degree   0" in said and "97 x" in said and "moves it by 0.0" in said and "fog" not in said
    doubted = tmp_path / "doubted.npz"
    write_radiance(doubted, replace(block_field(), contradicted=0.06, allowed=1.2))
    assert main(["radiance", "info", str(doubted)]) == 0
    assert "a patch of 6.0%" in (said := capsys.readouterr().out) and "doubtful" in said
    out = tmp_path / "block.ply"
    given = ["--count", "800", "--iterations", "10", "--pixels", "48", "--out", str(out)]
    assert main(["radiance", "bake", str(file), *given]) == 0
    assert "dB fitted" in capsys.readouterr().out
    splats = read_splats(out)
    assert 400 < splats.count <= 800
    np.testing.assert_allclose(splats.bounds(), block_field().bounds, atol=0.01)
    np.savez(tmp_path / "other.npz", density=np.zeros(3))
    assert main(["radiance", "info", str(tmp_path / "other.npz")]) == 2
    assert "Give density, bounds" in capsys.readouterr().err
    assert main(["radiance", "bake", str(file), "--out", str(tmp_path / "block.glb")]) == 2
