"""Speed and quality of softmode's splats beside Newton's ray-traced ones, on the same splats at rest; see `camera`.

Quality is the PSNR against supersampled pictures, one drawn by softmode in its classic mode and one by Newton, both
with eight times as many pixels along each edge, which are averaged. Each renderer is closest to its own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.camera_scene import SceneCamera, blob, handle_scene, intrinsics, orbit
from benchmarks.clock import Clock
from benchmarks.peers_newton import NewtonCamera
from softmode.splats.raster.pinhole import MAX_EDGE
from softmode.splats.splats import Splats

SUPERSAMPLING = 8
"""Pixels along the edge of a pixel in the pictures that quality is measured against."""


def report_speed(sizes: Sequence[int], counts: Sequence[int], clock: Clock) -> None:
    """Print milliseconds per frame of both, and their ratio."""
    print("  px splats | softmode ms  Newton ms  ratio  (one view at rest)")
    for size in sizes:
        for count in counts:
            splats = blob(count)
            own = SceneCamera(handle_scene(splats, 1), size, device=clock.device)
            other = newton_camera(splats, size, clock)
            spent, theirs = clock.replay(own.draw), clock.median(other.draw)
            print(f"{size:4d} {count:6d} | {spent:11.2f} {theirs:10.2f} {theirs / spent:6.1f}", flush=True)


def report_quality(sizes: Sequence[int], count: int, clock: Clock) -> None:
    """Print the PSNR of both against both supersampled pictures, and what a frame took."""
    splats = blob(count)
    print(f"  px | PSNR against softmode x {SUPERSAMPLING}, Newton x {SUPERSAMPLING} [dB], ms per frame")
    for size in sizes:
        fine = size * SUPERSAMPLING
        if fine > MAX_EDGE:
            print(f"{size:4d} | left out: supersampled pictures have at most {MAX_EDGE} px on each side")
            continue
        references = [average(softmode_image(splats, fine, clock, antialiased=False)[0])]
        references.append(average(newton_image(splats, fine, clock)[0]))
        agreement = psnr(references[0], references[1])
        drawn = {
            "softmode, antialiased": softmode_image(splats, size, clock, antialiased=True),
            "softmode, classic": softmode_image(splats, size, clock, antialiased=False),
            "Newton, one ray": newton_image(splats, size, clock),
        }
        for name, (image, spent) in drawn.items():
            scores = "  ".join(f"{psnr(image, reference):5.1f}" for reference in references)
            print(f"{size:4d} | {scores}  {spent:8.2f} ms  {name}", flush=True)
        print(f"{size:4d} | the two supersampled pictures agree to {agreement:.1f} dB", flush=True)


def softmode_image(splats: Splats, size: int, clock: Clock, *, antialiased: bool) -> tuple[np.ndarray, float]:
    """Return softmode's picture at rest and the time of a frame [ms]."""
    camera = SceneCamera(handle_scene(splats, 1), size, device=clock.device, antialiased=antialiased)
    spent = clock.replay(camera.draw) if size < 1024 else float("nan")
    camera.draw()
    return camera.rasterizer.rgb.numpy()[0].astype(np.float64), spent


def newton_image(splats: Splats, size: int, clock: Clock) -> tuple[np.ndarray, float]:
    """Return Newton's picture at rest and the time of a frame [ms]."""
    camera = newton_camera(splats, size, clock)
    spent = clock.median(camera.draw) if size < 1024 else float("nan")
    camera.draw()
    return camera.image(), spent


def newton_camera(splats: Splats, size: int, clock: Clock) -> NewtonCamera:
    """Return Newton's camera at the place of softmode's first."""
    return NewtonCamera(splats, orbit(0, 1), intrinsics(size), size, device=str(clock.device))


def average(image: np.ndarray) -> np.ndarray:
    """Average blocks of SUPERSAMPLING x SUPERSAMPLING pixels."""
    edge = len(image) // SUPERSAMPLING
    return image.reshape(edge, SUPERSAMPLING, edge, SUPERSAMPLING, 3).mean(axis=(1, 3))


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio of pictures in 0..1 [dB]."""
    return float(-10.0 * np.log10(((np.clip(image, 0.0, 1.0) - np.clip(reference, 0.0, 1.0)) ** 2).mean()))
