"""How much volume each material keeps when a cube is pressed between frictionless plates: closed forms and the solver.

At an axial stretch s with free sides the deformation is diag(t, t, s), and t solves P_11(diag(t, t, s)) = 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp
from newton import ModelBuilder
from scipy.optimize import brentq

from softmode.deformables.materials.material import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from tests import reference
from tests.deformables.affine_body import affine_cube, mean_gradient
from tests.scenes import Scene

MODELS = (
    MaterialModel.ARAP,
    MaterialModel.NEO_HOOKEAN,
    MaterialModel.STABLE_NEO_HOOKEAN,
    MaterialModel.STABLE_NEO_HOOKEAN_LOG,
    MaterialModel.COROTATED,
    MaterialModel.STVK,
)
KEPT = {
    (0.8, 0.30): (0.8000, 0.9114, 0.9000, 0.8981, 0.9025, 0.8864),
    (0.8, 0.45): (0.8000, 0.9759, 0.9750, 0.9738, 0.9740, 0.9296),
    (0.8, 0.49): (0.8000, 0.9950, 0.9950, 0.9947, 0.9947, 0.9411),
    (0.6, 0.30): (0.6000, 0.8004, 0.7333, 0.7278, 0.7566, 0.7152),
    (0.6, 0.45): (0.6000, 0.9391, 0.9333, 0.9265, 0.9275, 0.7728),
    (0.6, 0.49): (0.6000, 0.9869, 0.9867, 0.9851, 0.9851, 0.7882),
    (0.5, 0.45): (0.5000, 0.9124, 0.9000, 0.8870, 0.8889, 0.6687),
}
"""V / V0 by (axial stretch, Poisson's ratio), in the order of MODELS."""
E = 1.0e5


def kept_volume(model: MaterialModel, stretch: float, nu: float) -> float:
    """Return s t^2 of the closed form."""
    moduli = reference.lame(E, nu)

    def lateral_stress(t: float) -> float:
        return reference.stress(model, np.diag([t, t, stretch]), *moduli)[0, 0]

    t: Any = brentq(lateral_stress, 0.9, 1.5, xtol=1e-12)
    return stretch * t * t


@pytest.mark.parametrize(("stretch", "nu"), KEPT)
def test_closed_form(stretch, nu):
    """The table's four digits are what P_lateral = 0 gives."""
    kept = [kept_volume(model, stretch, nu) for model in MODELS]
    np.testing.assert_allclose(kept, KEPT[stretch, nu], atol=5.1e-5)


@pytest.mark.parametrize("stretch", sorted({stretch for stretch, _ in KEPT}))
def test_cube_between_plates(stretch):
    """A cube started at diag(1, 1, s) between two fixed frictionless plates settles at the table's volume, to 2e-3.

    One world per material and Poisson's ratio. The plates' penalty gives way by P / k, at most 1e5 / 1e9 m each.
    """
    body = affine_cube()
    cases = [
        (model, nu, kept)
        for (s, nu), row in KEPT.items()
        if s == stretch
        for model, kept in zip(MODELS, row, strict=True)
    ]

    def populate(world: ModelBuilder) -> None:
        material = Material(youngs_modulus=E, density=1000.0, friction=0.0, mass_damping=20.0)
        add_reduced_body(world, body, material=material, contact_stiffness_per_area=1.0e9)
        for side in (-1.0, 1.0):
            pose = wp.transform(wp.vec3(0.0, 0.0, side * (0.5 * stretch + 0.5)), wp.quat_identity())
            config = ModelBuilder.ShapeConfig(mu=0.0)
            world.add_shape_box(-1, xform=pose, hx=2.0, hy=2.0, hz=0.5, cfg=config)

    options = SolverReducedOptions(contact_smoothing=1.0e-5)
    scene = Scene(populate, [body], world_count=len(cases), dt=0.02, options=options)
    scene.set_parameter("poissons_ratio", [nu for _, nu, _ in cases])
    models = scene.model.softmode.material_model
    models.assign(np.array([int(model) for model, _, _ in cases], np.int32))
    scene.solver.notify_model_changed(0)
    for i in range(len(cases)):
        scene.set(q=body.affine(np.diag([1.0, 1.0, stretch])), instance=i)
    scene.step(120)
    assert not scene.reduced.status.numpy().any()
    F = np.stack([mean_gradient(body, scene.q(i)) for i in range(len(cases))])
    assert np.abs([scene.qd(i) for i in range(len(cases))]).max() < 1e-4  # at rest
    np.testing.assert_allclose(F[:, 2, 2], stretch, atol=3e-4)
    np.testing.assert_allclose(np.linalg.det(F), [kept for _, _, kept in cases], atol=2e-3)
