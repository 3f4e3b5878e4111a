"""Paint a body stiff, by colour and with a brush, and press it beside the unpainted one: how much harder does it push?

Four equal blocks of foam stand between frictionless plates. Red is stiffer: below the other half it helps little,
beside it much. The stroke of a brush comes from a file. In closed form, with s the relative Young's modulus:

    stacked 1 / <1/s>, strains are as 1/s       side by side, and the stroke, <s>, strains are equal

Run: ``python examples/paint_stiffness.py [--short]``; writes ``out/paint_stiffness.mp4`` and a sheet
"""

import argparse
from dataclasses import replace
from pathlib import Path

import newton
import numpy as np
import warp as wp

from softmode.deformables import Material, SoftEnergies, paint
from softmode.objects import Placed, SoftObject, StifferColor, color_field, load, read_field
from softmode.scenes import SplatScene, motion_of
from softmode.splats import PinholeCamera
from softmode.viz import Film

EDGE, HEIGHT, BRUSH, FACTOR, SMALL, LARGE = 0.08, 0.10, 0.012, 10.0, 0.02, 0.12
"""Edges of a block's section, its height, radius of the brush [m]; stiffness of what is red over the rest; share of
the height that the plates take where stiffness is measured, and at the end of the film."""
RED, CREAM = (0.78, 0.16, 0.13), (0.93, 0.86, 0.72)
FOAM = Material(youngs_modulus=2.0e4, poissons_ratio=0.0, density=100.0, friction=0.0, mass_damping=20.0)


def in_stroke(x: np.ndarray) -> np.ndarray:
    """Return which points (N, 3) lie below an S that a brush has drawn on the top."""
    y = np.linspace(-0.5, 0.5, 200) * EDGE
    drawn = np.stack([0.022 * np.sin(2.0 * np.pi * y / EDGE), y], axis=1)
    return np.linalg.norm(x[:, None, :2] - drawn, axis=2).min(axis=1) < BRUSH


def make_blocks(count: int) -> list[SoftObject]:
    """Return blocks of `count` splats: plain, a red lower half, a red half at the right, a red stroke."""
    plain = load(shape="box", extents=(EDGE, EDGE, HEIGHT), colors=2 * (CREAM,), material=FOAM, splat_count=count)
    splats, blocks = plain.visible_splats, [plain]
    for k, red in enumerate((splats.means[:, 2] < 0.0, splats.means[:, 0] > 0.0, in_stroke(splats.means))):
        shown = replace(splats, sh=(np.where(red[:, None], RED, splats.colors())[:, None] - 0.5) / 0.28209479177387814)
        field = color_field(shown, [StifferColor(color=RED, factor=FACTOR)])
        if k == 2:
            at = np.random.default_rng(0).uniform(-0.5, 0.5, (20000, 3)) * (EDGE, EDGE, HEIGHT)
            np.savez("out/stroke.npz", points=at, factors=np.where(in_stroke(at), FACTOR, 1.0))
            field = read_field("out/stroke.npz")
        blocks.append(replace(plain, body=paint(plain.body, stiffness_scale=field), splats=shown))
    return blocks


def make_press(blocks: list[SoftObject], edge: int) -> SplatScene:
    """Return the blocks in a row between two plates."""
    world, smooth = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0)), newton.ModelBuilder.ShapeConfig(mu=0.0)
    for side in (-1.0, 1.0):
        at = wp.transform((0.0, 0.0, side * (0.5 * HEIGHT + 0.008)), wp.quat_identity())
        world.add_shape_box(-1, xform=at, hx=0.27, hy=0.06, hz=0.008, cfg=smooth, color=(0.50, 0.53, 0.57))
    placed = [Placed(object=block, position=(0.13 * (k - 1.5), 0.0, 0.0)) for k, block in enumerate(blocks)]
    view = {"position": (0.0, -1.0, 0.20), "target": (0.0, 0.0, 0.0), "fov_y": 0.24}
    camera = PinholeCamera.look_at("film", width=5 * edge // 2, height=edge, **view)
    return SplatScene(world, placed, cameras=[camera], dt=1.0 / 60.0, steps_per_frame=2)


def press_to(scene: SplatScene, share: float) -> None:
    """Bring the plates nearer by a share of the height and take a frame."""
    poses = scene.model.shape_transform.numpy()
    poses[:2, 2] = np.array([-1.0, 1.0]) * (0.5 * HEIGHT * (1.0 - share) + 0.008)
    scene.model.shape_transform.assign(poses)
    scene.step()


def measure(scene: SplatScene) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the modulus along z of each block [Pa], and the strain of each at its points."""
    energies = SoftEnergies(scene.solver)
    energies.update(scene.state)
    points = [block.body.cubature for block in scene.objects]
    strains = [p.grad_basis[:, :, 2] @ q[:, 2] for p, q in zip(points, motion_of(scene).q, strict=True)]
    mean = np.array([np.average(strain, weights=p.weights) for p, strain in zip(points, strains, strict=True)])
    return 2.0 * energies.elastic.numpy() / (scene.objects[0].body.volume * mean**2), strains


def test_final(blocks: list[SoftObject], moduli: np.ndarray, strains: list[np.ndarray]) -> None:
    """Paint covers what was drawn; moduli are those of springs in a row and side by side, strains as 1/s in the row."""
    mean = np.array([np.average(p.stiffness_scale, weights=p.weights) for p in (b.body.cubature for b in blocks)])
    np.testing.assert_allclose(mean[1:3], 0.5 * (1.0 + FACTOR), rtol=0.02)
    scale, weights = blocks[1].body.cubature.stiffness_scale, blocks[1].body.cubature.weights
    found, expected = moduli / moduli[0], np.array([1.0, 1.0 / np.average(1.0 / scale, weights=weights), *mean[2:]])
    upper, lower = (np.average(strains[1][part], weights=weights[part]) for part in (scale == 1.0, scale > 1.0))
    print(f"plain, stacked, side by side, stroke: {found.round(2)} times as stiff, expected {expected.round(2)}")
    print(f"stacked: the red half strains {upper / lower:.2f} times less, expected {FACTOR:.2f}")
    assert abs(moduli[0] / FOAM.youngs_modulus - 1.0) < 0.01
    np.testing.assert_allclose(found, expected, rtol=0.08)  # 48 smooth functions, and contact that gives a little
    assert abs(upper / lower / FACTOR - 1.0) < 0.15


def main(arguments: list[str] | None = None) -> None:
    """Paint, press a little and measure, press on; film it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--short", action="store_true", help="small pictures")
    short = parser.parse_args(arguments).short
    wp.config.log_level = wp.LOG_WARNING
    Path("out").mkdir(exist_ok=True)
    blocks = make_blocks(2000 if short else 12000)
    scene = make_press(blocks, 96 if short else 360)
    for k in range(40):
        press_to(scene, SMALL * min(k / 20, 1.0))
    measured = measure(scene)
    with Film(Path("out/paint_stiffness.mp4")) as film:
        for share in np.linspace(SMALL, LARGE, 46).tolist() + 14 * [LARGE]:
            press_to(scene, share)
            film.add(scene.draw(), 30)
        film.publish()
    print(f"wrote {film.path} and {film.sheet_path}")
    test_final(blocks, *measured)


if __name__ == "__main__":
    main()
