"""Time the splat camera: throughput over worlds, stages and floor, and its peers on the same splats in the same run.

Run from the repository root: ``python -m benchmarks.camera`` (CPU, one core), or ``python -m benchmarks.camera --device
cuda:0 --worlds 1 64 256 1024 4096 --peer gsplat``.

Every world has its own deformation by 16 handles and its own camera (`camera_scene`); a frame deforms and draws all of
them. First, pictures of one of three worlds are compared with the splat formula over every splat in float64; pixels
where float64 itself is within 1e-4 of a decision are left out. Times are medians over replays of a captured graph.

The floor is the larger of two times: compulsory traffic (splats, projected splats, keys, bits and pixels written once
and read once) at the rate of a large copy, and arithmetic (24 flops per splat and basis function, 300 per splat for the
covariance and the projection, 30 per pixel of a tile and splat listed there) at the rate of a large float32 product,
both measured in the same run. What a blend must not do, such as pixels behind opaque ones, is not taken off.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import warp as wp

from benchmarks.camera_scene import DILATION, SceneCamera, blob, handle_scene, intrinsics, orbit
from benchmarks.clock import Clock, held
from benchmarks.step import product_rate
from softmode.splats.raster.rasterizer_kernels import TILE
from tests.splats.dense_reference import render_dense

TOLERANCE = 1e-5
"""Largest error of a colour against the float64 reference."""
UNDECIDED = 1e-4
"""Relative distance to a threshold below which single precision may decide otherwise."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; return 1 if a picture was wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 128], help="image edges [px]")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--splats", type=int, default=5000)
    parser.add_argument("--peer", choices=("gsplat", "none"), default="none")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--no-compile", action="store_true", help="leave torch.compile out")
    options = parser.parse_args(arguments)
    if min(*options.sizes, *options.worlds, options.splats, options.repeats) < 1:
        parser.error("--sizes, --worlds, --splats and --repeats are at least 1")
    wp.config.log_level = wp.LOG_WARNING
    sound = all([check(size, options.splats, options.device) for size in options.sizes])
    report_throughput(options)
    return 0 if sound else 1


def check(size: int, count: int, device: str) -> bool:
    """Compare a deformed world with the dense float64 formula, classic and antialiased; print the errors."""
    splats = blob(count)
    scene = handle_scene(splats, 3)
    world, sound = 1, True
    for antialiased in (False, True):
        camera = SceneCamera(scene, size, device=device, antialiased=antialiased)
        camera.frame()
        means, covariances = scene.deformed(world)
        lens = np.asarray(intrinsics(size), dtype=np.float32).astype(np.float64)  # as the camera has them
        expected = render_dense(
            means,
            covariances,
            splats.opacities.astype(np.float64),
            splats.sh.astype(np.float64),
            orbit(world, 3).astype(np.float32).astype(np.float64),
            (lens[0], lens[1], lens[2], lens[3]),
            size,
            size,
            antialiased=antialiased,
            dilation=DILATION,
        )
        decided = expected.margin > UNDECIDED
        error = np.abs(camera.rasterizer.rgb.numpy()[world] - expected.rgb)[decided].max()
        sound &= bool(error <= TOLERANCE)
        print(
            f"check {size} px, {'antialiased' if antialiased else 'classic'}: largest colour error {error:.1e} "
            f"in {decided.mean():.1%} of the pixels, {'ok' if error <= TOLERANCE else 'WRONG'}",
            flush=True,
        )
    return sound


def report_throughput(options: argparse.Namespace) -> None:
    """Print frames per second over worlds and sizes, stages, floor and memory, and the peer's beside them."""
    clock = Clock(options.device, options.repeats)
    copy, product = copy_rate(options.device), product_rate(options.device)
    print(f"{options.device}: copies {copy / 1e9:.0f} GB/s, float32 matrix product {product / 1e12:.2f} Tflop/s")
    peer = load_gsplat() if options.peer == "gsplat" else None
    print("  px worlds |  ms/frame  frames/s | deform project   sort  cover  blend | floor ms (bytes, flops)  x | MB")
    for size in options.sizes:
        for worlds in options.worlds:
            scene = handle_scene(blob(options.splats), worlds)
            before = held(clock.device)
            camera = SceneCamera(scene, size, device=options.device)
            total = clock.replay(camera.frame)
            spent = [clock.replay(run) for run in stages(camera)]
            floors = [1e3 * amount / rate for amount, rate in zip(least_work(camera), (copy, product), strict=True)]
            print(
                f"{size:4d} {worlds:6d} | {total:9.3f} {1e3 * worlds / total:9.0f} |"
                + "".join(f"{stage:7.2f}" for stage in spent)
                + f" | {floors[0]:8.3f} {floors[1]:8.3f} {total / max(floors):8.1f} | "
                f"{(held(clock.device) - before) / 1e6:.0f} (pool's peak {pool_peak(clock.device) / 1e6:.0f})",
                flush=True,
            )
            picture = camera.rasterizer.rgb.numpy()[0]
            del camera
            if peer is not None:
                report_gsplat(peer, scene, size, total, picture, options)


def stages(camera: SceneCamera) -> list[Callable[[], None]]:
    """Return what a frame consists of, in order; a radix sort takes as long when the keys are sorted already."""
    raster, splats, views = camera.rasterizer, camera.splats, camera.views
    return [
        camera.deform,
        lambda: raster._project(splats, views),
        raster._sort,
        raster._cover_tiles,
        lambda: raster._blend(splats, views, None, None),
    ]


def least_work(camera: SceneCamera) -> tuple[float, float]:
    """Return the compulsory traffic [bytes] and the arithmetic [flop] of a frame; see the module."""
    raster = camera.rasterizer
    views, count, pixels = raster.view_count, raster.splat_count, raster.width * raster.height
    projected = sum(a.dtype._length_ * 4 for a in (raster._center, raster._shape, raster._color)) + 8
    words = raster._cover.shape[0] * raster._cover.shape[1]
    sample = min(views, 16)
    part: Any = raster._cover[: sample * raster.tile_count[0] * raster.tile_count[1]]
    listed = views / sample * float(np.bitwise_count(part.numpy()).sum())
    functions = camera.skin.function_count
    moved = views * count * (2 * 36 + 2 * projected + 4 * 8) + 2 * 4 * words + views * pixels * 20
    flops = views * count * (24 * functions + 300) + listed * TILE**2 * 30
    return float(moved), float(flops)


def copy_rate(device: str) -> float:
    """Return the rate of a large copy, bytes read plus bytes written [1/s]."""
    size = 2**28 if wp.get_device(device).is_cuda else 2**26
    source, target = (wp.zeros(size, dtype=wp.uint8, device=device) for _ in range(2))
    return 2.0 * size / (1e-3 * Clock(device, 10).median(lambda: wp.copy(target, source)))


def pool_peak(device: wp.Device) -> int:
    """Return the most bytes that were ever in use in a CUDA device's pool; 0 on CPU."""
    return int(wp.get_mempool_used_mem_high(device)) if device.is_cuda else 0


def load_gsplat() -> Any:
    """Return the module that runs gsplat, or None, saying why not."""
    from benchmarks import peers_gsplat

    try:
        peers_gsplat.load()
    except peers_gsplat.PeerUnavailable as error:
        print(f"gsplat left out: {error}", file=sys.stderr)
        return None
    return peers_gsplat


def report_gsplat(
    peer: Any, scene: Any, size: int, own: float, picture: np.ndarray, options: argparse.Namespace
) -> None:
    """Print gsplat's time of a frame in every way, how much faster softmode was, and how the pictures agree."""
    import torch

    clock = Clock(options.device, options.repeats)
    with torch.no_grad():
        camera = peer.GsplatCamera(scene, size)
        for name, frame in camera.frames(compiled=not options.no_compile).items():
            try:
                error = frame()[0].cpu().numpy() - picture
                agreement = -10 * np.log10((error**2).mean())
                peak = torch.cuda.max_memory_allocated() / 1e6
                spent = clock.median(lambda frame=frame: (frame(), torch.cuda.synchronize()))
            except Exception as failure:  # out of memory, or no compiler: the other ways may still work
                print(f"{'':11} | gsplat {name}: {type(failure).__name__}: {str(failure)[:120]}", flush=True)
                continue
            print(
                f"{'':11} | {spent:9.3f} {1e3 * scene.world_count / spent:9.0f} | gsplat {name}: softmode is "
                f"{spent / own:.2f} x as fast, pictures agree to {agreement:.0f} dB, {peak:.0f} MB",
                flush=True,
            )
            torch.cuda.reset_peak_memory_stats()
        del camera
    torch.cuda.empty_cache()


if __name__ == "__main__":
    sys.exit(main())
