"""Radiance fields: times of the inverse map, the march and baked splats, and how near their pictures are in dB.

Run from the repository root: ``python -m benchmarks.radiance [--device cuda:0] [--worlds 1 256 1024] [--pixels 128]
[--quality]``. The plush, 0.12 m, as a field of 64 nodes, bent by 40 degrees; times are processor time on a CPU, wall
clock on a GPU, all of captured graphs. ``--quality`` bakes it (18 s of a CPU core) and compares pictures.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import warp as wp

from benchmarks.clock import Clock
from softmode.deformables import InverseMap
from softmode.objects import SoftObject, load
from softmode.radiance import MarchOptions, RadianceGrid, RadianceMarch, render_radiance, splats_from_radiance
from softmode.radiance.march import holds_of
from softmode.scenes import BoundSplats
from softmode.splats import PinholeCamera, SplatRasterizer, ViewArrays

SIZE = 0.12
"""Height of the toy [m]."""


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1])
    parser.add_argument("--pixels", type=int, default=128)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--quality", action="store_true")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    toy = load(size=SIZE)
    field = RadianceGrid.from_splats(toy.visible_splats, resolution=64)
    print(f"{options.device}: field {field.shape}, {int(field.occupied.sum())} nodes not empty, {options.pixels} px")
    for worlds in options.worlds:
        time_frame(toy, field, worlds, options.pixels, Clock(options.device, options.repeats))
    if options.quality:
        compare(toy, field, options.pixels, options.device)


def bent(toy: SoftObject, angle: float) -> np.ndarray:
    """Return coordinates of the toy bent forward about the floor by an angle from top to bottom [rad]."""
    low, high = toy.body.bounds[:, 2]

    def shift(x: np.ndarray) -> np.ndarray:
        z = x[:, 2] - low
        k = angle / (high - low)
        c, s = np.cos(k * z), np.sin(k * z)
        return np.stack([x[:, 0] * c + (1 - c) / k, x[:, 1], low + s / k - x[:, 0] * s], axis=1) - x

    return toy.body.project(shift)


def view(pixels: int) -> PinholeCamera:
    """Return the camera."""
    eye = (0.12, -0.33, 0.12)
    return PinholeCamera.look_at("c", position=eye, target=(0.0, 0.0, 0.0), width=pixels, height=pixels, fov_y=0.6)


def time_frame(toy: SoftObject, field: RadianceGrid, worlds: int, pixels: int, clock: Clock) -> None:
    """Print what a picture of each world costs."""
    angles = np.linspace(0.2, 0.7, worlds) if worlds > 1 else [0.7]
    states = np.concatenate([bent(toy, angle) for angle in angles])
    q = wp.array(states, dtype=wp.vec3d, device=clock.device)
    inverse = InverseMap(None, toy.body, within=holds_of(field), world_count=worlds, device=clock.device)
    march = RadianceMarch([(inverse, field)])
    views = ViewArrays.from_cameras([view(pixels)] * worlds, world=range(worlds), device=clock.device)
    follow = clock.replay(lambda: (inverse.move(q), march.mark()))
    rays = clock.replay(lambda: march.march(views, (pixels, pixels)))
    samples = int(march.march(views, (pixels, pixels))[2].numpy().sum())
    bound = BoundSplats(None, [toy], worlds=range(worlds), device=clock.device)
    rasterizer = SplatRasterizer(toy.visible_splats.count, worlds, pixels, pixels, device=clock.device)
    splats = clock.replay(lambda: (bound.move(q), rasterizer.render(bound.arrays, views)))
    print(
        f"{worlds:5d} worlds: inverse map {follow:8.2f} ms, march {rays:8.2f} ms ({samples / worlds:.0f} samples each),"
        f" together {1e3 * worlds / (follow + rays):8.0f} pictures/s, march alone {1e3 * worlds / rays:8.0f};"
        f" {toy.visible_splats.count} splats {splats:8.2f} ms, {1e3 * worlds / splats:8.0f} pictures/s"
    )


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio of two pictures 0..1 [dB]."""
    error = np.clip(one, 0.0, 1.0) - np.clip(other, 0.0, 1.0)
    return float(-10.0 * np.log10(max(float((error.astype(float) ** 2).mean()), 1e-12)))


def compare(toy: SoftObject, field: RadianceGrid, pixels: int, device: str) -> None:
    """Print the PSNR of marched pictures against finer ones, a moved camera, and baked splats."""
    eye = view(pixels)
    views = ViewArrays.from_cameras([eye], background=(1.0, 1.0, 1.0), device=device)
    inverse = InverseMap(None, toy.body, within=holds_of(field), device=device)

    def moved(q: np.ndarray, **options: Any) -> np.ndarray:
        march = RadianceMarch([(inverse, field)], options=MarchOptions(**options))
        inverse.move(wp.array(q, dtype=wp.vec3d, device=device))
        march.mark()
        layer = march.march(views, (pixels, pixels))[0].numpy()[0, 0]
        return layer[..., :3] + 1.0 - layer[..., 3:]

    def drawn(thing: SoftObject, q: np.ndarray) -> np.ndarray:
        bound = BoundSplats(None, [thing], device=device)
        bound.move(wp.array(q, dtype=wp.vec3d, device=device))
        rasterizer = SplatRasterizer(thing.visible_splats.count, 1, pixels, pixels, device=device)
        rasterizer.render(bound.arrays, views)
        return rasterizer.rgb.numpy()[0]

    rest, bend = np.zeros((toy.body.function_count, 3)), bent(toy, 0.5 * np.pi)
    pressed = toy.body.project(lambda x: x * [0.12, 0.12, -0.2])
    lens = (eye.fx, eye.fy, eye.cx, eye.cy)
    still = render_radiance(field, [eye.world_to_camera], lens, width=pixels, height=pixels, device=device)
    print(f"bent back at rest against straight rays {psnr(moved(rest), still.on((1, 1, 1))[0]):.1f} dB")
    print(f"step 0.6 against 0.15 {psnr(moved(bend), moved(bend, step=0.15)):.1f} dB")
    for count in (2000, 12_000):
        fit = splats_from_radiance(field, count=count, device=device)
        sharp = SoftObject(body=toy.body, splats=fit.splats)
        print(f"{fit.splats.count} splats: held-out pictures {fit.history[0][1]:.1f} dB, fitted {fit.psnr:.1f}")
        for name, q in (("at rest", rest), ("bent by 90 degrees", bend), ("squeezed to 0.8", pressed)):
            own, marched, baked = drawn(toy, q), moved(q, samples=2), drawn(sharp, q)
            print(
                f"  {name}: against the toy's own splats marched {psnr(marched, own):.1f} dB, baked"
                f" {psnr(baked, own):.1f}; against each other {psnr(marched, baked):.1f}"
            )


if __name__ == "__main__":
    main()
