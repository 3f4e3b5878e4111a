"""Bend and twist an object made of splats, one deformation per world, and draw all of them in one launch sequence.

Any splat file becomes a reduced body. Here no physics runs: q is fitted to a bend and a twist that are known, so that
the pictures show what a camera makes of large deformations. Colours that depend on the view turn with the material.
Each frame is compared with one that is drawn eight times as large and averaged.

Run: ``python examples/deform_splats.py [FILE] [--short]``; writes ``out/deform_splats.png``
"""

import argparse
import math
from pathlib import Path

import numpy as np
import warp as wp
from PIL import Image

from softmode.deformables import BuildOptions
from softmode.objects import load
from softmode.scenes import BoundSplats
from softmode.splats import PinholeCamera, SplatRasterizer, ViewArrays

SIZE, DISTANCE = 128, 2.4
"""Edge of the pictures [px]; distance of the camera in sizes of the object."""


def bend(x: np.ndarray, angle: float, height: float) -> np.ndarray:
    """Return points of an upright object bent sideways into an arc of `angle` [rad]."""
    t, arm = angle / height * x[:, 2], height / angle - x[:, 1]
    return np.stack([x[:, 0], height / angle - arm * np.cos(t), arm * np.sin(t)], axis=1)


def twist(x: np.ndarray, angle: float, height: float) -> np.ndarray:
    """Return points of an upright object twisted by `angle` [rad] from bottom to top."""
    c, s = np.cos(angle / height * x[:, 2]), np.sin(angle / height * x[:, 2])
    return np.stack([c * x[:, 0] - s * x[:, 1], s * x[:, 0] + c * x[:, 1], x[:, 2]], axis=1)


class Deformed:
    """An object in five worlds."""

    def __init__(self, file: str | None = None, *, mode_count: int = 16) -> None:
        """Reduce the object and fit the coordinates of each world."""
        self.thing = load(file, build=BuildOptions(mode_count=mode_count))
        splats = self.thing.visible_splats
        x = splats.means.astype(np.float64)
        self.height = float(np.ptp(x[:, 2]))
        motions = [x]
        motions += [bend(x, angle, self.height) for angle in (np.pi / 4, np.pi / 2)]
        motions += [twist(x, angle, self.height) for angle in (np.pi / 2, np.pi)]
        displacement = np.concatenate([y - x for y in motions], axis=1)
        fitted = np.linalg.lstsq(self.thing.basis, displacement, rcond=None)[0]
        misfit = (self.thing.basis @ fitted - displacement).reshape(len(x), -1, 3)
        self.misfit = np.sqrt((misfit**2).sum(axis=2).mean(axis=0)) / self.height
        q = fitted.reshape(len(fitted), -1, 3).transpose(1, 0, 2)  # (world, function, xyz)
        self.worlds = len(q)
        self.bound = BoundSplats(None, [self.thing], worlds=range(self.worlds))
        self.bound.move(wp.array(q.reshape(-1, 3), dtype=wp.vec3d))

    def draw(self, size: int) -> np.ndarray:
        """Draw every world from the front, shape (world, size, size, 3)."""
        distance = DISTANCE * float(np.ptp(self.thing.visible_splats.means, axis=0).max())
        camera = PinholeCamera.look_at(
            "front",
            position=(distance, 0.0, 0.0),
            target=(0.0, 0.0, 0.0),
            width=size,
            height=size,
            fov_y=2.0 * math.atan(1.0 / 3.0),
        )
        views = ViewArrays.from_cameras([camera] * self.worlds, world=range(self.worlds), background=(0.85, 0.88, 0.92))
        rasterizer = SplatRasterizer(self.thing.visible_splats.count, self.worlds, size, size)
        rasterizer.render(self.bound.arrays, views)
        return np.clip(rasterizer.rgb.numpy(), 0.0, 1.0)


def test_final(deformed: Deformed, frames: np.ndarray, factor: int) -> None:
    """The body follows the motions to 3 % of its height, frames reach 30 dB against supersampling, none are alike."""
    large = deformed.draw(factor * SIZE).reshape(-1, SIZE, factor, SIZE, factor, 3).mean(axis=(2, 4))
    decibel = -10.0 * np.log10(((frames - large) ** 2).mean(axis=(1, 2, 3)))
    print("misfit [% of the height]", *np.round(100.0 * deformed.misfit, 2))
    print("PSNR [dB]", *np.round(decibel, 1))
    assert (deformed.misfit < 0.03).all()
    assert (decibel >= 30.0).all()
    assert all(np.abs(frames[i] - frames[0]).max() > 0.2 for i in range(1, len(frames)))


def main() -> None:
    """Draw, compare and save."""
    parser = argparse.ArgumentParser(description="Bend and twist splats")
    parser.add_argument("file", nargs="?", help="splat file, y down; the plush bear if not given")
    parser.add_argument("--short", action="store_true", help="compare with four times the size only")
    arguments = parser.parse_args()
    deformed = Deformed(arguments.file)
    frames = deformed.draw(SIZE)
    test_final(deformed, frames, 4 if arguments.short else 8)
    Path("out").mkdir(exist_ok=True)
    sheet = np.concatenate(list(deformed.draw(3 * SIZE)), axis=1)
    Image.fromarray((255.0 * sheet).astype(np.uint8)).save("out/deform_splats.png")


if __name__ == "__main__":
    main()
