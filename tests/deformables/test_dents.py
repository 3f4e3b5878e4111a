"""Dents: what a contact gives beyond the functions of the body, against Hertz, punches and conservation of energy."""

import functools

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.build.build_body import build_body
from softmode.deformables.build.options import BuildOptions
from softmode.deformables.build.quadrature import quadrature_from_box, quadrature_from_sphere
from softmode.deformables.contact.dents import DENT_FACTOR, dent_lengths, resolved_size
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from tests.scenes import GRAVITY, Scene, cube

RADIUS, RATIO = 0.05, 0.3
SHAPE = 0.02
"""Half the height of what presses [m]."""
MANY = SolverReducedOptions(contact_max=2048)
FINITE = ((0.0, 0.01, 0.02, 0.04, 0.08, 0.11), (1.0, 1.02, 1.10, 1.12, 1.18, 1.23))
"""Force of a sphere between plates over Hertz's by depth over radius: 2,600 kernels, linear elasticity; the far field
of each contact moves the centre."""


@functools.cache
def ball(mode_count: int = 8, surface_count: int = 1500) -> ReducedBody:
    """Return a sphere of few functions and many samples."""
    quadrature = quadrature_from_sphere(RADIUS, point_count=3000, surface_count=surface_count)
    options = BuildOptions(mode_count=mode_count, kernel_count=250, cubature_count=300)
    return build_body(quadrature, options, name="ball")


def hertz(depth: float, youngs_modulus: float) -> float:
    """Return the force of a sphere pressed by a rigid plane [N]: 4/3 E* sqrt(R) d^(3/2), for a sphere between two."""
    modulus = youngs_modulus / (1.0 - RATIO**2)
    return 4.0 / 3.0 * modulus * RADIUS**0.5 * depth**1.5 * float(np.interp(depth / RADIUS, *FINITE))


class Press:
    """Bodies in a row along z between two rigid shapes that overlap them, without friction and gravity.

    Args:
        body: The body.
        half_height: Half its height [m].
        count: How many stand in the row.
        punch: Radius of the cylinders that press [m]; None for plates.
        youngs_modulus: E [Pa].
        scale: Of the bodies.
        stiffness: Contact stiffness per area [Pa/m]; None for the one that follows the body.
    """

    def __init__(
        self,
        body: ReducedBody,
        half_height: float,
        *,
        count: int = 1,
        punch: float | None = None,
        youngs_modulus: float = 1.0e6,
        scale: float = 1.0,
        stiffness: float | None = None,
    ) -> None:
        """Build the scene."""
        self.half, self.count = scale * half_height, count
        material = Material(
            youngs_modulus=youngs_modulus, poissons_ratio=RATIO, density=300.0, friction=0.0, mass_damping=50.0
        )

        def populate(world: newton.ModelBuilder) -> None:
            for k in range(count):
                place = (0.0, 0.0, (2 * k + 1 - count) * self.half)
                add_reduced_body(
                    world,
                    body,
                    material=material,
                    position=place,
                    scale=scale,
                    contact_stiffness_per_area=stiffness,
                )
            for _ in range(2):
                shape = world.add_body(is_kinematic=True)
                if punch is None:
                    world.add_shape_box(shape, hx=0.1, hy=0.1, hz=SHAPE)
                else:
                    world.add_shape_cylinder(shape, radius=punch, half_height=SHAPE)

        self.scene = Scene(populate, [body], options=MANY, dt=0.01)

    def force(self, depth: float, steps: int = 40) -> float:
        """Press by ``depth`` [m] at every contact and return the force on the lower shape [N]."""
        scene, end = self.scene, self.count * (self.half - depth) + SHAPE
        scene.restart()
        for k in range(self.count):
            closer = np.array([0.0, 0.0, -(2 * k + 1 - self.count) * depth])
            scene.set(q=scene.q(k) + scene.body(k).linear_coordinates[:, 3:] * closer, instance=k)
        poses = np.array([[0.0, 0.0, side * end, 0.0, 0.0, 0.0, 1.0] for side in (-1, 1)], dtype=np.float32)
        for state in (scene.state, scene.next_state):
            state.body_q.assign(poses)
        scene.step(steps)
        constraints = scene.reduced.view.constraints
        count = int(constraints.count.numpy()[0])
        below = constraints.shape.numpy()[0, :count] == 0
        return float(constraints.force.numpy()[0, :count][below, 2].sum())
