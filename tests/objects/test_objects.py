"""Soft objects: which part of a capture, how large, how it stands, what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from softmode.deformables.reduction.options import BuildOptions
from softmode.errors import AssetError, ConfigError
from softmode.objects import ObjectConfig, load, pipeline
from softmode.objects.parts import Part, choose_part
from softmode.objects.pose import stable_rotation
from softmode.objects.source import object_source
from softmode.splats import Splats, make_plush, plush, write_ply
from softmode.splats.point_cloud import splats_from_points


def shell(count: int, radius: float, centre: tuple[float, float, float], seed: int = 0) -> Splats:
    """Return flat splats on a sphere."""
    rng = np.random.default_rng(seed)
    k = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1.0 - 2.0 * k / count), np.pi * (1.0 + np.sqrt(5.0)) * k
    normal = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1)
    half = np.cross([0.0, 0.0, 1.0], normal)
    quats = np.column_stack([half, 1.0 + normal[:, 2]])  # from +z to the normal
    pitch = radius * np.sqrt(4.0 * np.pi / count)
    return Splats(
        means=radius * normal + np.asarray(centre) + 1e-6 * rng.normal(size=(count, 3)),
        quats=quats,
        scales=np.tile([pitch, pitch, 0.05 * pitch], (count, 1)),
        opacities=np.full(count, 0.95),
        sh=rng.normal(size=(count, 1, 3)),
    )


def slab(edge: float, pitch: float, z: float = 0.0) -> Splats:
    """Return flat splats on a square."""
    axis = np.arange(-0.5 * edge, 0.5 * edge, pitch)
    x, y = (g.ravel() for g in np.meshgrid(axis, axis))
    count = len(x)
    return Splats(
        means=np.column_stack([x, y, np.full(count, z)]),
        quats=np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)),
        scales=np.tile([pitch, pitch, 0.05 * pitch], (count, 1)),
        opacities=np.full(count, 0.95),
        sh=np.zeros((count, 1, 3)),
    )


def merged(*parts: Splats) -> Splats:
    """Return one set of splats."""
    fields = ("means", "quats", "scales", "opacities", "sh")
    return Splats(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in fields})


@pytest.fixture(scope="module")
def capture() -> Splats:
    """Return a ball over a wide patch of ground, beside a high thin pole of small balls."""
    pole = [shell(60, 0.05, (1.0, 1.0, 0.3 + 0.09 * k), seed=k) for k in range(12)]
    return merged(slab(4.0, 0.06), shell(900, 0.3, (0.0, 0.0, 0.5)), *pole)


@pytest.mark.parametrize(("rule", "height"), [("thickest", 0.6), ("tallest", 1.09), ("largest", 0.0)])
def test_part_is_chosen_by_its_rule(capture: Splats, rule: Part, height: float) -> None:
    """The ball is thickest, the pole tallest, the ground largest: each has a height of its own."""
    part = choose_part(capture, rule).part
    assert np.ptp(part.means[:, 2]) == pytest.approx(height, abs=0.01)


def test_thickest_part_does_not_depend_on_the_frame(capture: Splats) -> None:
    """The least spread is an eigenvalue of the covariance, so a capture may be tilted."""
    a = 0.7
    tilt = [[1.0, 0.0, 0.0], [0.0, np.cos(a), -np.sin(a)], [0.0, np.sin(a), np.cos(a)]]
    assert choose_part(capture.transformed(rotation=tilt), "thickest").part.count == 900


@pytest.mark.parametrize("count", [1000, 3000, 10000])
def test_points_strewn_at_random_are_one_part(count: int) -> None:
    """Of points that are uniform on a sphere, independently of each other, none is taken for a floater."""
    points = np.random.default_rng(count).normal(size=(count, 3))
    points *= 0.05 / np.linalg.norm(points, axis=1, keepdims=True)
    assert choose_part(splats_from_points(points), "thickest").part.count == count


def test_all_keeps_everything(capture: Splats) -> None:
    """Rule "all" is the identity."""
    assert choose_part(capture, "all").part is capture


def box(x: float, y: float, z: float) -> np.ndarray:
    """Return a grid of points that fills a box, corners included."""
    axes = [np.linspace(-0.5 * edge, 0.5 * edge, 7) for edge in (x, y, z)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def test_an_object_that_stands_is_left_alone() -> None:
    """A cube and the plush rest on a face already; a ball never tips, whatever it stands on."""
    assert stable_rotation(box(1.0, 1.0, 1.0)) is None
    assert stable_rotation(load(ObjectConfig()).body.surface.points) is None


@pytest.mark.parametrize("tilt", [0.3, 0.7, 1.2])
def test_a_tilted_box_lies_down_on_its_nearest_face(tilt: float) -> None:
    """Tilted by less than 45 degrees a cube turns back by the tilt, by more it goes on to the next face."""
    c, s = np.cos(tilt), np.sin(tilt)
    points = box(1.0, 1.0, 1.0) @ np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]).T
    turn = stable_rotation(points)
    assert turn is not None
    angle = np.arccos(0.5 * (np.trace(turn) - 1.0))
    assert angle == pytest.approx(min(tilt, 0.5 * np.pi - tilt), abs=1e-6)


def test_an_object_on_its_tip_topples_and_then_stands() -> None:
    """A cone on its apex turns; the turn is proper, lowers the centre of mass, and is the last one."""
    angle = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    rim = np.stack([0.4 * np.cos(angle), 0.4 * np.sin(angle), np.full(40, 0.25)], axis=1)
    points = np.concatenate([rim, [[0.0, 0.0, -0.75]]])  # the centre of mass of a solid cone is the origin
    turn = stable_rotation(points)
    assert turn is not None
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    turned = points @ turn.T
    assert -turned[:, 2].min() < -points[:, 2].min()
    assert stable_rotation(turned) is None


def test_plush_stands_on_the_table_at_its_size() -> None:
    """The longest edge is the size, the lowest surface sample lies `height` under the centre of mass."""
    thing = load(ObjectConfig(size=0.07))
    assert np.ptp(thing.visible_splats.means, axis=0).max() == pytest.approx(0.07, rel=0.02)
    assert thing.height == pytest.approx(-thing.body.surface.points[:, 2].min())
    assert thing.basis.shape == (thing.visible_splats.count, thing.body.function_count)
    assert thing.grad_basis.shape == (*thing.basis.shape, 3)


def test_a_contact_radius_lifts_what_stands_free() -> None:
    """The touching surface stands out by the radius, so the object rests so much higher, unless it is clamped."""
    box = ObjectConfig(
        shape="box", extents=(0.04, 0.04, 0.06), surface_count=40, build=BuildOptions(mode_count=1, cubature_count=24)
    )
    thing = load(box)
    assert thing.body.driven_count == 0
    assert load(replace(box, contact_radius=0.002)).height == pytest.approx(thing.height + 0.002)
    post = load(replace(box, contact_radius=0.002, clamped_height=0.01))
    assert post.height == pytest.approx(-post.body.surface.points[:, 2].min())
    low = post.body.surface.points[:, 2] < post.body.surface.points[:, 2].min() + 0.009
    free = post.body.evaluate(post.body.surface.points)[0][:, post.body.driven_count :]
    assert post.body.driven_count > 0 and low.sum() >= 4
    assert np.abs(free[low]).max() < 1e-6 < np.abs(free[~low]).max()


def test_affine_motion_of_body_moves_the_splats_along() -> None:
    """x(X) = X + sum b_k q_k with q = affine(A, t) is A X + t at every splat."""
    thing = load(ObjectConfig())
    A, t = np.array([[1.1, 0.2, 0.0], [0.0, 0.9, 0.1], [-0.1, 0.0, 1.0]]), np.array([0.1, -0.2, 0.3])
    X = thing.visible_splats.means.astype(float)
    np.testing.assert_allclose(X + thing.basis @ thing.body.affine(A, t), X @ A.T + t, atol=1e-9)


@pytest.mark.rest
def test_body_comes_from_the_cache_the_second_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A second load builds nothing and gives bitwise the same object; another size is another body."""
    monkeypatch.setenv("SOFTMODE_CACHE", str(tmp_path))
    file = tmp_path / "ball.ply"
    write_ply(file, shell(800, 1.0, (0.0, 0.0, 0.0)))
    config = ObjectConfig(splat=file, size=0.05)
    first = load(config)
    monkeypatch.setattr(pipeline, "build_body", lambda *_, **__: pytest.fail("built again"))
    second = load(config)
    np.testing.assert_array_equal(first.basis, second.basis)
    np.testing.assert_array_equal(first.visible_splats.means, second.visible_splats.means)
    with pytest.raises(pytest.fail.Exception, match="built again"):
        load(replace(config, size=0.06))


def test_up_axis_turns_the_file_upright(tmp_path: Path) -> None:
    """A plush written with y down and read with up="-y" is the plush read with up="+z", but for rounding."""
    down = make_plush().transformed(rotation=[[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # z up -> y down
    write_ply(tmp_path / "down.ply", down)
    write_ply(tmp_path / "up.ply", make_plush())
    a = object_source(ObjectConfig(splat=tmp_path / "down.ply", up="-y", part="all")).splats
    b = object_source(ObjectConfig(splat=tmp_path / "up.ply", up="+z", part="all")).splats
    np.testing.assert_allclose(a.means, b.means, atol=1e-6)


@pytest.mark.rest
def test_trained_capture_becomes_the_robot(playbot: Path) -> None:
    """Ground and hands go; the pointed foot cannot carry it, so it lies; nothing of it is under the table."""
    config = ObjectConfig(splat=playbot, size=0.08)
    thing = load(config)
    assert 1500 < thing.visible_splats.count < 1900  # of 8406: 6163 are ground, 468 are hands
    assert thing.visible_splats.sh_degree == 2
    lying = stable_rotation(thing.body.surface.points)
    assert lying is None
    standing = load(replace(config, pose="captured"))
    assert stable_rotation(standing.body.surface.points) is not None
    assert np.ptp(standing.visible_splats.means, axis=0).max() == pytest.approx(0.08, rel=0.03)
    assert thing.height < 0.6 * standing.height
    assert thing.body.volume == pytest.approx(standing.body.volume, rel=0.02)


def truncated(path: Path) -> None:
    """Write the first half of a splat file."""
    write_ply(path, make_plush(count=200))
    path.write_bytes(path.read_bytes()[:9000])


BAD_FILES = {
    "missing": lambda path: None,
    "truncated": truncated,
    "no volume": lambda path: write_ply(path, slab(1.0, 0.05)),
    "one point": lambda path: write_ply(path, slab(1.0, 0.05).transformed(scale=1e-30)),
    "text": lambda path: path.write_text("hello"),
}


@pytest.mark.parametrize("kind", BAD_FILES)
def test_unusable_files_are_refused_by_name(tmp_path: Path, kind: str) -> None:
    """Every unusable file is an AssetError that names the file and a remedy."""
    path = tmp_path / "bad.ply"
    BAD_FILES[kind](path)
    with pytest.raises(AssetError, match=r"bad\.ply") as caught:
        load(ObjectConfig(splat=path))
    assert caught.value.hint


def test_empty_crop_says_where_the_splats_are(tmp_path: Path) -> None:
    """The remedy of a crop that misses gives the bounds of what it missed."""
    write_ply(tmp_path / "plush.ply", make_plush(count=300))
    with pytest.raises(AssetError, match="no splat lies inside crop") as caught:
        load(ObjectConfig(splat=tmp_path / "plush.ply", up="+z", crop=(9.0, 9.0, 9.0, 10.0, 10.0, 10.0)))
    assert "fill" in caught.value.hint


@pytest.mark.parametrize(
    "given",
    [
        {"size": 0.0},
        {"size": float("nan")},
        {"size": 30.0},
        {"crop": (0.0, 0.0, 0.0, 1.0, -1.0, 1.0)},
        {"part": "best"},
        {"up": "z"},
        {"pose": "flat"},
        {"contact_radius": -0.001},
        {"clamped_height": float("inf")},
        {"resolution": 8},
    ],
)
def test_options_out_of_range_are_refused(given: dict) -> None:
    """Every option is checked when the configuration is made, before any file is read."""
    with pytest.raises(ConfigError, match=next(iter(given))):
        ObjectConfig(**given)


def test_plush_comes_from_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The plush is made once; what the cache returns has the same bits."""
    monkeypatch.setenv("SOFTMODE_CACHE", str(tmp_path))
    first = object_source(ObjectConfig()).splats
    monkeypatch.setattr(plush, "make_plush", lambda: pytest.fail("made again"))
    second = object_source(ObjectConfig()).splats
    assert first.name == second.name
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()
