"""A step and a build of 160 functions of local handles, beside 160 of eigenmodes at as many points.

Run: ``OMP_NUM_THREADS=1 python -m benchmarks.local_handles``. A bar as large as that of ``benchmarks.step`` with eight
corners that are moved: without its symmetry none of the functions are the same. Functions chosen by elastic energy are
130 at most, so both bodies have all functions of their handles. Processor time of one core. The floor is that of
``benchmarks.step``: the arithmetic of an iteration at the rate of a large float32 matrix product.
"""

from __future__ import annotations

import time
from itertools import product

import numpy as np
import trimesh
import warp as wp

from benchmarks.step import SIZE, Beam, product_rate
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.quadrature.quadrature import quadrature_from_mesh
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions

MOST, REPEATS, MOVED = 160, 20, 0.25
"""Functions, steps that are timed, and how far corners are moved at most, over the shortest edge."""
ALL = {"cubature_count": 6 * MOST, "cubature_error": None, "rank_tolerance": 1e-10}
"""One fit of the cubature, and all functions that are not the same."""
BODIES = {
    "eigenmodes": BuildOptions(mode_count=15, handles="quadratic", **ALL),
    "local": BuildOptions(handles="local", **ALL),
    "local, 384 points": BuildOptions(handles="local", **{**ALL, "cubature_count": 384}),
}
"""Sixteen handles of ten functions each."""


def skewed_bar() -> Quadrature:
    """Return the quadrature of the bar."""
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * SIZE
    corners += np.random.default_rng(0).uniform(-MOVED, MOVED, corners.shape) * min(SIZE)
    hull = trimesh.convex.convex_hull(corners)
    return quadrature_from_mesh(hull.vertices, hull.faces, point_count=5000, surface_count=100)


def main() -> None:
    """Print rows of builds, then of steps."""
    wp.config.log_level = wp.LOG_WARNING
    quadrature = skewed_bar()
    bodies: dict[str, ReducedBody] = {}
    for name, options in BODIES.items():
        start = time.process_time()
        bodies[name] = build_body(quadrature, options, name=name, progress=False)
        cubature = float(str(bodies[name].provenance["seconds_cubature"]))
        print(
            f"build of {name}: {time.process_time() - start:.2f} s of processor time, of {bodies[name].function_count} "
            f"functions at {bodies[name].point_count} points, whose forces err by "
            f"{bodies[name].provenance['cubature_force_error']:.3f}; wall clock of the cubature {cubature:.2f} s",
            flush=True,
        )
    rate = product_rate("cpu")
    print("modes functions points worlds bodies | ms/step iterations ms/iteration floor ms | kB/world status")
    for body in bodies.values():
        Beam(body, 1, 1, "cpu").report(REPEATS, rate)


if __name__ == "__main__":
    main()
