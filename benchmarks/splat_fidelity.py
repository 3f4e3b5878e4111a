"""Deformation fidelity of splats: F Sigma F^T against the same object as a dense cloud that is moved point by point.

A bar with smooth paint is sampled twice: by a few thousand splats, as a scanned object would be, and by a dense cloud,
whose splats are smaller than a pixel of a picture with eight times the resolution. For a file of splats, the dense
cloud is drawn from the splats themselves. The cloud is moved by x(X), drawn large and averaged down. So the figures
(PSNR of colours 0..1 over the whole picture [dB]) hold everything that separates a frame from the truth: the splats
themselves (what the row "rest" shows), the pixel filter, and the linearisation of x(X) within a splat.

Run: ``python benchmarks/splat_fidelity.py [--splat FILE] [--pictures out]``
"""

from __future__ import annotations

import argparse
import functools
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import binary_dilation

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.quadrature.quadrature import quadrature_from_box
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.skinning.averages import average_basis
from softmode.deformables.skinning.skin_splats import STRETCH_LIMIT, SkinSplats
from softmode.objects import ObjectConfig, load
from softmode.splats import Splats
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.raster.rasterizer import RasterizerOptions, SplatArrays, SplatRasterizer, ViewArrays
from softmode.splats.splats import SH_DC, quats_from_rotations, rotations_from_quats

Array = NDArray[np.float64]
Motion = Callable[[Array], Array]
"""Rest points [m] (N, 3) to deformed points (N, 3)."""

LENGTH, WIDTH, HEIGHT = 0.3, 0.05, 0.06
"""The bar [m], along x, y and z."""
SPREAD = 0.5
"""Standard deviation of a splat in its plane, in cells."""
SPACING = 0.003
"""Cells of the bar as an asset [m]: 6,768 splats."""
BACKGROUND = (0.85, 0.88, 0.92)


# -- objects ----------------------------------------------------------------------------------------------------------


def sample_bar(spacing: float, seed: int = 0) -> Splats:
    """Cover the bar with flat splats, one per cell of rings around it.

    Its cross-section is the squircle |y|^4 + |z|^4 = 1, scaled, and so is its profile along x: flat sides, round edges.

    Args:
        spacing: Edge of a cell [m].
        seed: Turns each ring by a random phase.
    """
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, np.pi, 20001)
    x = -0.5 * LENGTH * np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** (2 / 4)
    # Ends rounded over half a width: the profile is a squircle there and straight between.
    end = 0.5 * WIDTH
    reach = np.clip((np.abs(x) - (0.5 * LENGTH - end)) / end, 0.0, 1.0)
    radius = (1.0 - reach**4) ** (1 / 4)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), 0.5 * HEIGHT * np.diff(radius)))])
    turn = np.linspace(0.0, 2.0 * np.pi, 4001)
    section = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    section = np.sign(section) * np.sqrt(np.abs(section)) * [0.5 * WIDTH, 0.5 * HEIGHT]
    around = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(section, axis=0), axis=1))])
    rings = round(length[-1] / spacing)
    at = (np.arange(rings) + 0.5) * length[-1] / rings
    ring_x, ring_radius = np.interp(at, length, x), np.interp(at, length, radius)
    step = 1e-3 * spacing
    slope = np.stack([np.interp(at + step, length, f) - np.interp(at - step, length, f) for f in (x, radius)])
    slope /= 2.0 * step
    points, frames = [], []
    for k in range(rings):
        count = max(round(ring_radius[k] * around[-1] / spacing), 3)
        s = (np.arange(count) + rng.uniform()) % count * around[-1] / count

        def curve(s: Array) -> Array:
            return np.stack([np.interp(s % around[-1], around, section[:, j]) for j in (0, 1)], axis=1)

        c = curve(s)
        dc = (curve(s + 0.01 * spacing) - curve(s - 0.01 * spacing)) / (0.02 * spacing)
        points.append(np.column_stack([np.full(count, ring_x[k]), ring_radius[k] * c]))
        along = np.column_stack([np.full(count, slope[0, k]), slope[1, k] * c]) * (length[-1] / rings)
        across = np.column_stack([np.zeros(count), ring_radius[k] * dc]) * (around[-1] / count)
        normal = np.cross(along, across)
        normal *= 0.12 * spacing / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        frames.append(np.stack([SPREAD * along, SPREAD * across, normal], axis=-1))
    center, frame = np.concatenate(points), np.concatenate(frames)
    axes, scales, _ = np.linalg.svd(frame)
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    normals = frame[:, :, 2] / np.linalg.norm(frame[:, :, 2], axis=1, keepdims=True)
    return Splats(
        means=center,
        quats=quats_from_rotations(axes),
        scales=np.maximum(scales, 1e-3 * spacing),
        opacities=np.full(len(center), 0.99),
        sh=((paint(center, normals) - 0.5) / SH_DC)[:, None],
    )


def paint(points: Array, normals: Array) -> NDArray[np.floating]:
    """Return smooth stripes across the bar, with light from above baked in, shape (N, 3)."""
    x, y, z = (points / [LENGTH, WIDTH, HEIGHT]).T
    phase = np.stack([14.0 * x + 2.0 * y, 20.0 * x - 3.0 * z + 1.0, 9.0 * x + 4.0 * y * z + 2.0], axis=1)
    light = 0.75 + 0.2 * normals[:, 2] - 0.1 * normals[:, 1]
    return (0.5 + 0.35 * np.sin(phase)) * np.clip(light, 0.0, 1.0)[:, None]


def scatter(splats: Splats, count: int, seed: int = 0) -> Splats:
    """Replace every splat by a cloud of `count` small ones that lets the same light through.

    The optical depth of a splat is -ln(1 - o exp(-d^2/2)) = sum_n o^n / n exp(-n d^2/2): Gaussians of variance 1/n,
    each drawn as small splats of variance 1/8 at random points of variance 1/n - 1/8.
    """
    rng = np.random.default_rng(seed)
    small, n = 1.0 / 8.0, np.arange(1, 8)
    weight = np.minimum(splats.opacities.astype(np.float64), 0.99)[:, None] ** n / n**2
    total = weight.sum(axis=1)
    level = (np.arange(count) + rng.uniform(size=(splats.count, count))) / count * total[:, None]
    term = 1 + np.minimum((level[..., None] > weight.cumsum(axis=1)[:, None]).sum(axis=-1), 6)
    local = rng.normal(size=(splats.count, count, 3)) * np.sqrt(1.0 / term - small)[..., None] * splats.scales[:, None]
    points = splats.means[:, None] + np.einsum("nij,nkj->nki", rotations_from_quats(splats.quats), local)

    def repeat(array: np.ndarray) -> np.ndarray:
        return np.repeat(array, count, axis=0)

    return Splats(
        means=points.reshape(-1, 3),
        quats=repeat(splats.quats),
        scales=repeat(np.sqrt(small) * splats.scales),
        opacities=repeat(1.0 - np.exp(-total / (count * small))),
        sh=repeat(splats.sh),
    )


# -- deformations -----------------------------------------------------------------------------------------------------


def rest(x: Array) -> Array:
    """Leave the object as it is."""
    return x


def bend(angle: float, length: float = LENGTH) -> Motion:
    """Bend along x, upward, by `angle` [rad]; cross-sections stay plane, the neutral fibre keeps its length."""

    def move(x: Array) -> Array:
        t, arm = angle / length * x[:, 0], length / angle - x[:, 2]
        return np.stack([arm * np.sin(t), x[:, 1], length / angle - arm * np.cos(t)], axis=1)

    return move


def twist(angle: float, length: float = LENGTH) -> Motion:
    """Twist about x by `angle` [rad] from end to end."""

    def move(x: Array) -> Array:
        c, s = np.cos(angle / length * x[:, 0]), np.sin(angle / length * x[:, 0])
        return np.stack([x[:, 0], c * x[:, 1] - s * x[:, 2], s * x[:, 1] + c * x[:, 2]], axis=1)

    return move


def shear(gamma: float) -> Motion:
    """Shear, x = X + gamma Z: the same F everywhere."""
    return lambda x: x + gamma * np.outer(x[:, 2], [1.0, 0.0, 0.0])


def rip(distance: float, width: float, direction: int = 0) -> Motion:
    """Move the halves x < 0 and x > 0 apart by twice `distance` [m] within a seam of `width` [m]."""
    return lambda x: x + distance * np.outer(np.tanh(x[:, 0] / width), np.eye(3)[direction])


def upright(motion: Motion) -> Motion:
    """Turn a motion along x into one along z."""
    return lambda x: motion(x[:, [2, 0, 1]])[:, [1, 2, 0]]


class Moved:
    """Splats tied to functions: those of an analytic motion, one per axis, or those of a body.

    Args:
        splats: The splats.
        values: Functions b_k (N, n) at points (N, 3).
        averaged: Average the functions over each splat, or take them and their gradients at its centre.
    """

    def __init__(self, splats: Splats, values: Callable[[Array], Array], *, averaged: bool = True) -> None:
        """Evaluate the functions."""
        self.splats = splats
        widths = splats.covariances() if averaged else np.tile(1e-30 * np.eye(3), (splats.count, 1, 1))
        functions: Any = SimpleNamespace(values=values, narrow=0.0)
        self.basis, self.gradient = average_basis(functions, splats.means, widths)

    @classmethod
    def by(cls, motion: Motion, splats: Splats, **options: Any) -> Moved:
        """Tie to x(X) = X + sum_k (x_k(X) - X_k) e_k: q is the identity."""
        return cls(splats, lambda x: motion(x) - x, **options)

    def fit(self, motion: Motion) -> Array:
        """Return the q (n, 3) whose x(X) is nearest to a motion at the centres."""
        x = self.splats.means.astype(np.float64)
        return np.asarray(np.linalg.lstsq(self.basis, motion(x) - x, rcond=None)[0], dtype=np.float64)

    def draw(
        self,
        size: int,
        q: Array | None = None,
        *,
        stretch_limit: float = STRETCH_LIMIT,
        thinned: bool = False,
        oversampling: int = 1,
        center: Array | None = None,
        options: RasterizerOptions | None = None,
    ) -> Array:
        """Draw a square picture, shape (size, size, 3).

        Args:
            size: Edge [px].
            q: Coordinates (n, 3); the identity of an analytic motion by default.
            stretch_limit: Largest principal stretch that a splat follows.
            thinned: Keep opacity times area, in optical depth, instead of opacity.
            oversampling: Draw larger by this factor and average.
            center: What the camera looks at [m].
            options: How to draw.
        """
        arrays = SplatArrays.from_splats([self.splats], device="cpu")
        skin = SkinSplats(
            self.splats.means,
            self.splats.covariances(),
            self.basis,
            self.gradient,
            stretch_limit=stretch_limit,
            device="cpu",
        )
        moved = wp.array(np.eye(3) if q is None else q, dtype=wp.vec3d, device="cpu")
        start = wp.zeros(1, dtype=wp.int32, device="cpu")
        skin.launch(moved, start, arrays.means, arrays.covariances, rotations=arrays.rotations)
        if thinned:
            arrays = replace(arrays, opacities=wp.array(self._thinned(arrays), dtype=float, device="cpu"))
        side = size * oversampling
        rasterizer = SplatRasterizer(self.splats.count, 1, side, side, options=options, device="cpu")
        rasterizer.render(arrays, look(side, center))
        picture = rasterizer.rgb.numpy()[0].astype(np.float64)
        return picture.reshape(size, oversampling, size, oversampling, 3).mean(axis=(1, 3))

    def _thinned(self, arrays: SplatArrays) -> np.ndarray:
        """Return opacities whose optical depth falls as the area of the two larger axes grows."""
        c = arrays.covariances.numpy()[0][:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]].astype(np.float64)
        after = np.sqrt(np.maximum(np.linalg.eigvalsh(c), 1e-30))
        before = np.sort(self.splats.scales.astype(np.float64), axis=1)
        area = after[:, 1] * after[:, 2] / (before[:, 1] * before[:, 2])
        return (1.0 - (1.0 - np.minimum(self.splats.opacities, 0.9999).astype(np.float64)) ** (1.0 / area))[None]


# -- pictures ---------------------------------------------------------------------------------------------------------


def look(size: int, center: Array | None = None) -> ViewArrays:
    """Return a camera that looks at the centre from the front, a little from above, 0.52 m away."""
    u, v, w = np.zeros(3) if center is None else center
    x, y, z = np.array([u, v, w]) + 0.52 * np.array([-0.25, -0.9, 0.4]) / np.linalg.norm([-0.25, -0.9, 0.4])
    camera = PinholeCamera.look_at(
        "front", position=(x, y, z), target=(u, v, w), width=size, height=size, fov_y=2.0 * math.atan(1.0 / 3.0)
    )
    return ViewArrays.from_cameras([camera], background=BACKGROUND, device="cpu")


def psnr(a: Array, b: Array) -> float:
    """Return the peak signal-to-noise ratio of two pictures [dB]."""
    return float(-10.0 * np.log10(np.mean((np.clip(a, 0.0, 1.0) - np.clip(b, 0.0, 1.0)) ** 2)))


def spikes(picture: Array, truth: Array, reach: int = 3) -> float:
    """Return the pixels that err by more than 0.1 farther than `reach` from the object, as a share of its pixels."""
    inside = np.abs(truth - BACKGROUND).max(axis=-1) > 0.02
    wrong = np.abs(picture - truth).max(axis=-1) > 0.1
    outside = np.logical_not(binary_dilation(inside, iterations=reach))
    return float((wrong & outside).sum() / inside.sum())


def bar_body(mode_count: int = 16) -> ReducedBody:
    """Return a reduced body of the bar; its frame is the bar's."""
    options = BuildOptions(mode_count=mode_count, cubature_count=None)
    return build_body(quadrature_from_box((LENGTH, WIDTH, HEIGHT)), options, progress=False)


# -- table ------------------------------------------------------------------------------------------------------------

Case = tuple[str, Motion]
COLUMNS: dict[str, dict[str, Any]] = {
    "as drawn": {},
    "F at the centre": {"averaged": False},
    "F at the centre, no limit": {"averaged": False, "stretch_limit": np.inf},
    "no limit": {"stretch_limit": np.inf},
    "limit 3": {"stretch_limit": 3.0},
    "thinned": {"thinned": True},
    "filter 0.3": {"options": RasterizerOptions(dilation=0.3)},
}


def measure(
    title: str,
    cases: list[Case],
    tie: Callable[[Splats, bool, Motion], tuple[Moved, Array | None]],
    splats: Splats,
    dense: Splats,
    *,
    size: int = 128,
    pictures: Path | None = None,
) -> None:
    """Print PSNR and spikes of every column, and save truth, drawn, "F at the centre, no limit" side by side.

    Args:
        title: What the rows show.
        cases: Motions.
        tie: Ties splats to a motion: (splats, averaged, motion) to (moved, q).
        splats: The asset.
        dense: The dense cloud.
        size: Edge of the pictures [px].
        pictures: Folder to save them in.
    """
    print(f"\n{title}, {splats.count} splats of degree {splats.sh_degree}, truth {dense.count}, {size} px")
    print("| case | " + " | ".join(COLUMNS) + " |\n|---|" + "---|" * len(COLUMNS))
    for name, motion in cases:
        asset = {averaged: tie(splats, averaged, motion) for averaged in (True, False)}
        cloud, q = tie(dense, False, motion)[0], asset[True][1]
        placed = dense.means + cloud.basis @ (np.eye(3) if q is None else q)
        center = 0.5 * np.quantile(placed, [0.005, 0.995], axis=0).sum(axis=0)
        truth = cloud.draw(size, q, stretch_limit=np.inf, oversampling=8, center=center)
        cells, shown = [], [truth]
        for column, arguments in COLUMNS.items():
            moved, _ = asset[arguments.get("averaged", True)]
            options = {key: value for key, value in arguments.items() if key != "averaged"}
            picture = moved.draw(size, q, center=center, **options)
            cells.append(f"{psnr(picture, truth):.1f}, {100 * spikes(picture, truth):.1f} %")
            if column in ("as drawn", "F at the centre, no limit"):
                shown.append(picture)
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)
        if pictures is not None:
            sheet = np.kron(np.concatenate(shown, axis=1), np.ones((3, 3, 1)))
            file = pictures / f"fidelity_{title}_{name}.png".replace(" ", "_")
            Image.fromarray((255.0 * np.clip(sheet, 0.0, 1.0)).astype(np.uint8)).save(file)


def exactly(splats: Splats, averaged: bool, motion: Motion) -> tuple[Moved, Array | None]:
    """Tie splats to an analytic motion."""
    return Moved.by(motion, splats, averaged=averaged), None


def ties(values: Callable[[Array], Array]) -> Callable[[Splats, bool, Motion], tuple[Moved, Array | None]]:
    """Return what ties splats to the functions of a body, with the q that is nearest to a motion."""

    @functools.cache
    def moved(splats: Splats, averaged: bool) -> Moved:
        return Moved(splats, values, averaged=averaged)

    def tie(splats: Splats, averaged: bool, motion: Motion) -> tuple[Moved, Array | None]:
        tied = moved(splats, averaged)
        return tied, tied.fit(motion) if averaged else None

    return tie


def main() -> None:
    """Print the tables of docs/deforming_splats.md."""
    parser = argparse.ArgumentParser(description="Deformation fidelity of splats")
    parser.add_argument("--splat", help="a splat file to bend, twist and rip as well, its y axis down")
    parser.add_argument("--pictures", type=Path, help="folder for pictures side by side: truth, drawn, unlimited")
    arguments = parser.parse_args()
    if arguments.pictures is not None:
        arguments.pictures.mkdir(parents=True, exist_ok=True)
    exact: list[Case] = [
        ("rest", rest),
        ("bend 90", bend(np.pi / 2)),
        ("bend 180", bend(np.pi)),
        ("twist 180", twist(np.pi)),
        ("shear 1", shear(1.0)),
        ("shear 2", shear(2.0)),
        ("shear 3", shear(3.0)),
        ("seam 4 mm", rip(0.03, 0.002, 2)),
        ("seam 1 mm", rip(0.03, 0.0005, 2)),
        ("gap 4 mm", rip(0.03, 0.002)),
    ]
    bar, dense = sample_bar(SPACING), sample_bar(0.00045)
    print("PSNR [dB] and spikes (pixels wrong by > 0.1 beyond 3 px around the object, as a share of its own)")
    measure("bar", exact, exactly, bar, dense, pictures=arguments.pictures)
    measure("bar coarse", exact, exactly, sample_bar(0.008), dense, pictures=arguments.pictures)
    values = bar_body().values
    measure("bar 16 modes", exact[:4], ties(values), bar, sample_bar(0.0007), pictures=arguments.pictures)
    if arguments.splat:
        thing = load(ObjectConfig(splat=arguments.splat, size=0.25, build=BuildOptions(mode_count=16)))
        splats = thing.visible_splats
        high = float(np.ptp(splats.means[:, 2]))
        loose: list[Case] = [
            ("rest", rest),
            ("bend 90", upright(bend(np.pi / 2, high))),
            ("twist 180", upright(twist(np.pi, high))),
            ("shear 3", upright(shear(3.0))),
            ("torn across", upright(rip(0.6 * high, 0.02 * high, 2))),
            ("torn apart", upright(rip(0.3 * high, 0.02 * high))),
        ]
        values = thing.body.values
        measure(
            "file 16 modes",
            loose,
            ties(values),
            splats,
            scatter(splats, 32),
            pictures=arguments.pictures,
        )


if __name__ == "__main__":
    main()
