"""A step and a build of the functions of local handles, beside as many of the default's at as many points.

Run: ``OMP_NUM_THREADS=1 python -m benchmarks.local_handles``. The beam of ``benchmarks.step``, processor time of one
core. The floor is that of ``benchmarks.step``: the arithmetic of an iteration at the rate of a large float32 matrix
product.
"""

from __future__ import annotations

import time
from dataclasses import replace

import warp as wp

from benchmarks.step import SIZE, Beam, product_rate
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.build.build_body import build_body
from softmode.deformables.build.options import BuildOptions
from softmode.deformables.build.quadrature import quadrature_from_box

MOST, REPEATS = 160, 20


def main() -> None:
    """Print rows of builds, then of steps."""
    wp.config.log_level = wp.LOG_WARNING
    quadrature = quadrature_from_box(SIZE, point_count=5000, surface_count=100)
    bodies: dict[str, ReducedBody] = {}
    for name in ("default", "local, as many", "local, all", "local, all, 384 points"):
        options = BuildOptions(function_count=MOST, cubature_count=6 * MOST)
        if name == "local, as many":
            options = replace(options, handles="local", function_count=bodies["default"].function_count)
        elif name != "default":
            options = BuildOptions(handles="local", cubature_count=384 if "384" in name else 6 * MOST)
        start = time.process_time()
        bodies[name] = build_body(quadrature, options, name=name, progress=False)
        cubature = float(str(bodies[name].provenance["seconds_cubature"]))
        print(
            f"build of {name}: {time.process_time() - start:.2f} s of processor time, of {bodies[name].function_count} "
            f"functions at {bodies[name].point_count} points; wall clock of the cubature {cubature:.2f} s"
        )
    rate = product_rate("cpu")
    print("modes functions points worlds bodies | ms/step iterations ms/iteration floor ms | kB/world status")
    for body in bodies.values():
        Beam(body, 1, 1, "cpu").report(REPEATS, rate)


if __name__ == "__main__":
    main()
