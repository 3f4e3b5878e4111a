"""A ball becomes a four-legged animal, and that a swimming ring: splats ride on particles that gradients steer.

Each body is filled with particles. Small matrices, one for each particle and segment of ten steps, act on their
deformation; the adjoint of the material point method finds those that bring masses where the next body has them.

Run: ``python examples/morph.py [--short] [--device cuda:0]``; writes out/morph.mp4 and out/morph.npz
"""

import argparse
from pathlib import Path

import numpy as np
import warp as wp

from softmode.mpm import MorphOptions, MorphRun, morph
from softmode.objects import filled, solid_of
from softmode.viz import Film, MorphScene, film_morph


def test_final(run: MorphRun, short: bool) -> None:
    """The loss falls in every segment but that in which the target changes, and four fifths of it are gone."""
    assert len(run.ends) == run.target_count
    falls = np.diff(run.losses) < 0.0
    assert falls[: run.ends[0]].all()
    assert run.accuracy > (0.3 if short else 0.8)
    assert np.isfinite(run.positions).all()


def main() -> None:
    """Fill, plan, film."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--short", action="store_true", help="few particles, one target, 40 steps")
    parser.add_argument("--device", default=None)
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    names = ("sphere", "cow") if given.short else ("sphere", "cow", "duck")
    solids, bodies = filled([solid_of(name) for name in names], spacing=None, count=700 if given.short else 10_000)
    options = MorphOptions(frame_count=40 if given.short else 300)
    out = Path("out")
    run = morph(bodies[0], bodies[1:], options, file=out / "morph.npz", names=names, device=given.device)
    for target, end, first in zip(names[1:], run.ends, run.first_losses, strict=True):
        print(f"to the {target}: {100.0 * (1.0 - run.losses[end] / first):.1f} % of the loss is gone")
    with Film(out / "morph.mp4") as film:
        film_morph(
            film, MorphScene(run, solids, bodies, options, device=given.device), width=160 if given.short else 480
        )
        film.publish()
    print(f"wrote {film.path}")
    test_final(run, given.short)


if __name__ == "__main__":
    main()
