"""Build every shape of the test suite, pull it, and print what came of it.

Run from the repository root: ``python -m benchmarks.shapes [--only NAME ...] [--cells N] [--json FILE]``, the third
table alone by ``--springs [SOLID ...]``.

First table: quadrature and body against exact moments. Second table: each shape's voxel relative, held exactly at one
end, against quadratic finite elements on the same voxels; work done by gravity and by forces on the other end, as a
fraction of that of finite elements (1 is exact, less is too stiff), for several bases. Q-GMLS knows no held ends and is
not among them. Third table: clamps that no build was told of, as springs, for the default, local handles and Q-GMLS at
equal unknowns (``benchmarks.springs``). The last lines count failures.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import time
from pathlib import Path
from typing import Any

import warp as wp

from benchmarks.springs import NAMES, print_springs
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.errors import SoftmodeError
from tests.oracle.solids import SOLIDS
from tests.shape_trials import base_of, drop, solve_reference, try_build, try_pull, voxelise
from tests.shapes import SHAPES, Shape

BASES: dict[str, BuildOptions] = {
    "affine 8": BuildOptions(mode_count=8, static_responses=False),
    "affine 32": BuildOptions(mode_count=32, static_responses=False),
    "responses 8": BuildOptions(mode_count=8),
    "quadratic 8": BuildOptions(mode_count=8, handles="quadratic"),
    "chosen 48": BuildOptions(),
    "chosen 57": BuildOptions(function_count=57),
    "local 48": BuildOptions(function_count=48, handles="local", local_count=24),
}
"""Bases of the second table; responses are on but in the first two."""


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", default=list(SHAPES), metavar="NAME")
    parser.add_argument("--cells", type=int, default=8, help="voxels along the longest edge")
    parser.add_argument("--bases", nargs="+", default=list(BASES), choices=list(BASES))
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--springs", nargs="*", default=None, choices=[*SOLIDS, "star"], metavar="SOLID")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    if options.springs is not None:
        print_springs(options.springs or NAMES)
        return
    shapes = [SHAPES[name] for name in options.only]
    built, build_failures = print_builds(shapes)
    pulled, pull_failures = print_pulls(shapes, options.cells, options.bases)
    print()
    print_springs(NAMES)
    print(f"\nbuilds: {build_failures} of {len(shapes)} failed; pulls: {pull_failures} of {len(pulled)} failed")
    if options.json:
        options.json.write_text(json.dumps({"builds": built, "pulls": pulled}, indent=1))


def print_builds(shapes: list[Shape]) -> tuple[list[dict[str, Any]], int]:
    """Build every shape from its own source; return the rows and the number of failures."""
    print(
        f"{'shape':<20}{'source':>9}{'points':>8}{'n':>5}{'volume':>10}{'centre':>9}{'inertia':>9}{'M - 1':>9}"
        f"{'force':>9}{'s':>7}  broken"
    )
    rows, failures = [], 0
    for shape in shapes:
        try:
            trial = try_build(shape, BuildOptions())
        except SoftmodeError as error:
            failures += 1
            rows.append({"name": shape.name, "error": str(error)})
            print(f"{shape.name:<20}{shape.source:>9}  {type(error).__name__}: {error}")
            continue
        broken = trial.problems(shape)
        failures += bool(broken)
        rows.append({**dataclasses.asdict(trial), "broken": broken})
        print(
            f"{trial.name:<20}{shape.source:>9}{trial.point_count:>8}{trial.function_count:>5}{trial.volume:>+10.1e}"
            f"{trial.centre:>9.1e}{trial.inertia:>9.1e}{trial.gram:>9.1e}{trial.force:>9.1e}{trial.seconds:>7.2f}"
            f"  {', '.join(broken)}",
            flush=True,
        )
    return rows, failures


def print_pulls(shapes: list[Shape], cells: int, bases: list[str]) -> tuple[list[dict[str, Any]], int]:
    """Pull the voxel relative of every shape in one piece, and drop the others; return rows and number of failures."""
    print(f"\n{'shape':<20}{'cells':>6}{'FEM':>8}", *[f"{name:>26}" for name in bases], " broken")
    print(f"{'':<20}{'':>6}{'unknowns':>8}", *[f"{'unknowns  gravity  pull':>26}" for _ in bases])
    rows: list[dict[str, Any]] = []
    failures = 0
    for shape in shapes:
        if not shape.connected:
            body = build_body(shape.quadrature(), BuildOptions(), name=shape.name, progress=False)
            error = drop(body)
            failures += not error < 1e-4
            rows.append({"name": shape.name, "drop": error})
            print(f"{shape.name:<20}  in pieces: free fall, error {error:.1e}", flush=True)
            continue
        voxels = voxelise(shape, cells)
        quadrature = voxels.quadrature()
        loads = solve_reference(voxels, quadrature)
        line = f"{shape.name:<20}{int(voxels.filled.sum()):>6}{loads.unknowns:>8}"
        broken: list[str] = []
        row: dict[str, Any] = {"name": shape.name, "cells": int(voxels.filled.sum()), "unknowns": loads.unknowns}
        for name in bases:
            start = time.perf_counter()
            try:
                body = build_body(quadrature, BASES[name], regions=(base_of(voxels),), progress=False)
                trial = try_pull(shape.name, voxels, loads, body)
            except SoftmodeError as error:
                broken.append(f"{name}: {type(error).__name__}")
                line += f"{'':>27}"
                continue
            broken += [f"{name}: {problem}" for problem in trial.problems()]
            row[name] = {**dataclasses.asdict(trial), "seconds": time.perf_counter() - start}
            line += f"{trial.unknowns:>13}{trial.gravity:>8.3f}{trial.pull:>6.3f}"
        failures += bool(broken)
        rows.append({**row, "broken": broken})
        print(line, "", ", ".join(broken), flush=True)
    for name in bases:
        gravity = [row[name]["gravity"] for row in rows if name in row]
        pull = [row[name]["pull"] for row in rows if name in row]
        if gravity:
            print(
                f"{name:<20} median work: gravity {statistics.median(gravity):.3f}, pull "
                f"{statistics.median(pull):.3f}; least: {min(gravity):.3f}, {min(pull):.3f}"
            )
    return rows, failures


if __name__ == "__main__":
    main()
