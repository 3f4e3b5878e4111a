"""A radiance field trained on forty pictures of a preset becomes a soft body that is pulled and squeezed.

The pictures stand for photographs: the product's camera makes them before a white wall, with a lens that distorts,
blur, noise and wrong exposure. Training takes two minutes on one core.

Run: ``python examples/train_field.py [--preset bear] [--steps 1000] [--folder out/field] [--short]``
"""

import argparse
import time
from pathlib import Path

import newton
import numpy as np
from PIL import Image
from scipy import ndimage

from softmode import splats as gs
from softmode.deformables import Material, status_reasons
from softmode.learning import train_field
from softmode.objects import Placed, SoftObject, load
from softmode.radiance import render_radiance, write_radiance
from softmode.scenes import SplatScene

LENS, NOISE, BLUR, EXPOSURE = gs.Lens(k1=0.08, k2=-0.03, p1=0.001, p2=-0.0008), 0.02, 0.5, 0.1
"""What the lens does; noise of a pixel, blur [px], to which the lens adds as much, and error of the exposure."""
FOAM = Material(youngs_modulus=2.0e4, poissons_ratio=0.35, density=150.0, viscosity=4.0e-3)
WALL = (1.0, 1.0, 1.0)
SKY = gs.CameraOptions(sky=(WALL,) * 2)


def views(splats, z: np.ndarray, turn: float, edge: int, fov: float) -> list[gs.PinholeCamera]:
    """Return cameras on a spiral around splats, at heights -1..1."""
    low, high = splats.bounds()
    middle, distance = 0.5 * (low + high), 1.5 * float(np.linalg.norm(high - low))
    a, r = turn + np.arange(len(z)) * np.pi * (3.0 - np.sqrt(5.0)), np.sqrt(1.0 - z * z)
    eyes = middle + distance * np.stack([r * np.cos(a), r * np.sin(a), z], axis=1)
    size = {"target": tuple(middle), "width": edge, "height": edge, "fov_y": fov}
    return [gs.PinholeCamera.look_at(f"{i:03d}", position=tuple(eye), **size) for i, eye in enumerate(eyes)]


def pictures(splats, cameras: list[gs.PinholeCamera]) -> np.ndarray:
    """Return clean pictures before the wall, shape (V, height, width, 3)."""
    raster = gs.SplatRasterizer(splats.count, len(cameras), cameras[0].width, cameras[0].height)
    seen = gs.ViewArrays.from_cameras(cameras, world=[0] * len(cameras))
    raster.render(gs.SplatArrays.from_splats([splats]), seen)
    return raster.rgb.numpy() + (1.0 - raster.alpha.numpy()[..., None]) * np.array(WALL)


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    """Return the mean peak signal-to-noise ratio of pictures 0..1 [dB]."""
    error = (np.clip(one, 0.0, 1.0) - np.clip(other, 0.0, 1.0)) ** 2
    return float(-10.0 * np.log10(error.mean(axis=(1, 2, 3))).mean())


def pulled(thing: SoftObject, edge: int) -> tuple[list[np.ndarray], list[float], list[str]]:
    """Return pictures at rest, pulled to 1.25 of the height and squeezed to 0.8, heights over that, and what broke."""
    size = {"target": (0.0, 0.0, 0.0), "width": edge, "height": edge, "fov_y": 0.62}
    camera = gs.PinholeCamera.look_at("film", position=(0.2, -0.26, 0.1), **size)
    still = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    scene = SplatScene(still, [Placed(object=thing)], cameras=[camera], camera_options=SKY, grip_slots=24, march=True)
    points = thing.body.surface.points
    height = np.ptp(points[:, 2])
    order = np.argsort(points[:, 2])
    scene.grips[0].take(points[order[:12]], scene.state)
    hand = scene.grips[0].take(points[order[-12:]], scene.state)
    start = scene.grips[0].pose(hand)[0]
    shots, heights = [scene.draw()], [1.0]
    for share in (0.25, -0.2):
        scene.grips[0].aim(hand, start + np.array([0.0, 0.0, share * height]))
        scene.grips[0].begin_frame(20 * scene.steps_per_frame)
        for _ in range(40):
            scene.step()
        shots.append(scene.draw())
        heights.append(float(np.ptp(scene.surface(0)[:, 2]) / height))
    return shots, heights, list(status_reasons(int(scene.solver.status.numpy()[0])))


def test_final(decibels: float, volume: float | None, heights: list[float], broken: list[str], *, short: bool) -> None:
    """Held-out pictures look right, a solid that is not doubted has the mesh's volume, and was pulled and squeezed."""
    assert decibels > (22.0 if short else 29.0)
    assert volume is None or abs(volume - 1.0) < (0.6 if short else 0.05)
    assert heights[1] > 1.15 and heights[2] < 0.9 and not broken


def main() -> None:
    """Make pictures, train, load, pull and squeeze; print how well each went."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", default="bear")
    parser.add_argument("--steps", type=int, default=1000, help="steps of the training")
    parser.add_argument("--folder", type=Path, default=Path("out/field"))
    parser.add_argument("--short", action="store_true", help="fewer, smaller pictures and a rough field")
    given = parser.parse_args()
    count, edge, steps = (20, 64, 250) if given.short else (40, 128, given.steps)
    toy, rng = load(preset=given.preset), np.random.default_rng(3)
    splats = toy.visible_splats
    heights = np.sin(np.deg2rad(np.linspace(-48.0, 84.0, count)))  # even in angle, so that a third look into a cup
    cameras, held = views(splats, heights, 0.0, edge, 0.7), views(splats, np.linspace(-0.14, 0.91, 10), 1.0, edge, 0.7)
    seen = ndimage.gaussian_filter(pictures(splats, cameras), (0.0, BLUR, BLUR, 0.0))
    seen = seen * (1.0 + EXPOSURE * rng.uniform(-1.0, 1.0, (count, 1, 1, 1))) + NOISE * rng.normal(size=seen.shape)
    gs.write_transforms(given.folder, cameras, seen, LENS)
    clock = time.process_time()
    field = train_field(gs.read_transforms(given.folder), wall=WALL, steps=steps, metres=1.0)
    print(f"trained {steps} steps on {count} pictures of {edge} px in {time.process_time() - clock:.0f} s of a core")
    write_radiance(given.folder / "field.npz", field)
    lens, poses = (held[0].fx, held[0].fy, held[0].cx, held[0].cy), [camera.world_to_camera for camera in held]
    marched = render_radiance(field, poses, lens, width=edge, height=edge, samples=2).on(WALL)
    decibels = psnr(marched, pictures(splats, held))
    thing = load(given.folder / "field.npz", pose="captured", material=FOAM, splat_count=2000)
    volume = thing.body.volume / toy.body.volume
    doubted = any(finding.name == "doubtful solid" for finding in thing.findings())
    print(f"{decibels:.1f} dB on 10 held-out views; volume {volume - 1.0:+.1%} of the mesh; {thing.findings()}")
    shots, heights, broken = pulled(thing, 2 * edge)
    print(f"heights at rest, pulled, squeezed: {', '.join(f'{h:.2f}' for h in heights)}")
    Image.fromarray(np.concatenate(shots, axis=1)).save(given.folder / "pulled.png")
    test_final(decibels, None if doubted else volume, heights, broken, short=given.short)


if __name__ == "__main__":
    main()
