"""Bodies that springs hold at an end which the build was not told of, beside finite elements with the same springs.

Run from the repository root: ``python -m benchmarks.springs [--only NAME ...] [--functions N ...]``.

A row: the work of gravity on a body as a user builds it, over that on finite elements (nu = 0.4; springs of 30 E / w^2
per volume on an end of width w). Last, springs a hundred times as hard, on the body that ``hold`` makes of the first
one, and over the body that was told of them at the build.
"""

from __future__ import annotations

import argparse

import numpy as np

from softmode.deformables import BuildOptions, Region, build_body, hold, quadrature_from_mesh
from tests.oracle.solids import SOLIDS, Bricks

RATIO = 0.4
NAMES = ("plate 40:1", "rod 50:1", "cross", "helix", "hand", "Y", "spiral")
HARD = 3000.0
"""Of the hard springs, in E over the square of the end's width."""


def end_region(solid: Bricks, hardness: float) -> Region:
    """Return the end of a solid, held by springs."""
    box = np.array([[-np.inf] * 3, [np.inf] * 3])
    box[1, solid.end[0]] = solid.end_width
    return Region(name="end", box=box, stiffness=hardness / solid.end_width**2)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=NAMES, choices=list(SOLIDS), metavar="NAME")
    parser.add_argument("--functions", nargs="+", type=int, default=[48, 80])
    options = parser.parse_args()
    print(
        f"{'solid':<12}" + "".join(f"{f'{n} functions':>15}" for n in options.functions) + f"{'hard: hold, told':>20}"
    )
    for name in options.only:
        solid = SOLIDS[name]()
        quadrature = quadrature_from_mesh(*solid.surface())
        cells = []
        for n in options.functions:
            body = build_body(quadrature, BuildOptions(function_count=n, poissons_ratio=RATIO), progress=False)
            work, reference = solid.spring_works(body, RATIO)
            cells.append(f"{work / reference:.3f}")
        region = end_region(solid, HARD)
        known = build_body(quadrature, BuildOptions(poissons_ratio=RATIO), progress=False)
        told = build_body(quadrature, BuildOptions(poissons_ratio=RATIO), regions=[region], progress=False)
        held, reference = solid.spring_works(hold(known, region, progress=False), RATIO, HARD)
        hard = f"{held / reference:.3f}, {held / solid.spring_works(told, RATIO, HARD)[0]:.3f}"
        print(f"{name:<12}" + "".join(f"{cell:>15}" for cell in cells) + f"{hard:>20}", flush=True)


if __name__ == "__main__":
    main()
