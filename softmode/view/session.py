"""`LiveSession`: a soft body, or an environment with its robot, that runs in real time and is pulled, pinned and tuned.

All calls must come from one thread.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.materials import Material
from softmode.envs.objects import ObjectConfig
from softmode.view.live_types import (
    DragView,
    Energies,
    Hit,
    HoldName,
    LiveOptions,
    LiveParameters,
    LiveStatus,
    PinView,
    SceneName,
    SplatPicture,
)


class LiveSession:
    """Soft objects that run in real time while they are pulled, pinned and tuned; make one by `from_object`, `from_env`.

    Nothing here draws or serves: `advance` moves time, `splats`, `meshes` and `poses` are what to show, the rest is what
    a person does. All calls must come from one thread.
    """

    @classmethod
    def from_object(
        cls,
        source: ObjectConfig | str | Path | None = None,
        *,
        scene: SceneName = "hang",
        hold: HoldName = "top",
        size: float | None = None,
        material: Material | None = None,
        options: LiveOptions | None = None,
        device: Any = None,
        progress: Any = None,
    ) -> LiveSession:
        """Make a session with one object.

        Args:
            source: What it is: a configuration, the file of a splat, a mesh or a saved body (.npz), None for the
                built-in plush.
            scene: "hang": held by one end, nothing around it. "drop": above a table.
            hold: Which end a hanging object is held by.
            size: Longest edge of the object [m]; None for the configuration's.
            material: What it is made of.
            options: How the session runs.
            device: Warp device.
            progress: Reports the build of the object.

        Raises:
            ConfigError: If an option is unknown or out of range.
            AssetError: If the file cannot be used.
        """
        raise NotImplementedError

    @classmethod
    def from_env(
        cls,
        name: str = "softmode/LiftSoft-v0",
        *,
        policy: str = "scripted",
        config: Any = None,
        seed: int = 0,
        options: LiveOptions | None = None,
        device: Any = None,
        progress: Any = None,
    ) -> LiveSession:
        """Make a session with an environment, whose policy goes on while a person pulls the object.

        An episode that ends is followed by the next one; while something is dragged or pinned its time limit waits.

        Args:
            name: Id of the environment.
            policy: "scripted", "random", "zero", or the file of a trained policy.
            config: The task's configuration; None for the default.
            seed: Seed of the first episode.
            options: How the session runs.
            device: Warp device.
            progress: Reports the build of the object.

        Raises:
            ConfigError: If the environment or the policy is unknown, or an option out of range.
        """
        raise NotImplementedError

    # -- time ---------------------------------------------------------------------------------------------------------

    def advance(self, frame_dt: float) -> float:
        """Let up to `frame_dt` [s] of simulated time pass, if the session plays; call it once per frame.

        Takes whole blocks of physics steps (1/120 s, a control step with an environment), carries the rest over to the
        next call, and takes no more than fit in `LiveOptions.budget` of the frame.

        Returns:
            The simulated time that passed [s].

        Raises:
            ConfigError: If `frame_dt` is not a finite number >= 0.
        """
        raise NotImplementedError

    def play(self) -> None:
        """Let time run; a session starts playing."""
        raise NotImplementedError

    def pause(self) -> None:
        """Stop time; drags and pins may still be moved, and take effect when it runs again."""
        raise NotImplementedError

    def step(self) -> float:
        """Take one block of physics steps, paused or not, and return the simulated time that passed [s]."""
        raise NotImplementedError

    def reset(self) -> None:
        """Start over: drags and pins are let go, a hanging object is held again, an environment begins an episode.

        Parameters stay as they are.
        """
        raise NotImplementedError

    def close(self) -> None:
        """Discard a recording that is being made and let go of the environment; may be called twice."""
        raise NotImplementedError

    # -- what to show -------------------------------------------------------------------------------------------------

    @property
    def size(self) -> float:
        """Diagonal of the first object's bounding box at rest [m]."""
        raise NotImplementedError

    def bounds(self) -> NDArray[np.float64]:
        """Return the corners of a box around what is worth seeing at the start [m], shape (2, 3)."""
        raise NotImplementedError

    def splats(self) -> SplatPicture:
        """Return the splats of all objects as they are now, in arrays of their own."""
        raise NotImplementedError

    def meshes(self) -> tuple[Any, ...]:
        """Return the meshes of the rigid shapes, `softmode.viz.scene_meshes.SceneMesh`; they do not change."""
        raise NotImplementedError

    def poses(self) -> NDArray[np.float32]:
        """Return the poses of the rigid bodies: position [m] and quaternion (x, y, z, w), shape (B, 7)."""
        raise NotImplementedError

    def surface(self, object_index: int = 0) -> NDArray[np.float64]:
        """Return the surface samples of an object as they are now [m], shape (S, 3)."""
        raise NotImplementedError

    def centre(self, object_index: int = 0) -> NDArray[np.float64]:
        """Return the centre of mass of an object [m], shape (3,)."""
        raise NotImplementedError

    def status(self) -> LiveStatus:
        """Return times, flags and the rewards of the environment."""
        raise NotImplementedError

    def energies(self) -> Energies:
        """Return the energies of all objects."""
        raise NotImplementedError

    # -- pulling and pinning ------------------------------------------------------------------------------------------

    def pick(self, origin: ArrayLike, direction: ArrayLike) -> Hit | None:
        """Return where a ray meets the splats, or None: where half of the light behind is gone.

        Args:
            origin: Where the ray starts [m], shape (3,).
            direction: Its direction, of any length but zero, shape (3,).

        Raises:
            ConfigError: If they are not finite, or the direction is zero.
        """
        raise NotImplementedError

    def begin_drag(self, hit: Hit) -> None:
        """Put a damped spring between a point of an object and the cursor, which is at that point; ends another drag."""
        raise NotImplementedError

    def drag_to(self, point: ArrayLike) -> None:
        """Move the cursor to a point [m]; the spring's end gets there in the course of the next frame.

        Raises:
            ConfigError: If nothing is dragged, or the point is not finite.
        """
        raise NotImplementedError

    def end_drag(self) -> None:
        """Let go; does nothing if nothing is dragged."""
        raise NotImplementedError

    def drag(self) -> DragView | None:
        """Return the drag, or None."""
        raise NotImplementedError

    def pin(self, hit: Hit, radius: float | None = None) -> int:
        """Hold the region around a point of an object where it is, in its present shape.

        Args:
            hit: The point.
            radius: How far the region reaches from it at rest [m]; None for a tenth of the size.

        Returns:
            Number of the pin, for `move_pin` and `unpin`.

        Raises:
            ConfigError: If the radius is not a finite number > 0, or there are `LiveOptions.pin_max` pins already.
        """
        raise NotImplementedError

    def move_pin(self, pin: int, position: ArrayLike, wxyz: ArrayLike | None = None) -> None:
        """Move the centre of a pinned region to a point [m], and turn the region, in the course of the next frame.

        Args:
            pin: What `pin` returned.
            position: Where its centre shall be, shape (3,).
            wxyz: Turn since it was pinned, a quaternion; None keeps the present one.

        Raises:
            ConfigError: If there is no such pin, or a number is not finite.
        """
        raise NotImplementedError

    def unpin(self, pin: int) -> None:
        """Let a pinned region go.

        Raises:
            ConfigError: If there is no such pin.
        """
        raise NotImplementedError

    def pins(self) -> dict[int, PinView]:
        """Return the pins by number; the one that a hanging object is held by is among them."""
        raise NotImplementedError

    # -- parameters ---------------------------------------------------------------------------------------------------

    @property
    def parameters(self) -> LiveParameters:
        """The present values, of the first object."""
        raise NotImplementedError

    def set_parameters(
        self,
        *,
        youngs_modulus: float | None = None,
        poissons_ratio: float | None = None,
        density: float | None = None,
        viscosity: float | None = None,
        mass_damping: float | None = None,
        friction: float | None = None,
        gravity: float | ArrayLike | None = None,
    ) -> None:
        """Change parameters of all objects, at once and while time runs; None leaves one.

        Args:
            youngs_modulus: E [Pa].
            poissons_ratio: nu.
            density: rho [kg/m^3].
            viscosity: beta of Rayleigh's damping [s].
            mass_damping: alpha of Rayleigh's damping [1/s].
            friction: Coulomb coefficient of the objects.
            gravity: A vector [m/s^2], shape (3,), or its magnitude downwards.

        Raises:
            ConfigError: If a value lies outside its range; nothing is changed then.
        """
        raise NotImplementedError

    def set_handles(self, count: int) -> None:
        """Give the object another number of skinning eigenmodes: builds it anew, or takes it from the cache.

        Position, deformation and velocity are carried over by least squares, pins are kept, a drag ends. With an
        environment a new episode begins.

        Raises:
            ConfigError: If the count lies outside 0..64, or the object came as a saved body, which cannot be rebuilt.
        """
        raise NotImplementedError

    # -- recording ----------------------------------------------------------------------------------------------------

    def start_recording(
        self, path: str | Path, *, position: ArrayLike | None = None, target: ArrayLike | None = None, edge: int = 480
    ) -> None:
        """Record from now on: ".mp4" draws pictures, ".npz" keeps coordinates and poses, 30 frames per simulated second.

        Args:
            path: The file; it appears when the recording is stopped, complete or not at all.
            position: Where the camera stands [m]; None for a view of all.
            target: Where it looks [m].
            edge: Width and height of the pictures [px].

        Raises:
            ConfigError: If a recording is being made, or the path has another suffix or cannot be written.
            MissingExtraError: If what encodes videos is not installed.
        """
        raise NotImplementedError

    def stop_recording(self) -> Path:
        """Write the recording and return its path.

        Raises:
            ConfigError: If none is being made, or it has no frame.
        """
        raise NotImplementedError
