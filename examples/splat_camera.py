"""Cameras over a table: a soft plush, a rigid toy that carries splats, and an arm with a camera at its wrist.

Both toys fall a centimetre onto the table. Then a fixed and a wrist camera look at them in every world through a lens,
from a place and in a light drawn for that world. Depth and segmentation cover splats and meshes alike: unprojected, the
pixels of the toys lie on them, those of the table in its plane. Writes out/splat_camera.png, one row per world.

Run: ``python examples/splat_camera.py [--short]``
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo
from PIL import Image

from softmode.deformables import Material, SolverCoupledReduced, add_reduced_body
from softmode.objects import load
from softmode.robots import add_arm
from softmode.scenes import BoundSplats
from softmode.splats import (
    CameraOptions,
    CameraRandomization,
    PinholeCamera,
    RasterizerOptions,
    RigidSplats,
    RigidSplatsSkin,
    SplatCamera,
    make_plush,
)

DT, DROP, PLUSH, TOY = 1.0 / 240.0, 0.01, (0.42, -0.05), (0.5, 0.05)
"""Step [s], height of the fall [m], where the two stand on the table [m]."""
DRAWN = CameraRandomization(rotation=0.03, translation=0.02, focal=0.1, light=0.3, sky=0.1, splat_brightness=0.15)


class Scene:
    """The table in some worlds, settled, and a picture of it."""

    def __init__(self, worlds: int) -> None:
        """Build model and solver, let everything fall, and draw a view per world."""
        soft, figure = load(), make_plush(2000, height=0.07)
        figure = figure.transformed(translation=-figure.bounds().mean(axis=0))
        figure = replace(figure, sh=figure.sh[:, :, ::-1])  # red and blue swapped
        world, half = newton.ModelBuilder(), 0.5 * np.ptp(figure.bounds(), axis=0)
        SolverMuJoCo.register_custom_attributes(world)
        add_arm(world)
        below = wp.transform((0.35, 0.0, -0.03), wp.quat_identity())
        world.add_shape_box(-1, xform=below, hx=0.5, hy=0.6, hz=0.03, color=(0.62, 0.56, 0.5), label="table")
        toy = world.add_body(xform=wp.transform((*TOY, half[2] + DROP), wp.quat_identity()), label="toy")
        world.add_shape_box(toy, hx=half[0], hy=half[1], hz=half[2])
        add_reduced_body(world, soft.body, material=Material(youngs_modulus=2e4), position=(*PLUSH, soft.height + DROP))
        builder = newton.ModelBuilder()
        builder.replicate(world, worlds)
        model: Any = builder.finalize()
        self.state, after, control = model.state(), model.state(), model.control()
        newton.eval_fk(model, model.joint_q, model.joint_qd, self.state)
        solver = SolverCoupledReduced(model, [soft.body], rigid=SolverMuJoCo(model, njmax=64, nconmax=32))
        for _ in range(60):
            solver.step(self.state, after, control, None, DT)
            solver.step(after, self.state, control, None, DT)
        self.toy = RigidSplatsSkin(model, [RigidSplats(splats=figure, body="toy", hide_meshes=True)])
        self.bound = BoundSplats(model, [soft], others=self.toy.objects)
        look, up = PinholeCamera.look_at, (1.0, 0.0, 0.0)
        fixed = look("fixed", position=(0.85, -0.25, 0.25), target=(0.46, 0.015, 0.03), fov_y=0.48)
        wrist = look("wrist", body="link7", position=(0.1, 0.0, 0.03), target=(0.02, 0.0, 0.3), up=up, fov_y=1.0)
        options, median = CameraOptions(segmentation=True, mesh_samples=4), RasterizerOptions(median_depth=True)
        splats, given = self.bound.arrays, {"options": options, "rasterizer_options": median, "randomization": DRAWN}
        self.camera = SplatCamera(model, splats, (fixed, wrist), **given)
        self.bound.update(self.state)
        self.toy.launch(self.state, splats)
        self.camera.randomize()
        self.camera.render(self.state)

    def points(self, name: str) -> np.ndarray:
        """Unproject depth: points in the world [m], shape (worlds, height, width, 3)."""
        fx, fy, cx, cy = (k[:, None, None] for k in self.camera.intrinsics(name).numpy().T)
        (v, u), z = np.mgrid[:128, :128] + 0.5, self.camera.images(name, "median_depth").numpy()
        local, matrix = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], -1), self.camera.extrinsics(name).numpy()
        return np.einsum("wyxi,wij->wyxj", local - matrix[:, None, None, :3, 3], matrix[:, :3, :3])


def test_final(scene: Scene) -> None:
    """Both toys stand, one of them rigid; every view of every world sees plush, toy and table where they are."""
    camera, pixel = scene.camera, 0.005  # [m], seen at grazing angles
    toys = scene.bound.arrays.means.numpy()[:, scene.bound.columns[1]]
    solids = scene.state.particle_q.numpy().reshape(camera.world_count, -1, 3), toys
    assert all(np.abs(solid[..., 2].min(axis=1)).max() < 2e-3 for solid in solids)
    rest, now = (np.linalg.norm(np.diff(x, axis=-2), axis=-1) for x in (scene.toy.objects[0].means, toys))
    assert np.abs(now - rest).max() < 1e-6, "rigid"
    for name in ("fixed", "wrist"):
        points, seen = scene.points(name), camera.images(name, "segmentation").numpy()
        for world, index in np.ndindex(camera.world_count, 2):
            pixels, solid = points[world][seen[world] == index], solids[index][world]
            assert len(pixels) > 200 and (np.abs(pixels - np.clip(pixels, solid.min(0), solid.max(0))) < pixel).all()
        assert np.abs(points[seen == camera.segmentation_ids("*/table")[0]][:, 2]).max() < 0.5 * pixel
        assert np.abs(np.diff(camera.images(name).numpy().astype(int), axis=0)).mean() > 3.0, "worlds look different"


def main() -> None:
    """Write the contact sheet: fixed camera, wrist camera, depth, segmentation."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--short", action="store_true", help="two worlds, not four")
    camera = (scene := Scene(2 if parser.parse_args().short else 4)).camera
    depth, seen = (camera.images("fixed", output).numpy()[..., None] for output in ("depth", "segmentation"))
    gray = np.where(depth > 0.0, 510.0 * np.clip(1.0 - depth, 0.0, 0.5), 0.0) * np.ones(3)
    pictures = [*(camera.images(name).numpy() for name in ("fixed", "wrist")), gray, (seen + 1) * (97, 61, 151) % 256]
    Path("out").mkdir(exist_ok=True)
    sheet = np.hstack([np.vstack(list(column)) for column in pictures]).astype(np.uint8)
    Image.fromarray(sheet).save("out/splat_camera.png")
    print(f"out/splat_camera.png: {camera.world_count} worlds from fixed and wrist cameras, depth, segmentation")
    test_final(scene)


if __name__ == "__main__":
    main()
