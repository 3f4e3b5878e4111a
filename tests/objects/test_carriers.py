"""What carries a captured object is found and cut off, or named; look-alikes and bare things stay whole.

Builds captures, which is what it tests.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from benchmarks.carriers import MADE, SEEDS, judge
from softmode.deformables.quadrature.quadrature import quadrature_from_splats
from softmode.errors import AssetError, ConfigError
from softmode.objects import ObjectConfig
from softmode.objects.carriers import DISC, SURE, WIDE, Surface, closed, eroded, filled
from softmode.objects.hands import HELD, find_arm
from softmode.objects.parts import choose_part, find_ground
from softmode.objects.pipeline import standing_quadrature
from softmode.objects.source import object_source
from tests.captures import merged, render_shell, sheet, toy
from tests.carriers import CARRIER, OBJECT, bare, bear, box, carried, lathe, render, room, vase
from tests.hands import held

FEW = 8_000
"""Splats of a capture in the quick tests."""


def test_object_is_taken_without_its_carrier_and_closed() -> None:
    """A vase on steps: its splats to 97 %, the steps' to 1 %, its volume to 3 %; the report names what was cut."""
    made = carried(303, count=FEW)
    choice = choose_part(made.splats, "thickest")
    kept = np.isin(choice.number, choice.taken)
    assert kept[made.label == OBJECT].mean() > 0.97 and kept[made.label == CARRIER].mean() < 0.01
    part = choice.part
    assert part.count == kept.sum() + choice.told["floor_splats"]
    found = quadrature_from_splats(part.means, part.scales, part.quats, part.opacities, resolution=64)
    assert found.volume == pytest.approx(made.volume, rel=0.03)
    assert "doubt" not in choice.told  # its lower step is climbed for sure
    assert float(choice.told["carrier_score"]) > 0.85 and int(choice.told["carrier_splats"]) > 0
    numbers = tuple(map(int, str(choice.told["carrier_part"]).split()))
    whole = choose_part(made.splats, numbers)
    assert np.isin(whole.number, whole.taken)[made.label == CARRIER].mean() > 0.9
    below = choose_part(made.splats, (numbers[-1],))
    assert np.isin(below.number, below.taken)[made.label == OBJECT].mean() < 0.03
    assert int(below.told["floor_splats"]) > 0  # a lid


def test_layers_are_closed_and_filled_like_single_ones() -> None:
    """What is done to a stack of layers at once is what `scipy.ndimage` does to each, also at the border."""
    layers = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=(4, 40, 50)), (0, 2, 2)) > 0.1
    for one, mask in enumerate(layers):
        np.testing.assert_array_equal(eroded(layers, DISC)[one], ndimage.binary_erosion(mask, DISC))
        np.testing.assert_array_equal(closed(layers, WIDE)[one], ndimage.binary_closing(mask, WIDE))
        np.testing.assert_array_equal(filled(layers)[one], ndimage.binary_fill_holes(mask))


def test_a_block_with_a_handle_stays_whole() -> None:
    """A handle stands on its block, but is too little of it to be an object."""
    made = bare(5, count=FEW)
    choice = choose_part(made.splats, "thickest")
    assert "carrier" not in choice.told and choice.told["floor_splats"] == 0
    assert np.isin(choice.number, choice.taken)[made.label == OBJECT].mean() > 0.97


def test_of_two_things_on_one_carrier_one_is_taken() -> None:
    """A bear and a vase on a box: one of them, closed below, and the other as a candidate with a floor of its own."""
    left, right, below = bear(), vase(), box(2.2, 1.2, 0.5, at=(0, 0, -0.25))
    below.label = CARRIER
    for shape, way in ((left, -0.6), (right, 0.6)):
        for solid in shape:
            solid.at[0] += way
    made = render([*left, *right, below], "two", np.random.default_rng(6), count=2 * FEW)
    one = choose_part(made.splats, "thickest")
    other = choose_part(made.splats, (int(one.told["other_part"]),))
    for choice in (one, other):
        low, high = choice.part.bounds()[:, 0]
        assert low > 0.0 or high < 0.0
        assert int(choice.told["floor_splats"]) > 0
        assert (made.label[choice.rows] == OBJECT).mean() > 0.99
    assert len(one.rows) + len(other.rows) > 0.97 * (made.label == OBJECT).sum()


def test_a_room_is_named() -> None:
    """A room comes with a crop that holds some of it."""
    made = room(700, count=20_000)
    crop = [float(x) for x in str(choose_part(made.splats, "thickest").told["scene_crop"]).split()]
    inside = made.splats.cropped(crop[:3], crop[3:])
    assert 200 < inside.count < 0.5 * made.splats.count


def test_the_fullest_of_two_planes_is_the_ground() -> None:
    """Of a wide sheet and a smaller one a little above it, only the wide one is the ground; so it is of spheres."""
    wide, small = sheet(0.5, 0.5, 3e-3), sheet(0.16, 0.16, 3e-3, seed=1).transformed(translation=(0.0, 0.0, 6e-3))
    thing = render_shell(toy(), 4000).transformed(translation=(0.0, 0.0, 6e-3))
    scene = merged(wide, small, thing)
    radius = np.sort(scene.scales, axis=1)[:, 1:2]
    spheres = replace(scene, scales=np.repeat(radius, 3, axis=1), quats=Rotation.random(scene.count, 0).as_quat())
    for seen in (scene, spheres):
        ground = find_ground(seen)
        assert ground is not None and ground.normal[2] == pytest.approx(1.0, abs=1e-3)
        assert ground.splats[: wide.count].mean() > 0.95
        assert ground.splats[wide.count : wide.count + small.count].mean() < 0.05


def test_a_strip_of_a_round_side_is_no_ground() -> None:
    """All of a bell lies on one side of a strip of it, but not over it."""
    assert find_ground(bare(7, count=FEW).splats) is None


def test_what_a_hand_holds_is_refused() -> None:
    """An arm that ends open is named, and the capture refused, unless its candidates are taken by number."""
    made = held(2, count=FEW)
    choice = choose_part(made.splats, "thickest")
    assert float(choice.told["arm"]) > SURE
    with pytest.raises(AssetError, match="a hand seems to hold it") as caught:
        object_source(ObjectConfig(splat=made.splats))
    numbers = caught.value.hint.split("--part ")[1].split(" takes all")[0]
    part = tuple(map(int, numbers.split()))
    source = object_source(ObjectConfig(splat=made.splats, part=part))
    assert source.capture["part_splats"] == sum(np.isin(choice.number, part))


def test_the_neck_of_a_bottle_is_no_arm() -> None:
    """It is slim and open at its end, but the belly is turned about it."""
    outer = [(0.14, 0.0), (0.14, 0.55), (0.07, 0.72), (0.07, 0.97)]
    inner = [(r - 0.012, max(z, 0.012)) for r, z in reversed(outer)]
    bottle = [lathe([(0.0, 0.0), *outer, *inner, (0.0, 0.012)])]
    made = render(bottle, "bottle", np.random.default_rng(1), count=25_000)
    thing = made.splats.subset(np.flatnonzero(made.label == OBJECT))
    assert find_arm(Surface.of(thing))[0] < HELD


def test_bad_captures_are_refused() -> None:
    """Nothing but ground encloses nothing; a candidate that is not there is refused with those that are."""
    made = bare(5, count=FEW)
    ground = sheet(0.3, 0.3, 3e-3)
    config = ObjectConfig(splat=ground)
    with pytest.raises(AssetError, match="no volume"):
        standing_quadrature(config, object_source(config))
    with pytest.raises(ConfigError, match="candidates 1 to"):
        choose_part(made.splats, (9,))
    with pytest.raises(ConfigError, match="part is"):
        ObjectConfig(splat=ground, part=("1",))  # type: ignore[arg-type]


@pytest.mark.rest
@pytest.mark.parametrize(("kind", "least"), [("smooth", 6), ("rough", 1), ("bare", 3), ("room", 1), ("held", 1)])
def test_made_captures(kind: str, least: int) -> None:
    """Of smooth carriers 95 % come off, of rough ones 70; most bare things stay whole; rooms are named, hands refused.

    A sixth of each set is enough to see what breaks; ``python -m benchmarks.carriers`` judges whole sets.
    """
    first, count = SEEDS[kind]
    found = [judge(MADE[kind](seed), kind) for seed in range(first, first + -(-count // 6))]
    assert sum(one.right for one in found) >= least
    assert sum(not one.right and not one.doubted for one in found) <= 1
