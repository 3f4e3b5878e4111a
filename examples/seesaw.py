"""Drop two soft toys on a seesaw: the bear of "Getting started" among rigid things that move.

A plank on a hinge carries a light box on its left. The bear falls on the right, the plank tips and lifts the box; a
soft cube falls beside the bear, and all come to rest. MuJoCo moves plank and box, in one step with the toys: a scene
that holds something rigid that can move takes ``SolverCoupledReduced`` by itself and says so.

Run: ``python examples/seesaw.py [--video out/seesaw.mp4] [--device cuda:0] [--short]``
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

GRAVITY, DT = 9.81, 1.0 / 240.0
"""Gravity [m/s^2]; physics step [s]."""
LENGTH, HEIGHT, LIMIT = 0.17, 0.045, 0.16
"""Half length of the plank, height of its hinge [m], and the angle at which it stops on either side [rad]."""
EDGE = 0.02
"""Half edge of the box [m]."""
WOOD, STEEL = (0.50, 0.36, 0.24), (0.55, 0.57, 0.60)
UPRIGHT = wp.quat_identity()


class Seesaw:
    """The scene, and where its parts are."""

    def __init__(self, edge: int, device: str | None) -> None:
        """Build plank, box and toys."""
        world = newton.ModelBuilder()
        world.default_shape_cfg.mu = 0.8
        world.add_ground_plane(color=(0.62, 0.64, 0.66))
        post = wp.transform((0.0, 0.0, 0.4 * HEIGHT), UPRIGHT)
        apart = newton.ModelBuilder.ShapeConfig(has_shape_collision=False)  # the plank turns on it
        world.add_shape_box(-1, xform=post, hx=0.008, hy=0.02, hz=0.4 * HEIGHT, cfg=apart, color=STEEL)
        self.plank = world.add_link(label="plank")
        wood, balsa = (newton.ModelBuilder.ShapeConfig(density=density, mu=0.8) for density in (250.0, 100.0))
        world.add_shape_box(self.plank, hx=LENGTH, hy=0.08, hz=0.006, cfg=wood, color=WOOD)
        hinge = world.add_joint_revolute(
            *(-1, self.plank),
            parent_xform=wp.transform((0.0, 0.0, HEIGHT), UPRIGHT),
            axis=(0.0, 1.0, 0.0),
            limit_lower=-LIMIT,
            limit_upper=LIMIT,
            **{"limit_ke": 100.0, "limit_kd": 1.0, "friction": 0.004},
            label="hinge",
        )
        world.add_articulation([hinge])
        world.joint_q[-1] = -LIMIT
        height = HEIGHT - LENGTH * np.sin(LIMIT) + 2.5 * EDGE
        place = wp.transform((-LENGTH + 1.6 * EDGE, 0.0, height), UPRIGHT)
        self.box = world.add_body(xform=place, label="box")
        world.add_shape_box(self.box, hx=EDGE, hy=EDGE, hz=EDGE, cfg=balsa, color=(0.72, 0.52, 0.30))
        rubber = Material(youngs_modulus=2e4, density=250.0, friction=0.9, viscosity=5e-3)
        bear = load(size=0.08, material=rubber)
        cube = load(shape="box", extents=(0.04, 0.04, 0.04), material=rubber, surface_count=200)
        places = [(LENGTH - 0.05, 0.0, 0.14), (0.05, 0.0, 0.35)]
        toys = [Placed(object=toy, position=place) for toy, place in zip((bear, cube), places, strict=True)]
        eye, target = (0.15, -0.62, 0.24), (0.0, 0.0, 0.07)
        camera = PinholeCamera.look_at("film", position=eye, target=target, width=edge, height=edge, fov_y=0.66)
        light = CameraOptions(mesh_samples=4, splat_shadow=ShadowOptions(cells=96))
        self.scene = SplatScene(world, toys, cameras=[camera], dt=DT, camera_options=light, device=device)
        self.drop = self.scene.surface(1)[:, 2].mean()
        self.weight = GRAVITY * rubber.density * (bear.body.volume + cube.body.volume)

    def run(self, film: Film, frames: int) -> np.ndarray:
        """Film and measure; return a row (angle, height of the box, of bear and cube, kinetic energy) per frame."""
        rows = []
        for _ in range(frames):
            film.add(self.scene.draw(), round(1.0 / (DT * self.scene.steps_per_frame)))
            self.scene.step()
            angle, box = self.scene.state.joint_q.numpy()[0], self.scene.state.body_q.numpy()[self.box, 2]
            toys = [self.scene.surface(i)[:, 2].mean() for i in (0, 1)]
            rows.append((angle, box, *toys, self.scene.kinetic_energy()))
        return np.array(rows)


def test_final(seesaw: Seesaw, rows: np.ndarray) -> None:
    """The cube fell freely, the bear lifted the box, and at rest the plank carries the weight of both toys."""
    angle, box, _, cube, kinetic = rows.T
    n = seesaw.scene.steps_per_frame * np.arange(1, 5)
    np.testing.assert_allclose(seesaw.drop - cube[:4], 0.5 * GRAVITY * DT**2 * n * (n + 1), atol=1e-4)
    assert angle[0] < -0.5 * LIMIT and angle[-1] > 0.8 * LIMIT and np.abs(angle).max() < 1.5 * LIMIT
    assert box[-1] > HEIGHT + EDGE + 0.01
    assert kinetic[-1] < 1e-3 * kinetic.max()
    wrench = seesaw.scene.solver.body_wrench.numpy()
    np.testing.assert_allclose(wrench[seesaw.plank, :3], (0.0, 0.0, -seesaw.weight), atol=0.01 * seesaw.weight)
    # A toy that lands on the plank may be deep for a step; anything else went wrong.
    assert set(status_reasons(int(seesaw.scene.solver.status.numpy()[0]))) <= {"penetration"}


def main() -> None:
    """Film the toys and print what the plank did."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--video", type=Path, default=Path("out/seesaw.mp4"))
    parser.add_argument("--device")
    parser.add_argument("--short", action="store_true", help="small pictures")
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    seesaw = Seesaw(160 if given.short else 480, given.device)
    with Film(given.video) as film:
        rows = seesaw.run(film, 80)  # a body that keeps its spin sways for longer
        film.publish()
    for k, (angle, box, bear, cube, _) in list(enumerate(rows))[2::6]:
        heights = ", ".join(f"{name} {1e3 * z:4.0f} mm" for name, z in (("box", box), ("bear", bear), ("cube", cube)))
        print(f"{(k + 1) / 30:5.2f} s: plank {np.degrees(angle):6.1f} deg; heights: {heights}")
    print(f"wrote {film.path} and {film.sheet_path}")
    test_final(seesaw, rows)


if __name__ == "__main__":
    main()
