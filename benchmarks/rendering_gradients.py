"""Time the gradients of splat images beside the images, and compare them with central differences in float64.

Run: ``python benchmarks/rendering_gradients.py [--device cpu]``. A ball of random splats is seen by a ring of cameras;
the loss weighs every number of the images at random. Times are minima of one run, of the processor time on CPU.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
import warp as wp

from softmode.deformables.skinning.skin_splats import SkinSplats
from softmode.deformables.skinning.skinning_adjoint import AdjointSkinning
from softmode.splats import Splats
from softmode.splats.raster.rasterizer import SplatArrays, SplatRasterizer, ViewArrays
from softmode.splats.raster.rasterizer_adjoint import AdjointRasterizer
from softmode.splats.raster.rasterizer_kernels import vec6
from tests.splats.test_rasterizer import ball, look_at
from tests.splats.test_rasterizer_adjoint import HEIGHT, NAMES, WIDTH, Scene

REPEATS = 15


def least(run: Callable[[], object], device: wp.Device) -> float:
    """Return the least time of a run [ms]."""
    run()
    wp.synchronize_device(device)
    clock = time.process_time if device.is_cpu else time.perf_counter
    times = []
    for _ in range(REPEATS):
        begin = clock()
        run()
        wp.synchronize_device(device)
        times.append(clock() - begin)
    return 1e3 * min(times)


def cost(count: int, size: int, view_count: int, device: wp.Device) -> str:
    """Return one row of the table of times."""
    splats = ball(count)
    splats = Splats(
        means=splats.means,
        quats=splats.quats,
        scales=splats.scales * (400 / count) ** (1 / 3),
        opacities=splats.opacities,
        sh=splats.sh,
    )
    angles = 2.0 * np.pi * np.arange(view_count) / view_count
    arrays = SplatArrays.from_splats([splats], device=device)
    views = ViewArrays(
        world_to_camera=wp.array(
            [look_at((1.6 * np.cos(a), 1.6 * np.sin(a), 0.4)) for a in angles], dtype=wp.mat44, device=device
        ),
        intrinsics=wp.array(
            np.tile([1.1 * size, 1.1 * size, 0.5 * size, 0.5 * size], (view_count, 1)), dtype=wp.vec4, device=device
        ),
        world=wp.zeros(view_count, dtype=wp.int32, device=device),
        background=wp.zeros(1, dtype=wp.vec3, device=device),
    )
    rasterizer = SplatRasterizer(count, view_count, size, size, device=device)
    adjoint = AdjointRasterizer(rasterizer, arrays, views)
    weight = np.random.default_rng(0).normal(size=(view_count, size, size, 3))
    loss = wp.array(weight, dtype=wp.vec3, device=device)
    forward = least(lambda: rasterizer.render(arrays, views), device)
    backward = least(lambda: adjoint.backward(arrays, views, loss_rgb=loss), device)
    return (
        f"| {count} | {size} | {view_count} | {forward:.2f} | {backward:.2f} | {backward / forward:.2f} "
        f"| {1 + backward / forward:.2f} |"
    )


def skinning_cost(count: int, functions: int, device: wp.Device) -> str:
    """Return the times of skinning and of its adjoint."""
    rng = np.random.default_rng(0)
    skin = SkinSplats(
        rng.normal(size=(count, 3)),
        np.tile(1e-4 * np.eye(3), (count, 1, 1)),
        rng.normal(size=(count, functions)),
        rng.normal(size=(count, functions, 3)),
        device=device,
    )
    q = wp.array(0.01 * rng.normal(size=(functions, 3)), dtype=wp.vec3d, device=device)
    start = wp.zeros(1, dtype=wp.int32, device=device)
    means = wp.zeros((1, count), dtype=wp.vec3, device=device)
    covariances = wp.zeros((1, count), dtype=vec6, device=device)
    adjoint, by_q = AdjointSkinning(skin, 1), wp.zeros_like(q)
    forward = least(lambda: skin.launch(q, start, means, covariances), device)
    backward = least(lambda: adjoint.backward(q, start, means, covariances, by_q), device)
    return f"| {count} | {functions} | {forward:.2f} | {backward:.2f} | {backward / forward:.2f} |"


def deviations(count: int, coefficients: int, antialiased: bool, device: str, directions: int = 8) -> dict[str, float]:
    """Return, of each array, the error of directional derivatives relative to the norm of the gradient."""
    scene = Scene.make(count=count, coefficients=coefficients, antialiased=antialiased)
    got, rng, out = scene.gradients(device), np.random.default_rng(1), {}
    for name in (*NAMES, "rotations"):
        array = getattr(scene, name)
        gradient = got[name].sum(axis=1, keepdims=True) if name == "rotations" else got[name]
        errors = []
        for _ in range(directions):
            along = rng.normal(size=array.shape)
            errors.append(abs(scene.slope(name, along) - float((gradient * along).sum())))
        out[name] = float(np.sqrt(np.mean(np.square(errors))) / np.linalg.norm(gradient))
    return out


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    device = wp.get_device(parser.parse_args().device)
    print("| splats | px | views | image, ms | gradient, ms | ratio | both / image |\n|---|---|---|---|---|---|---|")
    for count, size, view_count in ((5000, 64, 4), (5000, 128, 4), (10000, 128, 4), (50000, 128, 4)):
        print(cost(count, size, view_count, device))
    print("\n| splats | functions | skinning, ms | gradient, ms | ratio |\n|---|---|---|---|---|")
    for functions in (16, 64):
        print(skinning_cost(10000, functions, device))
    print(f"\n3 views of {WIDTH} x {HEIGHT} px, 150 splats of degree 3; loss of colour, alpha and depth")
    for antialiased in (True, False):
        found = deviations(150, 16, antialiased, str(device))
        print(("antialiased: " if antialiased else "classic: ") + ", ".join(f"{k} {v:.1e}" for k, v in found.items()))


if __name__ == "__main__":
    main()
