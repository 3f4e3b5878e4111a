"""A potted plant in gusts of wind, and a hand that pulls one of its leaves: thin parts that each move on their own.

Stem, branches and leaves are made by code and shown as splats. Their motion is that of 78 local handles, the number of
kernels of PIE-NeRF's plant: of the 80 functions of these that count most, 240 unknowns.

Run: ``python examples/swaying_plant.py [--short]``; writes ``out/swaying_plant.mp4`` and a contact sheet
"""

import argparse
from pathlib import Path

import numpy as np
import warp as wp

from softmode.deformables import BuildOptions, SoftEnergies
from softmode.objects import Placed, SoftObject, load_model
from softmode.scenes import Fixture, SplatScene
from softmode.splats import PinholeCamera
from softmode.viz import Film

FOOT, RATE, DRAG, STEPS = 0.03, 30, 0.6, 2
"""What is in the earth [m]; frames per second; half of the air's density; steps of a frame."""
CALM, PULL, PULLED = 75, (100, 130), np.array([0.04, -0.05, -0.04])
"""Frame when the wind is over, those when the hand takes and lets go, and how far it pulls [m]."""


def make_plant(build: BuildOptions | None, splat_count: int) -> tuple[SoftObject, np.ndarray]:
    """Return the plant, held by its foot, and in its frame the foot and the tip of the top leaf [m], (2, 3)."""
    plant = load_model("plant", build=build, splat_count=splat_count)
    points = plant.body.surface.points
    low = points[:, 2].min()
    foot = np.array([*points[points[:, 2] < low + FOOT, :2].mean(axis=0), low])
    return plant, np.array([foot, points[points[:, 2].argmax()]])


def make_scene(plant: SoftObject, foot: np.ndarray, edge: int) -> SplatScene:
    """Return the plant in a pot of earth, with two physics steps for each picture."""
    looks, at = {(0.055, 0.03): (0.68, 0.36, 0.24), (0.05, 0.031): (0.22, 0.16, 0.12)}, (0.0, 0.0, FOOT - 0.032)
    pot = [Fixture(label="pot", shape="cylinder", size=a, position=at, color=b) for a, b in looks.items()]
    view = {"position": (0.25, -0.85, 0.34), "target": (0.0, 0.0, 0.185), "width": edge, "height": edge, "fov_y": 0.5}
    how = {"cameras": [PinholeCamera.look_at("film", **view)], "dt": 1.0 / (RATE * STEPS), "grip_slots": 1}
    return SplatScene(pot, [Placed(object=plant, position=tuple(-foot))], steps_per_frame=STEPS, **how)


def blow(scene: SplatScene, time: float, speed: float) -> None:
    """Put the drag of gusts along x [m/s] on the surface of the plant."""
    x, v = scene.surface(0), scene.state.particle_qd.numpy()
    gust = speed * (0.6 + 0.5 * np.sin(4.0 * time - 6.0 * x[:, 0]) * np.sin(9.0 * time + 8.0 * x[:, 2]))
    rush = (np.stack([gust, 0.3 * gust * np.sin(3.0 * time), 0.0 * gust]) - v.T) * (speed > 0.0)
    scene.push(0, (DRAG * scene.objects[0].body.surface.areas * np.linalg.norm(rush, axis=0) * rush).T)


def test_final(energy: np.ndarray, track: np.ndarray) -> None:
    """The hand's work is stored, but for what the material dissipates; once it has let go nothing comes to it."""
    work = (0.5 * (track[1:, 1] + track[:-1, 1]) * np.diff(track[:, 0], axis=0)).sum()
    stored, left = energy[PULL[1] - 1] - energy[PULL[0]], energy[PULL[1] :] - energy[PULL[0]]
    print(f"the hand did {1e3 * work:.1f} mJ of work, {1e3 * stored:.1f} mJ of it are stored")
    assert 0.8 * work < stored < 1.02 * work
    assert left.max() < stored and left[-1] < 0.05 * stored


def main(arguments: list[str] | None = None) -> None:
    """Blow, pull, let go; film it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--short", action="store_true", help="small pictures")
    short = parser.parse_args(arguments).short
    wp.config.log_level = wp.LOG_WARNING
    plant, places = make_plant(None, 4000 if short else 14000)
    scene = make_scene(plant, places[0], 128 if short else 480)
    (hand,), energies, energy, track = scene.grips, SoftEnergies(scene.solver), [], []
    with Film(Path("out/swaying_plant.mp4")) as film:
        for frame in range(190):
            blow(scene, frame / RATE, 6.0 if frame < CALM else 0.0)
            if frame == PULL[0]:
                hand.take(places[1:], scene.state, pulls=True)
            if frame == PULL[1]:
                hand.let_go_all()
            if hand.held:
                hand.aim(0, hand.pose(0)[0] + PULLED / (PULL[1] - PULL[0]))
                hand.begin_frame(STEPS)
            scene.step()
            film.add(scene.draw(), RATE)
            energies.update(scene.state)
            energy.append(sum(e.numpy().sum() for e in (energies.kinetic, energies.elastic, energies.gravitational)))
            track += [[hand.points(0, scene.state)[0], hand.force(0)]] if hand.held else []
        film.publish()
    test_final(np.array(energy), np.array(track))


if __name__ == "__main__":
    main()
