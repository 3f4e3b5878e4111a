"""Draw accuracy against unknowns and against time from the output of `benchmarks.accuracy`.

Run: ``python docs/accuracy_picture.py [out/accuracy.json] [docs/images/accuracy.png]``; needs matplotlib.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for the benchmarks

from benchmarks.accuracy import FREEFORM, MODES, SIMPLICITS

PAPER_MILLISECONDS = {6: 3.01, 9: 3.71, 16: 5.42, 32: 10.7}
"""FreeForm's time per step on a GPU, its table 5."""
SERIES = (
    ("paper", "affine", "affine (soft clamp)", "C0", "o-"),
    ("beyond", "affine, exact", "affine, exact clamp", "C1", "s-"),
    ("beyond", "affine + static, exact", "affine + static responses, exact clamp", "C2", "D-"),
    ("beyond", "quadratic, exact", "quadratic, exact clamp", "C3", "^-"),
    ("beyond", "quadratic + static, exact", "quadratic + static, exact clamp", "C4", "v-"),
)

PRINTED = (
    (FREEFORM, "FreeForm (printed, penalty against exact)", "x"),
    (SIMPLICITS, "Simplicits (printed, likewise)", "+"),
)


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", nargs="?", type=Path, default=Path("out/accuracy.json"))
    parser.add_argument("target", nargs="?", type=Path, default=Path("docs/images/accuracy.png"))
    options = parser.parse_args()
    try:
        import matplotlib
    except ImportError as error:
        raise SystemExit("the picture needs matplotlib: pip install matplotlib") from error
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    stored: dict[str, list[dict[str, Any]]] = json.loads(options.source.read_text())
    figure, axes = plt.subplots(2, 2, figsize=(11, 8.5), sharey="row", layout="constrained")
    for column, quantity in enumerate(("unknowns", "milliseconds")):
        for row, (scene, family) in enumerate((("bend", "bend"), ("twist_360", "twist"))):
            ax = axes[row, column]
            for suite, label, title, colour, style in SERIES:
                same = scene if suite == "beyond" else f"{scene}_soft_1e9"
                found = [r for r in stored.get(suite, []) if r["label"] == label and r["scene"] == same]
                if found:
                    found.sort(key=lambda r: r[quantity])
                    x, y = [r[quantity] for r in found], [r["nmse"] for r in found]
                    ax.loglog(x, y, style, color=colour, label=title)
            for table, name, marker in PRINTED:
                if quantity == "unknowns":
                    x = [12 * m for m in MODES]
                elif table is FREEFORM:
                    x = [PAPER_MILLISECONDS[m] for m in MODES]
                else:
                    continue
                ax.loglog(x, [table[family][m] for m in MODES], marker + ":", color="0.5", label=name)
            ax.set_title(f"{scene}: model and FEM with the same clamp")
            ax.grid(True, which="both", alpha=0.2)
            ax.set_xlabel("unknowns" if quantity == "unknowns" else "ms per step (softmode: one core; FreeForm: GPU)")
            if column == 0:
                ax.set_ylabel("nMSE (largest edge)")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9)
    options.target.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.target, dpi=110)
    print(options.target)


if __name__ == "__main__":
    main()
