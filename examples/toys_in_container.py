"""Drop 13 different soft toys into a container, as in FreeForm's large scene, and film them.

Presets of the library, each of its own shape, colours and material, fall in three layers, touch each other and the
walls, and come to rest. Captures of one's own take the places of the first. There is no robot: one world, one solve.

Run: ``python examples/toys_in_container.py [--splat FILE ...] [--object FILE ...] [--video FILE] [--seed N]
[--device cuda:0] [--short]``; both options may be given several times.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import newton
import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from softmode.deformables import BuildOptions, Material
from softmode.objects import ObjectConfig, Placed, load
from softmode.scenes import Record, SplatScene
from softmode.splats import CameraOptions, PinholeCamera, ShadowOptions
from softmode.viz import Film

HALF, HEIGHT, WALL = 0.11, 0.12, 0.012
"""Half width of the container inside, height and thickness of its walls [m]."""
BUILD, SAMPLES = BuildOptions(mode_count=5, cubature_count=192), 400
PRESETS = "bread mug banana fish doughnut ball block-a block-b block-c sponge bear cushion glove".split()
SIZE, SMALL = 0.085, {"doughnut": 0.07, "ball": 0.055, "block-a": 0.048, "block-b": 0.048, "block-c": 0.048}
"""Longest edge of a toy, and of those that are thick [m]."""
PLUSH = Material(youngs_modulus=5.0e4, poissons_ratio=0.35, density=150.0)
"""What captures are made of."""
LAYER = ((0.0, 0.0), (0.06, 0.06), (-0.06, -0.06), (0.06, -0.06), (-0.06, 0.06))
"""Where the five of a layer start [m]."""


def make_scene(own: list[str | ObjectConfig], seed: int, size: int, device: str | None) -> SplatScene:
    """Build the container and the toys above it, turned at random; one's own take the places of the first."""
    world, rng, upright = newton.ModelBuilder(), np.random.default_rng(seed), wp.quat_identity()
    world.default_shape_cfg.mu = 0.5
    below = wp.transform((0.0, 0.0, -0.05), upright)
    world.add_shape_box(-1, xform=below, hx=2.0, hy=2.0, hz=0.05, color=(0.72, 0.68, 0.62), label="floor")
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        place = wp.transform((x * (HALF + 0.5 * WALL), y * (HALF + 0.5 * WALL), 0.5 * HEIGHT), upright)
        hx, hy = (0.5 * WALL, HALF + WALL) if x else (HALF + WALL, 0.5 * WALL)
        world.add_shape_box(-1, xform=place, hx=hx, hy=hy, hz=0.5 * HEIGHT, color=(0.50, 0.36, 0.24))
    placed = []
    for i, source in enumerate([*own, *PRESETS[len(own) :]]):
        thing = load(source, size=SMALL.get(str(source), SIZE), surface_count=SAMPLES, build=BUILD)
        layer, cell = divmod(i, len(LAYER))
        place = (*LAYER[cell], 0.17 + 0.14 * layer + (0.06 if cell == 0 else 0.0))
        turn = Rotation.from_quat(rng.normal(size=4)).as_matrix()
        placed.append(Placed(object=replace(thing, material=thing.material or PLUSH), position=place, rotation=turn))
    eye, target = (0.31, -0.23, 0.64), (0.0, 0.0, 0.09)
    camera = PinholeCamera.look_at("film", position=eye, target=target, width=size, height=size, fov_y=0.72)
    light = CameraOptions(mesh_samples=4, splat_shadow=ShadowOptions(cells=160))
    fine = {"dt": 1.0 / 360.0, "steps_per_frame": 12}
    return SplatScene(world, placed, cameras=[camera], camera_options=light, device=device, **fine)


def depth_in_walls(scene: SplatScene) -> float:
    """Return how deep the deepest surface sample is in the floor or a wall [m]."""
    x = np.concatenate([scene.surface(i) for i in range(len(scene.objects))])
    beside = np.abs(x[:, :2]).max(axis=1)
    in_wall = np.minimum(np.minimum(beside - HALF, HALF + WALL - beside), HEIGHT - x[:, 2])
    return float(max(0.0, in_wall.max(), -x[:, 2].min()))


def test_final(scene: SplatScene, record: Record) -> None:
    """Nothing went wrong, all toys lie in the container, at rest, and nothing was ever deep in a wall or a toy."""
    centres = np.array([scene.surface(i).mean(axis=0) for i in range(len(scene.objects))])
    assert set(record.reasons) <= {"penetration"}
    assert (np.abs(centres[:, :2]) < HALF).all() and (centres[:, 2] > 0.0).all()
    assert record.energy < 1e-3 * record.peak_energy
    assert record.depth < 2e-3 and record.overlap < 2e-3


def main() -> None:
    """Film the fall and print what the physics did."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--video", type=Path, default=Path("out/toys_in_container.mp4"))
    parser.add_argument("--splat", action="append", default=[], help="a splat file of your own, y down")
    parser.add_argument("--object", action="append", default=[], help="a file of any kind, or a preset")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device")
    parser.add_argument("--short", action="store_true", help="1.6 s in small pictures, not 2 s")
    given = parser.parse_args()
    own = [*given.object, *(ObjectConfig(splat=file) for file in given.splat)]
    scene = make_scene(own, given.seed, 160 if given.short else 480, given.device)
    with Film(given.video) as film:
        record = scene.record(film, 48 if given.short else 60, depth_in_walls)
        film.publish()
    print(f"{record}\nwrote {film.path} and {film.sheet_path}")
    test_final(scene, record)


if __name__ == "__main__":
    main()
