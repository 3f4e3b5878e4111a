"""Two fingers pinch a waist into dough, then a coin is pressed into it: particles that yield, beside a robot.

Fingers and coin hang on drives that MuJoCo moves. They push the particles, and the particles push back. Where stress
comes to the yield stress the dough flows. ``--cell 2`` is the fine run that the depth of the print is compared with.

Run: ``python examples/dough.py [--video out/dough.mp4] [--cell MM] [--short]``
"""

import argparse
from dataclasses import replace
from pathlib import Path

import newton
import numpy as np
import warp as wp

from softmode.deformables import Material, MaterialModel
from softmode.mpm import Grid, GridShapes, MpmOptions, MpmSimulation, SolverCoupledParticles, particles_from_shape
from softmode.splats import PinholeCamera, SplatArrays, SplatCamera, Splats
from softmode.viz import Film

SIZE, YIELD = np.array([0.064, 0.032, 0.018]), 800.0  # Edges [m] and yield stress [Pa] of the dough.
DOUGH = Material(youngs_modulus=3.0e4, poissons_ratio=0.35, density=1200.0, model=MaterialModel.COROTATED)
WAIST, COIN, RADIUS = -0.016, 0.014, 0.010  # Where fingers and coin act along x, and the coin's radius [m].
FINE = 5.86e-3  # What stays of the print with cells of 2 mm [m].
TIMES = (0.0, 0.12, 0.18, 0.26, 0.28, 0.36, 0.40)  # When the drives are where the next two lines say [s].
FINGER = (0.022, 0.009, 0.030, 0.050, 0.050, 0.050, 0.050)  # From the middle to each finger [m].
PRESS = (0.020, 0.020, 0.015, -0.006, -0.006, 0.030, 0.030)  # Of the coin above the dough [m].


def slide(builder: newton.ModelBuilder, axis: tuple[float, ...], at: tuple[float, ...]) -> int:
    """Add a body on a driven slide; return it."""
    body, place = builder.add_link(), wp.transform(wp.vec3(*at), wp.quat_identity())
    drive = {"parent_xform": place, "axis": axis, "target_ke": 2.0e4, "target_kd": 200.0}
    builder.add_articulation([builder.add_joint_prismatic(parent=-1, child=body, **drive)])
    return body


class Kitchen:
    """The table, the tools, the dough and a camera."""

    def __init__(self, cell: float, edge: int) -> None:
        """Lay dough, two particles to a cell [m] along each axis, on the table; pictures are ``edge`` high [px]."""
        builder, steel = newton.ModelBuilder(), newton.ModelBuilder.ShapeConfig(density=2000.0, mu=0.4)
        builder.add_ground_plane(cfg=steel, color=(0.55, 0.42, 0.32))
        steel.margin = 0.5 * cell  # What moves over a grid is held half a cell before its surface: see the docs.
        for side in (-1.0, 1.0):
            finger = slide(builder, (0.0, side, 0.0), (WAIST, side * 0.008, 0.021))
            builder.add_shape_box(finger, hx=0.007, hy=0.008, hz=0.018, cfg=steel, color=(0.30, 0.33, 0.38))
        coin = slide(builder, (0.0, 0.0, 1.0), (COIN, 0.0, SIZE[2] + 0.008))
        builder.add_shape_cylinder(coin, radius=RADIUS, half_height=0.008, cfg=steel, color=(0.85, 0.65, 0.2))
        builder.joint_q = [FINGER[0], FINGER[0], PRESS[0]]
        model = builder.finalize()
        self.states, self.control = (model.state(), model.state()), model.control()
        for state in self.states:
            newton.eval_fk(model, model.joint_q, model.joint_qd, state)
        low, h = SIZE * [-0.5, -0.5, 0.0], 0.5 * cell
        bounds = [low + 0.5 * h, low + SIZE - 0.4 * h]
        body = particles_from_shape(lambda x: x[:, 2] > 0.0, bounds, spacing=h, material=DOUGH)
        grid = Grid.around(1.3 * low, 1.3 * low + 1.6 * SIZE, spacing=cell, room=2)
        grid = replace(grid, origin=(*grid.origin[:2], -4.01 * cell))  # A layer of nodes lies just within the table.
        options = MpmOptions(grid=grid, dt=0.13 * cell, gravity=(0.0, 0.0, -9.81), damping=10.0)
        shapes, body = GridShapes(model, state=self.states[0]), replace(body, yield_stress=YIELD)
        self.dough, self.rest = MpmSimulation(body, options, step_count=2, shapes=shapes), body.positions
        self.solver = SolverCoupledParticles(newton.solvers.SolverMuJoCo(model), self.dough)
        self.solver.step(*self.states, self.control, None, self.solver.dt)  # Compiles the kernels.
        with wp.ScopedCapture() as capture:
            for first, second in (self.states, self.states[::-1]):
                self.solver.step(first, second, self.control, None, self.solver.dt)
        self.graph = capture.graph
        self.solver.reset(self.states[0])
        stripes = np.floor(self.rest[:, :2] / 0.008).sum(axis=1, keepdims=True) % 2
        sh = (np.array([0.93, 0.84, 0.66]) - stripes * [0.10, 0.16, 0.22] - 0.5)[:, None] / 0.2820948
        one, width = np.ones((body.count, 1)), np.full(3, 0.55 * h)
        look = {"quats": one * [0.0, 0.0, 0.0, 1.0], "scales": one * width, "opacities": 0.95 * one[:, 0]}
        splats = SplatArrays.from_splats([Splats(means=self.rest, sh=sh, **look)])
        eye, target = (0.03, -0.13, 0.15), (0.0, 0.0, 0.010)
        view = PinholeCamera.look_at("film", position=eye, target=target, width=4 * edge // 3, height=edge, fov_y=0.45)
        self.camera = SplatCamera(model, splats, [view])

    def play(self, film: Film, rate: int) -> None:
        """Move the tools and film the dough, ``rate`` pictures a second."""
        span = 2.0 * self.solver.dt
        for time in np.arange(0.0, TIMES[-1], span):
            if int(time * rate) != int((time - span) * rate) or time + span > TIMES[-1]:
                self.camera.splats.means.assign(self.dough.first.x.numpy())
                self.camera.render(self.states[0])
                film.add(self.camera.images("film").numpy()[0].copy(), rate // 8)
            self.control.joint_target_q.assign([np.interp(time, TIMES, at) for at in (FINGER, FINGER, PRESS)])
            wp.capture_launch(self.graph)
        film.publish()
        self.dough.check()


def test_final(dough: MpmSimulation, rest: np.ndarray) -> None:
    """The print is as deep as that of the fine run to 5 %, the waist stays, and nothing left the grid."""
    x = dough.first.x.numpy()[0]
    under = (rest[:, 2] > rest[:, 2].max() - 1e-6) & (np.hypot(rest[:, 0] - COIN, rest[:, 1]) < 0.5 * RADIUS)
    pinched = (np.abs(x[:, 0] - WAIST) < 0.003) & (rest[:, 2] > 0.5 * SIZE[2])  # The fingers end above the table.
    depth, waist = (rest - x)[under, 2].mean(), np.ptp(x[pinched, 1])
    print(f"print {1e3 * depth:.2f} mm deep, {1e3 * FINE:.2f} mm with fine cells; waist {1e3 * waist:.1f} mm wide")
    assert abs(depth / FINE - 1.0) < 0.05
    assert waist < 0.75 * SIZE[1]


def main() -> None:
    """Film the kitchen."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--video", type=Path, default=Path("out/dough.mp4"))
    parser.add_argument("--cell", type=float, default=4.0, help="edge of a cell of the grid [mm]")
    parser.add_argument("--short", action="store_true", help="small pictures")
    given = parser.parse_args()
    kitchen = Kitchen(1e-3 * given.cell, 96 if given.short else 480)
    with Film(given.video) as film:
        kitchen.play(film, 20 if given.short else 200)
    test_final(kitchen.dough, kitchen.rest)


if __name__ == "__main__":
    main()
