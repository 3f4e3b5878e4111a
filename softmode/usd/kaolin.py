"""Attributes of Kaolin's `KaolinSkinnedPhysicsAPI` and `KaolinPhysicsMaterialAPI`, for exchange.

Kaolin moves points by x = X + sum_j w_j(X) T_j [X; 1] with the constant handle, w = 1, last: what `handles` writes. Its
arrays are float, one row per point: weights (point, handle), their gradients (point, handle, axis), flattened.

Kaolin gives every point the same share V / P of the volume, while a body has cubature weights V_p. Energy is linear in
Young's modulus and mass in density, so `skinned` scales both by V_p P / V: sums over Kaolin's equal shares are then
those over the cubature. `material` has them as they are.

Reference:
    NVIDIA Kaolin, `kaolin/io/usd/custom_schema/schema.usda`, `kaolin.physics.simplicits.SkinnedPhysicsPoints`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.usd.handles import handle_weights


def exchangeable(body: ReducedBody) -> bool:
    """Return whether Kaolin can express a body: no handle is quadratic."""
    return bool((body.handles.degrees <= 1).all())


def material_values(body: ReducedBody, material: Material) -> dict[str, Any]:
    """Return what `KaolinPhysicsMaterialAPI` says: points [m], E [Pa], nu, density [kg/m^3] and the volume [m^3]."""
    moduli, ratios = body.cubature.moduli(material.youngs_modulus, material.poissons_ratio)
    return {
        "pts": body.cubature.points.astype(np.float32),
        "yms": moduli.astype(np.float32),
        "prs": ratios.astype(np.float32),
        "rhos": np.full(body.point_count, material.density, np.float32),
        "appx_vol": float(body.volume),
    }


def skinned_values(body: ReducedBody, material: Material, splat_weights: NDArray[np.float32] | None) -> dict[str, Any]:
    """Return what `KaolinSkinnedPhysicsAPI` says.

    Args:
        body: The body; all its handles affine.
        material: Its material.
        splat_weights: Weights of the splats, shape (N, J), or None without splats.
    """
    weight, gradient = handle_weights(body, body.cubature.points)
    share = body.cubature.weights * (body.point_count / body.volume)
    values = material_values(body, material)
    moduli, _ratios = body.cubature.moduli(material.youngs_modulus, material.poissons_ratio)
    values["yms"] = (moduli * share).astype(np.float32)
    values["rhos"] = (material.density * share).astype(np.float32)
    values["skinning_weights"] = weight.astype(np.float32)
    values["dwdx"] = gradient.astype(np.float32)
    if splat_weights is not None:
        values["renderable_skinning_weights"] = splat_weights
    return values
