"""Two arms hand over a cushion: one lifts it by its rim, the other takes it, the first lets go.

The arms are those of an ALOHA station, whose file ships with mujoco-warp. Both arms and the cushion are unknowns of one
solve. Whoever holds the cushion carries its weight; while both do, their forces add up to it.

Run: ``python examples/handover.py [--video out/handover.mp4] [--short]``
"""

import argparse
from functools import partial
from pathlib import Path

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo

from softmode import robots
from softmode.objects import Placed, load
from softmode.scenes import Fixture, SplatScene, add_fixture
from softmode.splats import CameraOptions, PinholeCamera, ShadowOptions
from softmode.viz import Film

GRAVITY, SIZE, BASE = 9.81, 0.11, 0.469
"""Gravity [m/s^2], edge of the cushion [m], distance of each arm from the middle, which they face [m]."""
FLAT = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""The tool in the frame of its base: it points forwards, its fingers close along the vertical."""
START, RIM, HEIGHT, APART, SHUT = -0.10, 0.028, 0.24, 1.0, 0.27
"""Where the cushion lies along x, how far the fingers reach over its rim, its height [m]; openings of the grippers."""
PLAN = (
    # Name and duration [s]; of each arm: x of the cushion that it holds or would hold, its rise [m], the opening.
    ("wait", 0.4, (START, 0.0, APART), (0.14, 0.07, APART)),
    ("close", 0.5, (START, 0.0, SHUT), (0.14, 0.07, APART)),
    ("lift", 0.8, (0.0, 0.07, SHUT), (0.14, 0.07, APART)),
    ("left holds", 0.6, (0.0, 0.07, SHUT), (0.0, 0.07, APART)),
    ("both hold", 0.6, (0.0, 0.07, SHUT), (0.0, 0.07, SHUT)),
    ("let go", 0.4, (0.0, 0.07, APART), (0.0, 0.07, SHUT)),
    ("carry", 0.6, (-0.1, 0.07, APART), (0.08, 0.12, SHUT)),
    ("right holds", 0.6, (-0.1, 0.07, APART), (0.08, 0.12, SHUT)),
)


class Handover:
    """Two arms, the cushion on a stand, and who carries it."""

    def __init__(self, edge: int) -> None:
        """Build the scene; the left arm's fingers are around the cushion's rim."""
        self.arm = robots.load("aloha_arm")
        self.chain = robots.serial_chain(self.arm, robots.ParallelJaw.of(self.arm).frame)
        toy = Placed(object=load(preset="cushion", size=SIZE), position=(START, 0.0, HEIGHT))
        world = newton.ModelBuilder()
        world.add_ground_plane(color=(0.62, 0.64, 0.66))
        bases = {"left": (-BASE, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), "right": (BASE, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)}
        self.arms = [self.arm.add_to(world, xform=base, label=name) for name, base in bases.items()]
        world.joint_q[:] = self.targets(0.0).tolist()
        half = (0.02, 0.02, 0.5 * (HEIGHT + toy.body.bounds[0, 2]))
        add_fixture(world, Fixture(label="stand", size=half, position=(START, 0.0, half[2])))
        view = {"position": (0.1, -0.85, 0.5), "target": (0.0, 0.0, 0.24), "fov_y": 0.7, "width": edge, "height": edge}
        look = CameraOptions(mesh_samples=4, splat_shadow=ShadowOptions(cells=96))
        rigid = partial(SolverMuJoCo, disable_contacts=True)  # no rigid thing touches another
        cameras = [PinholeCamera.look_at("film", **view)]
        self.scene = SplatScene(world, [toy], cameras=cameras, rigid=rigid, camera_options=look)

    def targets(self, t: float) -> np.ndarray:
        """Return the drives' targets of both arms at a time, shape (16,)."""
        ends, joints = np.cumsum([stage[1] for stage in PLAN]), []
        k = min(int(np.searchsorted(ends, t)), len(PLAN) - 1)
        s = float(np.clip(1.0 - (ends[k] - t) / PLAN[k][1], 0.0, 1.0))
        for arm, sign in enumerate((1.0, -1.0)):
            first, last = (np.array(PLAN[max(i, 0)][2 + arm]) for i in (k - 1, k))
            x, rise, opening = first + s * s * (3.0 - 2.0 * s) * (last - first)
            place = np.array([[BASE + sign * x - 0.5 * SIZE + RIM, 0.0, HEIGHT + rise]])
            joints.append(self.arm.with_opening(opening))
            joints[-1][list(self.chain.joints)] = self.chain.inverse(place, FLAT[None], self.chain.home)[0][0]
        return np.concatenate(joints)

    def run(self, film: Film) -> dict[str, np.ndarray]:
        """Film all stages; return at the end of each the force of both arms [N], and the middle of the cushion [m]."""
        frame, t, rows = self.scene.dt * self.scene.steps_per_frame, 0.0, {}
        for name, duration, *_ in PLAN:
            for _ in range(round(duration / frame)):
                t += frame
                self.scene.control.joint_target_q.assign(self.targets(t).astype(np.float32))
                self.scene.step()
                film.add(self.scene.draw(), round(1.0 / frame))
            wrench = self.scene.solver.body_wrench.numpy()[:, :3]
            carried = np.array([-wrench[list(arm.link_bodies)].sum(0) for arm in self.arms])
            press = [np.linalg.norm(wrench[list(arm.finger_bodies)], axis=1).mean() for arm in self.arms]
            rows[name] = np.vstack([carried, self.scene.surface(0).mean(0)])
            print(f"{name:12s} carried {carried[:, 2].round(4)} N, fingers press {np.round(press, 2)} N")
        return rows


def test_final(handover: Handover, rows: dict[str, np.ndarray]) -> None:
    """Whoever holds the cushion carries its weight to 1 %, both together too; it never falls, and goes along."""
    weight = GRAVITY * handover.scene.placed[0].mass
    for stage, hands in {"left holds": [0], "both hold": [0, 1], "right holds": [1]}.items():
        np.testing.assert_allclose(rows[stage][hands].sum(0), (0.0, 0.0, weight), atol=0.01 * weight)
    np.testing.assert_allclose(rows["right holds"][2], (0.08, 0.0, HEIGHT + 0.12), atol=0.01)
    assert not rows["right holds"][0].any() and not handover.scene.solver.status.numpy().any()


def main() -> None:
    """Film the handover and print who carries what."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--video", type=Path, default=Path("out/handover.mp4"))
    parser.add_argument("--short", action="store_true", help="small pictures")
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    handover = Handover(96 if given.short else 480)
    with Film(given.video) as film:
        rows = handover.run(film)
        film.publish()
        print(f"weight {GRAVITY * handover.scene.placed[0].mass:.4f} N; wrote {film.path} and {film.sheet_path}")
    test_final(handover, rows)


if __name__ == "__main__":
    main()
