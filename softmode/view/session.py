"""`LiveSession`: a soft body, or an environment with its robot, that runs in real time and is pulled, pinned and tuned.

All calls must come from one thread.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from softmode.checks import require_number
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.deformables.model.namespaces import soft
from softmode.deformables.model.status import status_reasons
from softmode.deformables.reduction.hold import hold, paint
from softmode.deformables.reduction.patch import Patch
from softmode.deformables.reduction.sources import unpack_sources
from softmode.deformables.tools.energies import SoftEnergies
from softmode.deformables.tools.grips import Grip
from softmode.errors import ConfigError, SoftmodeError
from softmode.objects.config import ObjectConfig
from softmode.objects.cut import cut_object
from softmode.objects.object_file import write_object
from softmode.objects.paint import brushed, require_factor
from softmode.objects.soft_object import SoftObject
from softmode.scenes.host import host
from softmode.scenes.meshes import SceneMesh, scene_meshes
from softmode.scenes.motion import coordinates, motion_of, set_motion
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.view import live_parameters
from softmode.view.hands import Hands
from softmode.view.live_recording import LiveRecording
from softmode.view.live_scenes import EnvScene, LiveScene, ObjectScene, grips_strength
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
    finite_vector,
)
from softmode.view.pace import Pace
from softmode.view.picture import LivePicture
from softmode.view.pin_builds import Builds, Finish, held_untold, pin_regions
from softmode.view.recorders import RECORD_HZ, Recorder, live_camera, make_recorder
from softmode.view.sources import load_source, with_functions

Origin = ObjectConfig | tuple[SoftObject, ...]
"""What a scene is made of: a configuration, or objects as they are; none of them for what was first given."""


class LiveSession:
    """Soft objects that run in real time while they are pulled, pinned and tuned.

    Made by `from_object` or `from_env`. Nothing here draws or serves: `advance` moves time, `splats`, `meshes` and
    `poses` are what to show, the rest is what a person does. All calls must come from one thread.
    """

    def __init__(self, make: Callable[[Origin], LiveScene], options: LiveOptions) -> None:
        """Make the scene; use `from_object` or `from_env`."""
        self.options, self._make = options, make
        self._source: ObjectConfig | None = None
        self._live = make(())
        self._given: dict[str, Any] = {}
        self._playing = True
        self._recorder: Recorder | None = None
        self._hands, self._builds, self._message = Hands(options), Builds(), ""
        self._whole: tuple[SoftObject, ...] = ()
        self.generation = 0
        """Counts how often the objects were exchanged for others: their splats and samples are others then."""
        self._share: tuple[tuple[int, tuple[int, ...]], float] = ((0, ()), 0.0)
        self._clock, self._record_from = 0.0, 0.0
        self._bind()

    def _bind(self) -> None:
        """Take up a scene that has just been made."""
        self._scene = scene = self._live.scene
        self._picture = LivePicture(scene.objects, scene.model, self._live.marker)
        self._energies, self._first_body = SoftEnergies(scene.solver), scene.objects[0].body
        self._solver = scene.solver
        self._meshes: tuple[SceneMesh, ...] | None = None
        self.generation += 1
        self._painted: list[tuple[int, ReducedBody]] = []
        self._pace = Pace(self._live.block_dt, self.options.budget)
        self._begin()

    def _begin(self) -> None:
        """Forget what belongs to the time before a reset."""
        self._time, self._bits, self._stale = 0.0, 0, True
        self._pace.begin()
        self._hands.take_up(self._scene)
        self._solver.status.zero_()

    @classmethod
    def from_object(
        cls,
        source: ObjectConfig | SoftObject | str | Path | None = None,
        *,
        scene: SceneName = "hang",
        hold: HoldName = "top",
        size: float | None = None,
        material: Material | None = None,
        options: LiveOptions | None = None,
        device: wp.DeviceLike = None,
        progress: Any = None,
    ) -> LiveSession:
        """Make a session with one object.

        Args:
            source: What it is: a configuration, an object, the file of a splat, a mesh, a point cloud, a body or an
                OpenUSD stage (its first deformable body, or its splats), None for the built-in plush.
            scene: "hang": held by one end, nothing around it. "drop": above a table.
            hold: Which end a hanging object is held by.
            size: Longest edge of the object [m]; None for the configuration's.
            material: What it is made of; None for what the file says, else 1e5 Pa and 250 kg/m^3.
            options: How the session runs.
            device: Warp device.
            progress: Reports the build of the object.

        Raises:
            ConfigError: If an option is unknown or out of range.
            AssetError: If the file cannot be used.
        """
        chosen = options or LiveOptions()

        first = load_source(source, size, progress)

        def make(origin: Origin) -> LiveScene:
            given = isinstance(origin, ObjectConfig)
            found, objects = (load_source(origin, None, progress), ()) if given else (first, origin)
            made = material or found.object.material or Material(youngs_modulus=1.0e5, density=250.0)
            return ObjectScene(found, objects, scene, hold, made, chosen, device)

        return cls(make, chosen)

    @classmethod
    def from_env(
        cls,
        name: str = "softmode/LiftSoft-v0",
        *,
        policy: str = "scripted",
        config: Any = None,
        seed: int = 0,
        options: LiveOptions | None = None,
        device: wp.DeviceLike = None,
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
        chosen = options or LiveOptions()

        def make(origin: Origin) -> LiveScene:
            source = origin if isinstance(origin, ObjectConfig) else None
            return EnvScene(name, policy, config, seed, chosen, device, progress, source)

        return cls(make, chosen)

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
        require_number("frame_dt", frame_dt, at_least=0.0, unit="s")
        self._take_build()
        now = time.perf_counter()
        if not self._playing:
            return 0.0
        passed = self._run(self._pace.blocks(frame_dt))
        self._pace.frame(now, passed)
        return passed

    def play(self) -> None:
        """Let time run; a session starts playing."""
        self._playing = True
        self._pace.begin()

    def pause(self) -> None:
        """Stop time; drags and pins may still be moved, and take effect when it runs again."""
        self._playing = False
        self._pace.pause()

    def step(self) -> float:
        """Take one block of physics steps, paused or not, and return the simulated time that passed [s]."""
        return self._run(1)

    def reset(self) -> None:
        """Start over: drags and pins are let go, a hanging object is held again, an environment begins an episode.

        Parameters stay as they are. An object that was cut is whole again.

        Raises:
            ConfigError: If an object that was cut is being recorded.
        """
        self._hands.let_go()
        self._builds.forget()
        self._message = ""
        if self._whole:
            self._refuse_while_recording("the object is whole again")
            whole, self._whole = self._whole, ()
            self._remake(whole)
        else:
            self._live.reset()
        live_parameters.apply(self._scene, self._given)
        self._begin()

    def close(self) -> None:
        """Discard a recording that is being made and let go of the environment; may be called twice."""
        if self._recorder is not None:
            self._recorder.discard()
            self._recorder = None
        self._builds.close()
        self._live.close()

    # -- what to show -------------------------------------------------------------------------------------------------

    @property
    def object(self) -> SoftObject:
        """The first soft object."""
        return self._object(0)

    @property
    def objects(self) -> tuple[SoftObject, ...]:
        """The soft objects: more than one after a cut."""
        return self._scene.objects

    @property
    def size(self) -> float:
        """Diagonal of the first object's bounding box at rest [m]."""
        return float(self._solver.view.instances.size.numpy()[0])

    def bounds(self) -> NDArray[np.float64]:
        """Return the corners of a box around what is worth seeing at the start [m], shape (2, 3)."""
        corners = self.splats().means
        if isinstance(self._live, EnvScene):
            corners = np.concatenate([corners, [[-0.08, -0.2, 0.0], [0.6, 0.2, 0.45]]])
        return np.stack([corners.min(axis=0), corners.max(axis=0)]).astype(np.float64)

    def splats(self) -> SplatPicture:
        """Return the splats of all objects as they are now, in arrays of their own."""
        self._show()
        return self._picture.read()

    def meshes(self) -> tuple[SceneMesh, ...]:
        """Return the meshes of the rigid shapes; they do not change."""
        if self._meshes is None:
            self._meshes = scene_meshes(self._scene.model)
        return self._meshes

    def poses(self) -> NDArray[np.float32]:
        """Return the poses of the rigid bodies: position [m] and quaternion (x, y, z, w), shape (B, 7)."""
        return host(self._scene.state.body_q).astype(np.float32).reshape(-1, 7)

    def surface(self, object_index: int = 0) -> NDArray[np.float64]:
        """Return the surface samples of an object as they are now [m], shape (S, 3)."""
        count = self._object(object_index).body.surface_count
        start = int(soft(self._scene.model).particle_start.numpy()[object_index])
        return host(self._scene.state.particle_q)[start : start + count].astype(np.float64)

    def centre(self, object_index: int = 0) -> NDArray[np.float64]:
        """Return the centre of mass of an object [m], shape (3,)."""
        return self._object(object_index).body.mean_basis @ coordinates(self._scene, "q", object_index)

    def status(self) -> LiveStatus:
        """Return times, flags and the rewards of the environment."""
        live = self._live
        return LiveStatus(
            time=self._time,
            playing=self._playing,
            realtime_factor=self._pace.factor,
            step_milliseconds=1e3 * self._pace.block_seconds / live.block_steps,
            solver=status_reasons(self._bits),
            recording=self._recorder is not None,
            notice=self._notice(),
            reward_terms=dict(live.terms),
            success=live.success,
            episode=live.episode,
        )

    def energies(self) -> Energies:
        """Return the energies of all objects."""
        self._energies.update(self._scene.state)
        energies = {name: getattr(self._energies, name) for name in ("kinetic", "elastic", "gravitational")}
        return Energies(**{name: float(values.numpy().sum()) for name, values in energies.items()})

    # -- pulling and pinning ------------------------------------------------------------------------------------------

    def pick(self, origin: ArrayLike, direction: ArrayLike) -> Hit | None:
        """Return where a ray meets the splats, or None: where half of the light behind is gone.

        Args:
            origin: Where the ray starts [m], shape (3,).
            direction: Its direction, of any length but zero, shape (3,).

        Raises:
            ConfigError: If they are not finite, or the direction is zero.
        """
        start, way = finite_vector("origin", origin), finite_vector("direction", direction)
        length = float(np.linalg.norm(way))
        if length < 1e-12:
            raise ConfigError("direction is zero", hint="give the direction of the ray")
        self._show()
        return self._picture.pick(start, way / length, self._scene.state)

    def begin_drag(self, hit: Hit) -> None:
        """Put a damped spring between a point of an object and the cursor, which is at that point.

        Another drag ends.
        """
        self._hands.begin_drag(hit)

    def drag_to(self, point: ArrayLike) -> None:
        """Move the cursor to a point [m]; the spring's end gets there in the course of the next frame.

        Raises:
            ConfigError: If nothing is dragged, or the point is not finite.
        """
        self._hands.drag_to(point)

    def end_drag(self) -> None:
        """Let go; does nothing if nothing is dragged."""
        self._hands.end_drag()

    def drag(self) -> DragView | None:
        """Return the drag, or None."""
        return self._hands.drag()

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
        return self._hands.pin(hit, radius)

    def move_pin(self, pin: int, position: ArrayLike, wxyz: ArrayLike | None = None) -> None:
        """Move the centre of a pinned region to a point [m], and turn the region, in the course of the next frame.

        Args:
            pin: What `pin` returned.
            position: Where its centre shall be, shape (3,).
            wxyz: Turn since it was pinned, a quaternion; None keeps the present one.

        Raises:
            ConfigError: If there is no such pin, or a number is not finite.
        """
        self._hands.move_pin(pin, position, wxyz)

    def unpin(self, pin: int) -> None:
        """Let a pinned region go.

        Raises:
            ConfigError: If there is no such pin.
        """
        self._hands.unpin(pin)

    def pins(self) -> dict[int, PinView]:
        """Return the pins by number; the one that a hanging object is held by is among them."""
        return self._hands.pins()

    # -- parameters ---------------------------------------------------------------------------------------------------

    @property
    def parameters(self) -> LiveParameters:
        """The present values, of the first object."""
        return live_parameters.present(self._scene)

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
        values = {"youngs_modulus": youngs_modulus, "poissons_ratio": poissons_ratio, "density": density}
        values |= {"viscosity": viscosity, "mass_damping": mass_damping, "friction": friction}
        self._given |= live_parameters.checked(gravity, values)
        live_parameters.apply(self._scene, self._given)

    def set_functions(self, count: int) -> None:
        """Give the object another number of functions: builds it anew, or takes it from the cache.

        Position, deformation and velocity are carried over by least squares, pins keep their numbers, a drag ends. With
        an environment a new episode begins.

        Raises:
            ConfigError: If the count lies outside 10..120, the object came as a saved body, which cannot be rebuilt, or
                it has been cut.
        """
        self._refuse_while_recording("the functions change")
        if self._whole:
            raise ConfigError("the object is cut", hint="reset first, which makes it whole")
        source = with_functions(self._source or self._live.source, count)
        if count != self._object(0).body.function_count:
            self._exchange(source, (0,))
            self._source = source

    def build_for_pins(self) -> None:
        """Build the object anew for the regions that are pinned now, in the background; time runs on.

        A body that was not built to be held in a place is too stiff around it, see :func:`softmode.deformables.hold`.
        The first `advance` after the build exchanges the body, when nothing is dragged or recorded; motion is carried
        over and pins keep their numbers. `status` says in `notice` how it stands.

        Raises:
            ConfigError: With an environment, if nothing is pinned, if a build is under way, or if the object came as a
                body that does not keep what it was built from.
        """
        body, grips = self._object(0).body, self._pinned()
        if isinstance(self._live, EnvScene):
            raise ConfigError("an environment brings its object", hint="build its body with regions")
        if not grips:
            raise ConfigError("nothing is pinned", hint="pin a region first")
        first = self._first_body
        if not first.sources:
            raise ConfigError(f"body {body.name!r} does not keep what it was built from", hint="build it anew")
        regions = pin_regions(body, grips, grips_strength(self.options))

        def build() -> Finish:
            held = hold(first, *regions, progress=False)

            def finish() -> None:
                self._exchange_body(0, held)
                self._first_body = first

            return finish

        self._begin_build("building for the pins", build)

    def cut(self, patch: Patch) -> None:
        """Cut all objects by a patch where they are now, in the background; time runs on.

        The first `advance` after the build puts the parts in the place of what was cut, when nothing is dragged or
        recorded: they go on from where it is then, touch each other, and pins keep their numbers. `status` says in
        `notice` what happened. A reset makes the object whole again.

        Args:
            patch: What cuts, in the world [m].

        Raises:
            ConfigError: With an environment, or if a build is under way.
        """
        if isinstance(self._live, EnvScene):
            raise ConfigError("an environment brings its object", hint="cut it in a session of its own")
        objects, q = self._scene.objects, motion_of(self._scene).q

        def build() -> Finish:
            found = [cut_object(thing, patch, at, progress=False) for thing, at in zip(objects, q, strict=True)]

            def finish() -> None:
                owners = [k for k, (parts, _) in enumerate(found) for _ in parts]
                if not all(cut.missed for _, cut in found):
                    whole = self._whole or objects
                    self._exchange(tuple(part for parts, _ in found for part in parts), owners)
                    self._whole = whole
                told = [cut for _, cut in found if not cut.missed] or [cut for _, cut in found]
                self._message = "; ".join(note for cut in told for note in cut.notes)

            return finish

        self._begin_build("cutting", build)

    def paint(self, hits: Sequence[Hit], factor: float, *, radius: float, depth: float) -> None:
        """Make stiffer or softer what a brush has touched, in the background; time runs on.

        The first `advance` after the build exchanges the body, as with :meth:`build_for_pins`. The field is the body's:
        `save` keeps it.

        Args:
            hits: Where the brush touched, all on one object.
            factor: Young's modulus there over what it is now, 0.001 to 1000.
            radius: Radius of the brush [m], at rest and at the scale of the body.
            depth: How deep it reaches into the object [m], likewise.

        Raises:
            ConfigError: With an environment, if a build is under way, if there is no hit or no point of the object
                within reach, or radius or depth are no numbers > 0.
            MaterialError: If the factor lies outside its range, or what has been painted would.
        """
        if isinstance(self._live, EnvScene):
            raise ConfigError("an environment brings its object", hint="paint it in a session of its own")
        require_factor("factor", factor)
        if not hits:
            raise ConfigError("the brush has touched nothing", hint="draw on the object")
        index = hits[0].object_index
        body = self._object(index).body
        given = unpack_sources(body)
        X = np.array([hit.rest_point for hit in hits if hit.object_index == index])
        inward = -body.surface.normals[KDTree(body.surface.points).query(X)[1]]
        reached = brushed(given.quadrature.points, X + body.offset, inward, radius, depth)
        if not reached.any():
            raise ConfigError("no point of the object is within the brush's reach", hint="enlarge radius or depth")
        before = np.ones(len(reached)) if given.stiffness_scale is None else given.stiffness_scale
        field = np.where(reached, factor, 1.0) * before
        require_factor("stiffness", float(field[reached].max()))
        require_factor("stiffness", float(field[reached].min()))

        def build() -> Finish:
            painted = paint(body, stiffness_scale=field, progress=False)

            def finish() -> None:
                self._exchange_body(index, painted)
                self._painted.append((index, body))
                self._message = f"{factor:g} times as stiff: {int(reached.sum())} of {len(reached)} points"

            return finish

        self._begin_build("painting", build)

    def undo_paint(self) -> None:
        """Give the object the body that it had before the last stroke of the brush.

        Raises:
            ConfigError: If nothing was painted since the last cut or reset, or something is recorded or built.
        """
        self._refuse_while_recording("it is undone")
        if self._builds.what:
            raise ConfigError(f"a build is under way ({self._builds.what})", hint="wait until it is done")
        if not self._painted:
            raise ConfigError("nothing is painted", hint="paint first")
        index, body = self._painted.pop()
        self._exchange_body(index, body)
        self._message = ""

    def save(self, path: str | Path, object_index: int = 0) -> None:
        """Write an object as it is built now, with its splats, what was painted and what it is made of.

        Args:
            path: The .npz to write; `ReducedBody.load`, `load` and the commands read it.
            object_index: Which object.

        Raises:
            ConfigError: If there is no such object.
            StorageError: If it cannot be written.
        """
        thing, now = self._object(object_index), live_parameters.present(self._scene)
        made = {name: getattr(now, name) for name in ("youngs_modulus", "poissons_ratio", "density", "friction")}
        body = replace(thing.body, provenance={**thing.body.provenance, "material": json.dumps(made)})
        write_object(path, body, thing.splats, thing.radiance)

    def _begin_build(self, what: str, build: Callable[[], Finish]) -> None:
        """Build in the background."""
        self._builds.begin(what, build)
        self._message = ""

    def _refuse_while_recording(self, what: str) -> None:
        if self._recorder is not None:
            raise ConfigError("a recording is being made", hint=f"stop it before {what}")

    def _pinned(self) -> list[Grip]:
        """Return what holds the first object."""
        return [grip for grip in self._scene.grips[0].held.values() if not grip.pulls]

    def _take_build(self) -> None:
        """Take up what was built, if there is anything and nobody is busy with the object."""
        if self._recorder is not None or self._hands.dragging:
            return
        what = self._builds.what
        try:
            finish = self._builds.take()
            if finish is not None:
                finish()
        except SoftmodeError as error:
            self._message = f"{what} failed: {error}"

    def _notice(self) -> str:
        """Return what a person should know of pins, cuts and builds."""
        if self._builds.what:
            return f"{self._builds.what} ..."
        body, held = self._object(0).body, tuple(self._scene.grips[0].held)
        if self._share[0] != (id(body), held):
            self._share = ((id(body), held), held_untold(body, self._pinned()))
        share = self._share[1]
        hint = "build_for_pins() mends that" if body.sources and not isinstance(self._live, EnvScene) else ""
        stiff = f"pins hold {share:.0%} of {body.name!r}, which was not built for it and is too stiff; {hint}"
        return self._message or (stiff.rstrip("; ") if share else "")

    def _exchange_body(self, index: int, body: ReducedBody) -> None:
        """Give an object another build of its body."""
        objects, painted = list(self._scene.objects), self._painted
        objects[index] = replace(objects[index], body=body)
        self._exchange(tuple(objects), range(len(objects)))
        self._painted = painted

    def _exchange(self, origin: Origin, came_from: Sequence[int]) -> None:
        """Make the scene anew with other builds of its objects, or parts of them, and go on from where it is.

        Args:
            origin: What the scene is made of.
            came_from: Of each object, which one of the present ones it is or is a part of.
        """
        self.end_drag()
        before, pins, elapsed = motion_of(self._scene), self._hands.kept(), self._time
        self._remake(origin)  # a build that fails leaves all as it was
        if not isinstance(self._live, EnvScene):
            self._hands.hold_again(pins, before.bodies, came_from)
            set_motion(self._scene, before, came_from)
            self._time = elapsed
        live_parameters.apply(self._scene, self._given)

    def _remake(self, origin: Origin) -> None:
        """Make the scene anew."""
        made = self._make(origin)
        self._live.close()
        self._live = made
        self._bind()

    # -- recording ----------------------------------------------------------------------------------------------------

    def start_recording(
        self, path: str | Path, *, position: ArrayLike | None = None, target: ArrayLike | None = None, edge: int = 480
    ) -> None:
        """Record from now on, 30 frames per simulated second.

        Args:
            path: The file: ".mp4" draws pictures, ".npz" keeps coordinates for `show_frame`, ".usdc", ".usd" or ".usda"
                is an OpenUSD stage as `UsdAnimation` writes it. It appears when the recording is stopped, complete or
                not at all.
            position: Where the camera stands [m]; None for a view of all.
            target: Where it looks [m].
            edge: Width and height of the pictures [px].

        Raises:
            ConfigError: If a recording is being made, or the path has another suffix or cannot be written.
            MissingExtraError: If what encodes videos, or OpenUSD, is not installed.
        """
        if self._recorder is not None:
            raise ConfigError(f"{self._recorder.path} is being recorded", hint="stop that recording first")

        def camera() -> PinholeCamera:
            return live_camera(self._live.viewpoints, self.bounds(), position, target, edge)

        self._recorder = make_recorder(Path(path), self._scene, self._picture, camera)
        self._record_from = self._clock
        self._record()

    def show_frame(self, recording: LiveRecording, index: int) -> None:
        """Pause, and put everything where a frame of a recording has it, at rest; a reset makes it live again.

        Args:
            recording: A recording of the same objects.
            index: Which frame.

        Raises:
            ConfigError: If the recording is of other objects, or has no such frame.
        """
        recording.check(self._scene, index)
        self.pause()
        recording.show(self._scene, index)
        self._stale = True

    def stop_recording(self) -> Path:
        """Write the recording and return its path.

        Raises:
            ConfigError: If none is being made, or it has no frame.
        """
        if self._recorder is None:
            raise ConfigError("nothing is being recorded", hint="call start_recording first")
        recorder, self._recorder = self._recorder, None
        try:
            recorder.finish()
        finally:
            recorder.discard()
        return recorder.path

    # -- inside -------------------------------------------------------------------------------------------------------

    def _run(self, count: int) -> float:
        """Take blocks and return the simulated time that passed [s]."""
        live = self._live
        if count < 1:
            return 0.0
        for grips in self._scene.grips:
            grips.begin_frame(count * live.block_steps)
        self._bits, taken = 0, 0
        self._solver.status.zero_()
        for _ in range(count):
            if live.over(busy=self._hands.busy):
                self.reset()
                continue
            clock = time.perf_counter()
            live.step()
            self._bits |= int(self._solver.status.numpy()[0])  # waits for the device
            self._pace.took(time.perf_counter() - clock)
            taken += 1
            self._time += live.block_dt
            self._clock += live.block_dt
            self._stale = self._hands.moved = True
            self._record()
        return taken * live.block_dt

    def _show(self) -> None:
        """Deform the splats if anything has moved since."""
        if self._stale:
            self._picture.update(self._scene.state, *self._live.marker_place())
            self._stale = False

    def _record(self) -> None:
        """Give the recorder a frame if one is due."""
        recorder = self._recorder
        if recorder is not None and self._clock - self._record_from >= recorder.count / RECORD_HZ - 1e-9:
            self._show()
            recorder.add(self._clock - self._record_from, self._scene.state)

    def _object(self, index: int) -> SoftObject:
        objects = self._scene.objects
        require_number("object_index", index, at_least=0, at_most=len(objects) - 1)
        return objects[index]
