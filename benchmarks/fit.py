"""How well `softmode fit` finds what objects are made of, on films by code: python -m benchmarks.fit [NAME ...].

The object of the fit is filled anew from 12,000 splats of the true one. Every film has all troubles at once: other
light, gain, gamma and colours, 2 % noise, a camera 1 cm and 1 degree off, a textured background, a late start.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import newton
import numpy as np

from softmode.deformables import BuildOptions, Material, SolverReduced, add_reduced_body
from softmode.deformables.model.namespaces import soft
from softmode.errors import SoftmodeError
from softmode.fitting.film import Clip
from softmode.fitting.film_fit import fit_film
from softmode.fitting.holding import Held, held_object
from softmode.objects import SoftObject, load
from softmode.splats import write_splats
from softmode.splats.colored_mesh import ColoredMesh
from tests.fitting.films import NONE, Trouble, make_film, motion
from tests.oracle import fem
from tests.oracle.scenes import INFINITE, Box, Clamp, Scene, Shape

RATIO, DENSITY = 0.35, 300.0
CASES = {
    "banana": ("banana", 0.2, "+x:0.04", 120e3, 4e-3, 1),
    "banana stiff": ("banana", 0.2, "+x:0.04", 400e3, 4e-3, 2),
    "bear": ("bear", 0.2, "top:0.05", 40e3, 4e-3, 3),
    "bear 100": ("bear", 0.2, "top:0.05", 100e3, 3e-3, 4),
    "sponge": ("sponge", 0.18, "-x:0.03", 60e3, 5e-3, 5),
    "mug": ("mug", 0.16, "-x:0.03", 80e3, 4e-3, 6),
    "fish": ("fish", 0.2, "-x:0.04", 20e3, 4e-3, 7),
    "glove": ("glove", 0.2, "-x:0.04", 40e3, 6e-3, 8),
    "doughnut": ("doughnut", 0.2, "-x:0.03", 100e3, 3e-3, 9),
    "bread": ("bread", 0.22, "-x:0.03", 60e3, 5e-3, 10),
    "cushion": ("cushion", 0.22, "-x:0.03", 50e3, 4e-3, 11),
    "banana slow": ("banana", 0.25, "+x:0.04", 70e3, 8e-3, 12),
}
"""Object, size [m], what is held, E [Pa], viscosity [s], seed."""
FEM = {
    "fem bar": (((0.0, 0.0, 0.0, 0.2, 0.05, 0.04),), 60e3, 21),
    "fem T": (((0.0, 0.0, 0.0, 0.16, 0.04, 0.04), (0.12, -0.04, 0.0, 0.16, 0.08, 0.04)), 50e3, 22),
    "fem step": (((0.0, 0.0, 0.0, 0.1, 0.06, 0.05), (0.1, 0.0, 0.0, 0.2, 0.06, 0.03)), 60e3, 23),
}
"""Boxes [m], E [Pa], seed: moved by quadratic finite elements of tests/oracle, the first 3 cm along x held."""


WRONG = {"drop": ("bear", 0.2, "top:0.05", 40e3, 4e-3, 31), "poke": ("sponge", 0.18, "-x:0.03", 60e3, 5e-3, 32)}
"""Films of what is not held: dropped by 3 cm, or standing on a table and poked. They have to be refused."""


def free_motion(thing: SoftObject, made: Material, poked: bool) -> tuple[Any, Any]:
    """Return the coordinates of a body that falls on a table, or is poked there, and its model."""
    builder = newton.ModelBuilder()
    speed = (0.0, 0.4, 0.6) if poked else (0.0, 0.0, 0.0)
    add_reduced_body(builder, thing.body, material=made, velocity=speed)
    under = float(thing.body.surface.points[:, 2].min()) - (0.0 if poked else 0.03)
    builder.add_ground_plane(height=under)
    model = builder.finalize(device="cpu")
    solver, states = SolverReduced(model, [thing.body]), [model.state(), model.state()]
    found = [soft(states[0]).q.numpy().copy()]
    for _ in range(480):
        for a, b in (states, states[::-1]):
            solver.step(a, b, None, None, 1.0 / 960.0)
        found.append(soft(states[0]).q.numpy().copy())
    return np.array(found), model


def fem_truth(name: str) -> tuple[Any, Any, Material, int]:
    """Return an object held at its lower x, its motion by finite elements in its functions, its material, the seed."""
    boxes, youngs_modulus, seed = FEM[name]
    shape = Shape(boxes=tuple(Box(lower=b[:3], upper=b[3:]) for b in boxes))
    made = Material(youngs_modulus=youngs_modulus, poissons_ratio=RATIO, density=DENSITY)
    end = Box(lower=(-INFINITE, -INFINITE, -INFINITE), upper=(0.03, INFINITE, INFINITE))
    scene = Scene(
        name=name, shape=shape, energy="stable_neo_hookean_log", youngs_modulus=youngs_modulus, poissons_ratio=RATIO,
        density=DENSITY, clamps=(Clamp(region=end),), gravity=(0.0, 0.0, -9.81), dt=1.0 / 480.0, steps=480,
        cell=0.03, grading=0.5,
    )  # fmt: skip
    solid, moved = fem.simulate(scene, bdf2=True)
    import trimesh

    mesh: Any = trimesh.Trimesh(*shape.surface()).subdivide_to_size(0.012)
    stripes = (40 + 180 * (np.sin(90 * mesh.vertices[:, :1] + 60 * mesh.vertices[:, 1:2] + [0, 2, 4]) > 0)).astype("u1")
    mesh.visual.vertex_colors = np.hstack([stripes, np.full((len(stripes), 1), 255, np.uint8)])
    size = float(np.ptp(mesh.vertices, axis=0).max())
    first = load(
        ColoredMesh.from_trimesh(mesh), size=size, pose="captured", surface_count=300, splat_count=12_000,
        build=BuildOptions(function_count=96), material=made,
    )  # fmt: skip
    truth = held_object(first, Held.parse("-x:0.03"))
    body = truth.body
    points, weights = body.cubature.points, body.cubature.weights
    shift = shape.bounds[0] - (body.bounds + body.offset)[0]  # the object stands on z = 0 around the origin
    matrix = solid.mesh.interpolation(np.clip(points + body.offset + shift, *np.add(shape.bounds, [[1e-9], [-1e-9]])))
    q = np.array([body.fit(matrix @ u, points, weights) for u in moved[::2]])
    _, model = motion(truth, made, 0.01, 1.0 / 480.0)
    return first, (truth, (q, model)), made, seed


def run(
    name: str, *, trouble: Trouble, anew: bool, verbose: bool, device: str | None = None, seconds: float = 0.9
) -> tuple[float, float, float, float, float]:
    """Return ln E found over true, its bar, the same of viscosity, and the seconds of the fit."""
    held, moved, dt = Held.parse("-x:0.03"), None, 1.0 / 960.0
    if name in FEM:
        first, (truth, moved), made, seed = fem_truth(name)
        size, preset, dt = float(np.ptp(first.body.bounds, axis=0).max()), name, 1.0 / 480.0
    else:
        preset, size, end, youngs_modulus, viscosity, seed = {**CASES, **WRONG}[name]
        held = Held.parse(end)
        made = Material(youngs_modulus=youngs_modulus, viscosity=viscosity, poissons_ratio=RATIO, density=DENSITY)
        told = {"size": size, "pose": "captured", "surface_count": 300, "material": made}
        first = load(preset, splat_count=12_000 if anew else 2500, build=BuildOptions(function_count=64), **told)
        truth = held_object(first, held)
        if name in WRONG:
            truth, moved = first, free_motion(first, made, name == "poke")
    if anew:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / f"{preset}.ply"
            write_splats(file, first.visible_splats.transformed(translation=first.body.offset))
            told = {"size": size, "pose": "captured", "surface_count": 300}
            thing = held_object(load(file, up="+z", material=made, **told), held)
    else:
        thing = held_object(load(preset, splat_count=2500, size=size, pose="captured", material=made), held)
    youngs_modulus, viscosity = made.youngs_modulus, max(made.viscosity, 1e-3)
    frames, plate, camera = make_film(truth, made, trouble, seed, moved=moved, dt=dt, seconds=seconds)
    density = DENSITY * truth.body.volume / thing.body.volume  # the mass is weighed
    clip = Clip(frames=frames, times=np.arange(len(frames)) / 30.0, name=name)
    start, wall = time.process_time(), time.perf_counter()

    def tell(stage: str, fraction: float) -> None:
        if verbose:
            print(f"   {time.perf_counter() - wall:6.1f} s {stage}", flush=True)

    material = Material(poissons_ratio=RATIO, density=density)
    found, _, x = fit_film(thing, clip, camera, held, material=material, plate=plate, progress=tell, device=device)
    taken = time.process_time() - start
    e, v = found["youngs_modulus"], found["viscosity"]
    if verbose:
        print(found.details, np.round(x, 4).tolist())
    out = (np.log(e.value / youngs_modulus), np.log(e.high / e.value))
    more = (np.log(v.value / viscosity), np.log(v.high / v.value))
    print(
        f"{name:14s} E {youngs_modulus / 1e3:5.0f} kPa: ln error {out[0]:+.3f} +- {out[1]:.3f}"
        f"{'' if e.observable else ' (not observable)'}; viscosity {1e3 * viscosity:.1f} ms:"
        f" {more[0]:+.2f} +- {more[1]:.2f}; followed {found.details['followed']:.3f}, {found.details['tracks']} tracks;"
        f" integrator {' '.join(f'{v:.3f}' for v in found.details['integrator'].values())};"
        f" volume {thing.body.volume / truth.body.volume:.3f}; {taken:.0f} s",
        flush=True,
    )
    return (*out, *more, taken)


def main() -> None:
    """Run cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--none", action="store_true", help="no trouble")
    parser.add_argument("--same", action="store_true", help="the object of the fit is built from the same mesh")
    parser.add_argument("--device")
    parser.add_argument("--seconds", type=float, default=0.9, help="of film")
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    rows = []
    for name in options.names or (*CASES, *FEM, *WRONG):
        try:
            trouble = NONE if options.none else Trouble()
            given = {"verbose": options.verbose, "device": options.device, "seconds": options.seconds}
            rows.append(run(name, trouble=trouble, anew=not options.same, **given))
        except SoftmodeError as error:
            print(f"{name:14s} refused: {error}", file=sys.stderr, flush=True)
    if rows:
        error = np.abs(np.array(rows))[:, 0]
        print(f"{len(rows)} films: median {np.median(error):.3f}, largest {error.max():.3f}")


if __name__ == "__main__":
    main()
