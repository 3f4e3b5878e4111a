"""Accuracy against finite elements: FreeForm's table, the clamp, cubature, and what goes beyond it.

Run: ``python -m benchmarks.accuracy [suite ...] [--output out/accuracy.json]``; then
``python docs/accuracy_picture.py`` draws the picture. Suites that are run replace their rows in the output.
Reference: `tests/oracle`. Protocol and figures: `docs/accuracy.md`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import warp as wp

from benchmarks.accuracy_runner import Result, Row, run_all
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from tests.oracle.scenes import KAPPAS, SCENES

MODES = (6, 9, 16, 32)
FINE_RANK = 1.0e-8
"""Rank tolerance of the second set of the papers' rows, which keeps functions that the default drops."""
PAPER_ROWS: dict[str, dict[str, object]] = {
    "affine": {},
    f"affine, rank tolerance {FINE_RANK:.0e}": {"rank_tolerance": FINE_RANK},
}
"""Labels and changes of the papers' rows."""
KERNEL_COUNT = 1000
HELD_KERNEL_COUNT = 600
"""Kernels of bodies with regions: static responses use all of them, and more than an eighth of the points cost nothing
where there is no point. With 1000 the bend of 99 unknowns has 2.5e-3 in place of 1e-6."""
KAPPA = 1.0e9
"""Springs per volume of soft clamps [N/m^4] unless said otherwise."""
FREEFORM = {
    "bend": {6: 7.80e-3, 9: 4.90e-3, 16: 4.10e-4, 32: 2.93e-6},
    "twist": {6: 1.56e-4, 9: 2.95e-5, 16: 3.46e-6, 32: 6.64e-6},
}
"""Table 1 of FreeForm, column "Ours"."""
SIMPLICITS = {
    "bend": {6: 1.20e-2, 9: 6.94e-3, 16: 1.53e-3, 32: 1.17e-4},
    "twist": {6: 2.54e-3, 9: 3.42e-4, 16: 1.30e-4, 32: 4.21e-5},
}
"""Table 1 of FreeForm, column "Simplicits"."""
PROTOTYPE = {
    "bend": {6: 6.6e-3, 9: 5.3e-3, 16: 4.8e-4, 32: 2.4e-5},
    "twist": {6: 1.2e-4, 9: 1.0e-4, 16: 1.4e-5, 32: 2.8e-6},
}
"""A float64 prototype of the method, clamp 1e9 against an exact one, 2 s of the bend, by the diagonal."""

Work = Iterator[tuple[Row, list[str]]]


def affine(mode_count: int, **changes: object) -> BuildOptions:
    """Return the paper's basis: eigenmodes times (X, Y, Z, 1), whatever the defaults are."""
    base = BuildOptions(mode_count=mode_count, kernel_count=KERNEL_COUNT, handles="affine", static_responses=False)
    return dataclasses.replace(base, **changes)  # type: ignore[arg-type]


def soft(name: str, kappa: float) -> str:
    """Return the name of the scene with soft clamps."""
    return SCENES[name].with_clamp(kappa).name


def suite_paper() -> Work:
    """Bend and twist, affine basis: soft clamp in the model, against the exact and the same clamp; two tolerances."""
    for label, changes in PAPER_ROWS.items():
        for scene in ("bend", "twist_360"):
            for m in MODES:
                yield Row(label=label, scene=scene, options=affine(m, **changes)), [scene, soft(scene, KAPPA)]


def suite_twist() -> Work:
    """The twist to 720 degrees, pulled and as printed."""
    for name in ("twist_720_pull", "twist_720"):
        for m in MODES:
            yield Row(label="affine", scene=name, options=affine(m)), [name]


def suite_kappa() -> Work:
    """The bend against the clamp's stiffness, against the exact and the same clamp."""
    for m in MODES:
        for kappa in KAPPAS:
            row = Row(label="affine", scene="bend", options=affine(m), stiffness=kappa)
            yield row, ["bend", soft("bend", kappa)]


def suite_cubature() -> Work:
    """All quadrature points instead of the default cubature, and Newton to a tighter tolerance."""
    tight = SolverReducedOptions(contact_max=1, tolerance=1e-7, keep_spin=False)
    for scene, m in (("bend", 6), ("bend", 16), ("twist_360", 16), ("spin", 16)):
        references = [scene] if scene == "spin" else [scene, soft(scene, KAPPA)]
        yield Row(label="all points", scene=scene, options=affine(m, cubature_count=None)), references
        yield Row(label="384 points, tolerance 1e-7", scene=scene, options=affine(m), solver=tight), references
    for m in (2, 6, 16):
        for count in (None, 768):
            options = affine(m, static_responses=True, cubature_count=count, kernel_count=HELD_KERNEL_COUNT)
            label = f"affine + static, exact, {count or 'all'} points"
            yield Row(label=label, scene="bend", options=options, stiffness=None, regions="exact"), ["bend"]


def suite_free() -> Work:
    """The free beam, stretched and spinning."""
    for m in MODES:
        yield Row(label="affine", scene="spin", options=affine(m)), ["spin"]


def suite_other() -> Work:
    """Heterogeneous tapered beam, L-shape, and the bend with the energy that has an origin term."""
    for m in MODES:
        yield Row(label="affine", scene="bend_log", options=affine(m)), ["bend_log"]
    for name in ("taper", "l_shape"):
        for m in MODES:
            yield Row(label="affine", scene=name, options=affine(m), stiffness=KAPPA), [name]


def suite_beyond() -> Work:
    """Clamps known at build time: static responses, exact clamps, quadratic handles."""
    clamped = ("bend", "twist_360", "twist_720_pull", "taper", "l_shape")
    bases = (
        ("affine, exact", (6, 9, 16), {"handles": "affine", "static_responses": False}),
        ("affine + static, exact", (2, 3, 4, 6, 16), {"handles": "affine", "static_responses": True}),
        ("quadratic, exact", (2, 3, 6), {"handles": "quadratic", "static_responses": False}),
        ("quadratic + static, exact", (1, 2, 3), {"handles": "quadratic", "static_responses": True}),
    )
    for scene in clamped:
        for label, modes, changes in bases:
            for m in modes:
                options = affine(m, kernel_count=HELD_KERNEL_COUNT, **changes)
                yield Row(label=label, scene=scene, options=options, stiffness=None, regions="exact"), [scene]
    for m in (2, 4, 6, 16):
        options = affine(m, kernel_count=HELD_KERNEL_COUNT, static_responses=True)
        yield (
            Row(label="affine + static, soft", scene="bend", options=options, regions="soft"),
            ["bend", soft("bend", KAPPA)],
        )
    for m in (3, 6):
        yield Row(label="quadratic", scene="spin", options=affine(m, handles="quadratic")), ["spin"]


def suite_chosen() -> Work:
    """The same with functions chosen by elastic energy, and a twist on which nothing was chosen."""
    for scene in ("bend", "taper", "l_shape", "twist_360", "twist_720_pull", "twist_540_flat"):
        for count in (37, 48) if len(SCENES[scene].clamps) == 1 else (41, 48, 53):
            options = BuildOptions(function_count=count)
            yield Row(label="chosen, exact", scene=scene, options=options, stiffness=None, regions="exact"), [scene]


SUITES: dict[str, Callable[[], Work]] = {
    "paper": suite_paper,
    "twist": suite_twist,
    "kappa": suite_kappa,
    "cubature": suite_cubature,
    "free": suite_free,
    "other": suite_other,
    "beyond": suite_beyond,
    "chosen": suite_chosen,
}
HEADER = (
    "| model | clamp | m | unknowns | points | reference | nMSE | by diagonal | basis | solver | iterations | ms/step "
    "| FreeForm | Simplicits | prototype |\n" + "|---" * 15 + "|"
)


def line(result: Result) -> str:
    """Return a row of the table; published figures stand beside the protocol they belong to."""
    family = {"bend": "bend", "twist_360": "twist", "twist_720_pull": "twist", "twist_720": "twist"}.get(result.scene)
    published = ["", "", ""]
    if family and result.label in PAPER_ROWS and result.stiffness == KAPPA:
        tables = (FREEFORM, SIMPLICITS, PROTOTYPE if result.scene in ("bend", "twist_360") else {family: {}})
        published = [f"{table[family][m]:.2e}" if (m := result.mode_count) in table[family] else "" for table in tables]
    clamp = "free" if not SCENES[result.scene].clamps else "exact"
    if result.stiffness is not None and SCENES[result.scene].clamps:
        clamp = f"{result.stiffness:.0e}"
    flag = "" if result.status == 0 else f" (status {result.status})"
    cells = [
        result.label + flag,
        clamp,
        f"{result.mode_count}",
        f"{result.unknowns}",
        f"{result.cubature_count}",
        result.scene,
        f"{result.nmse:.2e}",
        f"{result.nmse_diagonal:.2e}",
        f"{result.basis:.1e}",
        f"{result.solver:.1e}",
        f"{result.iterations:.2f}",
        f"{result.milliseconds:.2f}",
        *published,
    ]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Run the suites and store their results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("suite", nargs="*", metavar="suite", help=", ".join(SUITES))
    parser.add_argument("--output", type=Path, default=Path("out/accuracy.json"))
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    wanted = options.suite or list(SUITES)
    for name in wanted:
        if name not in SUITES:
            parser.error(f"unknown suite {name!r}; there are {', '.join(SUITES)}")
    stored = json.loads(options.output.read_text()) if options.output.exists() else {}
    for name in wanted:
        print(f"\n{name}: {SUITES[name].__doc__}\n\n{HEADER}", flush=True)
        results = []
        for row, references in SUITES[name]():
            for result in run_all(row, references):
                print(line(result), flush=True)
                results.append(dataclasses.asdict(result))
        stored[name] = results
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(json.dumps(stored, indent=1))


if __name__ == "__main__":
    main()
