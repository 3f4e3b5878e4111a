"""Tables of markers and forces: what is read, and what is refused with a remedy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softmode.cli.main import main
from softmode.errors import AssetError, ConfigError, FitError
from softmode.fitting.marker_fit import MarkerPlaces
from softmode.fitting.tables import holds_forces, read_forces, read_markers


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
