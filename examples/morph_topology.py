"""A ring closes to a ball, and a letter turns into another: what no mesh and no reduced body can do.

The number of holes is counted on the grid: the Euler characteristic of the filled cells is 1 for a ball and 0 for a
ring, whatever their form.

Run: ``python examples/morph_topology.py [--short] [--device cuda:0]``; writes out/morph_topology.mp4
"""

import argparse
from pathlib import Path

import numpy as np
import warp as wp
from scipy.ndimage import binary_fill_holes, gaussian_filter, label

from softmode.mpm import MorphOptions, morph
from softmode.objects import filled, solid_of
from softmode.viz import Film, MorphScene, film_morph

CELL = 0.5
"""Edge of the cells that are counted [m]."""


def euler_characteristic(points: np.ndarray, volume: float) -> int:
    """Return vertices - edges + faces - cells of the largest piece where points, blurred, are 0.4 times as dense.

    Cavities are filled: what is counted are holes that go through.
    """
    at = np.round((points - points.min(axis=0)) / CELL).astype(int) + 8
    count = np.zeros(at.max(axis=0) + 9)
    np.add.at(count, tuple(at.T), 1.0)
    pieces = np.asarray(label(gaussian_filter(count, 1.2 / CELL) > 0.4 * CELL**3 * len(points) / volume)[0])  # type: ignore[index]
    fine = binary_fill_holes(pieces == np.bincount(pieces.ravel())[1:].argmax() + 1)
    total = 0
    for open_axes in np.ndindex(2, 2, 2):
        # A face of dimension d is there where any of the cells around it is; cells have all three axes open.
        there = fine
        for axis, is_open in enumerate(open_axes):
            if not is_open:
                there = there | np.roll(there, 1, axis=axis)
        total += (-1) ** sum(open_axes) * int(there.sum())
    return total


def test_final(counts: list[int]) -> None:
    """The ring has one hole (0), the ball none (1)."""
    assert counts == [0, 1], counts


def main() -> None:
    """Morph and film."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--short", action="store_true", help="few particles, no letters, no film")
    parser.add_argument("--device", default=None)
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    names = ("torus", "sphere") if given.short else ("torus", "sphere", "S", "8")
    solids, bodies = filled([solid_of(name) for name in names], spacing=None, count=1200 if given.short else 8000)
    options = MorphOptions(frame_count=360)
    run = morph(bodies[0], bodies[1:], options, names=names, device=given.device)
    counts = [euler_characteristic(run.positions[k], solids[0].volume) for k in (0, run.ends[0])]
    print(f"Euler characteristic: the ring {counts[0]}, the ball that it became {counts[1]}")
    for target, end, first in zip(names[1:], run.ends, run.first_losses, strict=True):
        print(f"to {target}: {100.0 * (1.0 - run.losses[end] / first):.1f} % of the loss is gone")
    if not given.short:
        with Film(Path("out/morph_topology.mp4")) as film:
            film_morph(film, MorphScene(run, solids, bodies, options, device=given.device))
            film.publish()
    test_final(counts)


if __name__ == "__main__":
    main()
