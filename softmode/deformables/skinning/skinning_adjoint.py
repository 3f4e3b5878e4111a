"""Gradients through skinning: from the loss by deformed splats to the loss by the reduced coordinates q.

With x = X + sum_k b_k q_k, F = 1 + sum_k q_k grad b_k^T and the covariance F Sigma F^T,

    dL/dq_k = sum over splats of b_k dL/dx + (dL/dF) grad b_k,    dL/dF = 2 G F Sigma + what the rotation of F adds,

G the symmetric matrix of the loss by the covariance. Where `limited_stretch` cuts a singular value the derivative is
that of the cut F: exact, and zero along a stretch at the limit. Sums are in float64 and in a fixed order, on CUDA too.
"""

from typing import Any

import warp as wp

from softmode.deformables.skinning import skinning_adjoint_kernels as kernels
from softmode.deformables.skinning.skin_splats import SkinSplats
from softmode.errors import BasisError


class AdjointSkinning:
    """Differentiates `SkinSplats.launch`; all buffers are allocated here, 36 bytes per splat and world.

    Args:
        skin: The object whose splats move.
        world_count: Number of worlds.
    """

    def __init__(self, skin: SkinSplats, world_count: int) -> None:
        """Allocate the buffers."""
        self.skin, self.world_count = skin, world_count
        lanes = 1 if skin.device.is_cpu else 64
        self._gradient = wp.zeros((world_count, skin.count), dtype=wp.mat33, device=skin.device)
        self._lane = wp.zeros((world_count, lanes, skin.function_count), dtype=wp.vec3d, device=skin.device)

    def backward(
        self,
        q: wp.array,
        function_start: wp.array,
        loss_means: wp.array,
        loss_covariances: wp.array,
        loss_q: wp.array,
        *,
        loss_rotations: wp.array | None = None,
        first_splat: int = 0,
    ) -> None:
        """Add the derivative of the loss by q; capturable.

        Args:
            q: Reduced coordinates of all instances [m], flat vec3d, as given to `launch`.
            function_start: First entry of q of this object's instance in each world, int32, shape (world_count,).
            loss_means: Derivative by the deformed centres [1/m], vec3, shape (world_count, total splats).
            loss_covariances: Derivative by the six entries of the deformed covariances [1/m^2], vec6, same shape; see
                `softmode.splats.raster.rasterizer_adjoint.RasterizerGradients`.
            loss_q: Derivative by q [1/m], flat vec3d like q; added to, so that objects can share it.
            loss_rotations: Derivative by a rotation vector of the colours' frames, vec3, shape of `loss_means`; None,
                or shape (1, 1) as for colours of degree 0, for none.
            first_splat: Column where this object's splats begin.

        Raises:
            BasisError: If an array has another shape than expected.
        """
        skin = self.skin
        shape = (self.world_count, max(first_splat + skin.count, loss_means.shape[-1]))
        if loss_rotations is not None and loss_rotations.shape == (1, 1) != shape:
            loss_rotations = None
        expected: dict[str, tuple[Any, tuple[int, ...]]] = {
            "function_start": (function_start, (self.world_count,)),
            "loss_means": (loss_means, shape),
            "loss_covariances": (loss_covariances, shape),
            "loss_q": (loss_q, q.shape),
            "loss_rotations": (loss_rotations, shape),
        }
        for name, (array, wanted) in expected.items():
            if array is not None and tuple(array.shape) != tuple(wanted):
                raise BasisError(
                    f"{name} has shape {tuple(array.shape)}, expected {tuple(wanted)}",
                    hint="Give the gradients of the arrays that launch wrote",
                )
        rest = [skin.rest_covariances, skin.basis, skin.stretch_limit, function_start, q, first_splat]
        dim, device, losses = (self.world_count, skin.count), skin.device, [loss_covariances, loss_rotations]
        wp.launch(kernels.gradient_adjoint, dim, [*rest, *losses], [self._gradient], device=device)
        dim = (self.world_count, -(-skin.function_count // 4), self._lane.shape[1])
        inputs = [skin.basis, skin.mean_basis, first_splat, loss_means, self._gradient]
        wp.launch(kernels.sum_splats, dim, inputs, [self._lane], device=device)
        dim = (self.world_count, skin.function_count)
        wp.launch(kernels.add_lanes, dim, [self._lane, function_start], [loss_q], device=device)
