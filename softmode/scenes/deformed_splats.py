"""The splats of soft bodies where a state has them, as centres, scales and orientations on the host."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.deformables.model.authoring import NAMESPACE
from softmode.deformables.skinning.skin_splats import SkinSplats
from softmode.deformables.skinning.skinning_kernels import vec6
from softmode.errors import ConfigError
from softmode.objects.soft_object import SoftObject
from softmode.scenes.splat_axes_kernels import principal_axes


@dataclass(frozen=True, kw_only=True, eq=False)
class SplatFrame:
    """The splats of one object in one world."""

    means: NDArray[np.float32]
    """Centres [m], shape (N, 3)."""
    covariances: NDArray[np.float32]
    """Covariances xx xy xz yy yz zz [m^2], shape (N, 6)."""


class DeformedSplats:
    """Skins the splats of the objects of some worlds with the kernels that cameras use.

    Args:
        model: A model with soft bodies, the same in every world.
        objects: The soft bodies of a world in the order in which they were added; None for one without splats.
        worlds: Which worlds.

    Raises:
        ConfigError: If the model has other soft bodies.
    """

    def __init__(self, model: newton.Model, objects: Sequence[SoftObject | None], worlds: Sequence[int]) -> None:
        """Upload the splats."""
        data: Any = getattr(model, NAMESPACE)
        count, owner = len(objects), data.instance_world.numpy()
        every = max(int(model.world_count), 1)
        if len(owner) != every * count or (every > 1 and not np.array_equal(owner, np.repeat(np.arange(every), count))):
            raise ConfigError(
                f"objects names {count} soft bodies, the model has {len(owner)} in {every} worlds",
                hint="give one object, or None, per soft body of a world, in the order in which they were added",
            )
        starts = data.function_start.numpy().reshape(every, count)[list(worlds)]
        device: Any = model.device
        self.device = device
        self._skins = {}
        for o, thing in enumerate(objects):
            if thing is None:
                continue
            splats = thing.visible_splats
            skin = SkinSplats(splats.means, splats.covariances(), thing.basis, thing.grad_basis, device=device)
            shape = (len(worlds), splats.count)
            self._skins[o] = (
                skin,
                wp.array(np.ascontiguousarray(starts[:, o]), dtype=int, device=device),
                wp.zeros(shape, dtype=wp.vec3, device=device),
                wp.zeros(shape, dtype=vec6, device=device),
            )

    def frames(self, state: newton.State) -> dict[tuple[int, int], SplatFrame]:
        """Return the splats by place of the world in `worlds` and object; reads from the device."""
        q = getattr(state, NAMESPACE).q
        found = {}
        for o, (skin, start, means, covariances) in self._skins.items():
            skin.launch(q, start, means, covariances)
            host = zip(means.numpy(), covariances.numpy(), strict=True)
            for w, (centers, six) in enumerate(host):
                found[w, o] = SplatFrame(means=centers.copy(), covariances=six.copy())
        return found

    def axes(self, frame: SplatFrame) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return standard deviations [m], shape (N, 3), and quaternions xyzw, shape (N, 4), of covariances."""
        return splat_axes(frame.covariances, self.device)


def splat_axes(covariances: NDArray[np.float32], device: Any = None) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the principal axes of Gaussians.

    Args:
        covariances: xx xy xz yy yz zz [m^2], shape (N, 6).
        device: Warp device.

    Returns:
        Standard deviations [m], shape (N, 3), and unit quaternions xyzw from the principal frame, shape (N, 4).
    """
    six = wp.array(np.ascontiguousarray(covariances, np.float32)[None], dtype=vec6, device=device)
    scales = wp.zeros(six.shape, dtype=wp.vec3, device=device)
    quats = wp.zeros(six.shape, dtype=wp.quat, device=device)
    wp.launch(principal_axes, dim=six.shape, inputs=[six], outputs=[scales, quats], device=device)
    return scales.numpy()[0], quats.numpy()[0]
