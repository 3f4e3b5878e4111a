"""Draw the picture of dents: a finger in a sponge, without the dents of contact and with them.

Run: ``python docs/dent_picture.py [docs/images]`` in the root of the repository. A finger of 16 mm presses 10 mm into
the preset sponge, which lies on a table. Prints how deep splats lie in the finger.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp
from numpy.typing import NDArray
from PIL import Image

from softmode.deformables import Material
from softmode.objects import Placed, load
from softmode.scenes import SplatScene
from softmode.splats import CameraOptions, PinholeCamera, ShadowOptions

RADIUS, DEEP, FRAMES, EDGE = 0.008, 0.010, 60, 420
"""Of the finger [m], how far it is pressed in [m], frames that it takes, and pixels of a picture."""
FOAM = Material(youngs_modulus=2.0e4, poissons_ratio=0.25, density=60.0, friction=0.5, viscosity=1.0e-2)


def main() -> None:
    """Press, and draw twice."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=Path("docs/images"))
    folder = parser.parse_args().folder
    wp.config.log_level = wp.LOG_WARNING
    scene, top = pressed()
    dents = scene.state.softmode.dent
    pictures, kept = [], dents.numpy().copy()
    for name, shown in (("without", np.zeros_like(kept)), ("with", kept)):
        dents.assign(shown)
        pictures.append(scene.draw())
        means = scene.splats.arrays.means.numpy()[0].astype(float) if scene.splats else np.zeros((1, 3))
        print(f"{name} dents: the deepest splat is {1e3 * depth(means, top - DEEP):.2f} mm in the finger")
    Image.fromarray(np.concatenate(pictures, axis=1)).save(folder / "dents.png")


def depth(points: NDArray[np.float64], tip: float) -> float:
    """Return how deep the deepest point is in the finger [m], whose lowest point is at a height [m]."""
    away = points - np.stack([0.0 * points[:, 0], 0.0 * points[:, 0], np.maximum(points[:, 2], tip + RADIUS)], axis=1)
    return float((RADIUS - np.linalg.norm(away, axis=1)).max())


def pressed() -> tuple[SplatScene, float]:
    """Return the scene at the end of the press, and how high the sponge was."""
    sponge = load(preset="sponge", material=FOAM, surface_count=3000)
    top = float(np.ptp(sponge.body.surface_points[:, 2]))
    builder: Any = newton.ModelBuilder()
    table = wp.transform((0.0, 0.0, -0.05), wp.quat_identity())
    builder.add_shape_box(-1, xform=table, hx=2.0, hy=2.0, hz=0.05, color=(0.66, 0.68, 0.70))
    finger = builder.add_body(is_kinematic=True, label="finger")
    builder.add_shape_capsule(finger, radius=RADIUS, half_height=0.03, color=(0.80, 0.58, 0.47))
    eye = {"position": (0.13, -0.11, top + 0.035), "target": (0.0, 0.0, top - 0.006), "fov_y": 0.42}
    camera = PinholeCamera.look_at("film", **eye, width=EDGE, height=EDGE)
    light = CameraOptions(mesh_samples=4, splat_shadow=ShadowOptions(cells=64))
    placed = Placed(object=sponge, position=(0.0, 0.0, sponge.height))
    scene = SplatScene(builder, [placed], cameras=[camera], camera_options=light, steps_per_frame=4)
    for k in range(FRAMES):
        low = top + 0.002 - (DEEP + 0.002) * min(1.0, k / (0.7 * FRAMES))
        pose = np.array([[0.0, 0.0, low + RADIUS + 0.03, 0.0, 0.0, 0.0, 1.0]], np.float32)
        for state in (scene.state, scene._scratch):
            state.body_q.assign(pose)
        scene.step()
    return scene, top


if __name__ == "__main__":
    main()
