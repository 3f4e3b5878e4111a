"""Cut a soft sculpture while it sways: the upper part falls off, lands beside it, and both cast shadows.

A column stands on its foot, which is a region of its body. It is pushed, and at the height of its swing a plane cuts it
obliquely. The parts are ordinary bodies: they take over place, momentum and at most the energy of the column, the upper
one slides down the cut and falls.

Run: ``python examples/cut_sculpture.py [--short]``; writes ``out/cut_sculpture.mp4`` and a contact sheet
"""

import argparse
import time
from pathlib import Path

import numpy as np
import warp as wp

from softmode.deformables import BuildOptions, Material, Patch
from softmode.objects import ObjectConfig, Placed, SoftObject, cut_object, load
from softmode.scenes import Fixture, SplatScene, motion_of, set_motion
from softmode.splats import CameraOptions, PinholeCamera
from softmode.viz import Film

HEIGHT, WIDTH, RATE = 0.24, 0.07, 30
GRAVITY = 9.81
MATERIAL = Material(youngs_modulus=6.0e4, density=300.0, viscosity=0.01, friction=0.15)
TABLE = Fixture(label="table", size=(0.5, 0.5, 0.02), position=(0.0, 0.0, -0.02), color=(0.62, 0.60, 0.56))


def make_scene(parts: list[SoftObject], whole: SoftObject, edge: int) -> SplatScene:
    """Return a scene with the column, or its parts where they were in it, on a table."""
    camera = PinholeCamera.look_at(
        "film", position=(0.30, -0.74, 0.34), target=(-0.06, 0.0, 0.09), width=edge, height=edge, fov_y=0.55
    )
    lift = np.array([0.0, 0.0, -whole.body.bounds[0, 2]]) - whole.body.offset
    placed = [Placed(object=part, position=tuple((lift + part.body.offset).tolist())) for part in parts]
    light = CameraOptions(mesh_samples=4)
    return SplatScene([TABLE], placed, cameras=[camera], dt=1.0 / 480.0, steps_per_frame=16, camera_options=light)


def momentum(scene: SplatScene) -> np.ndarray:
    """Return the momentum of all objects [kg m/s]."""
    bodies, rates = (thing.body for thing in scene.objects), motion_of(scene).qd
    return MATERIAL.density * np.sum(
        [b.volume * b.mean_basis @ qd for b, qd in zip(bodies, rates, strict=True)], axis=0
    )


def test_final(energies: list[float], momenta: list[np.ndarray], fall: float, rest: np.ndarray) -> None:
    """The cut adds no energy and keeps the momentum; the part falls at g, then lies on the table; the foot stays."""
    assert energies[1] <= energies[0] * (1.0 + 1e-9)
    assert np.linalg.norm(momenta[1] - momenta[0]) < 1e-9 * max(np.linalg.norm(momenta[0]), 1e-3)
    assert fall > 0.05, "the upper part fell"
    assert rest.min() > -2e-3, "nothing sank into the table"


def main(arguments: list[str] | None = None) -> None:
    """Sway, cut, fall; film it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--short", action="store_true", help="a small film of a coarser body")
    given = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    edge, options = (160, BuildOptions(function_count=24)) if given.short else (480, BuildOptions())
    config = ObjectConfig(shape="box", extents=(WIDTH, WIDTH, HEIGHT), clamped_height=0.03, splat_count=6000)
    column = load(config, build=options, material=MATERIAL)
    scene = make_scene([column], column, edge)
    with Film(Path("out/cut_sculpture.mp4")) as film:
        for frame in range(9):  # a gust along x, at its end the swing is about half way
            scene.model.set_gravity((6.0 if frame < 8 else 0.0, 0.0, -GRAVITY))
            scene.step()
            film.add(scene.draw(), RATE)
        before, energy, clock = motion_of(scene), scene.kinetic_energy(), time.perf_counter()
        centre = before.q[0]
        middle = column.body.mean_basis @ centre
        plane = Patch.plane(middle + np.array([0.0, 0.0, 0.02]), (-0.55, 0.0, 1.0))
        parts, cut = cut_object(column, plane, centre, inside=(0.85, 0.30, 0.24))
        print(f"{cut.notes[0]}; {time.perf_counter() - clock:.1f} s")
        momenta = [momentum(scene)]
        scene = make_scene(list(parts), column, edge)
        set_motion(scene, before, [0] * len(parts))
        energies = [energy + before.elastic.sum(), scene.kinetic_energy() + motion_of(scene).elastic.sum()]
        momenta.append(momentum(scene))
        upper = int(np.argmax([part.body.offset[2] for part in parts]))
        start = scene.surface(upper)[:, 2].mean()
        for _ in range(30 if given.short else 75):
            scene.step()
            film.add(scene.draw(), RATE)
        film.publish()
    rest = np.concatenate([scene.surface(k)[:, 2] for k in range(len(parts))])
    fall = start - scene.surface(upper)[:, 2].mean()
    print(f"energy {energies[0]:.4f} J before the cut, {energies[1]:.4f} J after; the part fell {1e3 * fall:.0f} mm")
    test_final(energies, momenta, fall, rest)
    print("wrote out/cut_sculpture.mp4 and out/cut_sculpture.png")


if __name__ == "__main__":
    main()
