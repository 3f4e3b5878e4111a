"""Run FreeForm's tables and figures beside the paper's numbers.

Run: ``python -m benchmarks.freeform [--tables 1 2 3 4 5] [--figures 4 5 7] [--quick] [--output out/freeform.json]``,
or ``--tables 2 --figures 6 --meshes FOLDER`` for Table 2 and figure 6 on meshes of your own.
What is run replaces its part of the output; Table 2 goes on where it was left.
`benchmarks/freeform/TABLES.md` says what the rows mean. SPH is not run.
"""

from __future__ import annotations

import argparse
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import warp as wp
from threadpoolctl import threadpool_limits

from benchmarks.freeform import beam, figures, objects, overlays, paper, training
from benchmarks.freeform.meshes import REFERENCES, References

Record = dict[str, Any]
PICTURES = Path("docs/images")
SPH = "not run (pysplishsplash 2.15 and 2.19 crash at import on Linux x86-64)"


def cell(value: float | None) -> str:
    """Return a number of a table, or a dash."""
    return f"{'-':>10}" if value is None else f"{value:>10.2e}"


def print_table1(rows: list[Record]) -> None:
    """Print Table 1."""
    print("\nTable 1: nMSE of the beam (exact: against FEM that holds it exactly; same: with the same springs)")
    print(
        f"{'beam':<11}{'basis':<22}{'m':>4}{'unknowns':>9}{'exact':>10}{'same':>10}{'ms':>9}{'FreeForm':>10}{'Simplicits':>11}"
    )
    for row in sorted(rows, key=lambda row: list(beam.BEAMS).index(row["beam"])):
        family, m = row["beam"].split()[0], row["m"]
        printed = [paper.FREEFORM[family].get(m), paper.SIMPLICITS[family].get(m)]
        if "MPM" in row["basis"]:
            printed = [paper.FULL_ORDER["MPM"][family], None]
        elif row["basis"] == "told, exact":
            printed = [None, None]
        flag = f"  status {row['status']}" if row["status"] else ""
        flag += f"  first {row['steps']} steps" if "steps" in row else ""
        print(
            f"{row['beam']:<11}{row['basis']:<22}{m or '':>4}{row['unknowns']:>9}{cell(row['exact'])}"
            f"{cell(row['same'])}{row['ms']:>9.2f}{cell(printed[0])}{cell(printed[1])}{flag}"
        )
    print("SPH:", SPH, {beam: value for beam, value in paper.FULL_ORDER["SPH"].items()})


def print_table2(records: list[Record]) -> None:
    """Print Table 2."""
    for several, dataset in ((False, "Thingi10K"), (True, "SimReady")):
        count = sum(record["several"] == several for record in records)
        if not count:
            continue
        found = objects.means(records, several)
        kind = "several moduli each" if several else "1e5 Pa (organic) or 1e8 Pa"
        print(f"\nTable 2: {count} objects, {kind} ({dataset} cannot be had offline)")
        print("Each condition: nMSE, the same of the worst frame, largest error; the paper's MSE and Max")
        print(f"{'':<22}{'unknowns':>9}{'build s':>8}", *[f"{name:>31}" for name in objects.CONDITIONS])
        for basis in dict.fromkeys(basis for basis, _ in found):
            rows = [found[basis, condition] for condition in objects.CONDITIONS]
            seconds = [r[f"seconds {basis}"] for r in records if r["several"] == several]
            values = "".join(f"{cell(row['mse'])}{cell(row['worst_frame'])}{cell(row['largest'])}  " for row in rows)
            print(f"{basis:<22}{rows[0]['unknowns']:>9.0f}{sum(seconds) / len(seconds):>8.1f}{values}")
        for method in ("FreeForm", "Simplicits"):
            printed = paper.OBJECTS[dataset]
            values = "".join(
                cell(printed[method][c][0]) + cell(printed[method][c][1]) + 12 * " " for c in objects.CONDITIONS
            )
            print(f"{'paper: ' + method:<22}{'':>9}{printed['seconds'][method]:>8.1f}{values}")


def print_meshes(records: list[Record]) -> None:
    """Print Table 2 on meshes, and in how many of them the default is not worse at equal unknowns."""
    print_table2(records)
    for first, second in objects.PAIRS:
        print(f"{second} is not worse than {first}:", objects.wins(records, second, first))


def print_table3(rows: list[Record]) -> None:
    """Print Table 3."""
    print("\nTable 3: loss and sampling, m = 16 (same: FEM with the same springs)")
    columns = f"{'loss':<15}{'sampling':<9}{'iterations':>11}{'s':>8}{'bend':>10}{'same':>10}{'twist':>10}{'same':>10}"
    print(f"{columns}   paper: bend, twist, s")
    for row in rows:
        errors = "".join(cell(row[key]) for key in ("bend", "bend_same", "twist", "twist_same"))
        printed = paper.TRAINING[row["loss"], row["sampling"]]
        print(
            f"{row['loss']:<15}{row['sampling']:<9}{row['iterations']:>11}{row['seconds']:>8.1f}{errors}"
            f"   {printed[0]:.2e} {printed[1]:.2e} {printed[2]:.0f}"
        )


def print_table4(rows: list[Record]) -> None:
    """Print Table 4."""
    print("\nTable 4: 5,000 integration points of the step, m = 16 or 68 functions")
    print(f"{'beam':<7}{'sampling':<9}{'basis':<22}{'exact':>10}{'same':>10}{'FreeForm':>10}{'Simplicits':>11}")
    for row in rows:
        simplicits, freeform = paper.POINTS[row["beam"]][row["sampling"]]
        printed = cell(freeform) + cell(simplicits)
        print(f"{row['beam']:<7}{row['sampling']:<9}{row['basis']:<22}{cell(row['exact'])}{cell(row['same'])}{printed}")


def print_table5(rows: list[Record]) -> None:
    """Print Table 5."""
    print("\nTable 5: processor time of a step of 0.01 s of the bend, one core [ms] (paper: GPU)")
    for row in rows:
        printed = paper.MILLISECONDS.get(row["basis"], "")
        if row["basis"] == "FreeForm's functions":
            printed = paper.MILLISECONDS["FreeForm"][row["m"]]
        print(f"{row['basis']:<22}{row['m'] or '':>4}{row['unknowns']:>6} unknowns{row['ms']:>10.2f}   {printed}")
    print("SPH:", SPH, paper.MILLISECONDS["SPH"])


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tables", type=int, nargs="*", choices=range(1, 6), default=None)
    parser.add_argument("--figures", type=int, nargs="*", choices=(4, 5, 6, 7), default=None)
    parser.add_argument("--meshes", type=Path, help="Table 2 on the meshes of this folder instead")
    parser.add_argument("--references", type=Path, default=REFERENCES, help="stored references of meshes")
    parser.add_argument("--networks", type=Path, help="Simplicits' networks of benchmarks.freeform.simplicits")
    parser.add_argument("--quick", action="store_true", help="a few steps of a few rows, to try")
    parser.add_argument("--print", action="store_true", help="print what is stored, run nothing")
    parser.add_argument("--output", type=Path, default=Path("out/freeform.json"))
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    everything = options.tables is None and options.figures is None
    tables = set(range(1, 6)) if everything else set(options.tables or ())
    asked = set() if options.print else tables
    if options.print and not options.output.exists():
        parser.error(f"{options.output} does not exist: run python -m benchmarks.freeform first, or give --output")
    stored: dict[str, Any] = json.loads(options.output.read_text()) if options.output.exists() else {}

    def save(**found: Any) -> None:
        stored.update(found)
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(json.dumps(stored, indent=1))

    with threadpool_limits(limits=1):
        for number, rows in ((1, beam.table1), (3, training.table3), (4, beam.table4), (5, beam.table5)):
            if number in asked:
                found: list[Record] = []
                for row in rows(quick=options.quick):
                    found.append(row)
                    print(row, flush=True)
                    save(**{f"table{number}": found})
        if 2 in asked and options.meshes:
            objects.run_meshes(
                options.meshes,
                stored.get("meshes", []),
                lambda found: save(meshes=found),
                references=References(options.references),
                networks=options.networks,
                quick=options.quick,
            )
        elif 2 in asked:
            objects.run_objects(stored.get("table2", []), lambda found: save(table2=found), quick=options.quick)
        for number in () if options.print else ((4, 5, 7) if everything else options.figures or ()):
            draw: dict[int, Callable[..., Any]] = {4: figures.figure4, 5: overlays.figure5, 7: figures.figure7}
            if number == 6:
                if options.meshes is None:
                    parser.error("figure 6 shows meshes: name their folder by --meshes")
                draw[6] = functools.partial(overlays.figure6, options.meshes)
            save(**{f"figure{number}": draw[number](PICTURES / f"freeform_figure{number}.png", quick=options.quick)})
            print(f"figure {number}:", stored[f"figure{number}"], flush=True)
    printers = {1: print_table1, 2: print_table2, 3: print_table3, 4: print_table4, 5: print_table5}
    for number in sorted(tables):
        if number == 2 and options.meshes:
            print_meshes(stored.get("meshes", []))
        elif f"table{number}" in stored:
            printers[number](stored[f"table{number}"])
        elif options.print:
            print(f"\nTable {number} is not in {options.output}")
    for number in (4, 5, 6, 7) if options.print else ():
        if f"figure{number}" in stored and (everything or number in (options.figures or ())):
            print(f"figure {number}:", stored[f"figure{number}"])


if __name__ == "__main__":
    main()
