"""Drop an object made of splats on a table and watch it bounce and come to rest.

The first thing to do with a capture of one's own: is it cut out well, filled, as heavy and as soft as it should be?
Energy is booked in every frame: gravity feeds it, damping, friction and impacts take it, nothing creates it.

Run: ``python examples/drop_a_splat.py [FILE] [--size 0.1] [--video out/drop_a_splat.mp4] [--short]``
"""

import argparse
from pathlib import Path

import newton
import numpy as np
import warp as wp

from softmode.deformables import Material, status_reasons
from softmode.objects import Placed, load
from softmode.scenes import SplatScene
from softmode.splats import CameraOptions, PinholeCamera, ShadowOptions
from softmode.viz import Film

GRAVITY, DT, STEPS = 9.81, 1.0 / 960.0, 32
"""Gravity [m/s^2]; physics step [s], and steps of a frame: implicit steps that are long eat the bounce."""
FOAM = Material(youngs_modulus=6.0e3, poissons_ratio=0.3, density=150.0, friction=0.6, viscosity=1.0e-3)


class Drop:
    """The object over a table, and what is measured of it."""

    def __init__(self, file: str | None, *, size: float, edge: int) -> None:
        """Reduce the object and hang it 1.5 sizes over the table."""
        self.thing = load(file, size=size, material=FOAM)
        self.fall = 1.5 * size
        world = newton.ModelBuilder()
        world.default_shape_cfg.mu = 0.8
        below = wp.transform((0.0, 0.0, -0.05), wp.quat_identity())
        world.add_shape_box(-1, xform=below, hx=9.0, hy=9.0, hz=0.05, color=(0.66, 0.68, 0.70), label="table")
        placed = Placed(object=self.thing, position=(0.0, 0.0, self.fall + self.thing.height))
        eye, target = (4.2 * size, -1.6 * size, 1.8 * size), (0.0, 0.0, 1.05 * size)
        camera = PinholeCamera.look_at("film", position=eye, target=target, width=edge, height=edge, fov_y=0.66)
        light = CameraOptions(mesh_samples=4, splat_shadow=ShadowOptions(cells=48))
        self.scene = SplatScene(world, [placed], cameras=[camera], dt=DT, steps_per_frame=STEPS, camera_options=light)
        self.weight = GRAVITY * FOAM.density * self.thing.body.volume

    def measure(self) -> tuple[float, float, float]:
        """Return lowest sample and centre of mass [m], and the kinetic energy [J]."""
        body, q = self.thing.body, self.scene.state.softmode.q.numpy()
        return self.scene.surface(0)[:, 2].min(), float(body.mean_basis @ q[:, 2]), self.scene.kinetic_energy()

    def run(self, film: Film, frames: int) -> np.ndarray:
        """Film and measure; return a row (time, lowest, centre, kinetic energy) per frame."""
        rows, frame_dt = [(0.0, *self.measure())], DT * STEPS
        for k in range(frames):
            film.add(self.scene.draw(), round(1.0 / frame_dt))
            self.scene.step()
            rows.append(((k + 1) * frame_dt, *self.measure()))
        return np.array(rows)


def test_final(drop: Drop, rows: np.ndarray) -> None:
    """It fell freely, gained no energy, did not sink in, bounced, and rests with its weight on the table."""
    t, lowest, centre, kinetic = rows.T
    falling = t < np.sqrt(2.0 * drop.fall / GRAVITY) - t[1]
    late = 0.5 * GRAVITY * t * DT  # how far the implicit Euler step runs ahead of the parabola
    np.testing.assert_allclose((centre[0] - centre - 0.5 * GRAVITY * t**2 - late)[falling], 0.0, atol=1e-6)
    total = kinetic + drop.weight * centre  # elastic energy, the rest, is never negative
    assert (total <= total[0] * (1.0 + 1e-6)).all()
    assert lowest.min() > -1.0e-3
    assert lowest[np.argmax(lowest < 1.0e-3) :].max() > 0.05 * drop.fall
    assert kinetic[-1] < 1.0e-4 * kinetic.max() and abs(lowest[-1]) < 5.0e-4
    pushed = drop.scene.solver.instance_force.numpy()[0]
    np.testing.assert_allclose(pushed / drop.weight, (0.0, 0.0, 1.0), atol=0.05)  # it still rocks a little
    assert not status_reasons(int(drop.scene.solver.status.numpy()[0]))


def main(arguments: list[str] | None = None) -> None:
    """Film the fall and print what the physics did."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", nargs="?", help="splat file, y down; the plush bear if not given")
    parser.add_argument("--size", type=float, default=0.1, help="longest edge [m]")
    parser.add_argument("--video", type=Path, default=Path("out/drop_a_splat.mp4"))
    parser.add_argument("--short", action="store_true", help="small pictures")
    given = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    drop = Drop(given.file, size=given.size, edge=128 if given.short else 480)
    print(
        f"{drop.thing.visible_splats.count} splats, {1e3 * drop.weight / GRAVITY:.1f} g, falls {100 * drop.fall:.0f} cm"
    )
    with Film(given.video) as film:
        rows = drop.run(film, 150)
        film.publish()
    for t, lowest, centre, kinetic in rows[::7]:
        print(
            f"{t:6.2f} s: lowest {1e3 * lowest:7.2f} mm, centre {1e3 * centre:6.1f} mm, moving {1e3 * kinetic:8.4f} mJ"
        )
    print(f"wrote {film.path} and {film.sheet_path}")
    test_final(drop, rows)


if __name__ == "__main__":
    main()
