"""The beam of FreeForm's Tables 1, 4 and 5: bend and twist of softmode's bodies, FEM and MPM.

Scenes, stored frames and metric are those of `benchmarks.accuracy`. Springs of 1e9 N/m^4 hold the beam; every row is
compared with finite elements that hold it exactly, as the paper does, and with those that have the same springs.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy import FINE_RANK, KAPPA, affine, soft
from benchmarks.accuracy_runner import Row, Simulation, body_of, compare, quadrature_of, reference_at
from benchmarks.baselines.mpm import Particles
from benchmarks.freeform import explicit
from benchmarks.freeform.paper import MODES
from softmode.deformables.body.records import BodyCubature
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.reduction.options import BuildOptions
from tests.oracle import frames
from tests.oracle.fem import simulate
from tests.oracle.scenes import BEND, SCENES

Array = NDArray[np.float64]
Record = dict[str, Any]

TWISTS = {"twist": "twist_360", "twist 432": "twist_720"}
"""Twists by label; the paper's goes to 720 degrees, where the beam has buckled."""
BEAMS = {"bend": "bend", **TWISTS}
PAPER_KAPPA = 4.0e8
"""Springs [N/m^4] with which FreeForm's functions have the paper's own errors, in bend and twist alike."""
MPM_VOXEL, MPM_TWIST_STEPS = 0.5, 50

EXPLICIT_SPACING = 0.25
"""Edge of a cell of softmode's own particles [m]."""


def freeform(mode_count: int, **changes: object) -> BuildOptions:
    """Return FreeForm's functions: all of them, none dropped for their small size."""
    return dataclasses.replace(affine(mode_count, rank_tolerance=FINE_RANK), **changes)  # type: ignore[arg-type]


def default(function_count: int, **changes: Any) -> BuildOptions:
    """Return softmode's functions, made for the beam's Poisson's ratio."""
    ratio = BEND.poissons_ratio
    count = changes.pop("cubature_count", max(384, 6 * function_count))
    return BuildOptions(function_count=function_count, poissons_ratio=ratio, cubature_count=count, **changes)


def run_body(
    name: str, body: ReducedBody, *, exact: bool = False, kappa: float = KAPPA, steps: int | None = None
) -> Record:
    """Run a scene with a body; return its errors against both references, and the median processor time of a step."""
    row = Row(label="", scene=name, options=BuildOptions(), stiffness=None if exact else kappa)
    scene = SCENES[name]
    simulation = Simulation(scene, body, row)
    count = min(steps or scene.steps, scene.steps)
    q, times, iterations = simulation.run(count)
    quadrature = quadrature_of(scene.shape, row.point_count)
    record: Record = {
        "unknowns": 3 * (body.function_count - body.driven_count),
        "ms": float(np.median(times)),
        "iterations": float(np.mean(iterations)),
        "status": int(simulation.solver.status.numpy()[0]),
        "same": None,
    }
    references = (
        {"exact": name} if exact or soft(name, kappa) not in SCENES else {"exact": name, "same": soft(name, kappa)}
    )
    for label, other in references.items():
        total = compare(q, body, quadrature, reference_at(other, row.point_count), scene)[0]
        record[label] = total / scene.edge**2
    return record


def table1(*, quick: bool = False) -> Iterator[Record]:
    """Yield the rows of Table 1: errors by basis, number of modes and beam."""
    steps = 5 if quick else None
    for m in MODES[:1] if quick else MODES:
        for label, options in (("FreeForm's functions", freeform(m)), ("default functions", default(4 * (m + 1)))):
            for beam, name in BEAMS.items():
                body = body_of(SCENES[name], options, 5000, "none", None)[0]
                yield {"basis": label, "m": m, "beam": beam, **run_body(name, body, steps=steps)}
                if options.mode_count:
                    softer = run_body(name, body, kappa=PAPER_KAPPA, steps=steps)
                    yield {"basis": "FreeForm's, clamp 4e8", "m": m, "beam": beam, **softer}
    for m in (3,) if quick else (3, 16):
        for beam, name in BEAMS.items():
            options = BuildOptions(mode_count=m, poissons_ratio=BEND.poissons_ratio)
            body = body_of(SCENES[name], options, 5000, "exact", None)[0]
            yield {"basis": "told, exact", "m": m, "beam": beam, **run_body(name, body, exact=True, steps=steps)}
    for beam, name in (("bend", "bend"), ("twist", "twist_360")):
        count = 2 if quick else SCENES[name].steps if beam == "bend" else MPM_TWIST_STEPS
        yield {"basis": "MPM", "m": None, "beam": beam, **run_mpm(name, count)}
        steps = 2 if quick else SCENES[name].steps
        yield {"basis": "softmode's MPM", "m": None, "beam": beam, **explicit.run_beam(name, steps, EXPLICIT_SPACING)}


def run_mpm(name: str, steps: int, voxel: float = MPM_VOXEL) -> Record:
    """Run Newton's implicit MPM against the exact clamp."""
    beam = Particles(SCENES[name], voxel)
    expected = frames.load(name).displacement(beam.rest, slice(1, steps + 1))
    errors, clock = [], []
    for frame in expected:
        start = time.process_time()
        beam.step()
        clock.append(1e3 * (time.process_time() - start))
        errors.append(float(((beam.displacement() - frame) ** 2).sum(axis=1).mean()))
    scene = SCENES[name]
    return {
        "unknowns": beam.unknowns,
        "ms": float(np.median(clock)),
        "iterations": None,
        "status": 0,
        "same": None,
        "exact": float(np.mean(errors)) / scene.edge**2,
        "steps": steps,
        "particles": len(beam.rest),
    }


def table4(*, quick: bool = False) -> Iterator[Record]:
    """Yield the rows of Table 4: 5,000 points of a grid or at random in the step, functions from the grid."""
    steps = 3 if quick else None
    for label, options in (
        ("FreeForm's functions", freeform(16, cubature_count=None)),
        ("default functions", default(68, cubature_count=None)),
    ):
        for beam, name in (("bend", "bend"), ("twist", "twist_360")):
            body = body_of(SCENES[name], options, 5000, "none", None)[0]
            for sampling, sampled in (("grid", body), ("random", at_random(body))):
                record = run_body(name, sampled, steps=steps)
                yield {"basis": label, "beam": beam, "sampling": sampling, "points": sampled.point_count, **record}


def at_random(body: ReducedBody, count: int = 5000, seed: int = 0) -> ReducedBody:
    """Return a box-shaped body whose energy is integrated at random points of equal weight."""
    points = np.random.default_rng(seed).uniform(*body.bounds, size=(count, 3))
    return dataclasses.replace(
        body,
        cubature=BodyCubature(
            points=points,
            weights=np.full(count, body.volume / count),
            grad_basis=body.evaluate(points)[1].astype(np.float32),
            stiffness_scale=np.ones(count),
        ),
        fingerprint=f"{body.fingerprint} random {seed}",
    )


def table5(*, quick: bool = False) -> Iterator[Record]:
    """Yield the rows of Table 5: processor time of a step of the bend."""
    steps = 5 if quick else 100
    bases: list[tuple[str, int | None, BuildOptions]] = []
    for m in MODES[:1] if quick else MODES:
        bases.append(("FreeForm's functions", m, freeform(m)))
        bases.append(("default functions", m, default(4 * (m + 1))))
    for label, m, options in [*bases, ("default", None, default(48))]:
        body = body_of(BEND, options, 5000, "none", None)[0]
        yield {"basis": label, "m": m, **_time_only(run_body("bend", body, steps=steps))}
    yield {"basis": "MPM", "m": None, **_time_only(run_mpm("bend", 2 if quick else 10))}
    yield {"basis": "FEM", "m": None, "unknowns": 9963, "ms": fem_milliseconds(2 if quick else 6)}


def _time_only(record: Record) -> Record:
    return {key: record[key] for key in ("unknowns", "ms")}


def fem_milliseconds(steps: int) -> float:
    """Return the mean processor time of a step of the reference [ms], the bend's first steps."""
    scene = dataclasses.replace(BEND, steps=steps)
    times: list[float] = []
    simulate(scene, progress=lambda step, iterations: times.append(time.process_time()))
    return 1e3 * (times[-1] - times[0]) / (len(times) - 1)
