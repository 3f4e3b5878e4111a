"""Let 18 different soft toys fall through a plinko board, as in FreeForm's large scene, and film them.

The fifteen presets and three of other size and stiffness start over staggered pegs between two panes (the front one is
clear) and come to rest in the bins below. Captures of one's own take the places of the first. There is no robot.

Run: ``python examples/plinko.py [--splat FILE ...] [--object FILE ...] [--video FILE] [--seed N] [--short]``
"""

import argparse
from dataclasses import replace
from pathlib import Path

import newton
import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from softmode.deformables import BuildOptions, Material, SolverReducedOptions
from softmode.objects import PRESETS, ObjectConfig, Placed, load
from softmode.scenes import Record, SplatScene
from softmode.splats import CameraOptions, PinholeCamera, ShadowOptions
from softmode.viz import Film

WIDTH, TALL, GAP, PANE = 0.60, 0.56, 0.09, 0.02  # Of the board: width, half height, room in it, thickness [m].
PEG, BIN, WALL = 0.012, 0.14, 0.006  # Radius of a peg, height of the walls between bins, half their thickness [m].
WALLS, BETWEEN = (-0.15, 0.0, 0.15), (-0.225, -0.075, 0.075, 0.225)
PEGS = np.array([(x, 0.32 + 0.12 * row) for row in range(4) for x in (WALLS if row % 2 else BETWEEN)])  # x, z [m].
SMALL = {"cable": 0.04, "doughnut": 0.06, "ball": 0.055, "block-a": 0.045, "block-b": 0.045, "block-c": 0.045}  # [m].
BUILD, SAMPLES, SIZE = BuildOptions(mode_count=5, cubature_count=192), 300, 0.065
MORE = [("bear", 0.055, 4.0), ("doughnut", 0.05, 8.0), ("cushion", 0.055, 3.0)]  # Edge [m], stiffness over its own.
TOYS = [*((name, SMALL.get(name, SIZE), 1.0) for name in PRESETS), *MORE]
PLUSH = Material(youngs_modulus=5.0e4, poissons_ratio=0.35, density=150.0)  # What captures are made of.


def add_board(world: newton.ModelBuilder) -> None:
    """Add floor, panes, sides, walls between the bins and pegs."""
    upright, across = wp.quat_identity(), wp.quat(0.5**0.5, 0.0, 0.0, 0.5**0.5)
    clear = newton.ModelBuilder.ShapeConfig(mu=0.1, is_visible=False)
    pane, far, wood = 0.5 * PANE, 0.5 * (GAP + PANE), (0.50, 0.36, 0.24)
    world.default_shape_cfg.mu = 0.1
    below, back, front = (wp.transform(x, upright) for x in ((0, 0, -0.05), (0, far, TALL), (0, -far, TALL)))
    world.add_shape_box(-1, xform=below, hx=3.0, hy=3.0, hz=0.05, color=(0.70, 0.68, 0.64))
    world.add_shape_box(-1, xform=back, hx=0.5 * WIDTH + PANE, hy=pane, hz=TALL, color=(0.80, 0.83, 0.86))
    world.add_shape_box(-1, xform=front, hx=0.5 * WIDTH + PANE, hy=pane, hz=TALL, cfg=clear)
    sides = [(x, TALL, pane) for x in (-0.5 * (WIDTH + PANE), 0.5 * (WIDTH + PANE))]
    for x, tall, thick in sides + [(x, 0.5 * BIN, WALL) for x in WALLS]:
        place = wp.transform((x, 0.0, tall), upright)
        world.add_shape_box(-1, xform=place, hx=thick, hy=0.5 * GAP, hz=tall, color=wood)
    peg = {"radius": PEG, "half_height": 0.5 * GAP, "color": (0.75, 0.2, 0.2)}
    for x, z in PEGS:
        world.add_shape_cylinder(-1, xform=wp.transform((x, 0.0, z), across), **peg)


def turned_to_fit(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a random rotation by which points (N, 3) fit between the panes and beside each other."""
    while True:
        turn = Rotation.from_quat(rng.normal(size=4)).as_matrix()
        if (np.ptp(points @ turn.T, axis=0)[:2] < (0.085, GAP - 0.006)).all():
            return turn


def make_scene(own: list[str | ObjectConfig], seed: int, height: int, device: str | None) -> SplatScene:
    """Build the board and three rows of six toys over it, turned at random, in random order."""
    world, rng = newton.ModelBuilder(), np.random.default_rng(seed)
    add_board(world)
    toys, placed = [*((source, SIZE, 1.0) for source in own), *TOYS[len(own) :]], []
    for i, k in enumerate(rng.permutation(len(toys))):
        (source, size, stiffer), (row, column) = toys[k], divmod(i, 6)
        thing = load(source, size=size, surface_count=SAMPLES, build=BUILD)
        stuff = replace(thing.material or PLUSH, friction=0.3)
        stuff = replace(stuff, youngs_modulus=stiffer * stuff.youngs_modulus)
        place = (0.09 * (column - 2.5) + rng.uniform(-0.005, 0.005), 0.0, 0.80 + 0.11 * row)
        turn = turned_to_fit(thing.body.surface.points, rng)
        placed.append(Placed(object=replace(thing, material=stuff), position=place, rotation=turn))
    eye, target, width = (0.18, -1.6, 0.75), (0.0, 0.0, 0.54), height // 40 * 24
    camera = PinholeCamera.look_at("film", position=eye, target=target, width=width, height=height, fov_y=0.70)
    light = CameraOptions(light_direction=(-0.2, 0.7, -0.7), mesh_samples=4, splat_shadow=ShadowOptions(cells=200))
    fine = {"dt": 1.0 / 360.0, "steps_per_frame": 12, "options": SolverReducedOptions(contact_max=768)}
    return SplatScene(world, placed, cameras=[camera], camera_options=light, device=device, **fine)


def depth_in_board(scene: SplatScene) -> float:
    """Return how deep the deepest surface sample is in floor, panes, sides, walls or pegs [m]."""
    x, y, z = np.concatenate([scene.surface(i) for i in range(len(scene.objects))]).T
    outside = max((-z).max(), (np.abs(y) - 0.5 * GAP).max(), (np.abs(x) - 0.5 * WIDTH).max())
    in_wall = max(np.minimum(WALL - np.abs(x - w), BIN - z).max() for w in WALLS)
    in_peg = max((PEG - np.hypot(x - px, z - pz)).max() for px, pz in PEGS)
    return float(max(0.0, outside, in_wall, in_peg))


def test_final(scene: SplatScene, record: Record, short: bool) -> None:
    """Nothing went wrong or through a wall; given time, all rest, in the bins but for a few that hang on a peg."""
    assert not record.reasons
    assert record.depth < 2e-3 and record.overlap < 2e-3
    if not short:
        assert sum(scene.surface(i)[:, 2].mean() < PEGS[0, 1] for i in range(18)) >= 15
        assert record.energy < 1e-3 * record.peak_energy


def main() -> None:
    """Film the fall and print what the physics did."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--video", type=Path, default=Path("out/plinko.mp4"))
    parser.add_argument("--splat", action="append", default=[], help="a splat file of your own, y down")
    parser.add_argument("--object", action="append", default=[], help="a file of any kind, or a preset")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device")
    parser.add_argument("--short", action="store_true", help="0.6 s in small pictures, not 3 s")
    arguments = parser.parse_args()
    own = [*arguments.object, *(ObjectConfig(splat=file) for file in arguments.splat)]
    scene = make_scene(own, arguments.seed, 200 if arguments.short else 640, arguments.device)
    with Film(arguments.video) as film:
        record = scene.record(film, 18 if arguments.short else 90, depth_in_board)
        film.publish()
    print(f"{record}\nwrote {film.path} and {film.sheet_path}")
    test_final(scene, record, arguments.short)


if __name__ == "__main__":
    main()
