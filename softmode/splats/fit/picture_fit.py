"""`fit_splats`: splats fitted to pictures by gradient descent: moved, turned, stretched, recoloured, faded."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.deformables.model.declare import launch
from softmode.errors import ConfigError
from softmode.splats.fit import picture_fit_kernels as kernels
from softmode.splats.fit.reference_views import ReferenceViews, orbit_poses
from softmode.splats.raster.rasterizer import SplatArrays, SplatRasterizer
from softmode.splats.raster.rasterizer_adjoint import AdjointRasterizer
from softmode.splats.splats import Splats

FIELD_OF_VIEW = 0.7
"""Field of view of the pictures [rad]; the object's bounding sphere just fits."""
WHITE = (1.0, 1.0, 1.0)
LOG_SCALE_RANGE = (0.02, 3.0)
"""Smallest and largest standard deviation over the spacing of the splats."""

Lens = tuple[float, float, float, float]
Draw = Callable[[NDArray[np.float32], Lens], ReferenceViews]
"""Draws an object whose bounding sphere is the unit sphere: world-to-camera transforms (V, 4, 4), fx, fy, cx, cy."""


@dataclass(frozen=True, kw_only=True)
class LearningRates:
    """Step sizes of Adam at the start; they fall to `final` of that along a cosine."""

    center: float = 0.02
    """Centres, over the spacing of the splats."""
    rotation: float = 0.01
    """Rotations [rad]."""
    scale: float = 0.02
    """Logarithms of the standard deviations."""
    opacity: float = 0.05
    """Logits of the opacities."""
    color: float = 0.02
    """Colour coefficients."""
    final: float = 0.02
    """Share of the rates at the end."""


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """How splats are fitted to pictures of an object."""

    iterations: int = 200
    """Steps of gradient descent; 0 leaves the splats as they were sampled."""
    size: int = 128
    """Edge of the square pictures [px], which the object fills. Splats look best at about the size they were fitted at:
    the pixel filter widens outlines by a part of a pixel, and the fit makes up for that."""
    view_count: int = 64
    """Pictures to fit."""
    held_out_count: int = 16
    """Further pictures, from other directions, that only measure the result."""
    views_per_step: int = 2
    """Pictures that a step sees."""
    samples: int = 4
    """Rays per pixel along each axis in the pictures."""
    report_every: int = 100
    """Steps between two measurements."""
    seed: int = 0
    """Seed of samples, cameras and backgrounds; on CPU the result is the same in every bit."""
    rates: LearningRates = field(default_factory=LearningRates)
    """Step sizes."""

    def __post_init__(self) -> None:
        """Validate the numbers."""
        for name, low, high in (
            ("iterations", 0, 10**6), ("size", 16, 2000), ("view_count", 1, 10**4), ("held_out_count", 1, 10**4),
            ("views_per_step", 1, self.view_count), ("samples", 1, 64), ("report_every", 1, 10**6),
            ("seed", 0, 2**63),
        ):  # fmt: skip
            if not low <= getattr(self, name) <= high:
                raise ConfigError(f"{name} is {getattr(self, name)}", hint=f"give a whole number of {low} to {high}")


def fit_splats(
    splats: Splats,
    spacing: float,
    draw: Draw,
    options: FitOptions,
    *,
    device: wp.DeviceLike = None,
    progress: Callable[[int, float], None] | None = None,
) -> tuple[Splats, tuple[tuple[int, float], ...]]:
    """Fit splats to pictures of an object from all around, so that the mean squared difference falls.

    Both are put before random backgrounds, which demands the right coverage as well. The optimiser is Adam on the
    splats that a picture shows (Kerbl et al. 2023, section 5, without densification: the splats cover the object
    already). Of colours the constant coefficient is fitted, and the others are kept.

    Args:
        splats: Where to start, in the unit sphere.
        spacing: Distance between neighbouring splats.
        draw: Draws the object.
        options: Pictures and steps.
        device: Warp device.
        progress: Called with the iteration and the loss after every step.

    Returns:
        The splats, and pairs of iteration and PSNR over held-out pictures before white [dB].
    """
    rng = np.random.default_rng(options.seed)
    fit = _Fit(splats, spacing, options, device)
    size, focal = options.size, 0.5 * options.size / np.tan(0.5 * FIELD_OF_VIEW)
    lens, distance = (focal, focal, 0.5 * size, 0.5 * size), 1.02 / np.sin(0.5 * FIELD_OF_VIEW)
    training = draw(orbit_poses(options.view_count, distance, rng), lens)
    held_out = draw(orbit_poses(options.held_out_count, distance, rng), lens)
    history = [(0, fit.psnr(held_out))]
    order = np.zeros(0, dtype=np.int64)
    for iteration in range(options.iterations):
        if len(order) < options.views_per_step:
            order = np.concatenate([order, rng.permutation(options.view_count)])
        chosen, order = np.split(order, [options.views_per_step])
        loss = fit.step(training, chosen, rng.random((len(chosen), 3)), iteration / options.iterations)
        done = iteration + 1
        if done % options.report_every == 0 or done == options.iterations:
            history.append((done, fit.psnr(held_out)))
        if progress is not None:
            progress(done, float(loss.numpy()[0]))
    return fit.splats(splats.name), tuple(history)


class _Fit:
    """Parameters, moments and rasterisers of one fit.

    Args:
        splats: Where to start.
        spacing: Distance between neighbouring splats [m].
        options: Pictures and steps.
        device: Warp device.
    """

    def __init__(self, splats: Splats, spacing: float, options: FitOptions, device: wp.DeviceLike) -> None:
        """Upload the parameters."""
        self.options, self.spacing, self.device = options, spacing, wp.get_device(device)
        self.count = count = splats.count
        opacity = np.clip(splats.opacities.astype(np.float64), 0.01, 0.99)

        def upload(array: NDArray[Any], dtype: type) -> wp.array:
            return wp.array(array.astype(np.float32), dtype=dtype, device=self.device)

        self.parameters = (
            upload(splats.means, wp.vec3),
            upload(splats.quats, wp.quat),
            upload(np.log(splats.scales), wp.vec3),
            upload(np.log(opacity / (1.0 - opacity)), wp.float32),
            upload(splats.sh[:, 0], wp.vec3),
        )
        kinds = (kernels.vec13, kernels.vec13, wp.int32)
        self.moments = tuple(wp.zeros(count, dtype=kind, device=self.device) for kind in kinds)
        self.arrays = SplatArrays.from_splats([splats], device=self.device)
        size = options.size
        self.rasterizer = SplatRasterizer(count, options.views_per_step, size, size, device=self.device)
        self.adjoint: AdjointRasterizer | None = None
        self.single = SplatRasterizer(count, 1, size, size, device=self.device)
        self.loss_rgb = wp.zeros_like(self.rasterizer.rgb)
        self.loss = wp.zeros(1, dtype=wp.float64, device=self.device)
        low, high = np.log(spacing * np.array(LOG_SCALE_RANGE))
        self.bounds = wp.vec3(low, low, low), wp.vec3(high, high, high)

    def compose(self) -> None:
        """Bring the splats up to date with the parameters."""
        splats = self.arrays
        outputs = (splats.means, splats.covariances, splats.opacities, splats.sh)
        launch(self.device, kernels.compose_splats, self.count, *self.parameters, *outputs)

    def step(
        self, pictures: ReferenceViews, chosen: NDArray[np.int64], background: NDArray[np.float64], elapsed: float
    ) -> wp.array:
        """Take one step down the gradient over some pictures; return the loss on the device.

        Args:
            pictures: What to fit.
            chosen: Which of them, shape (views_per_step,).
            background: Colour behind the object in each, shape (views_per_step, 3).
            elapsed: Share of the steps already taken.
        """
        self.compose()
        views = pictures.view_arrays(chosen, background)
        self.rasterizer.render(self.arrays, views)
        shape = self.rasterizer.rgb.shape
        self.loss.zero_()
        reference = wp.array(chosen.astype(np.int32), dtype=wp.int32, device=self.device)
        drawn = (self.rasterizer.rgb, pictures.rgb, pictures.alpha, reference, views.background)
        scale = 1.0 / float(3 * np.prod(shape))
        launch(self.device, kernels.image_loss, shape, *drawn, scale, self.loss_rgb, self.loss)
        if self.adjoint is None:
            self.adjoint = AdjointRasterizer(self.rasterizer, self.arrays, views, camera=False)
        gradients = self.adjoint.backward(self.arrays, views, loss_rgb=self.loss_rgb)
        rates = self.options.rates
        fall = rates.final + (1.0 - rates.final) * 0.5 * (1.0 + np.cos(np.pi * elapsed))
        per_part = (self.spacing * rates.center, rates.rotation, rates.scale, rates.opacity, rates.color)
        down = (gradients.means, gradients.covariances, gradients.opacities, gradients.sh)
        rate = kernels.vec13(*(fall * np.repeat(per_part, (3, 3, 3, 1, 3))))
        moved = (*self.parameters, *self.moments)
        launch(self.device, kernels.adam_step, self.count, *down, rate, *self.bounds, *moved)
        return self.loss

    def psnr(self, pictures: ReferenceViews) -> float:
        """Return the mean PSNR over the pictures before white [dB]."""
        self.compose()
        wanted = pictures.on(WHITE)
        values = []
        for k in range(len(wanted)):
            self.single.render(self.arrays, pictures.view_arrays([k], [WHITE]))
            error = np.clip(self.single.rgb.numpy()[0], 0.0, 1.0) - wanted[k]
            values.append(-10.0 * np.log10(max(float(np.mean(error.astype(np.float64) ** 2)), 1e-12)))
        return float(np.mean(values))

    def splats(self, name: str) -> Splats:
        """Download the splats."""
        center, quat, log_scale, logit, color = (array.numpy() for array in self.parameters)
        return Splats(
            means=center,
            quats=quat,
            scales=np.exp(log_scale),
            opacities=1.0 / (1.0 + np.exp(-logit)),
            sh=np.concatenate([color[:, None], self.arrays.sh.numpy()[0, :, 1:]], axis=1),
            name=name,
        )
