"""Draw the picture of dents: a finger in a sponge, and a section through both, without dents of contact and with them.

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

from softmode.deformables import Material
from softmode.objects import Placed, load
from softmode.scenes import SplatScene
from softmode.splats import CameraOptions, PinholeCamera, ShadowOptions

RADIUS, DEEP, FRAMES, EDGE, SLICE = 0.008, 0.010, 60, 420, 0.002
"""Of the finger [m], how far it is pressed in [m], frames that it takes, pixels of a picture, half a section [m]."""
FOAM = Material(youngs_modulus=2.0e4, poissons_ratio=0.25, density=60.0, friction=0.5, viscosity=1.0e-2)


def main() -> None:
    """Press, draw what a camera sees, and a section."""
    from matplotlib.figure import Figure

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=Path("docs/images"))
    folder = parser.parse_args().folder
    wp.config.log_level = wp.LOG_WARNING
    scene, top = pressed()
    dents = scene.state.softmode.dent
    seen, means, kept = scene.draw(), {}, dents.numpy().copy()
    for name, shown in (("without dents", np.zeros_like(kept)), ("with dents", kept)):
        dents.assign(shown)
        scene.draw()
        means[name] = scene.splats.arrays.means.numpy()[0].astype(float) if scene.splats else np.zeros((1, 3))
        print(f"{name}: the deepest splat is {1e3 * depth(means[name], top - DEEP):.2f} mm in the finger")
    figure = Figure(figsize=(8.4, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.imshow(seen)
    left.set_axis_off()
    section(right, means, top - DEEP)
    figure.savefig(folder / "dents.png", dpi=100)


def section(axes: Any, means: dict[str, NDArray[np.float64]], tip: float) -> None:
    """Draw the splats near the plane y = 0 around a finger whose lowest point is at a height [m], in millimetres."""
    edge = np.linspace(np.pi, 2.0 * np.pi, 90)
    x, z = RADIUS * np.cos(edge), tip + RADIUS + RADIUS * np.sin(edge)
    x, z = np.array([-RADIUS, *x, RADIUS]), np.array([1.0, *z, 1.0])
    axes.fill(1e3 * x, 1e3 * z, color=(0.80, 0.58, 0.47))
    for (name, points), color, size in zip(means.items(), ("0.35", "tab:blue"), (9, 14), strict=True):
        near = points[(np.abs(points[:, 1]) < SLICE) & (np.abs(points[:, 0]) < 3.0 * RADIUS)]
        near = near[near[:, 2] > tip - 0.008]
        axes.scatter(*(1e3 * near[:, (0, 2)].T), s=size, color=color, label=name, linewidths=0)
    axes.set(xlim=(-20, 20), ylim=(1e3 * tip - 5, 1e3 * tip + 17), xlabel="x [mm]", ylabel="z [mm]", aspect="equal")
    axes.set_title(f"splats within {1e3 * SLICE:.0f} mm of the middle", fontsize=9)
    axes.legend(loc="upper right", fontsize=8)


def depth(points: NDArray[np.float64], tip: float) -> float:
    """Return how deep the deepest point is in the finger [m], whose lowest point is at a height [m]."""
    away = points - np.stack([0.0 * points[:, 0], 0.0 * points[:, 0], np.maximum(points[:, 2], tip + RADIUS)], axis=1)
    return float((RADIUS - np.linalg.norm(away, axis=1)).max())


def pressed() -> tuple[SplatScene, float]:
    """Return the scene at the end of the press, and how high the sponge was."""
    sponge = load(preset="sponge", material=FOAM, surface_count=3000)
    top = float(np.ptp(sponge.body.surface.points[:, 2]))
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
