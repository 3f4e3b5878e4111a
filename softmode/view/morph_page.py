"""A page that plays a morph back: its particles, segment by segment and in between."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from softmode.mpm import MorphRun
from softmode.objects.shapes.primitives import checker
from softmode.objects.source import DEFAULT_COLORS
from softmode.view.app import ViewOptions
from softmode.view.page import Page

SEGMENT_TIME = 1.0 / 6.0
"""Seconds for which a segment is played."""


class MorphPage(Page):
    """A server whose page plays a morph; a context manager.

    Particles move on straight lines between the ends of segments, in the checker pattern that they have at the start.

    Args:
        run: The morph.
        options: Where the page is served.

    Raises:
        ConfigError: If the address or the port cannot be used.
        MissingExtraError: If viser is not installed.
    """

    def __init__(self, run: MorphRun, options: ViewOptions) -> None:
        """Start the server and build the page."""
        self.run = run
        super().__init__(options)
        try:
            self._build_page()
        except BaseException:
            self.close()
            raise

    def _build_page(self) -> None:
        """Add the particles and the controls."""
        gui, scene, run = self._server.gui, self._server.scene, self.run
        low, high = run.positions.min(axis=(0, 1)), run.positions.max(axis=(0, 1))
        size, centre = float(np.linalg.norm(high - low)), 0.5 * (low + high)
        scene.set_up_direction("+z")
        camera = self._server.initial_camera
        camera.look_at = tuple(centre.tolist())
        camera.position = tuple((centre + size * np.array([0.35, -1.0, 0.5])).tolist())
        camera.near, camera.far = 0.01 * size, 100.0 * size
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.add_markdown(f"**{' to '.join(run.names) or 'a morph'}**, {run.positions.shape[1]} particles")
        self._told = gui.add_markdown("")
        self.time = gui.add_slider(
            "segment", min=0.0, max=float(max(run.segment_count, 1)), step=0.05, initial_value=0.0
        )
        self.playing = gui.add_checkbox("play", initial_value=True)
        extent = np.ptp(run.positions[0], axis=0)
        pitch = float((np.prod(extent) / run.positions.shape[1]) ** (1.0 / 3.0))
        colors = np.asarray(DEFAULT_COLORS)[checker(run.positions[0])]
        self._cloud = scene.add_point_cloud(
            "/particles",
            run.positions[0].astype(np.float32),
            (255.0 * colors).astype(np.uint8),
            point_size=pitch,
            point_shape="circle",
        )

        @self.time.on_update
        async def _(_: object) -> None:
            self.show(self.time.value)

        self.show(0.0)

    def at(self, segments: float) -> NDArray[np.float32]:
        """Return the particles after a number of segments, also between two of them [m], shape (N, 3)."""
        first = min(int(segments), max(self.run.segment_count - 1, 0))
        last = min(first + 1, self.run.segment_count)
        part = segments - first
        return ((1.0 - part) * self.run.positions[first] + part * self.run.positions[last]).astype(np.float32)

    def show(self, segments: float) -> None:
        """Show the particles after a number of segments."""
        self._cloud.points = self.at(segments)
        segment = min(round(segments), self.run.segment_count)
        self._told.content = f"segment {segment} of {self.run.segment_count}, loss {self.run.losses[segment]:.4g}"

    def play(self, duration: float | None = None) -> None:
        """Play again and again while the box is ticked.

        Args:
            duration: Seconds after which to return; None plays until interrupted.
        """
        end = None if duration is None else time.monotonic() + duration
        while end is None or time.monotonic() < end:
            time.sleep(1.0 / 30.0)
            if self.playing.value:
                now = self.time.value + 1.0 / 30.0 / SEGMENT_TIME
                self.time.value = 0.0 if now > self.run.segment_count else now
                self.show(self.time.value)
