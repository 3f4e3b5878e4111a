"""Masses, sizes and tolerances of the instances, which follow from density and scale; see ``docs/bodies.md``."""

from typing import Any

import numpy as np
import warp as wp

from softmode.deformables.model import parameter_kernels as kernels
from softmode.deformables.model.layout import Layout


class Sizes:
    """What has a size at scale 1, and the launches that make it so for the bodies as they are scaled.

    Args:
        model: Finalised model.
        layout: Its layout, whose ``instances`` gain their arrays of sizes here.
        parameters: ``model.softmode``.
        tolerance: Newton's tolerance as a fraction of the size; likewise
        margin: detection distance of contact, and
        smoothing: range of its onset.
    """

    def __init__(
        self, model: Any, layout: Layout, parameters: Any, *, tolerance: float, margin: float, smoothing: float
    ) -> None:
        """Allocate everything once."""
        self.model, self.layout, self.parameters = model, layout, parameters
        self.rest: Any = kernels.RestSizes()
        asset, bodies = layout.asset, layout.bodies
        area = np.array([body.surface_areas.sum() for body in bodies])
        spacing = np.array([np.sqrt(body.surface_areas.mean()) for body in bodies])
        lengths = {
            "area": area[asset],
            "size": layout.size,
            "tolerance": tolerance * layout.size,
            "margin": margin * layout.size,
            "smoothing": smoothing * layout.size,
            "spacing": spacing[asset],
        }
        instances: Any = layout.instances
        for name, values in lengths.items():
            setattr(self.rest, name, self._array(values, float))
        for name in ("area", "size", "tolerance", "margin", "smoothing"):
            setattr(instances, name, wp.clone(getattr(self.rest, name)))
        self.rest.volume = self._array(np.array([body.volume for body in bodies])[asset], wp.float64)
        self.rest.radius = self._array(self._rest_radii(), float)
        count = layout.instance_count
        instances.scale = self._array(np.ones(count), float)
        instances.mass = self._array(np.zeros(count), wp.float64)
        instances.inertia = self._array(np.zeros(count), float)
        self.spacing = self._array(spacing[asset], float)
        """Spacing of the surface samples of each instance [m]."""
        self.rigid_tolerance = self._array(np.zeros(layout.world_count), float)
        """Least tolerance of the bodies of each world [m]."""
        self.instance_start = self._array(layout.instance_start, int)

    def _array(self, values: np.ndarray, dtype: Any) -> Any:
        return wp.array(values, dtype=dtype, device=self.model.device)

    def _rest_radii(self) -> np.ndarray:
        """Return the particle radii that the bodies would have at scale 1 [m], shape (particle_count,)."""
        radii = self.model.particle_radius.numpy().astype(float)
        placed = self.parameters.placed_scale.numpy().astype(float)
        for i, first in enumerate(self.parameters.particle_start.numpy()):
            radii[first : first + self.layout.bodies[self.layout.asset[i]].surface_count] /= placed[i]
        return radii

    def derive(self, world_mask: wp.array) -> None:
        """Compute what follows from density and scale in the masked worlds."""
        model, instances, given = self.model, self.layout.instances, self.parameters
        masked = [given.instance_world, world_mask]
        count, device = self.layout.instance_count, model.device
        wp.launch(
            kernels.derive_sizes,
            dim=count,
            inputs=[self.rest, given.scale, given.density, *masked],
            outputs=[instances, self.spacing],
            device=device,
        )
        wp.launch(
            kernels.derive_tolerances,
            dim=self.layout.world_count,
            inputs=[self.instance_start, instances],
            outputs=[self.rigid_tolerance],
            device=device,
        )
        wp.launch(
            kernels.derive_particles,
            dim=(count, self.layout.sample_max),
            inputs=[self.rest, instances, *masked],
            outputs=[model.particle_radius, model.particle_mass, model.particle_inv_mass],
            device=device,
        )
