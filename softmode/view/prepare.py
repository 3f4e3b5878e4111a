"""A page on which a person turns a capture upright and crops it, before it is built."""

from __future__ import annotations

import shlex
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from softmode.errors import SoftmodeError
from softmode.splats.formats import read_splats
from softmode.splats.splats import UpAxis, up_rotation
from softmode.view.app import ViewOptions, aim
from softmode.view.page import Page

Crop = tuple[float, float, float, float, float, float]
"""Lowest and highest corner of a box."""
SHOWN = 150_000
"""Most splats that are shown; of more, every k-th one is."""
FAINT = 0.06
"""Factor on the opacity of splats outside the box."""
ARC = 0.6
"""Radius of the arcs over the object's diagonal, so that they lie outside of it; viser's is 0.65 of their scale."""
HELP = (
    "**1.** Turn the toy upright with the arcs; it snaps to an axis of the file.  \n"
    "**2.** Pull the two corners of the box about it. What is outside is cut.  \n"
    "**3.** Build."
)
EDGES = ((0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7))
"""Edges of a box between its corners, which count in binary: x first."""


class PreparePage(Page):
    """A server whose page shows a capture with a box and arcs; a context manager.

    Args:
        file: The splat file.
        options: Where the page is served.
        up: Axis of the file that points up; None for -y.
        crop: Lowest and highest corner of the box; None for a box about all.
        rest: Other words of the command line that shows the same.

    Raises:
        AssetError: If the file cannot be read.
        ConfigError: If the address or the port cannot be used.
        MissingExtraError: If viser is not installed.
    """

    def __init__(
        self,
        file: Path,
        options: ViewOptions,
        *,
        up: UpAxis | None = None,
        crop: Crop | None = None,
        rest: Sequence[str] = (),
    ) -> None:
        """Start the server and build the page."""
        self.file, self._rest = file, tuple(rest)
        self._splats = read_splats(file)
        self.up: UpAxis = up or "-y"
        """Axis of the file that points up."""
        self._lock, self._done = threading.Lock(), threading.Event()
        super().__init__(options)
        try:
            self._build_page(crop)
        except BaseException:
            self.close()
            raise

    def wait(self, duration: float | None = None) -> bool:
        """Wait until a person asks for the build; return whether one did, in `duration` seconds at most."""
        return self._done.wait(duration)

    def press(self) -> None:
        """Ask for the build, as the button does; may be called from any thread."""
        self._done.set()

    def show_progress(self, stage: str, fraction: float) -> None:
        """Say how far a stage of the build is, 0..1; nothing can be pressed or pulled in the meantime."""
        self._button.disabled, self._gizmos.visible = True, False
        self._told.content = f"building: {stage}, {100.0 * fraction:.0f} %"

    def refuse(self, error: SoftmodeError) -> None:
        """Say why there is no build, and take the next press."""
        self._done.clear()
        self._told.content = f"**{error}**"
        self._button.disabled, self._gizmos.visible = False, True

    @property
    def crop(self) -> Crop | None:
        """The box, to four digits; None where nobody has pulled at it."""
        with self._lock:
            if self._untouched:
                return None
            a, b, c, d, e, f = (float(f"{x:.4g}") for x in (*self.low, *self.high))
            return a, b, c, d, e, f

    @property
    def command(self) -> str:
        """The command line that shows the same."""
        words = ["softmode", "view", str(self.file), f"--up={self.up}"]
        if self.crop is not None:
            words += ["--crop", *(f"{x:g}" for x in self.crop)]
        return shlex.join([*words, *self._rest])

    # -- the page -----------------------------------------------------------------------------------------------------

    def _build_page(self, crop: Crop | None) -> None:
        """Add gizmos and controls."""
        gui, scene = self._server.gui, self._server.scene
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        scene.set_up_direction("+z")
        gui.add_markdown(HELP)
        self._command = gui.add_text("repeat", "", multiline=True, hint="the command that builds the same, to copy")
        self._told = gui.add_markdown("")
        self._button = gui.add_button("build")

        @self._button.on_click
        async def _(_: Any) -> None:
            self.press()

        self._gizmos: Any = None
        self._turns = 0
        self.turn(np.eye(3), crop)
        aim(self._server)

    def turn(self, rotation: np.ndarray, crop: Crop | None = None) -> None:
        """Turn what is shown, and take the axis of the file that points up then; the box is that of all, or `crop`.

        Args:
            rotation: Rotation of what is shown, shape (3, 3).
            crop: Lowest and highest corner of the box.
        """
        axes: tuple[UpAxis, ...] = get_args(UpAxis)
        turned = rotation @ up_rotation(self.up)
        # The axis that R brings to +z is the one whose own upright rotation has the same last row.
        up = max(axes, key=lambda axis: float(turned[2] @ up_rotation(axis)[2]))
        with self._lock:
            self.up, self._untouched = up, crop is None
            self._upright = self._splats.oriented(up)
            low, high = self._upright.bounds(quantile=0.002)
            reach = 0.02 * float(np.linalg.norm(high - low))
            self.low, self.high = low - reach, high + reach
            if crop is not None:
                self.low, self.high = np.array(crop[:3]), np.array(crop[3:])
            self._size = float(np.linalg.norm(high - low))
        self._add_gizmos()
        self._show()

    def move(self, corner: int, position: np.ndarray) -> None:
        """Put the lowest (0) or highest (1) corner of the box somewhere; it stays beyond the other one."""
        with self._lock:
            self._untouched = False
            least = 0.01 * self._size
            if corner == 0:
                self.low = np.minimum(position, self.high - least)
            else:
                self.high = np.maximum(position, self.low + least)

    def _add_gizmos(self) -> None:
        """Add two corners and the arcs."""
        scene = self._server.scene
        if self._gizmos is not None:
            self._gizmos.remove()
        # A page keeps the pose of a gizmo that comes again under its name.
        self._turns += 1
        root = f"/gizmos {self._turns}"
        self._gizmos = scene.add_frame(root, show_axes=False)
        size, centre = self._size, 0.5 * (self.low + self.high)
        first = self._server.initial_camera
        first.up = (0.0, 0.0, 1.0)
        # Who is here already looks there too: what is turned about the file's origin goes elsewhere.
        for camera in (first, *(client.camera for client in self._server.get_clients().values())):
            camera.position = tuple((centre + size * np.array([0.75, -1.0, 0.55])).tolist())
            camera.look_at = tuple(centre.tolist())
            camera.near, camera.far = 0.01 * size, 100.0 * size
        corners = [
            scene.add_transform_controls(
                f"{root}/corner {k}",
                scale=0.22 * size,
                disable_rotations=True,
                depth_test=False,
                position=tuple(at.tolist()),
            )
            for k, at in enumerate((self.low, self.high))
        ]
        arcs = scene.add_transform_controls(
            f"{root}/turn", scale=ARC / 0.65 * size, line_width=4.0, depth_test=False,
            disable_axes=True, disable_sliders=True, position=tuple(centre.tolist()),
        )  # fmt: skip
        scene.add_label(f"{root}/corner 0/label", "lowest corner")
        scene.add_label(f"{root}/corner 1/label", "highest corner")
        scene.add_label(f"{root}/turn/label", "turn upright", position=(0.0, 0.0, ARC * size))
        for k, corner in enumerate(corners):
            corner.on_update(self._mover(k))

        async def turned(event: Any) -> None:
            w, x, y, z = event.target.wxyz
            rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
            if event.phase == "end":
                self.turn(rotation)
            else:  # the splats follow the hand
                self._cloud.wxyz, self._cloud.position = event.target.wxyz, centre - rotation @ centre

        arcs.on_update(turned)

    def _mover(self, corner: int) -> Any:
        """Return what follows a corner."""

        async def moved(event: Any) -> None:
            self.move(corner, np.array(event.target.position, float))
            self._show(splats=event.phase == "end")

        return moved

    def _show(self, *, splats: bool = True) -> None:
        """Show box and command line, and the splats, faint where they would be cut."""
        scene = self._server.scene
        bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
        corners = np.where(bits, self.high, self.low)
        lines: dict[str, Any] = {"colors": (255, 120, 30), "thickness": 2.0, "thickness_units": "screen"}
        scene.add_line_segments("/box", corners[np.array(EDGES)].astype(np.float32), **lines)
        means = self._upright.means
        inside = np.all((means >= self.low) & (means <= self.high), axis=1)
        if splats:
            part = slice(None, None, max(1, -(-self._upright.count // SHOWN)))
            shown = self._upright.subset(np.arange(self._upright.count)[part])
            opacity = np.where(inside[part], 1.0, FAINT) * shown.opacities
            unit = float(np.median(shown.scales.max(axis=1)))  # viser keeps covariances in half precision
            self._cloud = scene.add_gaussian_splats(
                "/splats", centers=shown.means / unit, scale=unit,
                covariances=(shown.covariances() / unit**2).clip(-6e4, 6e4).astype(np.float32),
                rgbs=shown.colors(), opacities=opacity[:, None].astype(np.float32),
            )  # fmt: skip
        self._command.value = self.command
        self._told.content = f"{np.count_nonzero(inside)} of {len(inside)} splats; **{self.up}** of the file is up"
