"""Time the build of a body, stage by stage, on one core.

Run: ``python -m benchmarks.build [--repeats N] [--record]``. Medians over builds of the papers' beam (5 x 1 x 1 m) with
5,000 points, 1,000 kernels and 32 modes, of the default body, and of a beam held and driven at its ends; then of the
plush from its splats. The basis (kernels, eigenmodes, responses, functions) and the cubature are told apart; the target
for the first basis is 0.5 s. For scale: FreeForm builds 32 modes in 3.19-3.93 s on a GPU. On a busy machine compare
`all` with `cpu`, the processor time of the whole build: stages are stretched by the same factor.
"""

from __future__ import annotations

import argparse
import statistics
import time

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.record import add_record_option, record
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.quadrature.quadrature import quadrature_from_box, quadrature_from_splats
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.splats import make_plush

LEFT = Region(name="left", box=((-np.inf,) * 3, (-2.0, np.inf, np.inf)))
RIGHT = Region(name="right", box=((2.0, -np.inf, -np.inf), (np.inf,) * 3))
PAPER = BuildOptions(mode_count=32, kernel_count=1000)
CASES: dict[str, tuple[BuildOptions, tuple[Region, ...]]] = {
    "K = 1000, m = 32": (PAPER, ()),
    "default: 48 functions, K = 1000": (BuildOptions(), ()),
    "48 functions, K = 400": (BuildOptions(kernel_count=400), ()),
    "K = 400, m = 8": (BuildOptions(mode_count=8), ()),
    "K = 400, m = 16": (BuildOptions(mode_count=16), ()),
    "K = 400, m = 8, quadratic handles": (BuildOptions(handles="quadratic"), ()),
    "K = 400, m = 2, one end held exactly": (BuildOptions(mode_count=2), (LEFT,)),
    "K = 400, m = 2, both ends driven": (BuildOptions(mode_count=2), (LEFT, RIGHT)),
    "K = 1000, m = 2, one end held exactly": (BuildOptions(mode_count=2, kernel_count=1000), (LEFT,)),
}
BASIS = ("kernels", "eigenmodes", "responses", "functions")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    add_record_option(parser)
    given = parser.parse_args()
    repeats = given.repeats
    found: dict[str, float | str] = {}
    with threadpool_limits(limits=1):
        quadrature = quadrature_from_box((5.0, 1.0, 1.0), point_count=5000)
        print(f"{len(quadrature.points)} quadrature points, one core, medians of {repeats} builds [s]")
        print(
            f"{'':<38}" + "".join(f"{name:>11}" for name in (*BASIS, "basis", "cubature", "all", "cpu")) + "  functions"
        )
        for name, (options, regions) in CASES.items():
            found[name] = report(name, quadrature, options, regions, repeats)
        plush, splats = [], make_plush()
        for _ in range(repeats):
            clock = time.process_time()
            filled = quadrature_from_splats(splats.means, splats.scales, splats.quats, splats.opacities)
            build_body(filled, BuildOptions(), progress=False)
            plush.append(time.process_time() - clock)
        print(f"plush from splats, cpu: {statistics.median(plush):.3f}")
    if given.record:
        record("build", {"box": found["default: 48 functions, K = 1000"], "plush": statistics.median(plush)})


def report(
    name: str, quadrature: Quadrature, options: BuildOptions, regions: tuple[Region, ...], repeats: int
) -> float:
    """Build `repeats` times, print the medians, and return that of the processor time [s]."""
    bodies, processor = [], []
    for _ in range(repeats):
        clock = time.process_time()
        bodies.append(build_body(quadrature, options, regions=regions, progress=False))
        processor.append(time.process_time() - clock)
    stages = [statistics.median(seconds(body, stage) for body in bodies) for stage in BASIS]
    basis = statistics.median(sum(seconds(body, stage) for stage in BASIS) for body in bodies)
    cubature = statistics.median(seconds(body, "cubature") for body in bodies)
    whole = statistics.median(body.build_seconds for body in bodies)
    row = "".join(f"{value:11.3f}" for value in (*stages, basis, cubature, whole, statistics.median(processor)))
    print(f"{name:<38}{row}  {bodies[0].function_count} ({bodies[0].driven_count} driven)", flush=True)
    return statistics.median(processor)


def seconds(body: ReducedBody, stage: str) -> float:
    """Return the wall time of a stage [s]."""
    value = body.provenance[f"seconds_{stage}"]
    assert isinstance(value, float)
    return value


if __name__ == "__main__":
    main()
