"""Draw the pictures of docs/morphing.md: loss on the surface and time of a morph, and a bar reduced and as particles.

Run: ``python docs/morph_pictures.py [docs/images]`` in the root of the repository; needs matplotlib (``pip install
'softmode[viz]'``). They show what figures 5 and 7 of Xu, Song, Levin and Hyde (2025) do, for a ball that becomes a
cow. The third is of the kind of figure 10 of PIE-NeRF: a reduced body beside the material point method on one scene.
Times are processor time of one CPU core, kernels compiled.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.deformables import (
    Markers,
    Material,
    Region,
    SolverReduced,
    SolverReducedOptions,
    add_reduced_body,
    build_body,
    quadrature_from_box,
)
from softmode.mpm import (
    Grid,
    GridShapes,
    MorphOptions,
    MorphPlanner,
    MpmOptions,
    MpmSimulation,
    ParticleBody,
    morph,
    particles_from_shape,
    replay,
)
from softmode.objects.solids import filled, solid_of

Array = NDArray[np.float64]

NAMES = ("sphere", "cow")
SHOWN = (0, 60, 120, 240, 420)
"""Steps that are drawn."""
MOST = 4.0
"""|ln((m + s) / (m* + s))| of the brightest colour: full nodes that should be empty have 4.3."""
COUNTS = (1400, 2800, 5600, 11200, 22400)

LENGTH, CLAMP, EDGE = 0.32, 0.04, 0.04
"""Length and width of a bar, and what of it is clamped [m]."""
CELL = 0.04 / 6.0
"""Cells of its particles' grid [m]: six across, for with three they are too stiff."""
GRAVITY = 9.81
BAR = Material(youngs_modulus=5.0e5, poissons_ratio=0.3, density=1000.0, viscosity=0.0)
FALLING = (0, 14, 28)
"""Which hundredths of a second are drawn."""


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
    shown: Any = None
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


def bar_as_particles(times: Array) -> tuple[list[Array], int, float]:
    """Let the bar fall as particles; return where they are at some times [m], the number of steps, and their time."""
    low = np.array([-0.5 * LENGTH + CLAMP, -0.5 * EDGE, -0.5 * EDGE]) + 0.25 * CELL
    high = np.array([0.5 * LENGTH, 0.5 * EDGE, 0.5 * EDGE]) - 0.25 * CELL
    volume = (LENGTH - CLAMP) * EDGE**2
    bar = particles_from_shape(
        lambda x: np.ones(len(x), dtype=bool), [low, high], spacing=0.5 * CELL, material=BAR, volume=volume
    )
    wall = newton.ModelBuilder()
    face = low[0] - 0.25 * CELL + 0.01 * CELL  # so that the nodes in the wall's face stick
    wall.add_shape_box(-1, xform=wp.transform(wp.vec3(face - 0.1, 0.0, 0.0)), hx=0.1, hy=0.2, hz=0.4)
    cells = (round(0.42 / CELL), round(0.12 / CELL), round(0.44 / CELL))
    grid = Grid(
        shape=(cells[0] + 1, cells[1] + 1, cells[2] + 1),
        spacing=CELL,
        origin=(-0.5 * LENGTH + CLAMP - 8.0 * CELL, -0.06, -0.32),
    )
    modulus, nu = BAR.youngs_modulus, BAR.poissons_ratio
    sound = np.sqrt(modulus * (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu)) / BAR.density)
    count = int(np.ceil(times[1] / (0.5 * CELL / sound)))
    options = MpmOptions(grid=grid, dt=float(times[1]) / count, gravity=(0.0, 0.0, -GRAVITY))
    shapes = GridShapes(wall.finalize(device="cpu"), boundary="stick")
    s = MpmSimulation(bar, options, step_count=count, shapes=shapes, device="cpu")
    s.forward()  # compiles
    s.start(bar.positions[None], *(np.zeros((1, bar.count, *shape)) for shape in ((3,), (3, 3))))
    begin, found = time.process_time(), [bar.positions]
    for _ in times[1:]:
        s.forward()
        s.check()
        s.first.copy_from(s.last)
        found.append(s.first.x.numpy()[0].astype(np.float64))
    return found, count * (len(times) - 1), time.process_time() - begin


def bar_as_body(times: Array, substeps: int = 1) -> tuple[list[Array], int, float]:
    """Let the bar fall as a reduced body; return its surface at some times [m], the number of steps, and their time."""
    wide = float("inf")
    root = Region(name="root", box=((-wide,) * 3, (-0.5 * LENGTH + CLAMP, wide, wide)))
    body = build_body(quadrature_from_box((LENGTH, EDGE, EDGE), point_count=4000), regions=(root,), progress=False)
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    add_reduced_body(builder, body, material=BAR)
    model: Any = builder.finalize(device="cpu")
    solver = SolverReduced(model, [body], options=SolverReducedOptions(integrator="bdf2"))
    markers = Markers(solver, body.surface.points)
    duration = float(times[1]) / substeps

    def fall() -> list[Array]:
        """Step from rest."""
        state, after = model.state(), model.state()
        found = [markers.positions(state.softmode.q.numpy())]
        for step in range(substeps * (len(times) - 1)):
            solver.step(state, after, None, None, duration)
            state, after = after, state
            if (step + 1) % substeps == 0:
                found.append(markers.positions(state.softmode.q.numpy()))
        return found

    fall()  # compiles
    begin = time.process_time()
    return fall(), substeps * (len(times) - 1), time.process_time() - begin


def draw_bar(out: Path, plot: Any) -> None:
    """Draw a clamped bar that falls, as a reduced body and as particles, and how far its end sinks."""
    times = np.linspace(0.0, 0.6, 61, dtype=np.float64)
    ways = {"reduced body": bar_as_body(times), "particles": bar_as_particles(times)}
    figure, axes = plot.subplots(1, 3, figsize=(11.0, 3.4), layout="constrained", width_ratios=(1.0, 1.0, 1.1))
    sinks = {}
    for axis, (name, (places, steps, seconds)), color in zip(
        axes, ways.items(), ("tab:blue", "tab:orange"), strict=False
    ):
        end = places[0][:, 0] > 0.5 * LENGTH - 0.5 * CELL
        sinks[name] = np.array([-float((x - places[0])[end, 2].mean()) for x in places])
        for k, alpha in zip(FALLING, (0.25, 0.5, 1.0), strict=True):
            x = places[k]
            axis.scatter(100.0 * x[:, 0], 100.0 * x[:, 2], s=2.0, color=color, alpha=alpha, lw=0.0)
        axis.axvspan(-17.0, 100.0 * (-0.5 * LENGTH + CLAMP), color="0.85", zorder=0)
        axis.set(xlim=(-17, 18), ylim=(-28, 6), aspect="equal", xlabel="x [cm]", ylabel="z [cm]")
        axis.set_title(f"{name}: {len(places[0])} points\n{steps} steps, {seconds:.2g} s of a core", fontsize=9)
        axes[2].plot(times, 100.0 * sinks[name], color=color, label=name)
        print(
            f"{name}: {len(places[0])} points, {steps} steps, {seconds:.3g} s; the end sinks "
            f"{100.0 * sinks[name].max():.2f} cm at {times[int(sinks[name].argmax())]:.2f} s"
        )
    apart = np.abs(sinks["reduced body"] - sinks["particles"])
    print(f"ends are apart by {100.0 * apart.max():.2f} cm at most, {100.0 * apart.mean():.2f} cm in the mean")
    axes[2].set(xlabel="time [s]", ylabel="the end has sunk [cm]")
    axes[2].invert_yaxis()
    axes[2].grid(visible=True, alpha=0.3)
    axes[2].legend()
    figure.savefig(out / "morph_bar.png", dpi=110)


DRAWN = {"loss": draw_loss, "time": draw_time, "bar": draw_bar}


def main() -> None:
    """Draw all pictures."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="?", default="docs/images", type=Path)
    parser.add_argument("--only", nargs="+", choices=DRAWN, help="pictures to draw, all if omitted")
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    with wp.ScopedDevice("cpu"):
        for name in given.only or DRAWN:
            DRAWN[name](given.out, pyplot)


if __name__ == "__main__":
    main()
