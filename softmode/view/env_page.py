"""`EnvPage`: an environment as it is now, in the browser, for people who look on; `render_mode="human"` opens one."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from softmode.scenes.host import host
from softmode.scenes.meshes import SceneMesh, scene_meshes
from softmode.splats.splats import SH_DC
from softmode.view.app import ViewOptions, aim
from softmode.view.live_types import SplatPicture
from softmode.view.page import Page, open_browser
from softmode.view.picture import SIX, goal_marker
from softmode.view.stage import Stage

if TYPE_CHECKING:
    from softmode.envs.soft_env import SoftEnv


class EnvPage(Page):
    """A page that shows an environment, one picture per step, no faster than its rate.

    Args:
        env: The environment, made with a render mode.
        options: Where the page is served; at any free port of this machine by default.

    Raises:
        ConfigError: If the address or the port cannot be used.
        MissingExtraError: If viser is not installed.
    """

    def __init__(self, env: SoftEnv, options: ViewOptions | None = None) -> None:
        """Start the server, say where, and open a browser where there is a display."""
        super().__init__(options or ViewOptions(port=0))
        self._period, self._due = 1.0 / env.metadata["render_fps"], 0.0
        try:
            self._stage = Stage(self._server, _Watched(env.task))
            aim(self._server)
        except BaseException:
            self.close()
            raise
        print(f"softmode: open {self.url} in a browser", file=sys.stderr, flush=True)
        open_browser(self.url)

    def show(self) -> None:
        """Show the environment as it is now, and wait until the next picture is due."""
        if self._server.get_clients():
            self._stage.update()
        now = time.perf_counter()
        time.sleep(max(self._due - now, 0.0))
        self._due = max(self._due, now) + self._period


class _Watched:
    """What a stage shows of a task's world 0."""

    def __init__(self, task: Any) -> None:
        """Remember the task."""
        self._task, self._scene = task, task.scene
        self._ring = goal_marker(task) if task.goal_ring else None
        last = self._scene.splats.columns[-1]
        self._shown = slice(0, last.start if self._ring is not None else last.stop)
        self.size = 2.0 * self._scene.soft.radius

    @property
    def generation(self) -> tuple[int, ...]:
        """Changes where other objects are there."""
        return tuple(self._scene.occupancy.by_world.numpy().ravel().tolist())

    def splats(self) -> SplatPicture:
        """Return the splats of objects and goal."""
        scene, at = self._scene, self._shown
        scene.move_splats()
        arrays = scene.splats.arrays
        means, six = arrays.means.numpy()[0, at], arrays.covariances.numpy()[0, at]
        colors, opacities = 0.5 + SH_DC * arrays.sh.numpy()[0, at, 0], arrays.opacities.numpy()[0, at]
        covariances = six[:, SIX].reshape(-1, 3, 3)
        if self._ring is not None:
            goal = scene.marker_place.numpy()[0, :3]
            means = np.concatenate([means, self._ring.means + goal])
            covariances = np.concatenate([covariances, self._ring.covariances()]).astype(np.float32)
            colors = np.concatenate([colors, self._ring.colors()])
            opacities = np.concatenate([opacities, self._ring.opacities])
        return SplatPicture(means=means, covariances=covariances, colors=colors, opacities=opacities)

    def meshes(self) -> tuple[SceneMesh, ...]:
        """Return the meshes of the rigid shapes."""
        return scene_meshes(self._scene.model)

    def poses(self) -> NDArray[np.float32]:
        """Return the poses of the rigid bodies, shape (B, 7)."""
        return host(self._scene.state.body_q).astype(np.float32).reshape(-1, 7)

    def bounds(self) -> NDArray[np.float64]:
        """Return the corners of a box around what is worth seeing [m], shape (2, 3)."""
        return np.array([[-0.08, -0.2, 0.0], [0.6, 0.2, 0.45]])
