"""Several views on several cores: slices of the views are drawn by threads, on CPU.

Warp runs a CPU kernel on the thread that launches it and lets go of Python's lock meanwhile, so that slices drawn by
different threads run at the same time. They share nothing but what they read: images are bitwise those of one thread.

A capture records the launches of all threads of the process in one graph, and replays it on one thread. `render` inside
a capture is therefore recorded slice by slice from the calling thread; to use all cores and no Python, `capture` makes
one graph per slice.
"""

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

import warp as wp

from softmode.checks import require_number
from softmode.errors import ConfigError
from softmode.splats.rasterizer import SHARED_BY_VIEWS, RasterizerOptions, SplatArrays, SplatRasterizer, ViewArrays

OUTPUTS = ("rgb", "depth", "alpha", "object_id", "median_depth")


class ThreadedRasterizer:
    """Draws like `SplatRasterizer`, with the same outputs, a slice of the views on each of several CPU threads.

    Args:
        splat_count: Number of splats per world, all objects together.
        view_count: Number of views (worlds x cameras).
        width: Image width [px].
        height: Image height [px].
        threads: Number of threads; None for one per core. At most one per view is used.
        options: How splats are drawn.

    Raises:
        ConfigError: If a size is out of range.
    """

    def __init__(
        self,
        splat_count: int,
        view_count: int,
        width: int,
        height: int,
        *,
        threads: int | None = None,
        options: RasterizerOptions | None = None,
    ) -> None:
        """Allocate the buffers."""
        require_number("threads", 1 if threads is None else threads, at_least=1, hint="None takes one per core")
        require_number("view_count", view_count, at_least=1)
        count = min(threads if threads is not None else os.cpu_count() or 1, view_count)
        bounds = [view_count * i // count for i in range(count + 1)]
        self.options = options if options is not None else RasterizerOptions()
        self.device = wp.get_device("cpu")
        self.splat_count, self.view_count, self.width, self.height = splat_count, view_count, width, height
        self._slices = [slice(begin, end) for begin, end in itertools.pairwise(bounds)]
        self._parts = [
            SplatRasterizer(splat_count, s.stop - s.start, width, height, options=self.options, device=self.device)
            for s in self._slices
        ]
        self.rgb: wp.array
        self.depth: wp.array
        self.alpha: wp.array
        self.object_id: wp.array
        self.median_depth: wp.array
        for name in OUTPUTS:
            first = getattr(self._parts[0], name)
            written = first.shape == self._parts[0].rgb.shape
            shape = (view_count, height, width) if written else first.shape
            whole = wp.zeros(shape, dtype=first.dtype, device=self.device)
            setattr(self, name, whole)
            for part, views in zip(self._parts, self._slices, strict=True):
                setattr(part, name, whole[views] if written else whole)
        self._compiled: set[bool] = set()
        self._pool = ThreadPoolExecutor(max_workers=count, thread_name_prefix="softmode-splats")

    @property
    def thread_count(self) -> int:
        """Number of threads that draw."""
        return len(self._parts)

    def render(
        self,
        splats: SplatArrays,
        views: ViewArrays,
        *,
        mesh_rgb: wp.array | None = None,
        mesh_depth: wp.array | None = None,
    ) -> None:
        """Draw one frame of all views; arguments and errors are those of `SplatRasterizer.render`."""
        jobs = self._jobs(splats, views, mesh_rgb, mesh_depth)
        # The first frame, with and without meshes, compiles kernels: one thread does that.
        with_mesh = mesh_depth is not None
        if self.device.is_capturing or with_mesh not in self._compiled:
            for job in jobs:
                job()
            self._compiled.add(with_mesh)
        else:
            self._run(jobs)

    def capture(
        self,
        splats: SplatArrays,
        views: ViewArrays,
        *,
        mesh_rgb: wp.array | None = None,
        mesh_depth: wp.array | None = None,
    ) -> Callable[[], None]:
        """Record one graph per slice, and return the function that replays them all at once.

        Draws a frame first, so that the kernels are compiled. Arguments and errors are those of `render`.
        """
        jobs = self._jobs(splats, views, mesh_rgb, mesh_depth)
        graphs = []
        for job in jobs:
            job()
            with wp.ScopedCapture(device=self.device) as capture:
                job()
            graphs.append(capture.graph)
        return lambda: self._run([lambda graph=graph: wp.capture_launch(graph) for graph in graphs])

    def _run(self, jobs: list[Callable[[], None]]) -> None:
        """Run the jobs at the same time, the first of them on this thread; wait for all."""
        running = [self._pool.submit(job) for job in jobs[1:]]
        try:
            jobs[0]()
        finally:
            wait(running)  # all of them, whichever fails
        for job in running:
            job.result()

    def _jobs(
        self, splats: SplatArrays, views: ViewArrays, mesh_rgb: wp.array | None, mesh_depth: wp.array | None
    ) -> list[Callable[[], None]]:
        """Return what each thread has to do."""
        given = {f"views.{name}": array for name, array in vars(views).items()}
        for name, array in {**given, "mesh_rgb": mesh_rgb, "mesh_depth": mesh_depth}.items():
            shared = name.removeprefix("views.") in SHARED_BY_VIEWS
            if array is not None and array.shape[0] != self.view_count and not (shared and array.shape[0] == 1):
                raise ConfigError(
                    f"{name} has shape {tuple(array.shape)}, expected {self.view_count} views",
                    hint="Size the rasteriser for these arrays",
                )

        def cut(array: wp.array | None, part: slice) -> Any:
            return array if array is None or array.shape[0] == 1 else array[part]

        def job(part: SplatRasterizer, s: slice) -> Callable[[], None]:
            own = ViewArrays(**{name: cut(array, s) for name, array in vars(views).items()})
            rgb, depth = cut(mesh_rgb, s), cut(mesh_depth, s)
            return lambda: part.render(splats, own, mesh_rgb=rgb, mesh_depth=depth)

        return [job(part, s) for part, s in zip(self._parts, self._slices, strict=True)]
