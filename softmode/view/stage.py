"""What a browser shows of a live session: splats, meshes with poses, what can be gripped, the drag and the pins."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import KDTree

from softmode.view.gaussians import GaussianBuffer
from softmode.view.live_types import DragView, SplatPicture, Vector

if TYPE_CHECKING:
    import viser

GRIP_MAX = 400
"""Spheres that receive the mouse."""
DRAG_COLOR = (255, 120, 30)
DRAG_HINT = "drag the toy with the mouse"
"""What is written below the object until somebody does."""
PIN_HINT = "held here: pull the arrows to move it"
"""What is written at the first pin."""
Handler = Callable[[Any], Coroutine[Any, Any, None]]


class Stage:
    """The three-dimensional half of the page. All calls from the thread of the session, handlers from viser's.

    Args:
        server: Where it is shown.
        session: What is shown, a `LiveSession`; or less of one where nobody touches it.
        on_drag: Called with viser's drag events on the object; they hold world positions and the client. None for a
            stage to look at, whose session has neither drags nor pins.
        on_click: The same for clicks.
        on_pin: Called with the number of a pin, a position and a quaternion (w, x, y, z) when its gizmo is moved.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Any,
        *,
        on_drag: Handler | None = None,
        on_click: Handler | None = None,
        on_pin: Callable[[int, Vector, Vector], None] | None = None,
    ) -> None:
        """Build the scene."""
        self._server, self._session, self._on_pin = server, session, on_pin
        self._on_drag, self._on_click, self._clickable = on_drag, on_click, False
        self.size = session.size
        self._look()
        self._add_meshes()
        self._add_objects()
        if on_drag is None:
            return
        self.stroke: tuple[Vector, Vector] | None = None
        """Ends of the stroke that somebody draws [m], or None."""
        nowhere = np.zeros((1, 2, 3), np.float32)
        self._line = server.scene.add_line_segments(
            "/drag", nowhere, colors=DRAG_COLOR, thickness=4.0, thickness_units="screen", visible=False
        )
        self._grip = server.scene.add_icosphere(
            "/grip", radius=0.02 * self.size, color=DRAG_COLOR, visible=False, cast_shadow=False
        )
        self._gizmos: dict[int, Any] = {}
        low, high = session.bounds()
        below = (*(0.5 * (low + high))[:2].tolist(), float(low[2]) - 0.05 * self.size)
        self._hint: Any = server.scene.add_label("/hint", DRAG_HINT, position=below, anchor="top-center")

    def update(self) -> None:
        """Show the session as it is now."""
        if self._generation != self._session.generation:
            self._splats.remove()
            if self._on_drag is not None:
                self._grips.remove()
            self._add_objects()
        picture = self._session.splats()
        words = self._gaussians.pack(picture.means, picture.covariances)
        poses = self._session.poses()
        grips = None if self._on_drag is None else self._surfaces()[self._grip_samples].astype(np.float32)
        with self._server.atomic():  # one message: splats never run ahead of the hand that holds them
            self._splats.buffer = words
            for body, frame in self._frames.items():
                x, y, z, i, j, k, w = poses[body].tolist()
                frame.position, frame.wxyz = (x, y, z), (w, i, j, k)
            if grips is not None:
                self._grips.batched_positions = grips
                self._show_drag(self._session.drag())
                self._show_pins()
        self._server.flush()

    def _look(self) -> None:
        """Put the camera where the whole scene is seen, and a grid below."""
        low, high = self._session.bounds()
        centre, reach = 0.5 * (low + high), float(np.linalg.norm(high - low))
        scene, camera = self._server.scene, self._server.initial_camera
        scene.set_up_direction("+z")
        camera.up = (0.0, 0.0, 1.0)
        camera.fov = 0.7
        right = np.array([1.15, 0.85, 0.0]) / np.hypot(1.15, 0.85)
        middle = centre + 0.15 * reach * right  # the panel covers the right of the page
        camera.look_at = tuple(middle)
        camera.position = tuple(middle + reach * np.array([0.95, -1.25, 0.6]))
        camera.near, camera.far = 0.02 * reach, 100.0 * reach
        self._floor = float(low[2]) - 0.3 * reach  # room to pull
        self._centre, self._reach = centre, reach

    def _add_meshes(self) -> None:
        """Add the rigid shapes, each below the frame of its body."""
        scene, meshes = self._server.scene, self._session.meshes()
        self._frames: dict[int, Any] = {
            body: scene.add_frame(f"/bodies/{body}", show_axes=False)
            for body in sorted({mesh.body for mesh in meshes if mesh.body >= 0})
        }
        for number, mesh in enumerate(meshes):
            parent = f"/bodies/{mesh.body}" if mesh.body >= 0 else "/world"
            name, color = f"{parent}/{number}", np.rint(255.0 * np.array(mesh.color)).astype(np.uint8)
            opacity = None if mesh.opacity >= 1.0 else mesh.opacity
            scene.add_mesh_simple(
                name, mesh.vertices, mesh.faces, color=color, opacity=opacity, side="double", flat_shading=False
            )
        if not meshes:  # nothing else tells up from down
            edge, at = 4.0 * self._reach, (float(self._centre[0]), float(self._centre[1]), self._floor)
            scene.add_grid(
                "/grid", width=edge, height=edge, cell_size=0.1 * self._reach, section_size=self._reach, position=at
            )

    def _add_objects(self) -> None:
        """Add the splats, and what receives the mouse."""
        picture, self._generation = self._session.splats(), self._session.generation
        self._gaussians = GaussianBuffer(picture)
        unit = self._gaussians.unit
        self._splats = self._server.scene.add_gaussian_splats(
            "/splats",
            centers=picture.means / unit,
            covariances=(picture.covariances / unit**2).clip(-6e4, 6e4),
            rgbs=picture.colors.clip(0.0, 1.0),
            opacities=picture.opacities.reshape(-1, 1).clip(0.0, 1.0),
            scale=unit,
        )
        if self._on_drag is not None:
            self._add_grips(picture, self._on_drag)

    def _surfaces(self) -> Vector:
        """Return the surface samples of all objects [m], shape (S, 3)."""
        return np.concatenate([self._session.surface(k) for k in range(len(self._session.objects))])

    def _add_grips(self, picture: SplatPicture, on_drag: Handler) -> None:
        """Cover the object with invisible spheres that receive the mouse.

        Splats receive none. A mesh does, but viser's own materials write depth even where they are transparent, which
        would cut the splats behind; one of a GLB that blends does not.
        """
        surface = self._surfaces()
        keep = np.linspace(0, len(surface) - 1, min(len(surface), GRIP_MAX)).round().astype(int)
        self._grip_samples = np.unique(keep)
        samples = surface[self._grip_samples]
        distance = KDTree(samples).query(picture.means)[0]
        near = distance[distance < 0.25 * self.size]  # an environment has other splats too
        radius = 1.3 * float(np.quantile(near, 0.95)) if len(near) else 0.1 * self.size
        turns = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(samples), 1))
        places: dict[str, Any] = {"batched_wxyzs": turns, "batched_positions": samples.astype(np.float32)}
        self._grips = self._server.scene.add_batched_glb(
            "/grips", _invisible_sphere(radius), **places, lod="off", cast_shadow=False, receive_shadow=False
        )
        self._grips.on_drag("left")(on_drag)
        if self._clickable:
            self.set_clickable(True)

    def set_clickable(self, clickable: bool) -> None:
        """Let clicks on the object through, or not; where they are, the browser outlines what is under the mouse."""
        self._clickable = clickable
        if clickable and self._on_click is not None:
            self._grips.on_click(self._on_click)
        else:
            self._grips.remove_click_callback("all")

    def _show_drag(self, drag: DragView | None) -> None:
        """Show a line from the gripped point to the cursor, or a stroke."""
        line = self.stroke if drag is None else (drag.point, drag.target)
        if line is not None:
            if self._hint is not None:  # known now
                self._hint.remove()
                self._hint = None
            self._line.points = np.array([line], np.float32)
            self._grip.position = tuple(line[0])
        self._line.visible = self._grip.visible = line is not None

    def _show_pins(self) -> None:
        """Add, move and remove the gizmos of pins."""
        pins = self._session.pins()
        for number in set(self._gizmos) - set(pins):
            self._gizmos.pop(number).remove()
        for number, pin in pins.items():
            if number not in self._gizmos:
                self._gizmos[number] = self._add_gizmo(number, pin.position, pin.wxyz)

    def move_gizmo(self, number: int, position: Vector) -> None:
        """Put the gizmo of a pin that is moved otherwise where the pin is."""
        if number in self._gizmos:
            self._gizmos[number].position = tuple(position)

    def _add_gizmo(self, number: int, position: Vector, wxyz: Vector) -> Any:
        """Add the gizmo that moves a pin."""
        pose: dict[str, Any] = {"position": tuple(position), "wxyz": tuple(wxyz)}
        gizmo = self._server.scene.add_transform_controls(
            f"/pins/{number}", scale=0.4 * self.size, **pose, depth_test=False, opacity=0.7
        )

        async def moved(event: Any) -> None:
            assert self._on_pin is not None
            self._on_pin(number, np.array(event.target.position), np.array(event.target.wxyz))

        gizmo.on_update(moved)
        if number == min(self._session.pins()):
            self._server.scene.add_label(f"/pins/{number}/label", PIN_HINT, anchor="bottom-center")
        return gizmo


def _invisible_sphere(radius: float) -> bytes:
    """Return a GLB with a sphere that is blended with opacity zero: it writes neither colour nor depth."""
    import trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    sphere = trimesh.creation.icosphere(subdivisions=1, radius=radius)
    sphere.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=[255, 255, 255, 0], alphaMode="BLEND"))
    data = sphere.export(file_type="glb")
    assert isinstance(data, bytes)
    return data
