"""`rest_grasps`: the grasps of a body that stands as it is built."""

from __future__ import annotations

import numpy as np

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.deformables.reduction.body_modes import surface_modes
from softmode.robots.grasp_planner import Grasp, plan_grasps
from softmode.robots.jaws import ParallelJaw


def rest_grasps(
    body: ReducedBody,
    jaw: ParallelJaw,
    *,
    density: float = 300.0,
    youngs_modulus: float | None = None,
    friction: float = Material().friction,
) -> tuple[Grasp, ...]:
    """Return the best grasps of a body that stands as it is built, in the body frame.

    Args:
        body: The body.
        jaw: The gripper.
        density: Density [kg/m^3].
        youngs_modulus: Young's modulus [Pa]; None for a body that counts as rigid, which takes less time.
        friction: Coulomb's coefficient between pads and body.

    Raises:
        GraspError: If none fits.
    """
    weight = 9.81 * density * body.volume
    return plan_grasps(
        body.surface.points,
        body.surface.normals,
        body.surface.areas,
        jaw,
        friction=friction,
        force=max(6.0, 2.5 * weight / friction),
        weight=weight,
        centre=np.zeros(3),
        modes=None if youngs_modulus is None else surface_modes(body) / np.sqrt(youngs_modulus),
        ground=float(body.surface.points[:, 2].min()),
        count=3,
    )
