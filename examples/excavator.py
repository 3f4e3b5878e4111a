"""A toy excavator whose arm hangs on rubber hinges, with local handles that the user put on these, and without.

PIE-NeRF's figures 4 and 5. Both toys have 48 functions, chosen among those of 8 local handles of the build, and
of the right one of 8 more, on hinges, beams and bucket (``add_kernels``). The same force pulls both buckets down.

Run: ``python examples/excavator.py [--short]``; writes ``out/excavator.mp4`` and a contact sheet
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import warp as wp

from softmode.deformables import BuildOptions, Material
from softmode.objects import Placed, SoftObject, StifferColor, load
from softmode.scenes import SplatScene
from softmode.splats import ColoredMesh, PinholeCamera
from softmode.viz import Film

RATE, STEPS, PULL, LET_GO, SLACK = 30, 4, 2.5, 60, 0.008
"""Frames per second, steps of a frame, force on a bucket [N], frame when it ends; half a hinge [m]."""
RUBBER = Material(youngs_modulus=4.0e6, poissons_ratio=0.4, density=600.0, viscosity=0.004, mass_damping=4.0)
YELLOW, DARK, GLASS, BLACK = ((0.94, 0.70, 0.10), (0.28, 0.28, 0.30), (0.45, 0.68, 0.80), (0.05, 0.05, 0.06))
SOFT = StifferColor(color=BLACK, factor=0.02)
ROOT, ELBOW, WRIST, TIP = np.array([[0.045, 0, 0.085], [0.115, 0, 0.165], [0.185, 0, 0.105], [0.19, 0, 0.06]])
"""Places of the hinges and of the bucket [m]."""
BOXES = (  # edges, places [m] and colours
    ((0.085, 0.10, 0.025), (0.0, 0.0, 0.055), YELLOW),
    ((0.03, 0.09, 0.045), (-0.04, 0.0, 0.08), YELLOW),
    ((0.035, 0.03, 0.04), (0.03, -0.01, 0.07), YELLOW),
    ((0.045, 0.04, 0.05), (0.005, 0.03, 0.088), GLASS),
    ((0.06, 0.06, 0.02), (0.0, 0.0, 0.035), DARK),
)
BEAMS = ((ROOT, ELBOW, 0.035), (ELBOW, WRIST, 0.03))
HANDLES = [(a + t * (b - a), radius) for a, b, radius in BEAMS for t in (0.25, 0.75)]
KERNELS = [*HANDLES, (TIP, 0.03), *((hinge, 0.016) for hinge in (ROOT, ELBOW, WRIST))]
"""Places and radii of the handles that the user gives [m]."""
BUILD = {"handles": "local", "local_count": 8, "function_count": 48, "cubature_count": 480}


def make_mesh() -> Any:
    """Return the toy: tracks, platform, cab, two beams on hinges, a bucket."""
    parts, turned = [], trimesh.transformations.rotation_matrix

    def add(mesh: Any, at: np.ndarray | tuple, color: tuple, angle: float = 0.0, axis: int = 1) -> None:
        mesh.apply_transform(turned(angle, np.eye(3)[axis])).apply_translation(at)
        mesh.visual.vertex_colors = np.tile([*color, 1.0], (len(mesh.vertices), 1))
        parts.append(mesh)

    for size, at, color in BOXES:
        add(trimesh.creation.box(size), at, color)
    for x, y in ((-0.055, -0.04), (-0.055, 0.04), (0.055, -0.04), (0.055, 0.04)):
        add(trimesh.creation.box((0.055, 0.028, 0.034)), (0.5 * x, y, 0.02), DARK)
        add(trimesh.creation.cylinder(0.017, 0.028, sections=24), (x, y, 0.02), DARK, np.pi / 2, 0)
    for a, b, wide, ends in ((ROOT, ELBOW, 0.024, (1.0, 0.4)), (ELBOW, WRIST, 0.022, (0.4, 1.0))):
        step, angle = SLACK * (b - a) / np.linalg.norm(b - a), np.arctan2(a[2] - b[2], b[0] - a[0])
        hinges = (a - ends[0] * step, a + 1.4 * step, 0.02, BLACK), (b - 1.4 * step, b + ends[1] * step, 0.019, BLACK)
        for low, high, edge, color in ((a + step, b - step, wide, YELLOW), *hinges):
            add(trimesh.creation.box((np.linalg.norm(high - low), edge, edge)), 0.5 * (low + high), color, angle)
    sides = ((0.185, 0.11), (0.20, 0.095), (0.205, 0.05), (0.165, 0.06))
    add(trimesh.convex.convex_hull([(x, y, z) for y in (-0.03, 0.03) for x, z in sides]), (0.0, 0.0, 0.0), DARK)
    return trimesh.util.concatenate(parts)


def make_toy(mesh: Any, count: int, placed: bool) -> tuple[SoftObject, np.ndarray]:
    """Return the toy, with handles that the user gives or without, and the place of its bucket in its frame [m]."""
    foot = np.array([*mesh.bounds.mean(axis=0)[:2], mesh.bounds[0, 2]])
    build = BuildOptions(add_kernels=[(x - foot, r) for x, r in KERNELS] if placed else (), **BUILD)
    how = {"build": build, "size": float(mesh.extents.max()), "clamped_height": 0.008, "stiffness_colors": (SOFT,)}
    toy = load(ColoredMesh.from_trimesh(mesh, name="toy"), pose="captured", splat_count=count, material=RUBBER, **how)
    return toy, TIP - foot - toy.body.offset


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
    toys, tips = zip(
        *(make_toy(make_mesh(), 4000 if short else 16000, placed) for placed in (False, True)), strict=True
    )
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
