"""A potted plant in gusts of wind, and a hand that pulls one of its leaves: thin parts that each move on their own.

Stem, branches and leaves are made by code and shown as splats. Their motion is that of 78 local handles, the number of
kernels of PIE-NeRF's plant: of the 80 functions of these that count most, 240 unknowns.

Run: ``python examples/swaying_plant.py [--short]``; writes ``out/swaying_plant.mp4`` and a contact sheet
"""

import argparse
from pathlib import Path

import numpy as np
import trimesh
import warp as wp

from softmode.deformables import BuildOptions, Material, SoftEnergies
from softmode.objects import Placed, SoftObject, load
from softmode.scenes import Fixture, SplatScene
from softmode.splats import ColoredMesh, PinholeCamera
from softmode.viz import Film

HEIGHT, FOOT, RATE, DRAG, STEPS = 0.36, 0.03, 30, 0.6, 2
"""Height of the stem, of what is in the earth [m]; frames per second; half of the air's density; steps of a frame."""
BUILD = BuildOptions(handles="local", local_count=78, function_count=80, cubature_count=560)
WOOD = Material(youngs_modulus=1.2e8, poissons_ratio=0.3, density=500.0, viscosity=0.004, mass_damping=0.3)
BARK, STALK, DARK, LIGHT = np.array([[93, 64, 38], [104, 122, 48], [38, 112, 36], [120, 178, 62]])
CALM, PULL, PULLED = 75, (100, 130), np.array([0.04, -0.05, -0.04])
"""Frame when the wind is over, those when the hand takes and lets go, and how far it pulls [m]."""
T = 0.5 * (1.0 + (BALL := trimesh.creation.icosphere(subdivisions=3)).vertices[:, 0])


def part(curve: np.ndarray, wide: float, thick: float, blunt: float, tints: np.ndarray) -> trimesh.Trimesh:
    """Return a ball drawn out along a curve, whose points at T are given: pointed as a leaf, or blunt as a branch."""
    values, first, back = np.unique(T.round(6), return_index=True, return_inverse=True)
    way = np.gradient(curve[first], values, axis=0)[back]
    side = np.cross((1.0, 0.0, 0.0) if np.ptp(curve[:, 2]) > 0.2 else (0.0, 0.0, 1.0), way)
    top = np.cross(way, side)
    y, z = BALL.vertices.T[1:] * np.maximum(4.0 * T * (1.0 - T), 1e-9) ** -blunt
    across = wide * y / np.linalg.norm(side, axis=1) * side.T + thick * z / np.linalg.norm(top, axis=1) * top.T
    colors = tints[0] + np.outer(T, tints[1] - tints[0])
    return trimesh.Trimesh(curve + across.T, BALL.faces, vertex_colors=colors.astype(np.uint8), process=False)


def make_plant(build: BuildOptions, splat_count: int) -> tuple[SoftObject, np.ndarray]:
    """Return the plant, held by its foot, and in its frame the foot and the tip of the top leaf [m], (2, 3)."""

    def arch(root: np.ndarray, long: float, turn: float, rise: float, fall: float) -> np.ndarray:
        return root + long * np.stack([np.cos(turn) * T, np.sin(turn) * T, rise * T - fall * T**2], axis=1)

    stem = np.stack([0.01 * np.sin(3.0 * T), 0.01 * np.cos(2.4 * T) - 0.01, HEIGHT * T], axis=1)
    parts = [part(stem, 0.0058, 0.0058, 0.45, np.array([BARK, STALK]))]
    for k in range(9):
        branch = arch(stem[np.abs(T - 0.3 - 0.08 * k).argmin()], 0.105 - 0.006 * k, 2.4 * k, 0.8, 0.3)
        parts.append(part(branch, 0.004, 0.004, 0.45, np.array([STALK, DARK])))
        for at, aside in ((0.6, 1.3), (0.96, -0.3)):
            leaf = arch(branch[np.abs(T - at).argmin()], 0.09 - 0.004 * k, 2.4 * k + aside, 0.3, 0.75)
            parts.append(part(leaf, 0.022 - 0.001 * k, 0.0026, 0.0, (0.8 + 0.04 * k) * np.array([DARK, LIGHT])))
    mesh = trimesh.util.concatenate(parts)
    how = {"material": WOOD, "build": build, "size": float(mesh.extents.max()), "clamped_height": FOOT}
    plant = load(ColoredMesh.from_trimesh(mesh, name="plant"), pose="captured", splat_count=splat_count, **how)
    places = np.array([np.zeros(3), leaf[np.abs(T - 0.85).argmin()]])
    return plant, places - [*mesh.bounds.mean(axis=0)[:2], mesh.bounds[0, 2]] - plant.body.offset


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
    plant, places = make_plant(BUILD, 4000 if short else 14000)
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
