"""`UsdAnimation`: a simulation as an OpenUSD stage, with time samples of handle matrices only, or baked.

The bodies go in as `write_usd` writes them. Each is moved by the rigid motion that goes along with it (time samples of
its Xform), and in that frame by its handles: a matrix for every skinning weight, `softmode:handles`. Whoever knows
nothing of handles sees rigid objects move; whoever knows them, or a baked stage, sees them deform.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from softmode.checks import require_choice, require_number
from softmode.deformables.materials.material import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.deformables.model.authoring import MATERIAL_FIELDS, body_key
from softmode.errors import ConfigError, SolverDiverged
from softmode.foreign import tokens
from softmode.foreign.openusd import Layer, Stage
from softmode.objects.placed import Placed
from softmode.objects.stage.scene import shortest
from softmode.scenes.binding import splats_of_states
from softmode.splats.formats.usd import set_splat_column, splat_columns
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.usd.dents import Dents
from softmode.usd.handles import handles_from_coordinates, local_coordinates, rigid_motion
from softmode.usd.openusd import check_stage, openusd, whole_stage
from softmode.usd.rigid import RigidMeshes
from softmode.usd.staging import author_cameras, author_lights, overview, whole_codes
from softmode.usd.writer import (
    UsdExportOptions,
    attribute,
    author_bodies,
    new_layer,
    new_stage,
    save,
    set_place,
    set_points,
    vectors,
)

Mode = Literal["handles", "baked"]
_SAVE_BYTES = 64e6
"""After so many bytes of baked samples the layer is saved, which takes them out of memory."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class UsdAnimationOptions:
    """How an animation is written.

    Raises:
        ConfigError: If a value lies outside its range.
    """

    mode: Mode = "handles"
    """What is sampled: handle matrices and dents, a kilobyte per frame and body; or also all positions, orientations
    and scales of splats, 40 bytes for each splat and frame, which any viewer of splats plays."""
    fps: float = 30.0
    """Frames per second where no times are given [1/s], and time codes per second; as many times more of these as make
    the time codes of all frames whole, up to 64."""
    cameras: tuple[PinholeCamera, ...] = ()
    """Cameras of the stage, those in the world; without any there is one that sees where the bodies were."""
    sh_degree: int | None = None
    """Degree that the colours of splats are cut to, 0 to 3; None for theirs. Baked colours above degree 0 turn with
    each splat: 12 (degree + 1)^2 bytes more for each splat and frame."""
    rigid_meshes: bool = True
    """Meshes of the rigid shapes, robots and table, with time samples of where they are."""
    export: UsdExportOptions = dataclasses.field(default_factory=lambda: UsdExportOptions(weights="half", kaolin=False))
    """What the stage holds beside; half precision of `splats` halves a baked stage."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_choice("mode", self.mode, get_args(Mode))
        require_number("fps", self.fps, above=0.0, hint="use 30")
        require_choice("sh_degree", self.sh_degree, (None, 0, 1, 2, 3))


class UsdAnimation:
    """Records one world of a simulation; the file appears complete with `publish` or not at all.

    Recording keeps the reduced coordinates and dents, a kilobyte or so per frame; everything else is done by `publish`.
    As a context manager it publishes when the block ends without an error. Recording reads from the device: not for
    captured graphs.

    Args:
        path: A `.usdc` or `.usd` (binary) or `.usda` (text) file; folders are made.
        model: The model.
        bodies: The soft bodies of the world in the order in which they were added, with splats; material, place and
            size are taken from model and state.
        world: Which world.
        options: How it is written.

    Raises:
        ConfigError: If the file or the world cannot be, or the bodies are not those of the world.
        StorageError: If the file cannot be written where it is named.
        MissingExtraError: If the extra `[usd]` is not installed.
    """

    def __init__(
        self,
        path: str | Path,
        model: Any,
        bodies: Sequence[Placed],
        *,
        world: int = 0,
        options: UsdAnimationOptions | None = None,
    ) -> None:
        """Find the bodies in the model."""
        self.path = check_stage(path)
        self.options = options or UsdAnimationOptions()
        self.model, self.world = model, world
        worlds = max(int(model.world_count), 1)
        require_number("world", world, at_least=0, at_most=worlds - 1)
        data = model.softmode
        self._instances = np.flatnonzero(np.isin(data.instance_world.numpy(), [-1, world])).tolist()
        found = [int(data.body_key.numpy()[i]) for i in self._instances]
        if found != [body_key(placed.body) for placed in bodies]:
            raise ConfigError(
                f"bodies: got {[placed.body.name for placed in bodies]}, world {world} holds {len(found)} soft bodies"
                + (", others or in another order" if len(found) == len(bodies) else ""),
                hint="pass a Placed for each add_reduced_body, in that order",
            )
        self._starts = data.function_start.numpy()[self._instances].tolist()
        self._samples = data.particle_start.numpy()[self._instances].tolist()
        self._bodies = tuple(bodies)
        self._placed: tuple[Placed, ...] = ()
        self._meshes = RigidMeshes(model, world) if self.options.rigid_meshes else None
        self._live: Any = None
        self._times: list[float] = []
        self._states: list[list[NDArray[np.float64]]] = []
        self._dents: list[list[Dents]] = []

    @classmethod
    def of_env(
        cls, path: str | Path, env: object, *, world: int = 0, options: UsdAnimationOptions | None = None
    ) -> UsdAnimation:
        """Return an animation of an environment; `record()` then takes its present state.

        Args:
            path: As above.
            env: A `SoftEnv` or a `SoftVectorEnv` whose worlds live in this process, wrapped or not.
            world: Which world.
            options: How it is written; by default with the environment's control rate as `fps` and its cameras.

        Raises:
            ConfigError: As above, or if `env` is no such environment.
        """
        inner = getattr(env, "unwrapped", env)
        scene = getattr(getattr(inner, "task", None), "scene", None)
        if scene is None:
            raise ConfigError(f"env is a {type(inner).__name__}", hint="pass a softmode environment, made by gym.make")
        still = tuple(c for drawn in scene.cameras.values() for c in drawn.cameras if c.body is None)
        made = cls(
            path,
            scene.model,
            [Placed(object=thing) for thing in scene.objects],
            world=world,
            options=options or UsdAnimationOptions(fps=scene.config.control_hz, cameras=still),
        )
        made._live = scene.state
        return made

    def __enter__(self) -> UsdAnimation:
        """Return the animation."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Publish what was recorded, unless an error ended the block."""
        if kind is None and self._times:
            self.publish()

    @property
    def frame_count(self) -> int:
        """Number of frames recorded."""
        return len(self._times)

    def record(self, state: Any = None, time: float | None = None) -> None:
        """Append a frame.

        Args:
            state: A state of the model; None for the present one of the environment (`of_env`).
            time: When it is [s], later than the frame before; None for one frame after it.

        Raises:
            ConfigError: If there is no state, or the time is not finite or not later than that of the frame before.
            SolverDiverged: If the state is not finite.
        """
        state = self._live if state is None else state
        if state is None:
            raise ConfigError("state is None", hint="pass a state of the model, or make the animation by of_env")
        when = (self._times[-1] + 1.0 / self.options.fps if self._times else 0.0) if time is None else float(time)
        if not (np.isfinite(when) and (not self._times or when > self._times[-1])):
            before = f" after one at {self._times[-1]} s" if self._times else ""
            raise ConfigError(f"time is {when} s{before}", hint="give times that grow, or None")
        q, dent = state.softmode.q.numpy(), state.softmode.dent.numpy()
        parts = [
            np.array(q[start : start + placed.body.function_count], dtype=np.float64)
            for start, placed in zip(self._starts, self._bodies, strict=True)
        ]
        if not all(np.isfinite(part).all() for part in parts):
            raise SolverDiverged(f"the state at {when} s is not finite", hint="record until a reset, or reset first")
        if not self._placed:
            self._placed = self._in_model(parts)
        if self._meshes is not None:
            self._meshes.record(state)
        self._times.append(when)
        self._states.append(parts)
        self._dents.append(
            [
                Dents.of(dent[start : start + placed.body.surface_count])
                for start, placed in zip(self._samples, self._bodies, strict=True)
            ]
        )

    def _in_model(self, states: Sequence[NDArray[np.float64]]) -> tuple[Placed, ...]:
        """Return the bodies with material, size and place as they are in the model at the first frame."""
        data = self.model.softmode
        columns = {name: getattr(data, name).numpy() for name in (*MATERIAL_FIELDS, "material_model", "scale")}
        placed = []
        for i, given, q in zip(self._instances, self._bodies, states, strict=True):
            values = {name: shortest(columns[name][i]) for name in MATERIAL_FIELDS}
            material = Material(model=MaterialModel(int(columns["material_model"][i])), **values)
            rotation, translation = rigid_motion(given.body, q)
            splats = given.splats
            if splats is not None and self.options.sh_degree is not None:
                splats = splats.with_sh_degree(min(self.options.sh_degree, splats.sh_degree))
            thing = dataclasses.replace(given.object, material=material, splats=splats)
            place = {"position": tuple(translation.tolist()), "rotation": rotation}
            placed.append(dataclasses.replace(given, object=thing, **place, scale=float(columns["scale"][i])))
        return tuple(placed)

    def publish(self) -> None:
        """Write the stage.

        Raises:
            ConfigError: If nothing was recorded.
            StorageError: If the file cannot be written.
        """
        if not self._times:
            raise ConfigError("no frame was recorded", hint="call record at least once")
        codes, rate = whole_codes(self._times, self.options.fps)
        with contextlib.suppress(OSError):  # what is in the way will be told by the next line
            self.path.parent.mkdir(parents=True, exist_ok=True)
        with whole_stage(self.path) as file:
            layer = new_layer(str(file))
            stage = new_stage(layer)
            stage.SetTimeCodesPerSecond(rate)
            stage.SetFramesPerSecond(self.options.fps)
            stage.SetStartTimeCode(codes[0])
            stage.SetEndTimeCode(codes[-1])
            paths = author_bodies(stage, self._placed, self.options.export)
            for k, (path, placed) in enumerate(zip(paths, self._placed, strict=True)):
                states, dents = [frame[k] for frame in self._states], [frame[k] for frame in self._dents]
                self._author_motion(stage, layer, path, placed, codes, states, dents)
            if self._meshes is not None:
                self._meshes.author(stage, codes)
            fixed = [camera for camera in self.options.cameras if camera.body is None]
            author_cameras(stage, fixed or [overview(self._surfaces())])
            author_lights(stage)
            save(layer)

    def _surfaces(self) -> NDArray[np.float64]:
        """Return where the surface samples of all bodies were in all frames [m], shape (N, 3)."""
        bodies = [(p.body.surface.points, p.body.surface.basis.astype(np.float64)) for p in self._placed]
        return np.concatenate([x + b @ q for frame in self._states for (x, b), q in zip(bodies, frame, strict=True)])

    def _author_motion(
        self,
        stage: Stage,
        layer: Layer,
        path: str,
        placed: Placed,
        codes: list[float],
        states: list[NDArray[np.float64]],
        dents: list[Dents],
    ) -> None:
        """Author the samples of one body."""
        UsdGeom, Vt = openusd("UsdGeom", "Vt")
        body, prim = placed.body, stage.GetPrimAtPath(path)
        handles = attribute(prim, tokens.HANDLES, "Matrix4dArray", None, custom=True)
        curved = bool((body.handles.degrees == 2).any())
        more = attribute(prim, tokens.HANDLES_QUADRATIC, "Double3Array", None, custom=True) if curved else None
        local, seen = np.empty((len(states), body.function_count, 3)), list[Dents]()
        for f, (code, q, dent) in enumerate(zip(codes, states, dents, strict=True)):
            rotation, translation = rigid_motion(body, q)
            set_place(UsdGeom.Xform(prim), translation, rotation, placed.scale, code)
            local[f] = local_coordinates(body, q, rotation, translation, placed.scale)
            seen.append(dent.mapped(rotation.T / placed.scale))
            matrices, quadratic = handles_from_coordinates(body, local[f])
            handles.Set(Vt.Matrix4dArray.FromNumpy(matrices), code)
            if more is not None:
                more.Set(Vt.Vec3dArray.FromNumpy(quadratic.reshape(-1, 3)), code)
        if any(len(dent.samples) for dent in seen):
            samples = attribute(prim, tokens.DENT_SAMPLES, "IntArray", None, custom=True)
            vector = attribute(prim, tokens.DENTS, "Float3Array", None, custom=True)
            for code, dent in zip(codes, seen, strict=True):
                samples.Set(Vt.IntArray.FromNumpy(dent.samples), code)
                vector.Set(vectors(dent.vectors), code)
        if self.options.mode == "baked":
            self._bake(stage, layer, path, placed, codes, local, seen)

    def _bake(
        self,
        stage: Stage,
        layer: Layer,
        path: str,
        placed: Placed,
        codes: list[float],
        local: NDArray[np.float64],
        dents: list[Dents],
    ) -> None:
        """Author points and splats frame by frame, in the frame of their body."""
        UsdGeom, UsdVol = openusd("UsdGeom", "UsdVol")
        points = UsdGeom.Points(stage.GetPrimAtPath(f"{path}/Simulation"))
        basis = placed.body.evaluate(placed.body.cubature.points)[0]
        for code, q in zip(codes, local, strict=True):
            set_points(points, placed.body.cubature.points + basis @ q, code)
        if placed.splats is None:
            return
        prim = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath(f"{path}/Splats"))
        turning = placed.splats.sh_degree > 0
        near, waiting = placed.splats.quats, 0.0
        every = np.array([dent.full(placed.body.surface_count) for dent in dents])
        for code, splats in zip(codes, splats_of_states(placed.object, local, every), strict=True):
            columns = splat_columns(splats, near=near)
            near = columns["orientations"]
            del columns["opacities"]
            for name, values in columns.items():
                if turning or not name.startswith("radiance"):
                    set_splat_column(prim, name, values, code, half=self.options.export.splats == "half")
                    waiting += values.nbytes
            if waiting > _SAVE_BYTES:
                save(layer)
                waiting = 0.0
