"""A toy excavator whose arm hangs on rubber hinges, with local handles that the user put on these, and without.

PIE-NeRF's figures 4 and 5: an excavator that deforms elastically, and kernels placed where motion is wanted. Both toys
are the same, with as many unknowns: 48 functions, chosen among those of 8 local handles that the build places, and of
the toy behind of 8 more, on the hinges, beams and bucket (``add_kernels``). The same force pulls both buckets down.

Run: ``python examples/excavator.py [--short]``; writes ``out/excavator.mp4`` and a contact sheet
"""

import argparse
from pathlib import Path

import numpy as np
import trimesh
import warp as wp

from softmode.deformables import BuildOptions, Material, SoftEnergies
from softmode.objects import Placed, SoftObject, StifferColor, load
from softmode.scenes import SplatScene
from softmode.splats import ColoredMesh, PinholeCamera
from softmode.viz import Film

RATE, STEPS, PULL, LET_GO = 30, 4, 2.5, 60
"""Frames per second, steps of a frame, force on a bucket [N], frame when it ends."""
RUBBER = Material(youngs_modulus=4.0e6, poissons_ratio=0.4, density=600.0, viscosity=0.004, mass_damping=0.6)
YELLOW, DARK, GLASS, BLACK = ((0.94, 0.70, 0.10), (0.28, 0.28, 0.30), (0.45, 0.68, 0.80), (0.05, 0.05, 0.06))
SOFT = StifferColor(color=BLACK, factor=0.02)
ROOT, ELBOW, WRIST, TIP = np.array([[0.045, 0, 0.085], [0.115, 0, 0.165], [0.185, 0, 0.105], [0.19, 0, 0.06]])
"""Places of the hinges and of the bucket [m]."""
SLACK = 0.008
"""Half the length of a hinge [m]."""
KERNELS = [(ROOT + t * (ELBOW - ROOT), 0.035) for t in (0.25, 0.75)]
KERNELS += [(ELBOW + t * (WRIST - ELBOW), 0.03) for t in (0.25, 0.75)] + [(TIP, 0.03)]
KERNELS += [(hinge, 0.016) for hinge in (ROOT, ELBOW, WRIST)]
"""Places and radii of the handles that the user gives [m]."""
BUILD = {"handles": "local", "local_count": 8, "function_count": 48, "cubature_count": 480}


def painted(mesh: trimesh.Trimesh, color: tuple[float, float, float]) -> trimesh.Trimesh:
    """Return a mesh in one colour."""
    mesh.visual = trimesh.visual.ColorVisuals(
        mesh, vertex_colors=np.tile(np.append(color, 1.0), (len(mesh.vertices), 1))
    )
    return mesh


def box(size: tuple[float, float, float], at: tuple[float, float, float], color: tuple) -> trimesh.Trimesh:
    """Return a box."""
    return painted(trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)), color)


def beam(a: np.ndarray, b: np.ndarray, wide: float, color: tuple) -> trimesh.Trimesh:
    """Return a square beam from a to b, which have the same y."""
    along = b - a
    turn = trimesh.transformations.rotation_matrix(np.arctan2(-along[2], along[0]), (0, 1, 0))
    turn[:3, 3] = 0.5 * (a + b)
    return painted(trimesh.creation.box((np.linalg.norm(along), wide, wide), turn), color)


def make_mesh() -> trimesh.Trimesh:
    """Return the toy: tracks, platform, cab, a boom of two beams on hinges, a bucket."""
    parts = [box((0.085, 0.10, 0.025), (0.0, 0.0, 0.055), YELLOW), box((0.03, 0.09, 0.045), (-0.04, 0, 0.08), YELLOW)]
    parts += [box((0.045, 0.04, 0.05), (0.005, 0.03, 0.088), GLASS), box((0.06, 0.06, 0.02), (0, 0, 0.035), DARK)]
    for y in (-0.04, 0.04):
        parts.append(box((0.11, 0.028, 0.034), (0.0, y, 0.02), DARK))
        for x in (-0.055, 0.055):
            wheel = trimesh.creation.cylinder(0.017, 0.028, sections=24)
            wheel.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
            parts.append(painted(wheel.apply_translation((x, y, 0.02)), DARK))
    first, second = ((b - a) / np.linalg.norm(b - a) for a, b in ((ROOT, ELBOW), (ELBOW, WRIST)))
    parts.append(box((0.035, 0.03, 0.04), (0.03, -0.01, 0.07), YELLOW))
    parts += [beam(ROOT - SLACK * first, ROOT + 1.2 * SLACK * first, 0.02, BLACK)]
    parts += [beam(ROOT + SLACK * first, ELBOW - SLACK * first, 0.024, YELLOW)]
    parts += [beam(ELBOW - 1.4 * SLACK * first, ELBOW + 0.4 * SLACK * first, 0.02, BLACK)]
    parts += [beam(ELBOW - 0.4 * SLACK * second, ELBOW + 1.4 * SLACK * second, 0.02, BLACK)]
    parts += [beam(ELBOW + SLACK * second, WRIST - SLACK * second, 0.022, YELLOW)]
    parts += [beam(WRIST - 1.4 * SLACK * second, WRIST + SLACK * second, 0.018, BLACK)]
    corners = [
        (x, y, z) for y in (-0.03, 0.03) for x, z in ((0.185, 0.11), (0.20, 0.095), (0.205, 0.05), (0.165, 0.06))
    ]
    parts.append(painted(trimesh.convex.convex_hull(np.array(corners)), DARK))
    return trimesh.util.concatenate(parts)


def make_toy(mesh: trimesh.Trimesh, count: int, placed: bool) -> tuple[SoftObject, np.ndarray]:
    """Return the toy, with handles that the user gives or without, and the place of its bucket in its frame [m]."""
    foot = np.array([*mesh.bounds.mean(axis=0)[:2], mesh.bounds[0, 2]])
    build = BuildOptions(add_kernels=[(x - foot, radius) for x, radius in KERNELS] if placed else (), **BUILD)
    how = {"material": RUBBER, "build": build, "size": float(mesh.extents.max()), "clamped_height": 0.008}
    toy = load(ColoredMesh.from_trimesh(mesh, name="excavator"), pose="captured", splat_count=count,
               stiffness_colors=(SOFT,), **how)  # fmt: skip
    return toy, TIP - foot - toy.body.offset


def make_scene(toys: list[SoftObject], edge: int) -> SplatScene:
    """Return the toys beside each other on a floor."""
    placed = [
        Placed(object=toy, position=(0.0, y, -float(toy.body.bounds[0, 2])))
        for toy, y in zip(toys, (0.0, 0.17), strict=True)
    ]
    view = {"position": (0.42, -0.62, 0.30), "target": (0.05, 0.085, 0.085), "fov_y": 0.42}
    camera = PinholeCamera.look_at("film", width=4 * edge // 3, height=edge, **view)
    return SplatScene([], placed, cameras=[camera], dt=1.0 / (RATE * STEPS), steps_per_frame=STEPS)


def test_final(moved: np.ndarray, energy: np.ndarray) -> None:
    """With the user's handles the arm gives more, so it is nearer to the truth; let go, the toys only lose energy."""
    pulled = moved[LET_GO - 1]
    print(f"buckets went {1e3 * pulled[0]:.1f} mm, with the user's handles {1e3 * pulled[1]:.1f} mm")
    assert pulled[1] > 1.08 * pulled[0]
    assert energy[LET_GO:].max() <= energy[LET_GO - 1] * 1.001 and energy[-1] < 0.2 * energy[LET_GO - 1]


def main(arguments: list[str] | None = None) -> None:
    """Pull both buckets, let go; film it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--short", action="store_true", help="small pictures")
    short = parser.parse_args(arguments).short
    wp.config.log_level = wp.LOG_WARNING
    mesh, count = make_mesh(), 4000 if short else 16000
    toys, tips = zip(*(make_toy(mesh, count, placed) for placed in (False, True)), strict=True)
    scene, energy, moved = make_scene(list(toys), 128 if short else 420), [], []
    energies = SoftEnergies(scene.solver)
    near = [np.linalg.norm(toy.body.surface_points - at, axis=1) < 0.025 for toy, at in zip(toys, tips, strict=True)]
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
            energies.update(scene.state)
            energy.append(sum(e.numpy().sum() for e in (energies.kinetic, energies.elastic, energies.gravitational)))
        film.publish()
    test_final(np.array(moved), np.array(energy) - energy[0])


if __name__ == "__main__":
    main()
