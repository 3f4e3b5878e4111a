"""Bodies that springs hold at an end which the build was not told of, beside finite elements with the same springs.

Run from the repository root: ``python -m benchmarks.springs [--only NAME ...] [--bases NAME ...]``.

A cell: the work of gravity on a body as a user builds it, over that on finite elements (nu = 0.4), for springs of 30 E
/ w^2 per volume on an end of width w, and for springs a hundred times as hard. Default, local handles and Q-GMLS have
as many functions as each other, the first number of three cells: 48 or 120, or as many as the poorest of them makes.
All functions of twelve handles stand with their own number. Last, the hard springs on the body that ``hold`` makes of
the default's, and over the body that was told of them at the build. Cubature has 384 points, or 960 of 120 functions.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from softmode.deformables import BuildOptions, ReducedBody, Region, build_body, hold, quadrature_from_mesh
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.reduction.options import CUBATURE_COUNT
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
    "default": BuildOptions(),
    "local": BuildOptions(function_count=48, handles="local", local_count=MANY),
    "Q-GMLS": BuildOptions(function_count=48, handles="qgmls", local_count=MANY),
    "12 local": BuildOptions(handles="local", local_count=12, cubature_count=960),
    "12 Q-GMLS": BuildOptions(handles="qgmls", local_count=12, cubature_count=960),
}
"""Functions chosen by elastic energy among those of eigenmodes, of local handles and of Q-GMLS; and all that twelve
local handles or kernels have, 120 at most."""
COUNTS = (48, 120)
"""How many are chosen."""


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


def spring_works(solid: Bricks, bodies: list[ReducedBody]) -> list[tuple[float, float]]:
    """Return the work of gravity on bodies over that on finite elements, with soft springs and with hard ones."""
    works = []
    for hardness in (SOFT, HARD):
        reference = solid.spring_reference(RATIO, hardness)
        works.append([solid.spring_work(body, RATIO, hardness) / reference for body in bodies])
    return list(zip(*works, strict=True))


def equal_bodies(quadrature: Quadrature, bases: list[BuildOptions], count: int) -> list[ReducedBody]:
    """Return bodies of as many functions as each other: so many, or as many as the poorest of them makes."""
    points = 960 if count > 100 else CUBATURE_COUNT
    options = [replace(base, function_count=count, cubature_count=points) for base in bases]
    bodies = [build_quietly(quadrature, one) for one in options]
    least = min(body.function_count for body in bodies)
    return [
        body if body.function_count == least else build_quietly(quadrature, one.with_functions(least))
        for body, one in zip(bodies, options, strict=True)
    ]


def build_quietly(quadrature: Quadrature, options: BuildOptions) -> ReducedBody:
    """Return a body; that there are fewer functions than were asked for is seen in the table."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "function_count:", RuntimeWarning)
        return build_body(quadrature, options, progress=False)


def print_springs(names: Sequence[str], bases: Sequence[str] = tuple(BASES), counts: Sequence[int] = COUNTS) -> None:
    """Print the table."""
    equal = [name for name in bases if BASES[name].chosen]
    whole = [name for name in bases if not BASES[name].chosen]
    head = [*([f"{count}: " * (k == 0) + name for count in counts for k, name in enumerate(equal)]), *whole]
    print(f"{'solid':<12}" + "".join(f"{name:>20}" for name in head) + f"{'hard: hold, told':>20}")
    for name in names:
        solid = solid_named(name)
        quadrature = quadrature_from_mesh(*solid.surface())
        bodies = [body for n in counts for body in equal_bodies(quadrature, [BASES[k] for k in equal], n)]
        bodies += [build_quietly(quadrature, BASES[basis]) for basis in whole]
        works = spring_works(solid, bodies)
        cells = [
            ("" if k % len(equal) and k < len(counts) * len(equal) else f"({body.function_count}) ")
            + f"{soft:.3f}, {hard:.3f}"
            for k, (body, (soft, hard)) in enumerate(zip(bodies, works, strict=True))
        ]
        region = end_region(solid, HARD)
        known = build_body(quadrature, BuildOptions(poissons_ratio=RATIO), progress=False)
        told = build_body(quadrature, BuildOptions(poissons_ratio=RATIO), regions=[region], progress=False)
        held = solid.spring_work(hold(known, region, progress=False), RATIO, HARD)
        ends = f"{held / solid.spring_reference(RATIO, HARD):.3f}, {held / solid.spring_work(told, RATIO, HARD):.3f}"
        print(f"{name:<12}" + "".join(f"{cell:>20}" for cell in [*cells, ends]), flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=NAMES, choices=[*SOLIDS, "star"], metavar="NAME")
    parser.add_argument("--bases", nargs="+", default=list(BASES), choices=list(BASES), metavar="NAME")
    parser.add_argument("--counts", nargs="+", type=int, default=COUNTS, help="how many functions are chosen")
    options = parser.parse_args()
    print_springs(options.only, options.bases, options.counts)


if __name__ == "__main__":
    main()
