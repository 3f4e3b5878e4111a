"""Forward skinning on the device: splat means, F Sigma F^T and the rotation of F from the reduced coordinates q.

x(X) = X + sum_k b_k(X) q_k and F(X) = I + sum_k q_k grad b_k(X)^T. The displacement q carries the whole rigid motion of
a body, metres of it, while splats are millimetres in size: the mean displacement of the splats is summed in float64,
what is left of it in float32, and their sum is rounded once at the end.
"""

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from softmode.deformables.skinning import skinning_cpu_kernels as cpu_kernels
from softmode.deformables.skinning import skinning_kernels as kernels
from softmode.errors import BasisError

STRETCH_LIMIT = 8.0
"""Largest principal stretch that a splat follows; see `limited_stretch`. A simple shear of 3 has 3.3; where a surface
is torn, less than 8 opens gaps in it, and more gains nothing."""


class SkinSplats:
    """The splats of one object with the basis that moves them; worlds share it.

    Args:
        means: Rest centres in the body frame [m], shape (N, 3).
        covariances: Rest covariances [m^2], shape (N, 3, 3).
        basis: Basis values, averaged over each splat (`averages.average_basis`) or at its centre, shape (N, n).
        grad_basis: Basis gradients likewise [1/m], shape (N, n, 3).
        stretch_limit: Largest principal stretch that a splat follows.
        near: Surface samples of the body whose dents move each splat, shape (N, k), see
            `softmode.deformables.contact.dents.dent_weights`; None where dents are not to be seen.
        share: By how much of them, shape (N, k).
        sample_count: Surface samples of the body.
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
        near: ArrayLike | None = None,
        share: ArrayLike | None = None,
        sample_count: int = 0,
        device: str | wp.Device | None = None,
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
        near, share = (np.zeros((n, 0)) if a is None else np.asarray(a) for a in (near, share))
        if (
            len(near) != n
            or near.shape != share.shape
            or (near.size and not 0 <= near.min() <= near.max() < sample_count)
        ):
            raise BasisError(
                f"near {near.shape} and share {share.shape} are not those of {n} splats and {sample_count} samples",
                hint="give samples and weights of dent_weights(body, means), and body.surface_count",
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
        self.sample_count = sample_count if near.size else 0
        self.near = wp.array(near.astype(np.int32), dtype=int, device=self.device)
        self.share = wp.array(share.astype(np.float32), dtype=float, device=self.device)
        self._motion: dict[
            int, tuple[wp.array, wp.array, wp.array]
        ] = {}  # by world count; kept, as graphs may hold them

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
        rows: wp.array | None = None,
        dent: wp.array | None = None,
        sample_start: wp.array | None = None,
    ) -> None:
        """Write the deformed means and covariances of all worlds; capturable after one launch for as many worlds.

        Args:
            q: Reduced coordinates of all instances [m], flat vec3d.
            function_start: First entry of q of this object's instance in each world, int32, shape (world_count,).
            means: Output centres [m], vec3, shape (world_count, total splats).
            covariances: Output covariances [m^2], vec6, shape (world_count, total splats).
            rotations: Output rotations of F, rest frame to world, quat, like `means`; None, or shape (1, 1) as in
                `SplatArrays` of degree 0, for colours that are the same from everywhere.
            first_splat: Column where this object's splats begin.
            rows: Row of each of the worlds in the outputs, int32, shape (world_count,), where other worlds show other
                objects, -1 for a world that does not show this one; None for outputs with one row per world, in their
                order.
            dent: Dents of the surface samples of all instances [m], flat vec3, `state.softmode.dent`; None for none.
            sample_start: First of them of this object's instance in each world, int32, shape (world_count,).

        Raises:
            BasisError: If an output has not a row per world or too few columns, `rotations` has another shape than
                `means`, or the first launch for that number of worlds is captured.
        """
        if rotations is not None and rotations.shape != means.shape:
            if rotations.shape != (1, 1):
                raise BasisError(f"rotations has shape {rotations.shape}, means {means.shape}; one per splat is needed")
            rotations = None
        worlds = function_start.shape[0]
        if rows is not None and rows.shape != (worlds,):
            raise BasisError(f"rows has shape {rows.shape} for {worlds} worlds", hint="Give the row of each world")
        shape = (worlds if rows is None else means.shape[0], means.shape[-1])
        columns = first_splat + self.count
        if means.shape != shape or covariances.shape != shape or not 0 <= first_splat <= columns <= shape[1]:
            raise BasisError(
                f"means {means.shape} and covariances {covariances.shape} do not hold columns {first_splat} to "
                f"{columns} of {worlds} worlds",
                hint="Build them by SplatArrays.from_splats(..., world_count=...)",
            )
        if worlds not in self._motion:
            if self.device.is_capturing:  # what a capture allocates belongs to its graph, and goes with it
                raise BasisError(
                    f"the first launch for {worlds} worlds is being captured",
                    hint="Launch once before the capture; that compiles the kernels too",
                )
            self._motion[worlds] = (
                wp.zeros(worlds, dtype=wp.vec3d, device=self.device),
                wp.zeros((worlds, self.function_count), dtype=wp.vec4, device=self.device),
                wp.zeros(worlds, dtype=int, device=self.device),
            )
        offset, moved, dented = self._motion[worlds]
        lanes = 32 if self.device.is_cuda else 1
        samples = 0 if dent is None else self.sample_count
        inputs = [self.mean_basis, function_start, q, sample_start, samples, dent, lanes]
        wp.launch(kernels.split_motion, (worlds, lanes), inputs, [dented, offset, moved], device=self.device)
        skin = kernels.Skin()
        skin.rest_mean, skin.rest_covariance, skin.basis = self.rest_means, self.rest_covariances, self.basis
        skin.stretch_limit, skin.first_splat, skin.offset, skin.q = self.stretch_limit, first_splat, offset, moved
        skin.sample_start, skin.dent, skin.dented, skin.near, skin.share = (
            sample_start,
            dent,
            dented,
            self.near,
            self.share,
        )
        skin.mean, skin.covariance, skin.rotation, skin.row = means, covariances, rotations, rows
        if self.device.is_cpu and self.count >= cpu_kernels.BLOCK:
            blocks = -(-self.count // cpu_kernels.BLOCK)
            wp.launch(cpu_kernels.skin_blocks, (blocks, worlds), [skin], device=self.device)
            return
        together = 4 if self.device.is_cuda and worlds > 1 else 1
        dim = (-(-worlds // together), self.count)
        wp.launch(kernels.skin_kernel(together), dim, [skin], device=self.device, block_dim=128)
