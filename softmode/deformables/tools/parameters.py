"""Parameters that are set on the device, per world and inside a captured graph, as randomised tasks do."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from softmode.deformables.model import parameter_kernels as kernels
from softmode.deformables.model.authoring import SCALE_MAX, SCALE_MIN
from softmode.deformables.model.tables import host
from softmode.deformables.solver.solver_base import ReducedSolver, require_reduced
from softmode.errors import ConfigError

PARAMETER_LIMITS: dict[str, tuple[float, float]] = {
    "youngs_modulus": (1.0, 1.0e12),
    "poissons_ratio": (-0.99, 0.4999),
    "density": (1.0e-3, 1.0e6),
    "friction": (0.0, 100.0),
    "scale": (SCALE_MIN, SCALE_MAX),
}
"""Closed ranges that values are clamped to, inside the open ones of ``Material``."""
PARAMETER_FLAGS = {name: 1 << k for k, name in enumerate(PARAMETER_LIMITS)} | {"held_scale": 32}
"""Bits of what :func:`set_parameters` returns; "held_scale": the body is pinned or driven and kept its scale."""


def set_parameters(
    solver: ReducedSolver,
    world_mask: wp.array | None = None,
    *,
    youngs_modulus: wp.array | None = None,
    poissons_ratio: wp.array | None = None,
    density: wp.array | None = None,
    friction: wp.array | None = None,
    scale: wp.array | None = None,
) -> wp.array:
    """Set parameters of the soft bodies of the masked worlds, with all that follows from them.

    Reads nothing back and may be captured; other worlds keep every bit. A change of ``scale`` is for a reset: call
    ``solver.reset`` for the same worlds afterwards, which places the bodies at their new size about their centres of
    mass; a state of the old size would be one under stress. A body that has pins or exact regions keeps its scale.

    Args:
        solver: A :class:`softmode.deformables.solver.solver_reduced.SolverReduced`, or a solver that couples one.
        world_mask: Boolean mask of shape (world_count + 1,) as for ``reset``; None for all worlds.
        youngs_modulus: E [Pa], float32, shape (instance_count,), on the solver's device, as all that follow; None
            leaves it.
        poissons_ratio: nu.
        density: rho [kg/m^3].
        friction: Coulomb coefficient of the surface.
        scale: Size over that of the asset.

    Returns:
        Bits of ``PARAMETER_FLAGS`` per instance of the masked worlds, int32, shape (instance_count,), an array of the
        solver's: which values lay outside ``PARAMETER_LIMITS`` and were clamped or, where no number, left.

    Raises:
        ConfigError: If an array has another shape or type or lies on another device, or the mask has.
    """
    tables = require_reduced(solver).tables
    given, parameters = kernels.Parameters(), kernels.Parameters()
    named = {
        "youngs_modulus": youngs_modulus,
        "poissons_ratio": poissons_ratio,
        "density": density,
        "friction": friction,
        "scale": scale,
    }
    for name, values in named.items():
        own = getattr(tables.parameters, name)
        setattr(parameters, name, own)
        setattr(given, name, own if values is None else _checked(name, values, own))
    limits = [wp.vec2(*PARAMETER_LIMITS[name]) for name in named]
    mask = solver.checked_mask(world_mask)
    masked = (PARAMETER_FLAGS["held_scale"], tables.parameters.instance_world, mask)
    out = (parameters, tables.parameter_flags)
    tables.launch(
        kernels.write_parameters, tables.layout.instance_count, tables.instances, given, *limits, *masked, *out
    )
    solver.refresh(mask)
    return tables.parameter_flags


class ShapeFriction:
    """Sets the friction of the same rigid shapes in every world, each world its own; contact reads it in every step.

    A contact uses sqrt(friction of body * friction of shape), so where one world is to have one coefficient give it to
    both. Contact between rigid shapes is MuJoCo's: it follows after
    ``solver.rigid.notify_model_changed(newton.ModelFlags.SHAPE_PROPERTIES)``.

    Args:
        solver: As for :func:`set_parameters`.
        shapes: Indices of shapes in the builder of one world.

    Raises:
        ConfigError: If there is no shape, or a world has not all of them: a shape outside all worlds, as a ground plane
            added after ``replicate``, has one friction for all.
    """

    def __init__(self, solver: ReducedSolver, shapes: Sequence[int]) -> None:
        """Find the shapes of every world."""
        self._solver = require_reduced(solver)
        model, worlds = solver.model, solver.world_count
        owner = host(model.shape_world)[: model.shape_count] if model.shape_count else np.zeros(0, int)
        chosen, table = [int(s) for s in shapes], []
        for w in range(worlds):
            mine = np.flatnonzero((owner == w) | ((owner < 0) & (worlds == 1)))
            if not chosen or min(chosen) < 0 or max(chosen) >= len(mine):
                raise ConfigError(
                    f"shapes must hold indices in 0..{len(mine) - 1} of world {w}, got {chosen}",
                    hint="add the shapes to the builder that is replicated, and pass what add_shape_* returned there",
                )
            table.append(mine[chosen])
        self._shape = wp.array(np.array(table), dtype=int, device=model.device)
        self._flags = wp.zeros(worlds, dtype=int, device=model.device)

    def set(self, friction: wp.array, world_mask: wp.array | None = None) -> wp.array:
        """Set the friction of the shapes in the masked worlds; reads nothing back and may be captured.

        Args:
            friction: Coulomb coefficient per world, float32, shape (world_count,), on the solver's device.
            world_mask: As for :func:`set_parameters`.

        Returns:
            ``PARAMETER_FLAGS["friction"]`` per masked world whose value was clamped or, where no number, left.

        Raises:
            ConfigError: As :func:`set_parameters`.
        """
        values, mask = _checked("friction", friction, self._flags), self._solver.checked_mask(world_mask)
        given = (self._shape, values, wp.vec2(*PARAMETER_LIMITS["friction"]), PARAMETER_FLAGS["friction"], mask)
        out = (self._solver.model.shape_material_mu, self._flags)
        self._solver.tables.launch(kernels.write_shape_friction, self._solver.world_count, *given, *out)
        return self._flags


def _checked(name: str, values: Any, like: Any) -> wp.array:
    """Return an array of float32 of the shape and on the device of another.

    Raises:
        ConfigError: If it is not one.
    """
    found: Any = type(values)
    if isinstance(values, wp.array):
        given: Any = values
        if (given.dtype, given.shape, given.device) == (wp.float32, like.shape, like.device):
            return given
        found = f"{given.dtype.__name__} {given.shape} on {given.device}"
    raise ConfigError(f"{name} must be a wp.array of float32, shape {like.shape}, on {like.device}, got {found}")
