"""Parameters of a live scene: checked, written into the model while it runs, read back."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from softmode.checks import require_number
from softmode.deformables.coupling.solver_coupled import SolverCoupledReduced
from softmode.deformables.model.namespaces import soft
from softmode.deformables.tools.parameters import PARAMETER_LIMITS, set_parameters
from softmode.errors import ConfigError
from softmode.scenes.host import host
from softmode.scenes.scene import Scene
from softmode.view.live_types import LiveParameters, finite_vector

LIMITS = {name: PARAMETER_LIMITS[name] for name in ("youngs_modulus", "poissons_ratio", "density", "friction")}
"""Closed ranges of the parameters that other quantities follow, and"""
DAMPING_LIMITS = {"viscosity": (0.0, 10.0), "mass_damping": (0.0, 1.0e4)}
"""of those that every step reads anew."""
GRAVITY_MAX = 1000.0
"""Largest gravity [m/s^2]."""


def checked(gravity: float | ArrayLike | None, values: dict[str, float | None]) -> dict[str, Any]:
    """Return the values that are given, gravity as a vector.

    Raises:
        ConfigError: If one lies outside its range.
    """
    limits, chosen = LIMITS | DAMPING_LIMITS, {}
    for name, value in values.items():
        if value is None:
            continue
        require_number(name, value, at_least=limits[name][0], at_most=limits[name][1])
        chosen[name] = float(value)
    if gravity is not None:
        downwards = isinstance(gravity, int | float | np.number)
        vector = finite_vector("gravity", (0.0, 0.0, -float(gravity)) if downwards else gravity)  # type: ignore[arg-type]
        if np.linalg.norm(vector) > GRAVITY_MAX:
            raise ConfigError(f"gravity must be at most {GRAVITY_MAX:g} m/s^2, got {gravity!r}")
        chosen["gravity"] = tuple((vector + 0.0).tolist())
    return chosen


def apply(scene: Scene, given: dict[str, Any]) -> None:
    """Write what was given into the model, for all objects; the captured steps follow."""
    data, device = soft(scene.model), scene.model.device
    shape = data.friction.shape
    arrays = {name: wp.full(shape, given[name], dtype=float, device=device) for name in LIMITS if name in given}
    if arrays:
        set_parameters(scene.solver, **arrays)
    for name in DAMPING_LIMITS:
        if name in given:
            getattr(data, name).fill_(given[name])
    if "gravity" in given:
        scene.model.set_gravity(given["gravity"])
        if isinstance(scene.solver, SolverCoupledReduced):  # its MuJoCo keeps its own
            scene.solver.rigid.notify_model_changed(newton.ModelFlags.MODEL_PROPERTIES)


def present(scene: Scene) -> LiveParameters:
    """Return the values of the first object."""
    data = soft(scene.model)
    values = {name: float(getattr(data, name).numpy()[0]) for name in LIMITS | DAMPING_LIMITS}
    x, y, z = (host(scene.model.gravity)[0] + 0.0).tolist()
    return LiveParameters(**values, gravity=(x, y, z), functions=scene.objects[0].body.function_count)
