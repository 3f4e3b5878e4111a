"""Frequencies of free bodies beside finite elements, for every solid, Poisson's ratio and number of functions.

Run from the repository root: ``python -m benchmarks.modes [--only NAME ...] [--functions N ...] [--all-points]
[--monotone | --held]``.

A row: the smallest and largest relative error of the first six frequencies, in percent, of a body as a user builds it
from the closed surface (cubature included), for each number of functions; "FreeForm" are 8 eigenmodes times affine
motion, 36 functions. "whole space" is the space that functions are chosen from, at all quadrature points: what is wrong
there no number of functions mends. "lost" is by how much at most the first six frequencies of the largest number of
functions are above that space at all points; "cubature" what its points change in the lowest 12 eigenvalues (root mean
square).

With ``--monotone`` a row is the largest rise of one of the frequencies from a number of functions to the next larger
one: more functions never make a body stiffer, but for what cubature leaves of its error.

With ``--held`` the solids are those of `tests/oracle/held.py`, with their exact regions and default options. A row has
over finite elements: works of gravity along x, y and z, of loads spread over the end and over its tip, and the first
six frequencies; then the errors that the build says it has, its processor time, and by how much at most a body that is
told of its regions late (`hold`) differs from these, at the first Poisson's ratio.
"""

from __future__ import annotations

import argparse
import time
import warnings

import numpy as np
from numpy.typing import NDArray

from softmode.deformables import BuildOptions, Quadrature, ReducedBody, build_body, hold, quadrature_from_mesh
from tests.oracle import held
from tests.oracle.solids import SOLIDS, TUBES, eigenvalues, frequency_errors

RATIOS = (0.3, 0.45, 0.49)
ALL = {**SOLIDS, **TUBES}


COUNTS = (10, 16, 24, 36, 48, 64, 80)
"""Numbers of functions of ``--monotone``."""


def largest_rise(quadrature: Quadrature, poissons_ratio: float, cubature_count: int | None) -> float:
    """Return how much one of the first six frequencies rises at most from a number of functions to the next."""
    last, rise = np.full(6, np.inf), -np.inf
    for count in COUNTS:
        options = BuildOptions(function_count=count, poissons_ratio=poissons_ratio, cubature_count=cubature_count)
        value = np.sqrt(eigenvalues(build_body(quadrature, options, progress=False), poissons_ratio))
        last, rise = value, max(rise, float((value / last - 1.0).max()))
    return rise


def space_errors(body: ReducedBody, reference: NDArray[np.float64], poissons_ratio: float) -> tuple[float, float]:
    """Return the smallest and the largest relative error of the whole space's frequencies at all points."""
    value = [float(str(body.provenance[f"space_eigenvalue_{poissons_ratio:g}_{k + 1}"])) for k in range(len(reference))]
    error = np.sqrt(np.array(value) / reference) - 1.0
    return float(error.min()), float(error.max())


def print_held(names: list[str]) -> None:
    """Print the table of held bodies."""
    print(
        f"{'solid':<18}{'nu':>5}{'gravity':>19}{'end':>19}{'tip':>19}{'frequencies':>37}{'space':>7}{'driven':>8}{'s':>6}"
    )
    for name in names:
        for first, ratio in enumerate(held.RATIOS.get(name, (0.3, 0.45))):
            solid, clock = held.SOLIDS[name](), time.process_time()
            quadrature = solid.quadrature()
            body = held.build_held(name, ratio)
            clock = time.process_time() - clock
            works, frequencies = held.against_elements(body, name, ratio)
            cells = [" ".join(f"{x:.3f}" for x in row) for row in (works[:3], works[6:], works[3:6], frequencies)]
            told = [100.0 * float(str(body.provenance.get(key, 0.0))) for key in ("space_error", "driven_error")]
            late = ""
            if not first:
                free = build_body(quadrature, BuildOptions(poissons_ratio=ratio), progress=False)
                found = held.against_elements(hold(free, *solid.regions, progress=False), name, ratio)
                change = np.concatenate(found) / np.concatenate([works, frequencies]) - 1.0
                late = f"  late {100.0 * np.abs(change).max():.1g} %"
            print(
                f"{name:<18}{ratio:5.2f}{cells[0]:>19}{cells[1]:>19}{cells[2]:>19}{cells[3]:>37}"
                f"{told[0]:5.1f} %{told[1]:6.1f} %{clock:6.1f}{late}",
                flush=True,
            )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list({**ALL, **held.SOLIDS}), metavar="NAME")
    parser.add_argument("--functions", nargs="+", type=int, default=[24, 36, 48, 80])
    parser.add_argument("--points", type=int, default=4000, help="quadrature points")
    parser.add_argument("--all-points", action="store_true", help="no cubature")
    parser.add_argument("--monotone", action="store_true", help="the largest rise of a frequency with more functions")
    parser.add_argument("--held", action="store_true", help="works and frequencies of held bodies")
    options = parser.parse_args()
    if options.held:
        warnings.simplefilter("ignore", RuntimeWarning)  # The table has these errors.
        print_held([name for name in options.only or held.SOLIDS if name in held.SOLIDS])
        return
    names = [name for name in options.only or ALL if name in ALL]
    count = None if options.all_points else BuildOptions().cubature_count
    if options.monotone:
        for name in names:
            quadrature = quadrature_from_mesh(*ALL[name]().surface(), point_count=options.points)
            rises = [f"{nu}: {100.0 * largest_rise(quadrature, nu, count):+.2f} %" for nu in RATIOS]
            print(f"{name:<26}{'   '.join(rises)}", flush=True)
        return
    print(
        f"{'solid':<26}{'nu':>6}{'FreeForm':>16}{'whole space':>16}"
        + "".join(f"{f'{n} functions':>18}" for n in options.functions)
        + f"{'lost':>8}{'cubature':>10}"
    )
    for name in names:
        solid = ALL[name]()
        quadrature = quadrature_from_mesh(*solid.surface(), point_count=options.points)
        freeform = build_body(quadrature, BuildOptions(mode_count=8, cubature_count=count), progress=False)
        for ratio in RATIOS:
            reference = solid.eigenvalues(ratio)
            cells = [frequency_errors(freeform, reference, ratio)]
            bodies = []
            for n in options.functions:
                chosen = BuildOptions(function_count=n, poissons_ratio=ratio, cubature_count=count)
                bodies.append(build_body(quadrature, chosen, progress=False))
            told = bodies[-1].provenance
            cells.append(space_errors(bodies[-1], reference, ratio))
            cells += [frequency_errors(body, reference, ratio) for body in bodies]
            text = [f"{100 * low:+.1f}..{100 * high:+.1f} %" for low, high in cells]
            lost, moved = (100.0 * float(str(told[key])) for key in ("frequency_error", "soft_mode_error"))
            print(
                f"{name:<26}{ratio:6.2f}{text[0]:>16}{text[1]:>16}"
                + "".join(f"{cell:>18}" for cell in text[2:])
                + f"{lost:6.2f} %{moved:8.2f} %",
                flush=True,
            )


if __name__ == "__main__":
    main()
