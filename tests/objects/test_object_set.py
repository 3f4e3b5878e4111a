"""Sets of objects: who gets which, what names become, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softmode.deformables import BuildOptions, Material
from softmode.errors import AssetError, ConfigError
from softmode.objects import PRESETS, ObjectConfig, ObjectSet
from softmode.splats import make_plush, write_splats

BUILD = BuildOptions(function_count=24)


def test_draws_follow_the_weights_and_not_the_number_of_worlds() -> None:
    """World i has the same object among few and many; counts are those of the weights, within 4 standard deviations."""
    weights = (1.0, 0.0, 3.0)
    given = ObjectSet(["mug", "sponge", "bear"], weights=weights, seed=5)
    chosen = given.chosen(4000)
    np.testing.assert_array_equal(chosen[:7], given.chosen(7))
    later = ObjectSet(["mug", "sponge", "bear"], weights=weights, seed=5, first_world=100)
    np.testing.assert_array_equal(chosen[100:110], later.chosen(10))
    share = np.bincount(chosen, minlength=3) / 4000
    expected = np.array(weights) / 4.0
    assert share[1] == 0.0
    assert (np.abs(share - expected) <= 4.0 * np.sqrt(expected * (1.0 - expected) / 4000)).all()
    assert (ObjectSet(["mug", "sponge", "bear"], weights=weights, seed=6).chosen(4000) != chosen).any()


def test_in_turn_deals_them_out() -> None:
    """World i has object i modulo their number."""
    given = ObjectSet(["mug", "bear"], order="in_turn", first_world=3)
    assert given.chosen(4).tolist() == [1, 0, 1, 0]


def test_named_objects_get_the_build_and_configurations_keep_theirs(tmp_path: Path) -> None:
    """A preset and a file take build, samples and size; each object has a name of its own, and its material."""
    file = tmp_path / "toy.ply"
    write_splats(file, make_plush(300))
    own = ObjectConfig(shape="box", extents=(0.05, 0.05, 0.05))
    steel = Material(density=900.0)
    given = ObjectSet(["mug", file, own, "mug"], size=0.06, materials=[None, steel, None, None])
    assert given.names == ("mug", "toy", "box", "mug#2")
    made = given.resolved(ObjectConfig(build=BUILD, surface_count=77))
    mug, toy, box, _ = (made.config(k) for k in range(4))
    assert (mug.preset, mug.build, mug.surface_count, mug.size) == ("mug", BUILD, 77, 0.06)
    assert (toy.splat, toy.build, toy.surface_count, toy.size) == (file, BUILD, 77, 0.06)
    assert box is own
    default = Material(density=1.0)
    assert [made.material(k, default) for k in range(3)] == [PRESETS["mug"].material, steel, default]


def test_a_folder_holds_its_objects_by_name(tmp_path: Path) -> None:
    """Files of known suffixes count, others do not."""
    for name in ("b.ply", "a.ply"):
        write_splats(tmp_path / name, make_plush(300))
    (tmp_path / "notes.txt").write_text("nothing")
    assert ObjectSet.folder(tmp_path, seed=3).names == ("a", "b")


@pytest.mark.parametrize(
    ("objects", "options", "error", "told"),
    [
        ([], {}, ConfigError, "objects is empty"),
        ("mug", {}, ConfigError, "expected a list"),
        ([3], {}, ConfigError, r"objects\[0\]"),
        (["mugg"], {}, AssetError, "mugg"),
        (["mug"], {"weights": [0.0]}, ConfigError, "weights"),
        (["mug"], {"weights": [1.0, 2.0]}, ConfigError, "weights has 2 entries"),
        (["mug", "bear"], {"weights": [1.0, -2.0]}, ConfigError, r"weights\[1\]"),
        (["mug"], {"weights": [1.0], "order": "in_turn"}, ConfigError, "weights"),
        (["mug"], {"materials": [3.0]}, ConfigError, r"materials\[0\]"),
        (["mug"], {"order": "random"}, ConfigError, "order"),
        (["mug"], {"seed": -1}, ConfigError, "seed"),
    ],
)
def test_what_is_no_set_is_refused(objects: Any, options: Any, error: type[Exception], told: str) -> None:
    """The error names what is wrong."""
    with pytest.raises(error, match=told):
        ObjectSet(objects, **options)


def test_a_folder_without_objects_is_refused(tmp_path: Path) -> None:
    """So is one that is not there."""
    with pytest.raises(ConfigError, match="holds no object"):
        ObjectSet.folder(tmp_path)
    with pytest.raises(ConfigError, match="no such folder"):
        ObjectSet.folder(tmp_path / "none")
