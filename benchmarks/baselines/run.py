"""Run every baseline on the bending beam, print one table, write JSON and a picture of accuracy against time.

Run from the repository root: ``python -m benchmarks.baselines.run [--steps 300] [--only softmode flex ...]
[--json FILE] [--picture FILE]``. Needs torch for the neural weights (extra ``[rl]``; some minutes of training per
network the first time, kept in the cache folder) and matplotlib for the picture. Rows of groups that are left out stay
as the JSON file has them.
"""

from __future__ import annotations

import argparse
import json
import platform
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from threadpoolctl import threadpool_limits

from benchmarks.baselines import flex, mpm, reduced, vbd
from benchmarks.baselines.common import Row, as_record
from benchmarks.baselines.neural_weights import NeuralWeightsOptions
from softmode.deformables.reduction.options import BuildOptions

Job = Callable[[int], Row]
KERNELS = reduced.KERNELS


def softmode_jobs() -> Iterator[Job]:
    """Yield softmode with an exact clamp that the build knows: static responses beside few or many eigenmodes."""
    for handles in ("affine", "quadratic"):
        for modes in (3, 6, 16) if handles == "affine" else (3, 6):
            options = BuildOptions(mode_count=modes, kernel_count=KERNELS, handles=handles)
            label = f"{handles} m = {modes} + responses"
            yield lambda steps, o=options, t=label: reduced.run_softmode(o, steps, exact=True, label=t)
    options = BuildOptions(mode_count=3, kernel_count=KERNELS, handles="quadratic")
    yield lambda steps, o=options: reduced.run_softmode(
        o, steps, exact=True, label="quadratic m = 3 + responses, BDF2", integrator="bdf2"
    )


def freeform_jobs() -> Iterator[Job]:
    """Yield FreeForm's basis in the same solver: eigenmodes alone, a clamp of springs that the build does not know."""
    for modes in (6, 9, 16, 32):
        options = BuildOptions(mode_count=modes, kernel_count=KERNELS)
        yield lambda steps, o=options: reduced.run_softmode(o, steps, exact=False, label=f"m = {o.mode_count}")


def neural_jobs() -> Iterator[Job]:
    """Yield Simplicits' weights at FreeForm's sizes, trained in metres and in Kaolin's unit cube."""
    for unit_cube in (False, True):
        for modes in (6, 9, 16, 32):
            options = NeuralWeightsOptions(mode_count=modes, unit_cube=unit_cube)
            yield lambda steps, o=options: reduced.run_neural(o, steps)


def flex_jobs() -> Iterator[Job]:
    """Yield MuJoCo's cages."""
    for dof, cells in (
        ("trilinear", (1, 1, 1)),
        ("trilinear", (9, 2, 2)),
        ("trilinear", (18, 4, 4)),
        ("quadratic", (1, 1, 1)),
        ("quadratic", (3, 1, 1)),
        ("quadratic", (5, 1, 1)),
        ("quadratic", (9, 1, 1)),
        ("quadratic", (9, 2, 2)),
        ("quadratic", (14, 2, 2)),
    ):
        yield lambda steps, d=dof, c=cells: flex.run(d, c, steps)


def vbd_jobs() -> Iterator[Job]:
    """Yield tetrahedra with few and with many sweeps."""
    for cells, sweeps in (
        ((9, 2, 2), 10),
        ((9, 2, 2), 100),
        ((9, 2, 2), 1000),
        ((18, 4, 4), 10),
        ((18, 4, 4), 100),
        ((18, 4, 4), 400),
    ):
        yield lambda steps, c=cells, s=sweeps: vbd.run(c, s, steps)


def mpm_jobs() -> Iterator[Job]:
    """Yield two grids."""
    yield lambda steps: mpm.run(0.5, steps)
    yield lambda steps: mpm.run(0.25, steps, per_cell=2)


GROUPS: dict[str, Callable[[], Iterator[Job]]] = {
    "softmode": softmode_jobs,
    "freeform": freeform_jobs,
    "neural": neural_jobs,
    "flex": flex_jobs,
    "vbd": vbd_jobs,
    "mpm": mpm_jobs,
}


def main() -> None:
    """Run the groups asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--only", nargs="*", choices=list(GROUPS), default=list(GROUPS), help="none: stored rows")
    parser.add_argument("--json", type=Path, default=Path("out/baselines.json"))
    parser.add_argument("--picture", type=Path, default=None)
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    options.json.parent.mkdir(parents=True, exist_ok=True)
    stored = json.loads(options.json.read_text())["rows"] if options.json.exists() else []
    rows = [row for row in stored if row["group"] not in options.only and row["steps"] == options.steps]
    print_head()
    for group in options.only:
        for job in GROUPS[group]():
            with threadpool_limits(limits=1):
                row = {"group": group, "steps": options.steps, **as_record(job(options.steps))}
            rows.append(row)
            print_row(row)
            options.json.write_text(json.dumps({"processor": platform.machine(), "rows": rows}, indent=1))
    if set(options.only) != set(GROUPS):
        print("\nwith the stored rows:")
        print_head()
        for group in GROUPS:
            for row in rows:
                if row["group"] == group:
                    print_row(row)
    if options.picture:
        draw(rows, options.picture)


def print_head() -> None:
    """Print the columns' names."""
    print(
        f"{'method':<28}{'variant':<50}{'unknowns':>9}{'clamp':>7}{'nMSE Euler':>12}{'nMSE motion':>12}{'sag':>7}"
        f"{'ms/step':>9}  note"
    )


def print_row(row: dict[str, Any]) -> None:
    """Print one line."""
    print(
        f"{row['method']:<28}{row['variant']:<50}{row['unknowns']:>9}{row['clamp']:>7}{row['nmse']:>12.1e}"
        f"{row['nmse_motion']:>12.1e}{row['amplitude']:>7.3f}{row['ms']:>9.3f}  {row['note']}",
        flush=True,
    )


STYLE = {
    "softmode": ("softmode, exact clamp, static responses", "tab:red", "o"),
    "freeform": ("FreeForm's eigenmodes, same solver", "tab:orange", "s"),
    "neural": ("Simplicits' neural weights, same solver", "tab:purple", "^"),
    "flex": ("MuJoCo flex (cages)", "tab:blue", "D"),
    "vbd": ("Newton VBD (tetrahedra)", "tab:green", "v"),
    "mpm": ("Newton implicit MPM", "tab:gray", "P"),
}


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw accuracy against time, against both references."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, 2, figsize=(11.0, 4.8), sharey=True, layout="constrained")
    titles = {"nmse": "against implicit Euler, h = 0.01 s", "nmse_motion": "against the motion converged in time"}
    for panel, (key, title) in zip(panels, titles.items(), strict=True):
        for group, (label, colour, marker) in STYLE.items():
            mine = [row for row in rows if row["group"] == group and np.isfinite(row[key])]
            time, error = [row["ms"] for row in mine], [row[key] for row in mine]
            panel.scatter(time, error, 34, colour, marker=marker, label=label, alpha=0.85)
        panel.set(xscale="log", yscale="log", xlabel="median processor time of a step, one thread [ms]", title=title)
        panel.grid(True, which="both", alpha=0.25)
    panels[0].set_ylabel("mean square error / length$^2$")
    panels[1].legend(fontsize=8, loc="lower left")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main()
