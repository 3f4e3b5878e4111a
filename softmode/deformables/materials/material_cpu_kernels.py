"""Device side of the materials on CPU: energy, stress and Hessian of eight points at a time, in vector registers.

The code is written from ``material_kernels`` and ``hessian_kernels``, the functions of a point.
"""

from typing import Any

import warp as wp

from softmode.deformables.materials.hessian_kernels import hessian
from softmode.deformables.materials.material_kernels import determinant_minus_one
from softmode.deformables.materials.material_kernels import energy_and_stress as of_a_point
from softmode.lanes import LANES, lanes_code

wp.set_module_options({"enable_backward": False})

vec8d: Any = wp.types.vector(length=LANES, dtype=wp.float64)
"""A number at eight points."""
mat98d: Any = wp.types.matrix(shape=(9, LANES), dtype=wp.float64)
"""A matrix (3, 3) row by row, at eight points."""
PointLanes: Any = wp.types.matrix(shape=(11, LANES), dtype=wp.float64)
"""Energy density, stress and J at eight points."""
HessianLanes: Any = wp.types.matrix(shape=(54, LANES), dtype=float)
"""The entries of ``hessian_kernels.HessianBlocks`` at eight points."""

_LOADS = """
    Law::MaterialParameters material;
    material.model = model;
    material.viscosity = rate;  // with a step of 1
    wp::mat_t<3, 3, lanes> G, start;
    __builtin_memcpy(&material.mu, &mu_in, sizeof(lanes));
    __builtin_memcpy(&material.lam, &lam_in, sizeof(lanes));
    __builtin_memcpy(&G, &G_in, sizeof(G));
    __builtin_memcpy(&start, &G_start, sizeof(start));
"""
_SAME = "viscosity", "dt"
_APART = "hessian_of_invariants", "singular_values", "principal_hessian", "positive_part", "_block"


@wp.func_native(
    snippet=f"""{{{lanes_code(of_a_point, determinant_minus_one, uniform=_SAME, apart=_APART)}{_LOADS}
    const Law::energy_and_stress_results found = Law::energy_and_stress(material, G, start, 1.0);
    const lanes J = 1.0 + Law::determinant_minus_one(G);
    wp::mat_t<11, 8, wp::float64> out;
    __builtin_memcpy(out.data[0], &found._0, sizeof(found._0));
    __builtin_memcpy(out.data[1], &found._1, sizeof(found._1));
    __builtin_memcpy(out.data[10], &J, sizeof(J));
    return out;
}}"""
)
def energy_and_stress(
    model: int, mu_in: vec8d, lam_in: vec8d, rate: wp.float64, G_in: mat98d, G_start: mat98d
) -> PointLanes:  # pyright: ignore[reportReturnType]
    """Return energy density, stress and J at eight points; see ``material_kernels.energy_and_stress``.

    Args:
        model: Energy density of all eight.
        mu_in: Lame's mu [Pa].
        lam_in: Lame's lambda [Pa].
        rate: Viscosity over the duration of the step, tau / dt.
        G_in: Displacement gradients F - I at the end of the step.
        G_start: Those at its start; not read where ``rate`` is 0.
    """
    ...


@wp.func_native(
    snippet=f"""{{{lanes_code(hessian, uniform=_SAME, apart=_APART)}{_LOADS}
    typedef float floats __attribute__((ext_vector_type({LANES})));
    const wp::mat_t<18, 3, lanes> C = Law::hessian(material, G, start, 1.0, project);
    wp::mat_t<54, 8, float> out;
    for (int k = 0; k < 54; ++k) {{
        const floats entry = __builtin_convertvector(C.data[k / 3][k % 3], floats);
        __builtin_memcpy(out.data[k], &entry, sizeof(entry));
    }}
    return out;
}}"""
)
def hessian_lanes(
    model: int, mu_in: vec8d, lam_in: vec8d, rate: wp.float64, G_in: mat98d, G_start: mat98d, project: int
) -> HessianLanes:  # pyright: ignore[reportReturnType]
    """Return the Hessian at eight points; see ``hessian_kernels.hessian``, and ``energy_and_stress`` for arguments."""
    ...
