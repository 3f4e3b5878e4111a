"""Masses, sizes and tolerances of the instances, which follow from density and scale; see ``docs/bodies.md``."""

import newton
import numpy as np
import warp as wp

from softmode.deformables.model import parameter_kernels as kernels
from softmode.deformables.model.declare import launch
from softmode.deformables.model.layout import Layout
from softmode.deformables.model.namespaces import soft
from softmode.deformables.model.struct_kernels import Instances
from softmode.deformables.model.tables import allocate, host


class ScaledQuantities:
    """What has a size at scale 1, and the launches that compute it for the bodies as they are scaled.

    Args:
        model: Finalised model.
        layout: Its layout.
        instances: Instances whose sizes, masses and tolerances are computed.
        tolerance: Newton's tolerance as a fraction of the size.
        margin: Detection distance of contact as a fraction of the size.
        smoothing: Range of its onset as a fraction of the size.
    """

    def __init__(
        self,
        model: newton.Model,
        layout: Layout,
        instances: Instances,
        *,
        tolerance: float,
        margin: float,
        smoothing: float,
    ) -> None:
        """Gather what the bodies are at scale 1."""
        self.model, self.layout, self.instances = model, layout, instances
        asset, bodies, size, device = layout.asset, layout.bodies, layout.size, model.device
        rest = {
            "volume": np.array([body.volume for body in bodies])[asset],
            "area": np.array([body.surface.areas.sum() for body in bodies])[asset],
            "size": size,
            "tolerance": tolerance * size,
            "margin": margin * size,
            "smoothing": smoothing * size,
            "spacing": np.array([np.sqrt(body.surface.areas.mean()) for body in bodies])[asset],
            "radius": self._rest_radii(),
        }
        self.rest = allocate(kernels.RestQuantities, "", {}, device, given=rest)
        self.spacing = wp.zeros(layout.instance_count, dtype=float, device=device)
        """Spacing of the surface samples of each instance [m]."""
        self.rigid_tolerance = wp.zeros(layout.world_count, dtype=float, device=device)
        """Least tolerance of the bodies of each world [m]."""
        self.instance_start = wp.array(layout.instance_start, dtype=int, device=device)

    def _rest_radii(self) -> np.ndarray:
        """Return the particle radii that the bodies would have at scale 1 [m], shape (particle_count,)."""
        data, layout = soft(self.model), self.layout
        radii, placed = (host(a).astype(float) for a in (self.model.particle_radius, data.placed_scale))
        for i, first in enumerate(data.particle_start.numpy()):
            radii[first : first + layout.bodies[layout.asset[i]].surface_count] /= placed[i]
        return radii

    def derive(self, world_mask: wp.array) -> None:
        """Compute what follows from density and scale in the masked worlds."""
        model, instances, given = self.model, self.instances, soft(self.model)
        masked = (given.instance_world, world_mask)
        count, device = self.layout.instance_count, model.device
        scaled = (given.scale, given.density, *masked)
        launch(device, kernels.derive_quantities, count, self.rest, *scaled, instances, self.spacing)
        tolerances = (self.instance_start, instances, self.rigid_tolerance)
        launch(device, kernels.derive_tolerances, self.layout.world_count, *tolerances)
        particles = (model.particle_radius, model.particle_mass, model.particle_inv_mass)
        samples = (count, self.layout.sample_max)
        launch(device, kernels.derive_particles, samples, self.rest, instances, *masked, *particles)
