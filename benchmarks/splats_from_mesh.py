"""How well splats stand for a mesh: PSNR on pictures the fit has not seen, before and after, by count and size.

python -m benchmarks.splats_from_mesh                                          # the table of docs/splats_from_mesh.md
python -m benchmarks.splats_from_mesh --meshes toy.glb --counts 2500 10000     # of your own meshes

"in" is the PSNR over the pixels that the object covers at least partly. "at 64" and "at 256" are pictures of the fitted
splats in other sizes than they were fitted at.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import warp as wp

from softmode.objects.mesh_file import read_mesh
from softmode.objects.mesh_fit import FitOptions, splats_from_mesh
from softmode.splats.colored_mesh import ColoredMesh
from softmode.splats.fit.picture_fit import FIELD_OF_VIEW
from softmode.splats.fit.reference_views import orbit_poses, render_mesh
from softmode.splats.mesh_samples import sample_mesh
from softmode.splats.raster.rasterizer import SplatArrays, SplatRasterizer
from softmode.splats.splats import Splats
from tests.splats.meshes import bumpy_sphere, checker_texture, painted_box, two_objects

VIEWS = 8
WHITE = (1.0, 1.0, 1.0)


def measure(mesh: ColoredMesh, splats: Splats, size: int) -> tuple[float, float]:
    """Return the PSNR of whole pictures before white and of the covered pixels only [dB]."""
    unit, center, radius = mesh.normalized()
    rng = np.random.default_rng(99)
    focal = 0.5 * size / np.tan(0.5 * FIELD_OF_VIEW)
    poses = orbit_poses(VIEWS, 1.02 / np.sin(0.5 * FIELD_OF_VIEW), rng)
    lens = (focal, focal, 0.5 * size, 0.5 * size)
    pictures = render_mesh(unit, poses, lens, width=size, height=size, samples=8)
    rasterizer = SplatRasterizer(splats.count, VIEWS, size, size)
    moved = splats.transformed(translation=-center).transformed(scale=1.0 / radius)
    rasterizer.render(SplatArrays.from_splats([moved]), pictures.view_arrays(range(VIEWS), [WHITE]))
    error = (np.clip(rasterizer.rgb.numpy(), 0.0, 1.0) - pictures.on(WHITE)).astype(np.float64) ** 2
    inside = pictures.alpha.numpy() > 0.0
    return float(np.mean(-10.0 * np.log10(error.mean(axis=(1, 2, 3))))), float(-10.0 * np.log10(error[inside].mean()))


def main() -> None:
    """Print one row per mesh and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", type=Path, nargs="*", help="mesh files; the built-in ones if omitted")
    parser.add_argument("--counts", type=int, nargs="*", default=[2500, 10_000])
    parser.add_argument("--iterations", type=int, default=FitOptions.iterations)
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    if arguments.meshes:
        meshes = {path.name: read_mesh(path) for path in arguments.meshes}
    else:
        sources = {
            "bumpy sphere, smooth texture": bumpy_sphere(),
            "bumpy sphere, checker": bumpy_sphere(texture=checker_texture()),
            "box, vertex colours": painted_box(),
            "scene of two": two_objects(),
        }
        meshes = {name: ColoredMesh.from_trimesh(source) for name, source in sources.items()}
    print("| mesh | splats | sampled | fitted | in | at 64 | at 256 | CPU s |\n|---|---|---|---|---|---|---|---|")
    for name, mesh in meshes.items():
        for count in arguments.counts:
            before = measure(mesh, sample_mesh(mesh, count), 128)[0]
            clock = time.process_time()
            fit = splats_from_mesh(mesh, count=count, options=FitOptions(iterations=arguments.iterations))
            seconds = time.process_time() - clock
            (at, inside), small, large = (measure(mesh, fit.splats, size) for size in (128, 64, 256))
            print(
                f"| {name} | {count:,} | {before:.1f} | {at:.1f} | {inside:.1f} | {small[0]:.1f} | {large[0]:.1f} "
                f"| {seconds:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
