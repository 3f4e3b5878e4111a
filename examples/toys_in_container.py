"""Drop 13 soft toys of splats into a container, as in FreeForm's large scene, and film them.

Plush bears of three sizes, balls, cubes, a beam and a disc, each of its own stiffness and colour, fall in three layers,
touch each other and the walls, and come to rest. There is no robot: one world, one solve for all bodies.

Run: ``python examples/toys_in_container.py [--presets] [--video FILE] [--splat FILE] [--seed N] [--device cuda:0]
[--short]``; with ``--presets`` thirteen different objects of the library fall instead, each of its own material.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import newton
import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from softmode.deformables import BuildOptions, Material, SolverReducedOptions
from softmode.objects import ObjectConfig, Placed, load
from softmode.scenes import Record, SplatScene
from softmode.splats import CameraOptions, PinholeCamera, ShadowOptions
from softmode.viz import Film

HALF, HEIGHT, WALL = 0.11, 0.12, 0.012
"""Half width of the container inside, height and thickness of its walls [m]."""
WHITE = (0.9, 0.9, 0.92)
BLUE, GREEN, PINK = ((0.2, 0.4, 0.8), WHITE), ((0.2, 0.6, 0.4), (0.95, 0.9, 0.6)), ((0.8, 0.3, 0.5), WHITE)
BUILD = BuildOptions(mode_count=5, cubature_count=192)
TOYS = {
    "bear": ObjectConfig(size=0.08),
    "small bear": ObjectConfig(size=0.06),
    "large bear": ObjectConfig(size=0.10),
    "ball": ObjectConfig(shape="sphere", extents=(0.065, 0.065, 0.065), colors=BLUE),
    "cube": ObjectConfig(shape="box", extents=(0.055, 0.055, 0.055), colors=GREEN),
    "beam": ObjectConfig(shape="box", extents=(0.13, 0.03, 0.03), colors=PINK),
    "disc": ObjectConfig(shape="cylinder", extents=(0.08, 0.08, 0.025)),
}
FALLING = "large bear,ball,bear,cube,small bear,beam,bear,disc,large bear,ball,small bear,cube,bear".split(",")
PRESETS = "bread mug banana fish doughnut ball block-a block-b block-c sponge bear cushion glove".split()
SMALL = {"doughnut": 0.07, "ball": 0.055, "block-a": 0.048, "block-b": 0.048, "block-c": 0.048}
LAYER = ((0.0, 0.0), (0.06, 0.06), (-0.06, -0.06), (0.06, -0.06), (-0.06, 0.06))
"""Where the five of a layer start [m]."""


def make_scene(splat: str | None, seed: int, size: int, device: str | None, presets: bool = False) -> SplatScene:
    """Build the container and the toys above it, turned at random."""
    world, rng, upright = newton.ModelBuilder(), np.random.default_rng(seed), wp.quat_identity()
    world.default_shape_cfg.mu = 0.5
    below = wp.transform((0.0, 0.0, -0.05), upright)
    world.add_shape_box(-1, xform=below, hx=2.0, hy=2.0, hz=0.05, color=(0.72, 0.68, 0.62), label="floor")
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        place = wp.transform((x * (HALF + 0.5 * WALL), y * (HALF + 0.5 * WALL), 0.5 * HEIGHT), upright)
        hx, hy = (0.5 * WALL, HALF + WALL) if x else (HALF + WALL, 0.5 * WALL)
        world.add_shape_box(-1, xform=place, hx=hx, hy=hy, hz=0.5 * HEIGHT, color=(0.50, 0.36, 0.24))
    toys = {name: ObjectConfig(preset=name, size=SMALL.get(name, 0.085)) for name in PRESETS} if presets else TOYS
    configs = {name: replace(toy, surface_count=150, build=BUILD) for name, toy in toys.items()}
    if splat and not presets:
        configs["bear"] = replace(configs["bear"], splat=splat)
    things = {name: load(config) for name, config in configs.items()}
    placed = []
    for i, name in enumerate(PRESETS if presets else FALLING):
        thing, (layer, cell) = things[name], divmod(i, len(LAYER))
        place = (*LAYER[cell], 0.17 + 0.13 * layer + (0.04 if cell == 0 else 0.0))
        turn = Rotation.from_quat(rng.normal(size=4)).as_matrix()
        modulus = float(np.exp(rng.uniform(np.log(3.0e4), np.log(3.0e5))))
        stuff = (presets and thing.material) or Material(youngs_modulus=modulus, poissons_ratio=0.35, density=250.0)
        shown = thing.visible_splats
        if name.endswith(" bear") or (name == "bear" and not presets):
            shown = replace(shown, sh=np.roll(shown.sh, i, axis=2))  # red, green and blue change places
        toy = replace(thing, material=stuff, splats=shown)
        placed.append(Placed(object=toy, position=place, rotation=turn))
    eye, target = (0.38, -0.28, 0.46), (0.0, 0.0, 0.085)
    camera = PinholeCamera.look_at("film", position=eye, target=target, width=size, height=size, fov_y=0.72)
    light = CameraOptions(mesh_samples=4, splat_shadow=ShadowOptions(cells=160))
    many = SolverReducedOptions(contact_max=512)
    return SplatScene(world, placed, cameras=[camera], options=many, camera_options=light, device=device)


def depth_in_walls(scene: SplatScene) -> float:
    """Return how deep the deepest surface sample is in the floor or a wall [m]."""
    x = np.concatenate([scene.surface(i) for i in range(len(scene.objects))])
    beside = np.abs(x[:, :2]).max(axis=1)
    in_wall = np.minimum(np.minimum(beside - HALF, HALF + WALL - beside), HEIGHT - x[:, 2])
    return float(max(0.0, in_wall.max(), -x[:, 2].min()))


def test_final(scene: SplatScene, record: Record) -> None:
    """Nothing went wrong, all toys lie in the container, at rest, and nothing was ever deep in a wall or a toy.

    In the fall arms are pressed into others by up to 6 mm, presets by up to 11 mm: the status says "penetration".
    """
    centres = np.array([scene.surface(i).mean(axis=0) for i in range(len(scene.objects))])
    assert set(record.reasons) <= {"penetration"}
    assert (np.abs(centres[:, :2]) < HALF).all() and (centres[:, 2] > 0.0).all()
    assert record.energy < 1e-3 * record.peak_energy
    assert record.depth < 2e-3 and record.overlap < (14e-3 if scene.objects[0].config.preset else 8e-3)


def main() -> None:
    """Film the fall and print what the physics did."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--video", type=Path, default=Path("out/toys_in_container.mp4"))
    parser.add_argument("--splat", help="splat file of three of the toys, y down")
    parser.add_argument("--presets", action="store_true", help="objects of the library")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device")
    parser.add_argument("--short", action="store_true", help="1.6 s in small pictures, not 2 s")
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    scene = make_scene(given.splat, given.seed, 160 if given.short else 480, given.device, given.presets)
    with Film(given.video) as film:
        record = scene.record(film, 48 if given.short else 60, depth_in_walls)
        film.publish()
    print(f"{record}\nwrote {film.path} and {film.sheet_path}")
    test_final(scene, record)


if __name__ == "__main__":
    main()
