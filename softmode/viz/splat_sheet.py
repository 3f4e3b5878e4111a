"""A sheet of pictures of a capture before it is built: four views, what is taken and cut, what the fill holds."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.quadrature.occupancy import Occupancy, fill_splats
from softmode.errors import AssetError
from softmode.objects.config import ObjectConfig
from softmode.objects.parts import Choice, choose_part
from softmode.objects.rooms import crop_of
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.raster.rasterizer import SplatArrays, SplatRasterizer, ViewArrays
from softmode.splats.splats import SH_DC, Splats
from softmode.stages import stage
from softmode.viz.figure_file import figure_file

Array = NDArray[np.float64]

PIXELS = 420
"""Edge of a picture [px]."""
FAR = 12.0
"""Distance of the cameras in sizes of the capture, so that near and far parts have nearly one scale."""
CUT = (0.85, 0.25, 0.22)
"""Colour of what is no candidate: the ground, floaters, frays."""
COLORS = ("#2a5bd7", "#27964a", "#e08a00", "#8e44ad", "#12a3a8", "#b8860b", "#e056a0", "#5d6d7e", "#7d5a3c")
"""Colours of the candidates."""
VIEWS = {
    "from the front (-y)": ((0.0, -1.0, 0.0), "x", "z"),
    "from the right (+x)": ((1.0, 0.0, 0.0), "y", "z"),
    "from above (+z)": ((0.0, 0.0, 1.0), "x", "y"),
    "from the corner": ((0.62, -0.68, 0.40), "", ""),
}
"""Views by title: direction to the camera, and the axes to the right and up in the picture."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SplatSurvey:
    """What would be taken of a capture."""

    splats: Splats
    """The capture, upright and cropped, in the unit of the file."""
    kept: NDArray[np.bool_]
    """Which splats are of the part that is the object, shape (N,)."""
    choice: Choice
    """What was found: the candidates by number, and which of them are taken."""
    fill: Occupancy | None
    """The solid of the object; None if it encloses none."""
    why: str
    """Why there is none."""


def survey_splats(splats: Splats, config: ObjectConfig) -> SplatSurvey:
    """Return what a build would take of a capture.

    Args:
        splats: The capture, upright and cropped.
        config: How it would be built; its `part` and `resolution` are read.

    Raises:
        AssetError: If all splats lie at one point.
    """
    with stage("finding the object in the capture"):
        choice = choose_part(splats, config.part)
    thing, fill, why, held = choice.part, None, "", np.ones(choice.part.count, bool)
    try:
        with stage("filling it with a solid"):
            fill = fill_splats(thing.means, thing.scales, thing.quats, thing.opacities, resolution=config.resolution)
        held = fill.members
    except AssetError as error:
        why = error.message
    kept = np.zeros(splats.count, bool)
    kept[choice.rows[held[: len(choice.rows)]]] = True
    return SplatSurvey(splats=splats, kept=kept, choice=choice, fill=fill, why=why)


def write_splat_sheet(path: str | os.PathLike[str], survey: SplatSurvey, *, title: str, notes: list[str]) -> None:
    """Draw the sheet; the file appears complete or not at all.

    Args:
        path: The .png to write.
        survey: What is shown.
        title: Title of the sheet.
        notes: Lines to print on it.

    Raises:
        MissingExtraError: If matplotlib is not installed.
        ConfigError: If the name is not that of a .png.
        StorageError: If it cannot be written.
    """
    splats, kept = survey.splats, survey.kept
    thing, number = splats.subset(kept), survey.choice.number
    with figure_file(path, (16.0, 8.9), what="sheet", whole="a sheet of a capture", like="toy.png") as figure:
        from matplotlib.colors import to_rgb

        paint = np.array([CUT, *(to_rgb(color) for color in COLORS)])[np.minimum(number, len(COLORS))]
        marked = replace(splats, sh=(0.35 * splats.sh[:, :1] + 0.65 * (paint[:, None] - 0.5) / SH_DC))
        figure.text(0.015, 0.965, title, fontsize=15, weight="bold")
        grid = figure.add_gridspec(2, 4, left=0.03, right=0.985, top=0.915, bottom=0.05, wspace=0.2, hspace=0.2)
        for k, (name, (toward, right, up)) in enumerate(VIEWS.items()):
            draw_view(figure.add_subplot(grid[0, k]), name, splats, np.array(toward), right, up)
        corner = np.array(VIEWS["from the corner"][0])
        taken = " ".join(map(str, survey.choice.taken))
        axes, heading = figure.add_subplot(grid[1, 0]), f"candidates; taken: {taken}; red is none"
        place = draw_view(axes, heading, marked, corner, "", "")
        for k in range(1, number.max() + 1):
            x, y = place(np.median(splats.means[number == k], axis=0))
            frame = {"boxstyle": "circle", "facecolor": COLORS[min(k, len(COLORS)) - 1], "edgecolor": "white"}
            axes.text(x, y, str(k), color="white", weight="bold", ha="center", va="center", bbox=frame)
        draw_view(figure.add_subplot(grid[1, 1]), "what is taken", thing, corner, "", "")
        _draw_fill(figure.add_subplot(grid[1, 2]), survey, thing)
        words = figure.add_subplot(grid[1, 3])
        words.set_axis_off()
        words.text(0.0, 1.0, "\n".join([*notes, *_told(survey)]), va="top", fontsize=9.5, linespacing=1.5, wrap=True)


def _told(survey: SplatSurvey) -> list[str]:
    """Return what was found, in lines."""
    splats, fill = survey.splats, survey.fill
    x, y, z = np.ptp(splats.bounds(quantile=0.002), axis=0)
    lines = [f"{splats.count} splats, {x:.3g} x {y:.3g} x {z:.3g} (unit of the file)", *candidate_lines(survey)]
    if fill is None:
        return [*lines, f"no solid: {survey.why}"]
    taken = f"taken: {np.count_nonzero(survey.kept)} splats"
    return [*lines, taken, f"   --crop {crop_of(splats.subset(survey.kept))}"]


def candidate_lines(survey: SplatSurvey) -> list[str]:
    """Return the candidates with their sizes, and what is doubtful about the choice, in lines."""
    number, told, lines = survey.choice.number, survey.choice.told, []
    for k in range(1, number.max() + 1):
        part = survey.splats.subset(number == k)
        size = " x ".join(f"{edge:.3g}" for edge in np.ptp(part.bounds(quantile=0.002), axis=0))
        lines.append(f"{k}: {part.count} splats, {size}{' (taken)' if k in survey.choice.taken else ''}")
    if "carrier" in told:
        lines.append(f"cut at z = {told['carrier_height']:.4g}, score {told['carrier_score']:.2f}")
        lines.append(f"   --part {told['carrier_part']} keeps what carries it")
    if "doubt" in told:
        lines += [f"doubt: {told['doubt']}", f"   {str(told['doubt_remedy']).split('; ')[-1]}"]
    if "scene_crop" in told:
        lines += ["a room, or a scene of several things; begin with", f"   --crop {told['scene_crop']}"]
    return lines


def draw_view(
    axes: Any, title: str, splats: Splats, toward: Array, right: str = "", up: str = "", *, unit: str | None = None
) -> Callable[[Array], tuple[float, float]]:
    """Draw splats from one side, with a bar and the axes.

    Args:
        axes: Axes of matplotlib.
        title: Title of the picture.
        splats: What is drawn.
        toward: Direction to the camera, shape (3,).
        right: Name of the axis to the right, empty in a view along none.
        up: Name of the axis up.
        unit: Unit of the bar, in a picture of a known scale, which then has no axes.

    Returns:
        What tells where a point (3,) is in the picture.
    """
    toward = toward / np.linalg.norm(toward)
    above = np.array([0.0, 1.0, 0.0]) if abs(toward[2]) > 0.9 else np.array([0.0, 0.0, 1.0])
    across = np.cross(above, toward)
    across /= np.linalg.norm(across)
    upward = np.cross(toward, across)
    low, high = splats.bounds(quantile=0.002)
    centre, size = 0.5 * (low + high), float(np.linalg.norm(high - low)) or 1.0
    corners = np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(3, -1).T - centre
    reach = 1.08 * float(np.abs(corners @ np.column_stack([across, upward])).max())
    eye, fov = centre + FAR * size * toward, 2.0 * float(np.arctan(reach / (FAR * size)))
    (x, y, z), (u, v, w), (a, b, c) = eye.tolist(), centre.tolist(), upward.tolist()
    camera = PinholeCamera.look_at(
        "sheet", position=(x, y, z), target=(u, v, w), up=(a, b, c), width=PIXELS, height=PIXELS, fov_y=fov
    )
    rasterizer = SplatRasterizer(splats.count, 1, PIXELS, PIXELS, device="cpu")
    views = ViewArrays.from_cameras([camera], background=(1.0, 1.0, 1.0), device="cpu")
    rasterizer.render(SplatArrays.from_splats([splats], device="cpu"), views)
    axes.set_title(title, fontsize=11)
    middle = (0.0, 0.0) if not right else (centre @ across, centre @ upward)
    extent = (middle[0] - reach, middle[0] + reach, middle[1] - reach, middle[1] + reach)
    axes.imshow(np.clip(rasterizer.rgb.numpy()[0], 0.0, 1.0), extent=extent)

    def place(point: Array) -> tuple[float, float]:
        return middle[0] + (point - centre) @ across, middle[1] + (point - centre) @ upward

    bar = _round_length(0.6 * reach)
    left, bottom = extent[0] + 0.06 * reach, extent[2] + 0.08 * reach
    axes.plot([left, left + bar], [bottom, bottom], color="black", lw=3, solid_capstyle="butt")
    axes.text(left + 0.5 * bar, bottom + 0.03 * reach, f"{bar:g} {unit or ''}", ha="center", va="bottom", fontsize=9)
    axes.tick_params(labelsize=8)
    if right:
        axes.set_xlabel(right, fontsize=10, labelpad=0)
        axes.set_ylabel(up, fontsize=10, labelpad=0)
        return place
    axes.set_xticks([])
    axes.set_yticks([])
    if unit is not None:
        axes.set_frame_on(False)
        return place
    root = np.array([extent[0] + 0.25 * reach, extent[3] - 0.45 * reach])
    for axis, name, color in zip(np.eye(3), "xyz", ("#c0392b", "#27964a", "#2a5bd7"), strict=True):
        tip = root + 0.28 * reach * np.array([axis @ across, axis @ upward])
        axes.annotate("", xy=tip, xytext=root, arrowprops={"arrowstyle": "->", "color": color, "lw": 2})
        axes.text(*(root + 1.22 * (tip - root)), name, color=color, ha="center", va="center", fontsize=10)
    return place


def _draw_fill(axes: Any, survey: SplatSurvey, thing: Splats) -> None:
    """Draw the section of the solid through its middle, and the splats near that plane."""
    low, high = thing.bounds(quantile=0.002)
    y = float(np.median(thing.means[:, 1]))
    near = np.abs(thing.means[:, 1] - y) < 0.04 * (high - low).max()
    if survey.fill is None:
        axes.set_title("no solid", fontsize=11, color="#b3261e")
    else:
        axes.set_title(f"section of the fill at y = {y:.3g}", fontsize=11)
        margin = 0.08 * float((high - low).max())
        x, z = (np.linspace(low[k] - margin, high[k] + margin, 180) for k in (0, 2))
        points = np.stack(np.meshgrid(x, [y], z, indexing="ij"), axis=-1)
        level = survey.fill.level(points.reshape(-1, 3)).reshape(len(x), len(z)).T
        axes.contourf(x, z, level, levels=[-np.inf, 0.0], colors=["#f2c894"])
        axes.contour(x, z, level, levels=[0.0], colors=["#9a5b00"], linewidths=1.2)
    axes.scatter(thing.means[near, 0], thing.means[near, 2], s=2, color="0.25", lw=0, label="splats near it")
    axes.set_aspect("equal")
    axes.set_xlabel("x", fontsize=10, labelpad=0)
    axes.set_ylabel("z", fontsize=10, labelpad=0)
    axes.tick_params(labelsize=8)


def _round_length(length: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is no longer."""
    decade = 10.0 ** np.floor(np.log10(length))
    return float(decade * max(step for step in (1.0, 2.0, 5.0) if step * decade <= length * 1.0000001))
