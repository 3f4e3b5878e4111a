"""Splats that bend: the motion of each by that of the nearest integrator point, affine or quadratic.

A painted bar is bent by 180 degrees. PIE-NeRF knows its motion at integrator points and continues it from the nearest
one: x = x_k + F_k d (affine), or + 1/2 d^T H_k d with H the second derivatives (quadratic). softmode evaluates its
functions at every splat. Printed is how far splats are from where they should be, and the PSNR of the pictures against
the one of the exact motion.

Run: ``python docs/warp_picture.py [docs/images/warp.png]``
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import KDTree

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for the benchmarks

from benchmarks.splat_fidelity import HEIGHT, LENGTH, WIDTH, Motion, Moved, bend, sample_bar
from softmode.deformables.quadrature.quadrature import quadrature_from_box
from softmode.deformables.quadrature.quadrature_cuboids import nearest_cells
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions

Array = NDArray[np.float64]
SIZE, STEP = 320, 1.0e-4
COUNTS = (8, 24)
"""Integrator points along the bar."""


def continued(motion: Motion, points: Array, *, quadratic: bool) -> Motion:
    """Return a motion that is known with its derivatives at some points, and continued from the nearest one."""
    steps = STEP * np.eye(3)
    place = motion(points)
    # F[:, i, j] = d x_i / d X_j and H[:, i, j, k], by central differences.
    F = np.stack([motion(points + e) - motion(points - e) for e in steps], axis=2) / (2.0 * STEP)
    H = np.empty((len(points), 3, 3, 3))
    for j, a in enumerate(steps):
        for k, b in enumerate(steps):
            corners = motion(points + a + b) - motion(points + a - b) - motion(points - a + b) + motion(points - a - b)
            H[:, :, j, k] = corners / (4.0 * STEP**2)
    tree = KDTree(points)

    def move(x: Array) -> Array:
        k = np.asarray(tree.query(x)[1])
        d = x - points[k]
        found = place[k] + np.einsum("nij,nj->ni", F[k], d)
        return found + 0.5 * np.einsum("nijk,nj,nk->ni", H[k], d, d) if quadratic else found

    return move


def main() -> None:
    """Draw the pictures in a row and print what they are worth."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="?", type=Path, default=Path("docs/images/warp.png"))
    file = parser.parse_args().file
    splats, motion = sample_bar(0.003), bend(np.pi)
    inside = np.random.default_rng(0).uniform(-0.5, 0.5, (6000, 3)) * (LENGTH, WIDTH, HEIGHT)
    weights = np.ones(len(inside))
    truth = Moved.by(motion, splats).draw(SIZE)
    body = build_body(quadrature_from_box((LENGTH, WIDTH, HEIGHT)), BuildOptions(), progress=False)
    own = Moved(splats, lambda x: body.evaluate(x)[0])
    q = own.fit(motion)
    rows = [truth]
    for count in COUNTS:
        centres = inside[np.linspace(0, len(inside) - 1, count).astype(int)]
        for _ in range(20):
            centres = nearest_cells(inside, weights, centres)[2]
        for quadratic in (False, True):
            warp = continued(motion, centres, quadratic=quadratic)
            moved = Moved.by(warp, splats, averaged=False).draw(SIZE)
            name = f"{'quadratic' if quadratic else 'affine'} from {count} points"
            report(name, warp(splats.means.astype(float)) - motion(splats.means.astype(float)), moved, truth)
            rows.append(moved)
    drawn = own.draw(SIZE, q)
    away = splats.means + own.basis @ q - motion(splats.means.astype(float))
    report(f"{body.function_count} functions at every splat", away, drawn, truth)
    order = [rows[1], rows[2], rows[3], rows[4], drawn]
    strip = np.concatenate([picture[int(0.16 * SIZE) : int(0.64 * SIZE)] for picture in order], axis=1)
    image = Image.fromarray((255.0 * np.clip(strip, 0.0, 1.0)).astype(np.uint8))
    image.save(file, optimize=True)
    print(f"wrote {file}")


def report(name: str, away: Array, picture: Array, truth: Array) -> None:
    """Print how far splats are from where they should be, and the PSNR of the picture."""
    far = np.linalg.norm(away, axis=1)
    psnr = -10.0 * np.log10(np.mean((picture - truth) ** 2))
    print(f"{name}: rms {np.sqrt((far**2).mean()):.1e} m, most {far.max():.1e} m, {psnr:.1f} dB")


if __name__ == "__main__":
    main()
