"""The code that evaluates the materials, and which models each part knows: any other would have no energy there."""

import inspect
import re
from collections.abc import Iterable
from functools import cache

from softmode.deformables.materials import hessian_kernels, material_kernels
from softmode.deformables.materials.material_kernels import (
    MaterialModel,
    energy_and_stress,
    has_rotation,
    invariant_derivatives,
)
from softmode.errors import MaterialError

_ALSO = has_rotation, invariant_derivatives
PATHS = {
    "material_kernels.invariant_energy": (has_rotation, material_kernels.invariant_energy, energy_and_stress),
    "material_kernels.invariant_derivatives": (*_ALSO, energy_and_stress),
    "hessian_kernels.hooke_strain": (*_ALSO, hessian_kernels.hooke_strain),
    "hessian_kernels.principal_hessian": (*_ALSO, hessian_kernels.principal_hessian),
}
"""Functions that together compare a material's model with all that they know."""


@cache
def paths_without(name: str) -> list[str]:
    """Return the paths that compare with no model of a name."""
    compared = re.compile(rf"== (?:int\(MaterialModel\.)?{name}\b")
    texts = {path: [x if isinstance(x, str) else inspect.getsource(x) for x in code] for path, code in PATHS.items()}
    return [path for path, code in texts.items() if not any(map(compared.search, code))]


def require_models(models: Iterable[int]) -> None:
    """Refuse material models that a path does not know.

    Raises:
        MaterialError: If there is one; the message names the paths.
    """
    names = {int(model): model.name for model in MaterialModel}
    for model in models:
        if lacking := paths_without(str(names.get(model))):
            hint = "use a member of MaterialModel; CONTRIBUTING.md says where a new one is written"
            raise MaterialError(f"material model {model!r} is not known to {', '.join(lacking)}", hint=hint)
