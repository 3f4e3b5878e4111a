"""Bodies that springs hold at an end which the build was not told of, beside finite elements with the same springs.

Run from the repository root: ``python -m benchmarks.springs [--only NAME ...] [--bases NAME ...]``.

A cell: the work of gravity on a body as a user builds it, over that on finite elements (nu = 0.4), for springs of 30 E
/ w^2 per volume on an end of width w, and for springs a hundred times as hard; with the number of functions where not
all that were asked for are there. Last, the hard springs on the body that ``hold`` makes of the first one, and over the
body that was told of them at the build. Cubature has 384 points, or 960 of 120 functions.
"""

from __future__ import annotations

import argparse

import numpy as np

from softmode.deformables import BuildOptions, Region, build_body, hold, quadrature_from_mesh
from tests.oracle.solids import SOLIDS, Bricks
from tests.shape_trials import voxelise
from tests.shapes import SHAPES

RATIO = 0.4
NAMES = ("plate 40:1", "rod 50:1", "cross", "helix", "hand", "star", "Y", "spiral")
SOFT, HARD = 30.0, 3000.0
"""Of the springs, in E over the square of the end's width."""
MANY = 60
"""Local handles, or kernels of Q-GMLS, that few functions are chosen among."""
BASES = {
    "chosen 48": BuildOptions(function_count=48),
    "local 48": BuildOptions(function_count=48, handles="local", local_count=MANY),
    "Q-GMLS 48": BuildOptions(function_count=48, handles="qgmls", local_count=MANY),
    "chosen 120": BuildOptions(function_count=120, cubature_count=960),
    "local 120": BuildOptions(function_count=120, handles="local", local_count=MANY, cubature_count=960),
    "Q-GMLS 120": BuildOptions(function_count=120, handles="qgmls", local_count=MANY, cubature_count=960),
    "12 local": BuildOptions(handles="local", local_count=12, cubature_count=960),
    "12 Q-GMLS": BuildOptions(handles="qgmls", local_count=12, cubature_count=960),
    "chosen 80": BuildOptions(function_count=80),
}
"""Functions chosen by elastic energy among those of eigenmodes, of local handles and of Q-GMLS; and all that twelve
local handles or kernels have, 120 at most."""
SHOWN = tuple(name for name in BASES if name != "chosen 80")


def solid_named(name: str) -> Bricks:
    """Return a solid; the star of twelve spikes as voxels."""
    if name != "star":
        return SOLIDS[name]()
    voxels = voxelise(SHAPES[name], 10)
    low, *_ = voxels.cell
    return Bricks(mask=voxels.filled, pitch=(low, *voxels.cell[1:]), end=(voxels.axis, 1))


def end_region(solid: Bricks, hardness: float) -> Region:
    """Return the end of a solid, held by springs."""
    box = np.array([[-np.inf] * 3, [np.inf] * 3])
    box[1, solid.end[0]] = solid.end_width
    return Region(name="end", box=box, stiffness=hardness / solid.end_width**2)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=NAMES, choices=[*SOLIDS, "star"], metavar="NAME")
    parser.add_argument("--bases", nargs="+", default=SHOWN, choices=list(BASES), metavar="NAME")
    options = parser.parse_args()
    print(f"{'solid':<12}" + "".join(f"{name:>20}" for name in options.bases) + f"{'hard: hold, told':>20}")
    for name in options.only:
        solid = solid_named(name)
        quadrature = quadrature_from_mesh(*solid.surface())
        cells = []
        for basis in options.bases:
            body = build_body(quadrature, BASES[basis], progress=False)
            works = [work / reference for work, reference in (solid.spring_works(body, RATIO, k) for k in (SOFT, HARD))]
            asked = BASES[basis].function_count or 120
            count = "" if body.function_count == asked else f" ({body.function_count})"
            cells.append(f"{works[0]:.3f}, {works[1]:.3f}{count}")
        region = end_region(solid, HARD)
        known = build_body(quadrature, BuildOptions(poissons_ratio=RATIO), progress=False)
        told = build_body(quadrature, BuildOptions(poissons_ratio=RATIO), regions=[region], progress=False)
        held, reference = solid.spring_works(hold(known, region, progress=False), RATIO, HARD)
        hard = f"{held / reference:.3f}, {held / solid.spring_works(told, RATIO, HARD)[0]:.3f}"
        print(f"{name:<12}" + "".join(f"{cell:>20}" for cell in cells) + f"{hard:>20}", flush=True)


if __name__ == "__main__":
    main()
