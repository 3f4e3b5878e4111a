"""Forward skinning on the device: splat means, F Sigma F^T and the rotation of F from the reduced coordinates q.

x(X) = X + sum_k b_k(X) q_k and F(X) = I + sum_k q_k grad b_k(X)^T. The displacement q carries the whole rigid motion of
a body, metres of it, while splats are millimetres in size: the mean displacement of the splats is summed in float64,
what is left of it in float32, and their sum is rounded once at the end.
"""

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from softmode.deformables import skinning_cpu_kernels as cpu_kernels
from softmode.deformables import skinning_kernels as kernels
from softmode.errors import BasisError

STRETCH_LIMIT = 3.0
"""Largest principal stretch that a splat follows; see `limited_stretch`."""


class SkinSplats:
    """The splats of one object with the basis that moves them; worlds share it.

    Args:
        means: Rest centres in the body frame [m], shape (N, 3).
        covariances: Rest covariances [m^2], shape (N, 3, 3).
        basis: Basis values at the rest centres, shape (N, n).
        grad_basis: Basis gradients at the rest centres [1/m], shape (N, n, 3).
        stretch_limit: Largest principal stretch that a splat follows.
        device: Warp device.

    Raises:
        BasisError: If the shapes do not belong together.
    """

    def __init__(
        self,
        means: ArrayLike,
        covariances: ArrayLike,
        basis: ArrayLike,
        grad_basis: ArrayLike,
        *,
        stretch_limit: float = STRETCH_LIMIT,
        device: Any = None,
    ) -> None:
        """Upload the rest state."""
        x, s = np.asarray(means, dtype=np.float64), np.asarray(covariances, dtype=np.float64)
        b, g = np.asarray(basis, dtype=np.float64), np.asarray(grad_basis, dtype=np.float64)
        n = len(x)
        if x.shape != (n, 3) or s.shape != (n, 3, 3) or b.ndim != 2 or len(b) != n or g.shape != (*b.shape, 3):
            raise BasisError(
                f"means {x.shape}, covariances {s.shape}, basis {b.shape}, grad_basis {g.shape} do not belong together",
                hint="Expected (N, 3), (N, 3, 3), (N, n) and (N, n, 3)",
            )
        self.stretch_limit = float(stretch_limit)
        self.device = wp.get_device(device)
        six = np.stack([s[:, 0, 0], s[:, 0, 1], s[:, 0, 2], s[:, 1, 1], s[:, 1, 2], s[:, 2, 2]], axis=1)
        mean = b.mean(axis=0)
        basis4 = np.concatenate([g, (b - mean)[..., None]], axis=2).transpose(1, 0, 2).astype(np.float32)
        self.rest_means = wp.array(x.astype(np.float32), dtype=wp.vec3, device=self.device)
        self.rest_covariances = wp.array(six.astype(np.float32), dtype=kernels.vec6, device=self.device)
        self.basis = wp.array(np.ascontiguousarray(basis4), dtype=wp.vec4, device=self.device)
        """Gradient [1/m] and value less its average over the splats, shape (n, N)."""
        self.mean_basis = wp.array(mean, dtype=wp.float64, device=self.device)
        """Average of the basis values over the splats, shape (n,)."""
        self._motion: dict[int, tuple[wp.array, wp.array]] = {}  # by world count; kept, as graphs may hold them

    @property
    def count(self) -> int:
        """Number of splats N."""
        return self.rest_means.shape[0]

    @property
    def function_count(self) -> int:
        """Number of basis functions n."""
        return self.basis.shape[0]

    def launch(
        self,
        q: wp.array,
        function_start: wp.array,
        means: wp.array,
        covariances: wp.array,
        *,
        rotations: wp.array | None = None,
        first_splat: int = 0,
    ) -> None:
        """Write the deformed means and covariances of all worlds; capturable.

        Args:
            q: Reduced coordinates of all instances [m], flat vec3d.
            function_start: First entry of q of this object's instance in each world, int32, shape (world_count,).
            means: Output centres [m], vec3, shape (world_count, total splats).
            covariances: Output covariances [m^2], vec6, shape (world_count, total splats).
            rotations: Output rotations of F, rest frame to world, quat, like `means`; None, or shape (1, 1) as in
                `SplatArrays` of degree 0, for colours that are the same from everywhere.
            first_splat: Column where this object's splats begin.

        Raises:
            BasisError: If `rotations` has another shape than `means`.
        """
        if rotations is not None and rotations.shape != means.shape:
            if rotations.shape != (1, 1):
                raise BasisError(f"rotations has shape {rotations.shape}, means {means.shape}; one per splat is needed")
            rotations = None
        worlds = function_start.shape[0]
        if worlds not in self._motion:
            self._motion[worlds] = (
                wp.zeros(worlds, dtype=wp.vec3d, device=self.device),
                wp.zeros((worlds, self.function_count), dtype=wp.vec4, device=self.device),
            )
        motion = self._motion[worlds]
        lanes = 32 if self.device.is_cuda else 1
        wp.launch(
            kernels.split_motion,
            dim=(worlds, lanes),
            inputs=[self.mean_basis, function_start, q, lanes],
            outputs=[*motion],
            device=self.device,
        )
        inputs = [self.rest_means, self.rest_covariances, self.basis, self.stretch_limit, *motion, first_splat]
        outputs = [means, covariances, rotations]
        if self.device.is_cpu and self.count >= cpu_kernels.BLOCK:
            blocks = -(-self.count // cpu_kernels.BLOCK)
            wp.launch(cpu_kernels.skin_blocks, (blocks, worlds), inputs, outputs, device=self.device)
            return
        together = 4 if self.device.is_cuda and worlds > 1 else 1
        wp.launch(
            kernels.skin_kernel(together),
            dim=(-(-worlds // together), self.count),
            inputs=inputs,
            outputs=outputs,
            device=self.device,
            block_dim=128,
        )
