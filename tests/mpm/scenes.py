"""Small bodies of particles for the tests."""

from __future__ import annotations

import numpy as np

from softmode.deformables import Material
from softmode.mpm import MORPH_MATERIAL, MpmOptions, MpmSimulation, ParticleBody, particles_from_shape


def ball(radius: float, spacing: float = 0.5, material: Material = MORPH_MATERIAL) -> ParticleBody:
    """Return a ball about the origin."""
    return particles_from_shape(
        lambda x: (x**2).sum(axis=1) <= radius**2,
        [[-radius] * 3, [radius] * 3],
        spacing=spacing,
        material=material,
    )


def torus(major: float, minor: float, spacing: float = 0.5, material: Material = MORPH_MATERIAL) -> ParticleBody:
    """Return a torus around z."""
    reach = major + minor
    return particles_from_shape(
        lambda x: (np.hypot(x[:, 0], x[:, 1]) - major) ** 2 + x[:, 2] ** 2 <= minor**2,
        [[-reach, -reach, -minor], [reach, reach, minor]],
        spacing=spacing,
        material=material,
    )


def moving(body: ParticleBody, options: MpmOptions, *, seed: int = 0, **arguments: int | bool) -> MpmSimulation:
    """Return a simulation with random velocities and controls."""
    rng = np.random.default_rng(seed)
    found = MpmSimulation(body, options, device="cpu", **arguments)
    found.start(
        v=rng.standard_normal((1, body.count, 3)),
        C=0.5 * rng.standard_normal((1, body.count, 3, 3)),
        F=np.eye(3) + 0.05 * rng.standard_normal((1, body.count, 3, 3)),
    )
    found.control.assign(0.02 * rng.standard_normal((*found.control.shape, 3, 3)))
    return found
