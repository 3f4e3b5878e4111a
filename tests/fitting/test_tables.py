"""Tables of markers and forces: what is read, what is refused with a remedy, and what the command says first.

Builds a bar with an end held.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from softmode.cli.main import main
from softmode.deformables import Material
from softmode.errors import AssetError, ConfigError, FitError
from softmode.fitting.holding import Held, held_object
from softmode.fitting.marker_fit import MarkerPlaces
from softmode.fitting.tables import holds_forces, read_forces, read_markers
from softmode.objects import load
from softmode.objects.object_file import write_object
from tests import bodies
from tests.fitting.films import motion


def marker_file(path: Path, change: str = "") -> Path:
    """Write a swing of two markers; ``change`` says what is wrong with it."""
    times = np.arange(60) / 100.0
    places = np.zeros((60, 2, 3))
    places[:, :, 2] = -0.01 * np.where(times < 0.1, 0.0, 1.0 - np.cos(20.0 * (times - 0.1)))[:, None]
    places[:, 1, 0] = 0.02
    titles = [f"m{k}_{axis}" for k in (0, 1) for axis in "xyz"]
    if change == "jumps":
        places[30:, 1, 0] += 0.05
    if change == "renamed":
        titles[3] = "m2_x"
    if change == "back":
        times[20] = 0.0
    rows = [[f"{v:.6f}" for v in (t, *p.ravel())] for t, p in zip(times, places, strict=True)]
    if change == "vanishes":
        rows[40][5] = ""
    path.write_text("\n".join([",".join(["time", *titles]), *map(",".join, rows)]))
    return path


def test_markers_are_read(tmp_path: Path) -> None:
    """Names, times and places come back, and the frame before the first motion is found."""
    found = read_markers(marker_file(tmp_path / "m.csv"))
    assert found.names == ("m0", "m1") and found.places.shape == (60, 2, 3)
    assert found.times[-1] == pytest.approx(0.59) and found.places[0, 1, 0] == 0.02
    assert 9 <= found.release <= 12


@pytest.mark.parametrize("change", ["jumps", "vanishes", "renamed", "back"])
def test_bad_markers_are_refused(tmp_path: Path, change: str) -> None:
    """A marker that jumps, vanishes or is renamed, and times that go back, are named, with a remedy."""
    with pytest.raises(FitError, match=r"m1|m2_x|times") as caught:
        read_markers(marker_file(tmp_path / "m.csv", change))
    assert caught.value.hint


def test_forces_have_units(tmp_path: Path) -> None:
    """Units are taken from the titles; a log without them, or one in which nothing presses, is refused."""
    path = tmp_path / "f.csv"
    path.write_text("time,depth [mm],force_mN\n0,0,0\n1,1,20\n2,2,60\n3,3,120\n")
    assert holds_forces(path)
    log = read_forces(path)
    assert not log.opening
    np.testing.assert_allclose(log.way, [0, 1e-3, 2e-3, 3e-3])
    np.testing.assert_allclose(log.force, [0, 0.02, 0.06, 0.12])
    for text, match in (
        ("depth,force\n0,0\n1,1\n2,2\n3,3\n", "no unit"),
        ("depth [mm],force [N]\n0,0\n1,0\n2,0\n3,0\n", "nothing presses"),
        ("way [mm],force [N]\n0,0\n1,0\n2,0\n3,0\n", "columns"),
    ):
        path.write_text(text)
        with pytest.raises(FitError, match=match) as caught:
            read_forces(path)
        assert caught.value.hint
    path.write_text("depth [mm],force [N]\n0,0\n1,one\n2,0\n3,0\n")
    with pytest.raises(AssetError, match="one"):
        read_forces(path)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (["--between", "y", "--radius", "0.01"], "--radius says nothing about jaws"),
        (["--between", "y", "--exposure", "0.01"], "--exposure says nothing about a force log"),
        (["--between", "y", "--free", "friction"], "free says nothing about a force log"),
        (["--between", "y", "--scene", "press.json"], "kind is 'press'"),
    ],
)
def test_options_that_say_nothing_are_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    match: str,
) -> None:
    """An option of a ball between jaws, of a film, of what moves, and a scene of another kind: none is ignored."""
    monkeypatch.chdir(tmp_path)
    Path("f.csv").write_text("depth [mm],force [N]\n0,0\n1,1\n2,2\n3,3\n")
    Path("press.json").write_text('{"kind": "press"}')
    assert main(["fit", "f.csv", "--object", "sponge", *options]) == 2
    assert match in capsys.readouterr().err


def test_axes_of_markers() -> None:
    """Three right-handed axes make a rotation; others are refused."""
    turned = MarkerPlaces(points={}, axes=("+z", "-y", "+x")).rotation
    np.testing.assert_allclose(turned @ [1.0, 2.0, 3.0], [3.0, -2.0, 1.0])
    with pytest.raises(ConfigError, match="axes"):
        _ = MarkerPlaces(points={}, axes=("+x", "+y", "-z")).rotation


@pytest.mark.rest
def test_without_a_mass_the_first_line_is_e_over_density(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Markers on a bar of a density that is not told: E over density is right within 3 %, and is said first."""
    write_object(tmp_path / "bar.npz", bodies.bar())
    made = Material(youngs_modulus=4.0e5, viscosity=8e-3, poissons_ratio=0.35, density=250.0)
    thing = held_object(load(tmp_path / "bar.npz"), Held.parse("-x:0.06"))
    q, _ = motion(thing, made, 0.4, 1.0 / 800.0)
    points, some = thing.body.surface.points, [thing.body.surface.points[:, 0].argmax(), 60]
    still = points[some] + thing.body.offset
    places = still + np.einsum("mk,tkc->tmc", thing.body.surface.basis[some], np.concatenate([0.0 * q[:20], q]))
    titles = [f"m{k}_{axis}" for k in (0, 1) for axis in "xyz"]
    rows = [",".join(f"{v:.6f}" for v in (k / 400.0, *p.ravel())) for k, p in enumerate(places)]
    (tmp_path / "m.csv").write_text("\n".join([",".join(["time", *titles]), *rows]))
    scene = {"held": "-x:0.06", "poissons_ratio": 0.35, "markers": dict(zip(["m0", "m1"], still.tolist(), strict=True))}
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    files = {"--object": "bar.npz", "--scene": "scene.json", "--out": "toy.npz"}
    options = [word for name, file in files.items() for word in (name, str(tmp_path / file))]
    capsys.readouterr()
    assert main(["fit", str(tmp_path / "m.csv"), *options]) == 0
    first, *others = capsys.readouterr().out.splitlines()
    assert first.startswith("Young's modulus over density: ") and any(
        "which was not measured" in line for line in others
    )
    told = json.loads((tmp_path / "fit.json").read_text())["parameters"]["youngs_modulus_over_density"]
    assert told["value"] == pytest.approx(4.0e5 / 250.0, rel=0.03)
