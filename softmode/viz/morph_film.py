"""Films of morphs: splats ride on the particles, their colours cross to those of the target as the loss falls there."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import newton
import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial import KDTree

from softmode.mpm import MorphOptions, MorphRun, ParticleBody, ReplayFrame, replay
from softmode.objects.solids import Solid
from softmode.scenes.film_camera import FilmCamera
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.raster.rasterizer import SplatArrays
from softmode.splats.splats import Splats
from softmode.viz.film import Film
from softmode.viz.morph_film_kernels import ride

Array = NDArray[np.float64]

SIZE = 0.02
"""Metres of the film's scene for one metre of the run's grid."""
RATE = 30
"""Pictures per second."""
STRIDE = 2
"""Steps from one picture to the next."""
STRETCH_LIMIT = 1.6
"""Largest stretch at which a splat is drawn."""
LAG = 4.0
"""How much later colours cross where masses are farthest from the target's: the exponent is 1 + LAG there."""
FILL = 0.42
"""Standard deviation of a particle's own splat over the distance between particles."""
HOLD = 1.0
"""Seconds for which the last picture stays."""


class MorphScene:
    """The splats of a morph, frame by frame: those of the source's surface, and one for each particle beneath them.

    Args:
        run: The morph.
        solids: Source and targets, as they were filled.
        bodies: Their particles.
        options: Those of the run.
        as_particles: Draw particles alone.
        device: Warp device.
    """

    def __init__(
        self,
        run: MorphRun,
        solids: Sequence[Solid],
        bodies: Sequence[ParticleBody],
        options: MorphOptions | None = None,
        *,
        as_particles: bool = False,
        device: wp.DeviceLike = None,
    ) -> None:
        """Find the splats at rest."""
        self.run, self._bodies, self.device = run, bodies, device
        self.options = options or MorphOptions()
        self.as_particles = as_particles
        self.progress: Callable[[int], object] | None = None
        """Called after each frame of :meth:`move` and :meth:`splat_frames` with the number of its step."""
        self._looks = [solid.splats.with_sh_degree(0) for solid in solids]
        spacing = float((np.prod(np.ptp(bodies[0].positions, axis=0)) / bodies[0].count) ** (1.0 / 3.0))
        spacing = min(spacing, float(np.median(KDTree(bodies[0].positions).query(bodies[0].positions, k=2)[0][:, 1])))
        source, surface = bodies[0].positions, self._looks[0]
        self._points = np.zeros((0, 3)) if as_particles else surface.means.astype(np.float64)
        width = (0.36 if as_particles else FILL) * spacing
        count = len(source)
        means = np.concatenate([source, self._points])
        colors = np.concatenate(
            [surface.sh[KDTree(surface.means).query(source)[1]], surface.sh][: 1 + (not as_particles)]
        )
        flat = surface.subset(np.arange(len(self._points))) if len(self._points) else None
        self.splats = Splats(
            means=means,
            quats=np.concatenate([np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)), *([flat.quats] if flat else [])]),
            scales=np.concatenate([np.full((count, 3), width), *([flat.scales] if flat else [])]),
            opacities=np.concatenate([np.full(count, 0.95), *([flat.opacities] if flat else [])]),
            sh=colors,
            name="morph",
        ).transformed(translation=run.offsets[0])
        """All splats at the start, in the frame of the run's grid [m]: particles, then the surface."""

    def frames(self, stride: int = STRIDE) -> Iterator[tuple[ReplayFrame, Array, Array, Array]]:
        """Yield every ``stride``-th step: what was replayed, positions [m], deformation gradients and SH colours."""
        run = self.run
        body, *goals = self._bodies
        steps = list(replay(run, body, goals, self.options, points=self._points, stride=stride, device=self.device))
        now, most = self.splats.sh[:, 0].astype(np.float64), np.max([frame.residual for frame in steps], axis=0)
        ends = [*(np.asarray(run.ends, dtype=int)), run.segment_count][: run.target_count]
        length = self.options.segment_length
        for leg in range(max(frame.target for frame in steps) + 1):
            part = [frame for frame in steps if frame.target == leg]
            last = part[-1]
            look = self._looks[leg + 1]
            near = KDTree(look.means + run.offsets[leg + 1]).query(np.concatenate([last.particles, last.points]))[1]
            goal = look.sh[near, 0].astype(np.float64)
            begun = ends[leg - 1] if leg else 0
            losses = np.concatenate([[run.first_losses[leg]], run.losses[begun + 1 : ends[leg] + 1]])
            fallen = np.maximum.accumulate(1.0 - losses / losses[0])
            for frame in part:
                at = np.interp(frame.step / length - begun, np.arange(len(fallen)), fallen / max(fallen[-1], 1e-9))
                share = at ** (1.0 + LAG * frame.residual / np.maximum(most, 1e-9))
                share = share**2 * (3.0 - 2.0 * share)
                color = now + share[:, None] * (goal - now)
                identity = np.tile(np.eye(3), (len(frame.particles), 1, 1))
                x = np.concatenate([frame.particles, frame.points])
                yield frame, x, np.concatenate([identity, frame.gradients]), color
            now = goal

    def move(self, arrays: SplatArrays, size: float = 1.0, stride: int = STRIDE) -> Iterator[ReplayFrame]:
        """Move splats on the device to every ``stride``-th step: x, F Sigma F^T with limited stretch, colours.

        Args:
            arrays: Of `splats`, scaled by ``size``.
            size: Factor of all lengths.
            stride: Steps from one frame to the next.
        """
        device = self.device
        rest = size**2 * self.splats.covariances()
        found = wp.array(rest.astype(np.float32), dtype=wp.mat33, device=device)
        for frame, x, F, color in self.frames(stride):
            inputs = [
                wp.array((size * x).astype(np.float32), dtype=wp.vec3, device=device),
                wp.array(F.astype(np.float32), dtype=wp.mat33, device=device),
                found,
                STRETCH_LIMIT,
                arrays.means,
                arrays.covariances,
            ]
            wp.launch(ride, len(x), inputs=inputs, device=device)
            arrays.sh.assign(color[None, :, None].astype(np.float32))
            yield frame
            if self.progress is not None:
                self.progress(frame.step)

    def splat_frames(self, stride: int = STRIDE) -> Iterator[tuple[ReplayFrame, Splats]]:
        """Yield every ``stride``-th step with its splats on the host, in the frame of the run's grid [m]."""
        arrays = SplatArrays.from_splats([self.splats], device=self.device)
        for frame in self.move(arrays, stride=stride):
            means, covariances = arrays.means.numpy()[0], arrays.covariances.numpy()[0]
            moved = self.splats.with_covariances(means, covariances, np.eye(3))
            yield frame, dataclasses.replace(moved, sh=arrays.sh.numpy()[0].copy())


def film_morph(
    film: Film,
    scene: MorphScene,
    *,
    width: int = 640,
    height: int | None = None,
) -> None:
    """Film a morph on a table.

    Args:
        film: Where the pictures go; it is not published.
        scene: The morph.
        width: Width of the pictures [px].
        height: Their height [px]; three quarters of the width if None.
    """
    device, run = scene.device, scene.run
    low, high = SIZE * run.positions.min(axis=(0, 1)), SIZE * run.positions.max(axis=(0, 1))
    middle, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    builder = newton.ModelBuilder()
    floor = wp.transform((float(middle[0]), float(middle[1]), float(low[2]) - 0.03), wp.quat_identity())
    builder.add_shape_box(body=-1, xform=floor, hx=4.0, hy=4.0, hz=0.02, color=(0.78, 0.76, 0.73))
    model = builder.finalize(device=device)
    away = np.array([0.35, -1.0, 0.62])
    place = middle + away / np.linalg.norm(away) * radius * 2.6
    camera = PinholeCamera.look_at(
        "film",
        position=(float(place[0]), float(place[1]), float(place[2])),
        target=(float(middle[0]), float(middle[1]), float(middle[2])),
        width=width,
        height=height or (3 * width // 4) // 2 * 2,
        fov_y=0.7,
    )
    arrays = SplatArrays.from_splats([scene.splats.transformed(scale=SIZE)], device=device)
    seen, state = FilmCamera(model, model.state(), arrays, None, [camera]), model.state()
    picture = None
    for _ in scene.move(arrays, SIZE):
        picture = seen.render(state).numpy()[0].copy()
        film.add(picture, RATE)
    for _ in range(round(HOLD * RATE)):
        assert picture is not None
        film.add(picture, RATE)
