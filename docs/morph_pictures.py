"""Draw the pictures of docs/morphing.md: the loss on the surface of a morph, and its time over the number of particles.

Run: ``python docs/morph_pictures.py [docs/images]`` in the root of the repository; needs matplotlib (``pip install
'softmode[viz]'``). They show what figures 5 and 7 of Xu, Song, Levin and Hyde (2025) do, for a ball that becomes a
cow. Times are processor time of one CPU core, kernels compiled.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.mpm import MorphOptions, MorphPlanner, ParticleBody, morph, replay
from softmode.objects.solids import filled, solid_of

Array = NDArray[np.float64]

NAMES = ("sphere", "cow")
SHOWN = (0, 60, 120, 240, 420)
"""Steps that are drawn."""
MOST = 4.0
"""|ln((m + s) / (m* + s))| of the brightest colour: full nodes that should be empty have 4.3."""
COUNTS = (1400, 2800, 5600, 11200, 22400)


def bodies_of(count: int) -> list[ParticleBody]:
    """Return the ball and what it becomes, of about a number of particles each."""
    return filled([solid_of(name) for name in NAMES], spacing=None, count=count)[1]


def draw_loss(out: Path, plot: Any) -> None:
    """Draw particles from one side, coloured by the residual of the masses around them."""
    source, target = bodies_of(1400)
    options = MorphOptions()
    run = morph(source, target, options, device="cpu")
    frames = {frame.step: frame for frame in replay(run, source, target, options, stride=10, device="cpu")}
    figure, axes = plot.subplots(1, len(SHOWN), figsize=(2.2 * len(SHOWN) + 0.8, 2.9), layout="constrained")
    turn = np.array([[np.cos(0.6), np.sin(0.6), 0.0], [-np.sin(0.6), np.cos(0.6), 0.0], [0.0, 0.0, 1.0]])
    for axis, step in zip(axes, SHOWN, strict=True):
        frame = frames[step]
        x = frame.particles @ turn.T
        order = np.argsort(-x[:, 1])  # the nearest last
        colour = frame.residual[: len(x)][order]
        shown = axis.scatter(
            x[order, 0], x[order, 2], c=colour, cmap="magma", vmin=0.0, vmax=MOST, s=34, edgecolors="0.25", lw=0.2
        )
        part = 1.0 - run.losses[step // options.segment_length] / run.losses[0]
        axis.set_title(f"{step} steps, {100.0 * part:.1f} % gone", fontsize=9)
        axis.set(xlim=(-11, 11), ylim=(-11, 11), aspect="equal", xticks=[], yticks=[])
    figure.colorbar(shown, ax=axes[-1], shrink=0.8, label="|ln((m + s) / (m* + s))|")
    figure.savefig(out / "morph_loss.png", dpi=110)


def seconds_of(bodies: list[ParticleBody], options: MorphOptions) -> float:
    """Return the processor time of a morph [s]."""
    planner = MorphPlanner(
        [body.moved(-body.centre) for body in bodies[:1]], bodies[1].moved(-bodies[1].centre), options
    )
    start = time.process_time()
    planner.run()
    return time.process_time() - start


def draw_time(out: Path, plot: Any) -> None:
    """Draw the time of 20 steps over the number of particles."""
    options = replace(MorphOptions(), frame_count=20)
    pairs = [bodies_of(count) for count in COUNTS]
    seconds_of(pairs[0], options)  # compiles
    counts, seconds = [pair[0].count for pair in pairs], [seconds_of(pair, options) for pair in pairs]
    for count, spent in zip(counts, seconds, strict=True):
        print(
            f"{count} particles: {spent:.2f} s for 20 steps, {1e6 * spent / (count * 240):.2f} us a particle and step"
        )
    figure, axis = plot.subplots(figsize=(5.0, 3.4), layout="constrained")
    axis.loglog(counts, seconds, "o-", color="tab:blue", label="measured")
    axis.loglog(counts, np.array(counts) * seconds[-1] / counts[-1], "--", color="0.5", label="in proportion")
    axis.set(xlabel="particles", ylabel="processor time of 20 steps [s]", title="one CPU core, 24 gradients")
    axis.set_xticks(counts, [str(count) for count in counts])
    axis.set_xticks([], minor=True)
    axis.grid(visible=True, which="both", alpha=0.3)
    axis.legend()
    figure.savefig(out / "morph_time.png", dpi=110)


def main() -> None:
    """Draw all pictures."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="?", default="docs/images", type=Path)
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    with wp.ScopedDevice("cpu"):
        draw_loss(given.out, pyplot)
        draw_time(given.out, pyplot)


if __name__ == "__main__":
    main()
