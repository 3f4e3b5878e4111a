"""The splats of a body in any of its states, moved by softmode's own skinning."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.skinning.skin_splats import SkinSplats, average_basis
from softmode.splats.rasterizer import SplatArrays
from softmode.splats.splats import Splats

_ROWS = 400_000
"""Most splats that are moved in one launch; bounds the memory."""


class SkinnedSplats:
    """Splats tied to a body: the mean of x(X) and the covariance F Sigma F^T over each splat.

    Args:
        body: The body.
        splats: Its splats in the body frame [m].
    """

    def __init__(self, body: ReducedBody, splats: Splats) -> None:
        """Keep both; the functions are averaged over the splats when first needed."""
        self.body, self.splats = body, splats

    @cached_property
    def _skin(self) -> SkinSplats:
        means, covariances = self.splats.means, self.splats.covariances()
        basis = average_basis(lambda x: self.body.evaluate(x)[0], means, covariances)
        return SkinSplats(means, covariances, *basis, device="cpu")

    def frames(self, states: ArrayLike) -> Iterator[Splats]:
        """Yield the splats of each state.

        Args:
            states: Reduced coordinates [m], shape (F, n, 3).
        """
        q = np.asarray(states, dtype=np.float64)
        count, n = max(1, _ROWS // self.splats.count), self.body.function_count
        for first in range(0, len(q), count):
            part = q[first : first + count]
            arrays: Any = SplatArrays.from_splats([self.splats], world_count=len(part), device="cpu")
            self._skin.launch(
                wp.array(part.reshape(-1, 3), dtype=wp.vec3d, device="cpu"),
                wp.array(np.arange(len(part)) * n, dtype=wp.int32, device="cpu"),
                arrays.means,
                arrays.covariances,
                rotations=arrays.rotations,
            )
            means, covariances = arrays.means.numpy(), arrays.covariances.numpy()
            turns = arrays.rotations.numpy()
            for k in range(len(part)):
                # colours of degree 0 look the same from everywhere, and no rotations are computed for them
                turn = np.eye(3) if self.splats.sh_degree == 0 else turns[k]
                yield self.splats.with_covariances(means[k], covariances[k], turn)
