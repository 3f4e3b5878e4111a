"""Fill of captures: shells of known volume, and twelve captures of known objects.

Run with `python -m benchmarks.captures [--scenes | --loads]`. Volumes and extents are relative to the truth, times are
of one core (processor time). With `--loads`: the whole of `load`, from a file to a body that has never been built.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path
from unittest import mock

import numpy as np

from softmode.deformables.quadrature.quadrature import quadrature_from_points, quadrature_from_splats
from softmode.objects import ObjectConfig, load
from softmode.objects.pipeline import standing_quadrature
from softmode.objects.source import object_source
from softmode.splats.formats import write_splats
from tests.captures import CAPTURES, SHELLS, render_shell

BARE = 4e-4
"""Thickness of the splats whose centres stand for a cloud of points [m]; it does not matter."""


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=20_000, help="splats of a shell")
    parser.add_argument("--sigmas", type=float, nargs="+", default=[0.05e-3, 0.4e-3, 1e-3], help="their thickness [m]")
    parser.add_argument("--scenes", action="store_true", help="the twelve captures instead")
    parser.add_argument("--loads", type=int, nargs="*", help="load files of so many splats; 100,000 and 500,000")
    options = parser.parse_args()
    if options.loads is not None:
        print_loads(options.loads or [100_000, 500_000])
    elif options.scenes:
        print_scenes()
    else:
        print_shells(options.count, options.sigmas)


def print_shells(count: int, sigmas: list[float]) -> None:
    """Fill every shell from the bare centres of its splats and at every thickness."""
    print(f"{'shell':8}{'sigma mm':>10}{'volume':>9}{'+-':>7}{'centre %':>10}{'voxels':>8}{'s':>7}")
    for name, make in SHELLS.items():
        solid = make()
        volume, centre = solid.moments
        for sigma in [None, *sigmas]:
            splats = render_shell(solid, count, sigma=sigma or BARE)
            start = time.process_time()
            if sigma is None:
                found = quadrature_from_points(splats.means)
            else:
                found = quadrature_from_splats(splats.means, splats.scales, splats.quats, splats.opacities)
            seconds = time.process_time() - start
            off = (
                np.linalg.norm(found.weights @ found.points / found.volume - centre)
                / np.ptp(solid.bounds, axis=0).max()
            )
            print(
                f"{name:8}{'points' if sigma is None else f'{1e3 * sigma:.2f}':>10}{found.volume / volume:9.3f}"
                f"{found.report['volume_uncertainty']:7.3f}{100.0 * off:10.2f}"
                f"{found.report['resolution']:8d}{seconds:7.1f}",
                flush=True,
            )


def print_loads(counts: list[int]) -> None:
    """Time `load` of files with shells of some captures, without any cache."""
    print(f"{'capture':12}{'splats':>9}{'voxels':>8}{'functions':>11}{'load, s':>9}")
    for name in ("dense", "thin neck", "mug"):
        for count in counts:
            with tempfile.TemporaryDirectory() as folder, mock.patch.dict(os.environ, SOFTMODE_CACHE=folder):
                file = Path(folder) / "capture.ply"
                write_splats(file, render_shell(CAPTURES[name].solid(), count))
                start = time.process_time()
                body = load(ObjectConfig(splat=file, up="+z")).body
                seconds = time.process_time() - start
            voxels = body.provenance["quadrature_resolution"]
            print(f"{name:12}{count:9d}{voxels:8d}{body.function_count:11d}{seconds:9.1f}", flush=True)


def print_scenes() -> None:
    """Load every capture as it is."""
    print(f"{'capture':16}{'splats':>8}{'of part':>9}{'volume':>9}{'extent':>9}{'kept':>7}{'voxels':>8}{'s':>7}")
    for name, capture in CAPTURES.items():
        solid, scene = capture.solid(), capture.scene()
        size = np.ptp(solid.bounds, axis=0)
        start = time.process_time()
        config = ObjectConfig(splat=scene, size=float(size.max()), pose="captured", **capture.options)
        source = object_source(config)
        found = standing_quadrature(config, source)[0]
        seconds = time.process_time() - start
        ratio = np.sort(np.ptp(found.bounds, axis=0)) / np.sort(size)
        print(
            f"{name:16}{scene.count:8d}{source.splats.count:9d}{found.volume / solid.volume:9.3f}"
            f"{ratio[np.abs(ratio - 1.0).argmax()]:9.3f}{found.report['kept_share']:7.3f}"
            f"{found.report['resolution']:8d}{seconds:7.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
