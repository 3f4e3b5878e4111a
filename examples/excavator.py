"""A toy excavator whose arm hangs on rubber hinges, with local handles that the user put on these, and without.

PIE-NeRF's figures 4 and 5. Both toys have 48 functions, chosen among those of 8 local handles of the build, and
of the right one of 8 more, on hinges, beams and bucket (``add_kernels``). The same force pulls both buckets down.

Run: ``python examples/excavator.py [--short]``; writes ``out/excavator.mp4`` and a contact sheet
"""

import argparse
from pathlib import Path

import numpy as np
import warp as wp

from softmode.deformables import BuildOptions
from softmode.objects import EXCAVATOR_BUCKET, EXCAVATOR_HINGES, Placed, SoftObject, load_model
from softmode.scenes import SplatScene
from softmode.splats import PinholeCamera
from softmode.viz import Film

RATE, STEPS, PULL, LET_GO = 30, 4, 2.5, 60
"""Frames per second, steps of a frame, force on a bucket [N], frame when it ends."""
ROOT, ELBOW, WRIST = EXCAVATOR_HINGES
BEAMS = ((ROOT, ELBOW, 0.035), (ELBOW, WRIST, 0.03))
HANDLES = [(a + t * (b - a), radius) for a, b, radius in BEAMS for t in (0.25, 0.75)]
KERNELS = [*HANDLES, (EXCAVATOR_BUCKET, 0.03), *((hinge, 0.016) for hinge in EXCAVATOR_HINGES)]
"""Places and radii of the handles that the user gives [m]."""
BUILD = {"handles": "local", "local_count": 8, "function_count": 48, "cubature_count": 480}


def make_toy(count: int, placed: bool) -> tuple[SoftObject, np.ndarray]:
    """Return the toy, with handles that the user gives or without, and the place of its bucket in its frame [m]."""
    build = BuildOptions(add_kernels=KERNELS if placed else (), **BUILD)
    toy = load_model("excavator", build=build, splat_count=count)
    return toy, EXCAVATOR_BUCKET - toy.body.offset


def make_scene(toys: list[SoftObject], edge: int) -> SplatScene:
    """Return the toys beside each other."""
    places = [(0.34 * k, 0.0, -float(toy.body.bounds[0, 2])) for k, toy in enumerate(toys)]
    view = {"position": (0.05, -0.95, 0.36), "target": (0.2, 0.0, 0.075), "fov_y": 0.29}
    how = {"cameras": [PinholeCamera.look_at("film", width=5 * edge // 2, height=edge, **view)], "dt": 1 / RATE / STEPS}
    return SplatScene([], [Placed(object=toys[k], position=places[k]) for k in (0, 1)], steps_per_frame=STEPS, **how)


def test_final(moved: np.ndarray, energy: np.ndarray) -> None:
    """With the user's handles the arm gives as much or a little more; let go, the toys come to rest."""
    pulled = moved[LET_GO - 1]
    print(f"buckets went {1e3 * pulled[0]:.1f} mm, with the user's handles {1e3 * pulled[1]:.1f} mm")
    assert 0.99 * pulled[0] < pulled[1] < 1.05 * pulled[0]
    assert moved[-1].max() < 0.4 * pulled.min() and energy[-1] < 1e-6 * energy[LET_GO:].max()  # the sag is left


def main(arguments: list[str] | None = None) -> None:
    """Pull both buckets, let go; film it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--short", action="store_true")
    short = parser.parse_args(arguments).short
    wp.config.log_level = wp.LOG_WARNING
    toys, tips = zip(*(make_toy(4000 if short else 16000, placed) for placed in (False, True)), strict=True)
    scene, energy, moved = make_scene(list(toys), 96 if short else 280), [], []
    near = [np.linalg.norm(toy.body.surface.points - at, axis=1) < 0.025 for toy, at in zip(toys, tips, strict=True)]
    rest = [scene.surface(k)[some].mean(axis=0) for k, some in enumerate(near)]
    with Film(Path("out/excavator.mp4")) as film:
        for frame in range(150):
            for k, some in enumerate(near):
                force = np.zeros((len(some), 3))
                force[some, 2] = -PULL * min(1.0, frame / 30) * (frame < LET_GO) / some.sum()
                scene.push(k, force)
            scene.step()
            film.add(scene.draw(), RATE)
            moved.append([np.linalg.norm(scene.surface(k)[some].mean(axis=0) - rest[k]) for k, some in enumerate(near)])
            energy.append(scene.kinetic_energy())
        film.publish()
    test_final(np.array(moved), np.array(energy))


if __name__ == "__main__":
    main()
