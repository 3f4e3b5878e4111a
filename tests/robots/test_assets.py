"""Names, the cache, and references that a robot file may not make."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from softmode import robots
from softmode.cli.main import main
from softmode.errors import AssetError, ConfigError, SoftmodeError
from softmode.robots.assets import ALIASES, find
from tests.robots.files import MJCF, URDF, write_mjcf, write_urdf, write_wedge

menagerie = pytest.importorskip("mujoco_menagerie", reason="needs the extra [robots]")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache, and a download server that has nothing."""
    monkeypatch.delenv("MENAGERIE_ROOT", raising=False)
    monkeypatch.setenv("MENAGERIE_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("MENAGERIE_BASE_URL", (tmp_path / "nowhere").as_uri())
    return tmp_path / "cache"


def fill(folder: Path, name: str = "vx300s") -> Path:
    """Put a model of our own where that of a name is looked for."""
    write_mjcf(folder).rename(folder / f"{name}.xml")
    return folder


# -- names -------------------------------------------------------------------------------------------------------------


def test_available_names():
    """The short names are there, all stand for a model of the registry, none is a robot that walks or drives."""
    names = robots.available()
    assert {"franka_panda", "so101", "ur5e", "vx300s", "universal_robots_ur5e"} <= set(names)
    assert set(ALIASES.values()) <= set(menagerie.names())
    assert "unitree_go2" not in names
    assert list(names) == sorted(set(names))


@pytest.mark.parametrize(
    ("name", "near"),
    [("frnka_panda", "franka_panda"), ("ur5", "ur5e"), ("SO101", "so101"), ("aloha-arm", "aloha"), ("vx300", "vx300s")],
)
def test_unknown_name_says_which_are_near(name, near):
    """The error names what was asked, the nearest names, and where all of them are listed."""
    with pytest.raises(ConfigError) as caught:
        robots.load(name)
    assert repr(name) in caught.value.message
    assert f"'{near}'" in caught.value.hint
    assert "available()" in caught.value.hint


@pytest.mark.parametrize("name", ["", "zzzzzzzz", "../../etc/passwd.txt"])
def test_name_that_is_near_nothing(name):
    """No guess is made."""
    with pytest.raises(SoftmodeError) as caught:
        robots.load(name)
    assert "did you mean" not in str(caught.value).lower()


def test_name_of_a_walking_robot():
    """It is known but not loaded, and the error says why."""
    with pytest.raises(ConfigError, match="quadruped"):
        robots.load("unitree_go2")


def test_source_of_a_wrong_type():
    """Neither name nor path."""
    with pytest.raises(ConfigError, match="int"):
        robots.load(7)


# -- the cache ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("download", [True, False])
def test_asset_that_cannot_be_fetched(cache, download):
    """The error names the cache and the command that fills it, at once."""
    started = time.perf_counter()
    with pytest.raises(AssetError) as caught:
        robots.load("so101", download=download)
    assert time.perf_counter() - started < 60.0  # no endless retry
    assert str(cache) in caught.value.message
    for word in ("softmode robots fetch robotstudio_so101", "MENAGERIE_CACHE_DIR", "MENAGERIE_ROOT"):
        assert word in caught.value.hint


def test_prefetched_model_needs_no_network(cache):
    """What a fetch left in the cache is loaded, with its short and with its full name."""
    robot = menagerie.get("trossen_vx300s")
    folder = fill(menagerie.Cache().model_path(robot))
    (folder / ".complete").write_text("{}")
    for name in ("vx300s", "trossen_vx300s"):
        loaded = robots.load(name, download=False)
        assert loaded.name == "trossen_vx300s"
        assert loaded.path == folder / "vx300s.xml"
    assert robots.fetch("vx300s") == (folder,)


def test_checkout_of_the_menagerie(tmp_path, monkeypatch):
    """MENAGERIE_ROOT is used as it is; a model that it lacks is an error."""
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    folder = fill(tmp_path / "trossen_vx300s")
    assert robots.load("vx300s").path == folder / "vx300s.xml"
    with pytest.raises(AssetError, match="MENAGERIE_ROOT"):
        robots.load("ur5e")


def test_panda_has_a_tool_point(tmp_path, monkeypatch):
    """Its hand has no site; the tool point lies between the pads."""
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    write_mjcf(tmp_path / "franka_emika_panda", MJCF.replace('"fore"', '"hand"')).rename(
        tmp_path / "franka_emika_panda" / "panda.xml"
    )
    robot = robots.load("franka_panda")
    assert robot.end_effector == "hand"
    assert robot.tool == (0.0, 0.0, 0.1034, 0.0, 0.0, 0.0, 1.0)


def test_command_line(cache, capsys):
    """It lists the names, fetches, and says what is wrong in one line."""
    assert main(["robots", "list"]) == 0
    assert capsys.readouterr().out.split() == list(robots.available())
    folder = fill(menagerie.Cache().model_path(menagerie.get("trossen_vx300s")))
    (folder / ".complete").write_text("{}")
    assert main(["robots", "fetch", "vx300s"]) == 0
    assert str(folder) in capsys.readouterr().out
    for arguments, word in ((["vx300s", "ur5"], "'ur5e'"), (["so101"], "cannot be fetched"), ([], "so101 ur5e")):
        assert main(["robots", "fetch", *arguments]) == 2
        error = capsys.readouterr().err.strip()
        assert word in error and "\n" not in error


# -- references --------------------------------------------------------------------------------------------------------

INCLUDE = '<mujoco><include file="{}"/></mujoco>'


@pytest.mark.parametrize(
    "text",
    [
        MJCF.replace("wedge.stl", "../../secret.stl"),
        MJCF.replace("wedge.stl", "/etc/hostname"),
        MJCF.replace("wedge.stl", "https://example.org/wedge.stl"),
        MJCF.replace("wedge.stl", "C:\\wedge.stl"),
        MJCF.replace("wedge.stl", "link.stl"),
        MJCF.replace('meshdir="meshes"', 'meshdir="../"').replace("wedge.stl", "secret.stl"),
        MJCF.replace('meshdir="meshes"', 'assetdir="/etc"').replace("wedge.stl", "hostname"),
        MJCF.replace("</asset>", '<texture name="t" type="2d" file="../secret.png"/></asset>'),
        MJCF.replace("</asset>", '<hfield name="h" file="../secret.png" size="1 1 1 1"/></asset>'),
        INCLUDE.format("../outside.xml"),
        INCLUDE.format("small.xml"),
    ],
)
def test_references_stay_inside(text, tmp_path):
    """Dots, absolute paths, URLs, links, asset folders and includes that lead outside are refused, existing or not."""
    folder = tmp_path / "robot"
    path = write_mjcf(folder, text)
    (tmp_path / "outside.xml").write_text(MJCF)
    write_wedge(tmp_path / "secret.stl")
    (tmp_path / "secret.png").write_bytes(b"")
    os.symlink(tmp_path / "secret.stl", folder / "meshes" / "link.stl")
    with pytest.raises(AssetError) as caught:
        robots.load(path)
    assert str(path) in str(caught.value)
    assert caught.value.hint


@pytest.mark.parametrize("name", ["../../../secret.stl", "package://lifter/../../secret.stl", "file:///etc/hostname"])
def test_urdf_references_stay_inside(name, tmp_path):
    """The same for a URDF."""
    path = write_urdf(tmp_path / "root", URDF.replace("package://lifter/meshes/wedge.stl", name))
    write_wedge(tmp_path / "secret.stl")
    with pytest.raises(AssetError, match=r"lifter\.urdf"):
        robots.load(path, asset_root=tmp_path / "root")


def test_asset_root_widens_the_folder(tmp_path):
    """A robot whose meshes lie beside its folder loads once the common folder is named, and stays an error without."""
    write_mjcf(tmp_path, MJCF)
    folder = tmp_path / "mjcf"
    folder.mkdir()
    path = folder / "small.xml"
    path.write_text(INCLUDE.format("../small.xml"))
    with pytest.raises(AssetError, match="asset_root"):
        robots.load(path)
    with pytest.raises(AssetError, match="asset_root"):
        robots.load(path, asset_root=tmp_path / "meshes")
    path.write_text(MJCF.replace('meshdir="meshes"', 'meshdir="../meshes"'))
    assert robots.load(path, asset_root=tmp_path).joint_names == ("shoulder", "elbow", "left", "right")


@pytest.mark.parametrize(("make", "words"), [("missing.xml", "does not exist"), ("folder.xml", "Is a directory")])
def test_file_not_found(make, words, tmp_path):
    """The error names the path."""
    (tmp_path / "folder.xml").mkdir()
    with pytest.raises(AssetError, match=words) as caught:
        robots.load(str(tmp_path / make))
    assert make in str(caught.value)


def test_names_are_found_before_paths(tmp_path, monkeypatch):
    """A folder of the same name in the working directory does not shadow a robot."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "aloha_arm").mkdir()
    if "aloha_arm" in robots.available():
        assert find("aloha_arm").name == robots.load("aloha_arm").name
