"""One picture of a body: rest, soft modes, skinning weights, cubature, kernels, grasps, spectra, and its report."""

from __future__ import annotations

import os
import textwrap
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.reduction.body_modes import soft_modes
from softmode.deformables.reduction.report import BodyReport
from softmode.errors import GraspError
from softmode.objects.rest_grasps import rest_grasps
from softmode.robots.arm import ArmDescription
from softmode.robots.jaws import ParallelJaw
from softmode.splats.splats import SH_DC, Splats
from softmode.viz.figure_file import figure_file

Array = NDArray[np.float64]

COLUMNS = 7
"""Pictures in a row: the body at rest and six modes; the constant weight's place and six weights."""
PIXELS = 380
"""Width of each rendered picture [px]."""
AMPLITUDE = 0.16
"""Largest displacement in a mode's picture, over the body's size."""
STEEPNESS = 1.2
"""Largest gradient of the displacement there: a linear mode turned further swells instead."""
TOWARDS = np.array([0.80, -0.48, 0.36])
"""Direction from the body to the camera."""
_LIGHT = np.array([0.55, -0.35, 0.76])
_COLORS = {"broken": "#b3261e", "warning": "#9a5b00", "note": "#44546a"}
_REGION = np.array([0.85, 0.15, 0.45])


def mode_frequencies(body: ReducedBody, *, youngs_modulus: float, density: float) -> Array:
    """Return the natural frequencies of the undamped body [Hz], ascending, without rigid motions.

    Args:
        body: The body; free, or held by its exact regions.
        youngs_modulus: Young's modulus [Pa]; Poisson's ratio is `cubature.POISSON_RATIO`.
        density: Density [kg/m^3].
    """
    value = soft_modes(body, 0)[0]
    return np.sqrt(youngs_modulus * value / (density * body.volume)) / (2.0 * np.pi)


def write_body_picture(
    path: str | os.PathLike[str],
    body: ReducedBody,
    splats: Splats,
    report: BodyReport,
    *,
    youngs_modulus: float = 1.0e5,
    density: float = 300.0,
) -> None:
    """Draw a body and write the picture; the file appears complete or not at all.

    Args:
        path: The .png to write.
        body: The body.
        splats: Splats that show it, in the body frame.
        report: Its report.
        youngs_modulus: Young's modulus for the frequencies [Pa].
        density: Density for the frequencies [kg/m^3].

    Raises:
        MissingExtraError: If matplotlib is not installed.
        ConfigError: If the name is not that of a .png.
        StorageError: If it cannot be written.
    """
    told = {"what": "picture", "whole": "the picture of a body", "like": "toy.png"}
    with figure_file(path, (14.0, 9.0), **told, few_colors=True) as figure:
        modes = soft_modes(body, COLUMNS - 1)[1]
        names, weights = _weights(body, splats)
        asset = [splats, *_moved(body, splats, modes)]
        pictures = _render(body, [*asset, *(_painted(body, splats, color) for color in weights)])
        frequency = mode_frequencies(body, youngs_modulus=youngs_modulus, density=density)

        strip = 13.5 / COLUMNS * pictures[0].shape[0] / pictures[0].shape[1]  # height of a row of pictures [in]
        height = 2.0 * strip + 4.8
        figure.set_size_inches(14.0, height)
        edges = {"left": 0.02, "right": 0.985, "top": 1.0 - 0.8 / height, "bottom": 0.5 / height}
        gap = 0.5 / ((2.0 * strip + 3.0) / 3.0)
        rows = figure.add_gridspec(3, 1, height_ratios=(strip, strip, 3.0), hspace=gap, **edges)
        x, y, z = 1e2 * np.ptp(body.bounds, axis=0)
        facts = (
            f"{x:.3g} x {y:.3g} x {z:.3g} cm, {1e6 * body.volume:.4g} cm$^3$ · {body.function_count} functions · "
            f"{body.mode_count} handles · {body.point_count} cubature points · {len(body.kernels.centres)} kernels"
        )
        figure.text(0.02, 1.0 - 0.35 / height, body.name, fontsize=15, weight="bold")
        figure.text(0.985, 1.0 - 0.35 / height, facts, fontsize=10, ha="right", color="0.3")
        titles = ["at rest", *(f"soft mode {k + 1}: {frequency[k]:.3g} Hz" for k in range(len(modes)))]
        _strip(figure, rows[0], titles, pictures[: len(titles)])
        _strip(figure, rows[1], names, pictures[len(titles) :])
        lower = rows[2].subgridspec(1, 5, width_ratios=(0.85, 0.85, 0.85, 0.8, 2.1), wspace=0.24)
        _draw_points(figure.add_subplot(lower[0]), body)
        _draw_kernels(figure.add_subplot(lower[1]), body)
        _draw_grasps(figure.add_subplot(lower[2]), body, youngs_modulus, density)
        spectra = lower[3].subgridspec(2, 1, hspace=0.75)
        _draw_spectrum(
            figure.add_subplot(spectra[0]), body.eigenvalues[1:], "skinning eigenvalues [1/m$^2$]", "eigenmode"
        )
        title = f"[Hz], E = {youngs_modulus:.3g} Pa, {density:.3g} kg/m$^3$"
        _draw_spectrum(figure.add_subplot(spectra[1]), frequency, title, "elastic mode")
        _write_report(figure.add_subplot(lower[4]), body, report)


# -- what the splats show ---------------------------------------------------------------------------------------------


def _moved(body: ReducedBody, splats: Splats, modes: Array) -> list[Splats]:
    """Return the splats displaced by each mode, so far that the largest displacement is a fixed part of the size."""
    from softmode.deformables.skinning.averages import average_basis

    value, gradient = average_basis(body, splats.means, splats.covariances())
    size, found = float(np.linalg.norm(np.ptp(body.bounds, axis=0))), []
    for q in modes:
        motion = value @ q
        # A mode has no sign: the one drawn has most of its motion along +x +y +z.
        slope = np.einsum("nkd,kc->ncd", gradient, q)
        steepest = float(np.quantile(np.linalg.norm(slope, axis=(1, 2)), 0.95))
        scale = min(AMPLITUDE * size / np.linalg.norm(motion, axis=1).max(), STEEPNESS / max(steepest, 1e-300))
        scale *= 1.0 if (motion**3).sum() >= 0.0 else -1.0
        found.append(splats.deformed(splats.means + scale * motion, np.eye(3) + scale * slope))
    return found


def _weights(body: ReducedBody, splats: Splats) -> tuple[list[str], list[Array]]:
    """Return titles and colours (N, 3) per splat: the stiffness or regions, then skinning weights."""
    from matplotlib import colormaps

    x = splats.means.astype(np.float64)
    weight = body.skinning_weights(x)[0] if body.skinned else np.ones((len(x), 1))
    title, color = _first(body, x)
    names, colors = [title], [color]
    ranks = _weight_names(body)
    for j in range(1, min(len(body.handles.degrees), COLUMNS)):
        one = weight[:, j] / max(float(np.abs(weight[:, j]).max()), 1e-300)
        names.append(ranks[j])
        colors.append(np.asarray(colormaps["RdBu_r"](0.5 + 0.5 * one))[:, :3])
    return names, colors


def _weight_names(body: ReducedBody) -> list[str]:
    """Return what each skinning weight is: constant, of regions, eigenmodes, then static responses."""
    responses = int((body.handles.degrees == 0).sum())
    regions = len(body.handles.degrees) - responses - len(body.eigenvalues)
    order = [name for name, k in zip(body.regions.names, body.regions.stiffness, strict=True) if k == 0.0]
    order += [name for name, k in zip(body.regions.names, body.regions.stiffness, strict=True) if k > 0.0]
    modes = [f"weight {k}: {value:.3g} / m$^2$" for k, value in enumerate(body.eigenvalues[1:], start=1)]
    return ["constant", *(f"region {name}" for name in order[:regions]), *modes, *["static response"] * responses]


def _first(body: ReducedBody, x: Array) -> tuple[str, Array]:
    """Return title and colours (N, 3) that show where a body is stiffer, or its regions."""
    from matplotlib import colormaps

    scale = body.cubature.stiffness_scale
    low, high = scale.min(), scale.max()
    if high > 1.0001 * low:
        level = np.log(scale[KDTree(body.cubature.points).query(x)[1]] / low) / np.log(high / low)
        return f"stiffness x {low:.2g} to {high:.2g}", np.asarray(colormaps["viridis"](level))[:, :3]
    found = np.full((len(x), 3), 0.86)
    for region in body.regions.parts:
        found[region.distance(x)[0] <= 0.0] = _REGION
    return "regions: " + ", ".join(body.regions.names) if body.regions.names else "surface", found


def _painted(body: ReducedBody, splats: Splats, colors: Array) -> Splats:
    """Return the splats in other colours, shaded by the surface's normal so that the shape can be seen."""
    normal = body.surface.normals[KDTree(body.surface.points).query(splats.means)[1]]
    light = 0.62 + 0.38 * np.clip(normal @ (_LIGHT / np.linalg.norm(_LIGHT)), 0.0, 1.0)
    return replace(splats, sh=((colors * light[:, None] - 0.5) / SH_DC)[:, None])


def _render(body: ReducedBody, shown: list[Splats]) -> list[NDArray[np.uint8]]:
    """Draw every set of splats from the same side."""
    from softmode.splats.raster.pinhole import PinholeCamera
    from softmode.splats.raster.rasterizer import SplatArrays, SplatRasterizer, ViewArrays

    right, up = _camera_axes()
    seen = np.concatenate([s.means for s in shown]) @ np.column_stack([right, up])
    low, high = seen.min(axis=0), seen.max(axis=0)
    margin = 0.06 * float((high - low).max())
    width, tall = (high - low + 2.0 * margin).tolist()
    # As far away as eight heights, so that near and far parts have nearly one scale, and what was measured fits.
    toward = TOWARDS / np.linalg.norm(TOWARDS)
    middle, distance = 0.5 * (low + high), 8.0 * max(width, tall)
    centre = middle[0] * right + middle[1] * up + (body.bounds.mean(axis=0) @ toward) * toward
    position = centre + distance * toward
    rows = round(PIXELS * min(max(tall / width, 0.35), 1.3))
    fov = 2.0 * float(np.arctan(0.5 * max(tall, width * rows / PIXELS) / distance))
    (x, y, z), (u, v, w) = position.tolist(), centre.tolist()
    camera = PinholeCamera.look_at("body", position=(x, y, z), target=(u, v, w), width=PIXELS, height=rows, fov_y=fov)
    views = ViewArrays.from_cameras([camera], background=(1.0, 1.0, 1.0))
    pictures = []
    for splats in shown:
        rasterizer = SplatRasterizer(splats.count, 1, PIXELS, rows)
        rasterizer.render(SplatArrays.from_splats([splats]), views)
        pictures.append((255.0 * np.clip(rasterizer.rgb.numpy()[0], 0.0, 1.0)).round().astype(np.uint8))
    return pictures


def _camera_axes() -> tuple[Array, Array]:
    """Return the directions to the right and up in the picture."""
    forward = -TOWARDS / np.linalg.norm(TOWARDS)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return right, np.cross(right, forward)


# -- panels -----------------------------------------------------------------------------------------------------------


def _strip(figure: Any, row: Any, titles: list[str], pictures: list[NDArray[np.uint8]]) -> None:
    """Put pictures side by side into a row of the figure's grid."""
    places = row.subgridspec(1, COLUMNS, wspace=0.03)
    for column, (title, picture) in enumerate(zip(titles, pictures, strict=True)):
        axes = figure.add_subplot(places[column])
        axes.imshow(picture)
        axes.set_axis_off()
        axes.set_title(title, fontsize=9, pad=3)


def _plane(axes: Any, body: ReducedBody, title: str) -> tuple[Array, Array]:
    """Prepare a panel that looks at the body from the camera's side; return the directions in the picture."""
    right, up = _camera_axes()
    axes.scatter(body.surface.points @ right, body.surface.points @ up, s=3, color="0.82", linewidths=0)
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title(title, fontsize=9, pad=3)
    return right, up


def _draw_points(axes: Any, body: ReducedBody) -> None:
    """Draw the cubature points, as large as their volume, near ones darker."""
    right, up = _plane(axes, body, "cubature points by volume")
    order = np.argsort(body.cubature.points @ TOWARDS)
    depth = body.cubature.points[order] @ TOWARDS
    shade = (depth - depth[0]) / max(float(np.ptp(depth)), 1e-300)
    look = {"s": 5000.0 * body.cubature.weights[order] / body.volume, "linewidths": 0.3, "edgecolors": "white"}
    x, y = body.cubature.points[order] @ right, body.cubature.points[order] @ up
    axes.scatter(x, y, c=0.25 + 0.65 * shade, cmap="Blues", vmin=0.0, vmax=1.0, **look)


def _draw_kernels(axes: Any, body: ReducedBody) -> None:
    """Draw the kernel centres, and the nominal radius of a few."""
    from matplotlib.patches import Circle

    right, up = _plane(axes, body, "kernels, some radii")
    x, y = body.kernels.centres @ right, body.kernels.centres @ up
    axes.scatter(x, y, s=5, color="#7a3e9d", linewidths=0)
    for place in np.column_stack([x, y, body.kernels.radii])[::10].tolist():
        axes.add_patch(Circle(place[:2], place[2], fill=False, color="#7a3e9d", alpha=0.35, lw=0.7))
    axes.autoscale_view()


def _draw_grasps(axes: Any, body: ReducedBody, youngs_modulus: float, density: float) -> None:
    """Draw the pads of the best grasps, and the line between what they touch; or say why there is none."""
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Polygon

    jaw = ParallelJaw.of(ArmDescription())
    try:
        found = rest_grasps(body, jaw, youngs_modulus=youngs_modulus, density=density)
    except GraspError as error:
        _plane(axes, body, "no grasp of the arm")
        words = "\n".join(textwrap.wrap(str(error), 34))
        axes.text(
            0.5, -0.04, words, fontsize=7.5, color=_COLORS["warning"], transform=axes.transAxes, ha="center", va="top"
        )
        return
    best = found[0]
    title = f"best grasps, {1e3 * best.width:.0f} mm wide"
    right, up = _plane(axes, body, title)
    view = np.stack([right, up], axis=1)
    pad = 0.5 * np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]]) * (jaw.pad_width, 0.0, jaw.pad_length)
    for grasp, color in reversed(list(zip(found, ("#b3261e", "#e39b3c", "#ecc98f"), strict=False))):
        turn, beside = Rotation.from_euler("z", grasp.yaw), np.array([0.0, 0.5 * grasp.width, 0.0])
        faces = [turn.apply(pad + side * beside) + grasp.position for side in (1.0, -1.0)]
        for face in sorted(faces, key=lambda face: float(face.mean(axis=0) @ TOWARDS)):
            axes.add_patch(Polygon(face @ view, facecolor=(*to_rgb(color), 0.25), edgecolor=color, lw=1.1))
        axes.plot(*(np.array(grasp.contacts) @ view).T, color=color, lw=1.4, marker="o", ms=3)
    axes.autoscale_view()


def _draw_spectrum(axes: Any, values: Array, title: str, label: str) -> None:
    """Draw a spectrum as bars, on a logarithmic scale if it is wide."""
    axes.bar(np.arange(1, len(values) + 1), values, color="#2f6f9f", width=0.8 if len(values) < 40 else 1.0)
    axes.set_xlim(0.4, len(values) + 0.6)
    axes.xaxis.get_major_locator().set_params(integer=True)
    if len(values) and values.max() > 30.0 * values.min() > 0.0:
        axes.set_yscale("log")
    axes.set_title(title, fontsize=9, pad=3)
    axes.set_xlabel(label, fontsize=8, labelpad=1)
    axes.tick_params(which="both", labelsize=7)
    axes.spines[["top", "right"]].set_visible(False)


def _write_report(axes: Any, body: ReducedBody, report: BodyReport) -> None:
    """Write the measures in two columns and the findings under them."""
    axes.set_axis_off()
    told = ("extent", "mass at", "functions", "cubature points", "splats")  # the title has these, or the findings
    lines = [f"{m.name}: {m.value:.3g} {m.unit}".rstrip() for m in report.measures if not m.name.startswith(told)]
    lines.append(f"build: {body.build_seconds:.2f} s")
    half, y, step = -(-len(lines) // 2), 1.0, 0.06
    for column, part in enumerate((lines[:half], lines[half:])):
        for row, line in enumerate(part):
            axes.text(0.525 * column, y - step * row, line, fontsize=6.8, transform=axes.transAxes, va="top")
    y -= step * (half + 0.7)
    if not report.findings:
        axes.text(0.0, y, "no findings", fontsize=9, color="#1b7f3b", weight="bold", transform=axes.transAxes, va="top")
    for finding in report.findings:
        for line in textwrap.wrap(f"{finding.severity}, {finding.name}: {finding.what}", 98):
            if y < -0.1:
                return
            axes.text(0.0, y, line, fontsize=6.8, color=_COLORS[finding.severity], transform=axes.transAxes, va="top")
            y -= step
