"""Files from strangers: each ends in a typed error within 8 bytes for each of its own and 300 MB, or is read so."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path

import pytest

from tests.attack import Outcome, attack
from tests.foreign import bombs

Writers = Mapping[str, Callable[[Path], Path]]


def parts(cheap: Collection[str], writers: Writers) -> list[object]:
    """Return the names of cheap files, and those of the others for the rest; each part is read by one process."""
    others = [name for name in writers if name not in cheap]
    return [pytest.param(list(cheap), id="cheap"), pytest.param(others, id="others", marks=pytest.mark.rest)]


def outcomes(
    folder: Path, reader: str, writers: Writers, names: list[str], sound: Callable[[Path], Path]
) -> dict[str, Outcome]:
    """Return what a reader makes of files, each checked against its size."""
    places = [folder / f"{k}" for k in range(len(names) + 1)]
    for place in places:
        place.mkdir()
    files = [writers[name](place) for name, place in zip(names, places[1:], strict=True)]
    found = dict(zip(names, attack(reader, files, warm=sound(places[0])), strict=True))
    for place, (name, outcome) in zip(places[1:], found.items(), strict=True):
        size = sum(path.stat().st_size for path in place.rglob("*") if path.is_file())
        print(f"{name}: {size} bytes, {outcome.memory / 1e6:.0f} MB, {outcome.seconds:.2f} s, {outcome.message[:150]}")
        assert outcome.typed, (name, outcome)
        assert outcome.within(size, seconds=20.0), (name, outcome)  # the clock of a busy machine is not what is tested
    return found


@pytest.mark.parametrize(
    "names",
    parts(("textures", "scene cycle", "link outside", "negative faces", "ply", "accessor"), bombs.MESHES),
)
def test_meshes(tmp_path: Path, names: list[str]) -> None:
    """Pictures, archives, counts, copies, links: none is read; trimesh takes cycles apart, and leaves a picture out."""
    sound = bombs.text("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    found = outcomes(tmp_path, bombs.MESH, bombs.MESHES, names, sound)
    expected = {name: "" if "cycle" in name or name == "one texture" else "AssetError" for name in names}
    assert {name: outcome.error for name, outcome in found.items()} == expected


@pytest.mark.parametrize(
    "names",
    parts(("flexcomp", "chain", "key frames", "nested", "gain that is NaN", "negative gain"), bombs.ROBOTS),
)
def test_robots(tmp_path: Path, names: list[str]) -> None:
    """Robot files that multiply, and numbers that are none: none is read but a chain that is merely long."""
    found = outcomes(tmp_path, bombs.ROBOT, bombs.ROBOTS, names, bombs.mjcf("", bombs.chain(1)))
    expected = {name: "" if name == "chain" else "AssetError" for name in names}
    assert {name: outcome.error for name, outcome in found.items()} == expected


@pytest.mark.parametrize("names", parts((f"link to {bombs.DATA}", "flags"), bombs.DATASETS))
def test_datasets(tmp_path: Path, names: list[str]) -> None:
    """Tables that are short on the disk alone, and links that lead out of the folder."""
    pytest.importorskip("pyarrow")
    found = outcomes(tmp_path, bombs.DATASET, bombs.DATASETS, names, bombs.dataset)
    assert {name: outcome.error for name, outcome in found.items()} == dict.fromkeys(names, "AssetError")
