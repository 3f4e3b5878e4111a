"""A hand takes a soft ball from a stand, squeezes it, holds it by its fingertips, turns it, and lets it go.

The hand is an Allegro of the MuJoCo Menagerie (``pip install 'softmode[robots]'``), or the file that ``--hand`` names.
The fingers carry the ball's weight, and all momentum is accounted for.

Run: ``python examples/hand_squeeze.py [--hand wonik_allegro] [--video out/hand_squeeze.mp4] [--short]``
"""

import argparse
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo
from scipy.spatial.transform import Rotation

from softmode import robots
from softmode.deformables import Material
from softmode.errors import AssetError, MissingExtraError
from softmode.objects import Placed, load
from softmode.scenes import SplatScene
from softmode.splats import PinholeCamera
from softmode.viz import Film

GRAVITY, RADIUS, TIP, HEIGHT = 9.81, 0.04, 0.012, 0.25
"""Gravity [m/s^2]; radii of the ball and of a fingertip, height of the palm, which looks down [m]."""
BALL, TURN = np.array([0.01, 0.0, 0.07]), 0.25
"""Where the ball is in the frame of the palm [m], and by how much the fingers go around it [rad]."""
WAYS = {"ff_tip": (0.8, -0.6, 0.1), "mf_tip": (1.0, 0.0, 0.1), "rf_tip": (0.8, 0.6, 0.1), "th_tip": (-1.0, -0.1, 0.1)}
"""From where each finger comes to the ball, in the frame of the palm."""
FOAM = Material(youngs_modulus=5.0e4, poissons_ratio=0.4, density=200.0, friction=0.9)
STAGES = {"close": 0.6, "squeeze": 0.6, "stand goes": 0.2, "hold": 0.6, "turn": 0.8, "hold again": 0.6}
GAPS = {"close": (0.018, -0.01), "squeeze": (-0.01, -0.02)}
"""Durations [s]; how far from the ball the drives aim with the fingertips [m], at both ends, by default as at last."""


class Hand:
    """The hand over a ball on a stand."""

    def __init__(self, hand: robots.RobotDescription, edge: int, samples: int = 400) -> None:
        """Build the scene."""
        self.tips = robots.Fingertips(hand, {name: (0.0, 0.0, 0.035 if name == "th_tip" else 0.019) for name in WAYS})
        world = newton.ModelBuilder()
        world.add_ground_plane(color=(0.62, 0.64, 0.66))
        at, options = (BALL[0], -BALL[1], HEIGHT - BALL[2]), {"material": FOAM, "surface_count": samples}
        toy = Placed(object=load(preset="ball", size=2.0 * RADIUS, **options), position=at)
        stand = wp.transform((*at[:2], half := 0.5 * (at[2] + toy.body.bounds[0, 2])), wp.quat_identity())
        self.stand = world.add_shape_box(-1, xform=stand, hx=0.012, hy=0.012, hz=half, color=(0.5, 0.36, 0.24))
        self.links = list(hand.add_to(world, xform=(0.0, 0.0, HEIGHT, 1.0, 0.0, 0.0, 0.0)).link_bodies)
        world.joint_q[:] = self.pose(GAPS["close"][0], 0.0).tolist()
        view = {"position": (0.25, -0.4, 0.3), "target": (0.0, 0.0, 0.18), "width": edge, "height": edge}
        cameras = [PinholeCamera.look_at("film", fov_y=0.6, **view)]
        self.scene = SplatScene(world, [toy], cameras=cameras, rigid=lambda m: SolverMuJoCo(m, disable_contacts=True))
        self.mass, self.rest = toy.mass, self.scene.surface(0)

    def pose(self, gap: float, turn: float) -> np.ndarray:
        """Return joint coordinates with the fingertips at a distance [m], gone around the ball by an angle [rad]."""
        go, far = Rotation.from_rotvec((0.0, 0.0, turn)), RADIUS + TIP + gap
        points = {name: BALL + far * go.apply(way) / np.linalg.norm(way) for name, way in WAYS.items()}
        return self.tips.joint_q(points, self.tips.hand.with_opening(0.6))[0].astype(np.float32)

    def run(self, film: Film) -> dict[str, dict[str, Any]]:
        """Film all stages; return forces [N], depth [m] and turn about the vertical [deg] at the end of each."""
        frame, turned, rows = self.scene.dt * self.scene.steps_per_frame, 0.0, {}
        for name, duration in STAGES.items():
            (first, last), count = GAPS.get(name, GAPS["squeeze"][1:] * 2), round(duration / frame)
            for s in np.arange(1, count + 1) / count:
                turned = TURN * s if name == "turn" else turned
                self.scene.control.joint_target_q.assign(self.pose(first + s * (last - first), turned))
                places = self.scene.model.shape_transform.numpy()
                places[self.stand, 2] -= 0.07 / count if name == "stand goes" else 0.0
                self.scene.model.shape_transform.assign(places)
                self.scene.step()
                film.add(self.scene.draw(), round(1.0 / frame))
            wrench, x = self.scene.solver.body_wrench.numpy()[self.links, :3], self.scene.surface(0)
            press, depth = np.linalg.norm(wrench, axis=1), max(0.0, -self.scene.rigid_gaps().min(initial=0.0))
            angle = np.degrees(Rotation.align_vectors(x - x.mean(0), self.rest - self.rest.mean(0))[0].as_rotvec()[2])
            press = press[press > 0.0]
            rows[name] = {"force": -wrench.sum(0), "press": press, "depth": depth, "angle": angle}
            forces = f"carried {-wrench[:, 2].sum():.4f} N, fingers press {press.round(2)} N"
            print(f"{name:10s} {forces}; {1e3 * depth:.2f} mm deep, turned by {angle:.0f} deg")
        return rows


def test_final(hand: Hand, rows: dict[str, dict[str, Any]], error: float) -> None:
    """The fingers carry the weight to 1 %, no deeper than 1 % of the ball; it turned; the momentum is accounted for."""
    for name in ("hold", "hold again"):
        np.testing.assert_allclose(rows[name]["force"] / (GRAVITY * hand.mass), (0.0, 0.0, 1.0), atol=0.01)
        assert len(rows[name]["press"]) >= 4 and rows[name]["depth"] < 0.02 * RADIUS
    assert rows["squeeze"]["press"].sum() > 1.2 * rows["close"]["press"].sum()
    assert abs(rows["hold again"]["angle"] - rows["hold"]["angle"]) > 15.0
    assert error < 0.01 and not hand.scene.solver.status.numpy().any()


def main() -> None:
    """Film the hand and print its forces."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hand", default="wonik_allegro", help="a name, or the path of an MJCF or URDF file")
    parser.add_argument("--video", type=Path, default=Path("out/hand_squeeze.mp4"))
    parser.add_argument("--short", action="store_true", help="small pictures")
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    try:
        robot = robots.load(given.hand)
    except (AssetError, MissingExtraError) as error:
        return print(f"skipped, there is no hand here: {error}")
    hand = Hand(robot, 96 if given.short else 480)
    with Film(given.video) as film:
        rows = hand.run(film)
        film.publish()
    hand.scene.control.joint_target_q.assign(hand.pose(GAPS["close"][0], TURN))  # lets go
    error = hand.scene.momentum_error(24) / (GRAVITY * hand.mass * hand.scene.dt)
    print(f"the ball weighs {GRAVITY * hand.mass:.4f} N; momentum is off by {error:.1e} of a step's impulse of that")
    test_final(hand, rows, error)


if __name__ == "__main__":
    main()
