"""Draw success against environment steps and against time from the tables of the training runs.

Run: ``python docs/learning_curves.py [docs/data] [docs/images/learning_curves.png]``; needs matplotlib. A table
has the columns env_steps, seconds and success of a run's progress.csv; evaluations.csv what the last policy did.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

RUNS = {
    "push_soft": ("PushSoft", "C0", "-"),
    "press_soft": ("PressSoft", "C2", "-"),
    "lift_soft": ("LiftSoft", "C1", "-"),
    "lift_soft_pixels": ("LiftSoft, 64 px, with a teacher", "C3", "-"),
    "push_soft_cpu": ("PushSoft, two CPU cores", "C0", "--"),
}
"""Label, colour and line of each table."""


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", nargs="?", type=Path, default=Path("docs/data"))
    parser.add_argument("target", nargs="?", type=Path, default=Path("docs/images/learning_curves.png"))
    options = parser.parse_args()
    try:
        import matplotlib
    except ImportError as error:
        raise SystemExit("the picture needs matplotlib: pip install matplotlib") from error
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(10.0, 3.6), sharey=True, layout="constrained")
    ends = {row["run"]: row for row in _rows(options.source / "evaluations.csv")}
    for name, (label, color, line) in RUNS.items():
        rows = _rows(options.source / f"{name}.csv")
        success = [100.0 * float(row["success"]) for row in rows]
        end = ends[name]
        reached = 100.0 * int(end["successes"]) / int(end["episodes"])
        for axis, column, scale in zip(axes, ("env_steps", "seconds"), (1e6, 1.0), strict=True):
            axis.plot([float(row[column]) / scale for row in rows], success, line, color=color, label=label, lw=1.5)
            axis.plot(float(end[column]) / scale, reached, "o", color=color, mfc="none" if line == "--" else color)
    axes[0].set(xlabel="environment steps [million]", ylabel="successful episodes [%]", ylim=(0.0, 103.0))
    axes[1].set(xlabel="wall time of training [s]", xscale="log", xlim=(2.0, 2500.0))
    for axis in axes:
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8, loc="lower right")
    options.target.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.target, dpi=110)


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


if __name__ == "__main__":
    main()
