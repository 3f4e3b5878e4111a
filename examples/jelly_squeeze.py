"""Four jellies between frictionless plates: how much volume each energy keeps, beside closed forms.

A plate comes down to 60 % of the height. ARAP, the energy of many tools for captures, does not know of volume: it
keeps 60 %. At a Poisson's ratio of 0.45 Neo-Hookean energies keep 93 %. The bars show what is left of each.

Run: ``python examples/jelly_squeeze.py [--video out/jelly_squeeze.mp4] [--short]``
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp

from softmode.deformables import Material, MaterialModel, SolverReduced, SolverReducedOptions, add_reduced_body
from softmode.objects import load
from softmode.scenes import BoundSplats
from softmode.splats import PinholeCamera, SplatCamera
from softmode.viz import Film

EDGE, STRETCH, DT = 0.1, 0.6, 1.0 / 120.0
"""Edge of a cube [m], height of the gap at the end over it, physics step [s]."""
KEPT = {
    MaterialModel.ARAP: 0.600,
    MaterialModel.NEO_HOOKEAN: 0.939,
    MaterialModel.STABLE_NEO_HOOKEAN: 0.933,
    MaterialModel.STABLE_NEO_HOOKEAN_LOG: 0.927,
}
"""V / V_0 of diag(t, t, s) with no stress on the sides, at s = 0.6 and nu = 0.45; the last is the default energy."""
GEL = Material(youngs_modulus=2.0e4, poissons_ratio=0.45, density=1000.0, friction=0.0, mass_damping=20.0)


class Press:
    """The cubes, the plates, and what is left of each cube."""

    def __init__(self, edge: int) -> None:
        """Build a row of cubes, one for each energy, between two plates."""
        options = {"extents": (EDGE, EDGE, EDGE), "colors": ((0.85, 0.25, 0.35), (0.97, 0.62, 0.55))}
        self.thing = load(shape="box", **options, material=GEL, surface_count=200, splat_count=1500)
        world = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        smooth = newton.ModelBuilder.ShapeConfig(mu=0.0)
        places = 0.2 * (np.arange(len(KEPT)) - 0.5 * (len(KEPT) - 1))
        for side in (-1.0, 1.0):
            at = wp.transform((0.0, 0.0, side * (0.5 * EDGE + 0.01)), wp.quat_identity())
            world.add_shape_box(-1, xform=at, hx=0.42, hy=0.11, hz=0.01, cfg=smooth, color=(0.55, 0.57, 0.60))
        for model, x in zip(KEPT, places, strict=True):
            material, stiff = replace(GEL, model=model), {"contact_stiffness_per_area": 1.0e9}
            add_reduced_body(world, self.thing.body, material=material, position=(float(x), 0.0, 0.0), **stiff)
        self.model = world.finalize()
        how = SolverReducedOptions(contact_smoothing=1.0e-5)
        self.solver = SolverReduced(self.model, [self.thing.body], options=how)
        self.states: list[Any] = [self.model.state(), self.model.state()]
        self.splats = BoundSplats(self.model, [self.thing] * len(KEPT))
        eye, target = (0.0, -1.1, 0.12), (0.0, 0.0, -0.02)
        view = PinholeCamera.look_at("film", position=eye, target=target, width=3 * edge, height=edge, fov_y=0.28)
        self.camera = SplatCamera(self.model, self.splats.arrays, [view])

    def lower(self, gap: float) -> None:
        """Move the plates to a distance [m] and take two steps."""
        poses = self.model.shape_transform.numpy()
        poses[:2, 2] = np.array([-1.0, 1.0]) * (0.5 * gap + 0.01)
        self.model.shape_transform.assign(poses)
        for first, second in (self.states, self.states[::-1]):
            self.solver.step(first, second, self.model.control(), None, DT)

    def gradients(self) -> np.ndarray:
        """Return the mean deformation gradient of each cube, shape (4, 3, 3)."""
        body = self.thing.body
        mean = np.einsum("p,pkd->kd", body.cubature.weights, body.cubature.grad_basis) / body.volume
        q = self.states[0].softmode.q.numpy().reshape(len(KEPT), -1, 3)
        return np.eye(3) + np.einsum("bkc,kd->bcd", q, mean)

    def picture(self) -> np.ndarray:
        """Return a picture with a bar of each cube's volume below it."""
        self.splats.update(self.states[0])
        self.camera.render(self.states[0])
        image = self.camera.images("film").numpy()[0].copy()
        height, width = image.shape[:2]
        for k, volume in enumerate(np.linalg.det(self.gradients())):
            left, long = int((0.12 + 0.215 * k) * width), int(0.12 * width)
            image[int(0.9 * height) : int(0.94 * height), left : left + long] = 90
            image[int(0.9 * height) : int(0.94 * height), left : left + int(volume * long)] = (80, 200, 120)
        return image


def test_final(press: Press) -> None:
    """Each cube has the volume of its closed form to 2e-3, at the height of the gap, and is at rest."""
    found = press.gradients()
    np.testing.assert_allclose(found[:, 2, 2], STRETCH, atol=2e-3)
    np.testing.assert_allclose(np.linalg.det(found), list(KEPT.values()), atol=2e-3)
    assert np.abs(press.states[0].softmode.qd.numpy()).max() < 1e-3
    assert not press.solver.status.numpy().any()


def main() -> None:
    """Film the press and print the volumes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--video", type=Path, default=Path("out/jelly_squeeze.mp4"))
    parser.add_argument("--short", action="store_true", help="small pictures")
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    press = Press(96 if given.short else 320)
    with Film(given.video) as film:
        for k in range(100):
            film.add(press.picture(), round(0.5 / DT))
            press.lower(EDGE * max(1.0 - (1.0 - STRETCH) * k / 60.0, STRETCH))
        film.publish()
    for (model, kept), volume in zip(KEPT.items(), np.linalg.det(press.gradients()), strict=True):
        print(f"{model.name.lower():24s} keeps {volume:.4f} of its volume, closed form {kept:.3f}")
    print(f"wrote {film.path} and {film.sheet_path}")
    test_final(press)


if __name__ == "__main__":
    main()
