"""A radiance field falls on a table, drawn twice: rays marched through the deformed field, and splats baked of it.

The field is sampled from the built-in plush if no file is given. Physics do not know how they are drawn: both scenes
move the same, to the bit, so that the pictures can be compared.

Run: ``python examples/radiance_field.py [FILE] [--size 0.1] [--video out/radiance_field.mp4] [--short]``
"""

import argparse
from pathlib import Path

import newton
import numpy as np
import warp as wp

from softmode.deformables import Material, status_reasons
from softmode.objects import Placed, load
from softmode.radiance import RadianceGrid, read_radiance
from softmode.scenes import SplatScene
from softmode.splats import PinholeCamera, make_plush
from softmode.viz import Film

GRAVITY, DT, STEPS = 9.81, 1.0 / 480.0, 16
"""Gravity [m/s^2]; physics step [s], and steps of a frame."""
FOAM = Material(youngs_modulus=5.0e3, poissons_ratio=0.35, density=150.0, friction=0.7, viscosity=4.0e-3)


class Falls:
    """The same object in two scenes, marched and baked."""

    def __init__(self, field: RadianceGrid, *, size: float, edge: int) -> None:
        """Reduce the solid that the field shows, bake it, and hang it over a table, tilted."""
        self.thing = load(field, size=size, material=FOAM, splat_count=3000)
        self.fall = size
        turn = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
        lowest = (self.thing.body.surface.points @ turn.T)[:, 2].min()
        placed = Placed(object=self.thing, position=(0.0, 0.0, self.fall - lowest), rotation=turn)
        eye, target = (2.2 * size, -2.9 * size, 1.7 * size), (0.0, 0.0, 0.95 * size)
        camera = PinholeCamera.look_at("film", position=eye, target=target, width=edge, height=edge, fov_y=0.62)
        self.scenes = []
        for march in (True, False):
            world = newton.ModelBuilder()
            world.default_shape_cfg.mu = 0.8
            world.add_ground_plane(color=(0.66, 0.68, 0.70))
            scene = SplatScene(world, [placed], cameras=[camera], dt=DT, steps_per_frame=STEPS, march=march)
            self.scenes.append(scene)

    def run(self, film: Film, frames: int) -> np.ndarray:
        """Film both; return a row (lowest point, PSNR of the pictures, kinetic energy) per frame."""
        rows = []
        for _ in range(frames):
            marched, baked = (scene.draw() for scene in self.scenes)
            film.add(np.concatenate([marched, baked], axis=1), round(1.0 / (DT * STEPS)))
            error = (marched / 255.0 - baked / 255.0) ** 2
            scene = self.scenes[0]
            rows.append((scene.surface(0)[:, 2].min(), -10.0 * np.log10(error.mean() + 1e-12), scene.kinetic_energy()))
            for scene in self.scenes:
                scene.step()
        return np.array(rows)


def test_final(falls: Falls, rows: np.ndarray) -> None:
    """It fell freely, rests with its weight, moved alike in both scenes to the bit, and looks alike in every frame."""
    lowest, psnr, kinetic = rows.T
    n = STEPS * np.arange(3)
    np.testing.assert_allclose(lowest[0] - lowest[:3], 0.5 * GRAVITY * DT**2 * n * (n + 1), atol=1e-5)
    assert lowest.min() > -2.0e-3 and kinetic[-1] < 0.01 * kinetic.max()
    one, other = (scene.state.softmode.q.numpy() for scene in falls.scenes)
    np.testing.assert_array_equal(one, other)
    assert psnr.min() > 27.0
    weight = GRAVITY * FOAM.density * falls.thing.body.volume
    force = falls.scenes[0].solver.instance_force.numpy()[0]
    np.testing.assert_allclose(force / weight, (0.0, 0.0, 1.0), atol=0.2)  # it still rocks a little
    assert not status_reasons(int(falls.scenes[0].solver.status.numpy()[0]))


def main() -> None:
    """Film the fall and print how alike the pictures are."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", nargs="?", help="radiance field (.npz, .nvdb); one of the plush if not given")
    parser.add_argument("--size", type=float, default=0.1, help="longest edge [m]")
    parser.add_argument("--video", type=Path, default=Path("out/radiance_field.mp4"))
    parser.add_argument("--short", action="store_true", help="small pictures")
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    field = read_radiance(given.file) if given.file else RadianceGrid.from_splats(make_plush(), resolution=64)
    falls = Falls(field, size=given.size, edge=96 if given.short else 360)
    print(f"field of {' x '.join(map(str, field.shape))} nodes; {falls.thing.visible_splats.count} splats baked of it")
    with Film(given.video) as film:
        rows = falls.run(film, 60)
        film.publish()
    for k in range(0, len(rows), 6):
        lowest, psnr, kinetic = rows[k]
        print(f"{k * DT * STEPS:5.2f} s: lowest {1e3 * lowest:6.1f} mm, {1e3 * kinetic:7.4f} mJ, {psnr:.1f} dB apart")
    print(f"wrote {film.path} and {film.sheet_path}")
    test_final(falls, rows)


if __name__ == "__main__":
    main()
