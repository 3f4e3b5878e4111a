"""`RerunLogger`: a scene or an environment as a recording for the rerun viewer."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import newton
import numpy as np
from numpy.typing import NDArray

from softmode.deformables.tools.energies import SoftEnergies
from softmode.deformables.tools.sensing import ContactSensor
from softmode.errors import ConfigError
from softmode.scenes.binding import BoundSplats, SplatFrame
from softmode.scenes.host import host
from softmode.scenes.meshes import distinct, scene_meshes, scene_poses
from softmode.splats.cameras.camera import SplatCamera
from softmode.splats.splats import Splats
from softmode.viz.rerun_blueprint import make_blueprint
from softmode.viz.rerun_options import RerunOptions
from softmode.viz.rerun_pictures import encoded, encoded_depth
from softmode.viz.rerun_sources import Moment, source_of
from softmode.viz.rerun_stream import RerunStream, check_target


class RerunLogger:
    """Writes what happens in a scene to a file for the rerun viewer, or shows it in one live.

    A file appears complete when the ``with`` block ends, or by :meth:`publish`; an error or an interruption leaves
    none. Everything is read from the device after the step; the recording is one of its own, whatever else uses rerun.

    Entities, of several worlds each under ``world_3/``: ``scene/bodies`` (meshes of links, their poses per frame),
    ``scene/fixed``, ``scene/soft/NAME`` (splats) and its ``surface``, ``scene/contacts`` (forces on rigid bodies),
    ``scene/marker`` (the goal), ``scene/camera/NAME/rgb`` and ``depth``, ``energy/NAME``, ``reward``, ``success``,
    ``metrics``, ``action``, ``observation``, ``joints/position`` and ``joints/target`` (of joints with one degree of
    freedom, [rad] or [m], named in the legend), ``solver``, ``log``. Timelines: ``step`` and ``sim_time``.

    Args:
        target: File to write (.rrd); or address of a running viewer, like "rerun+http://127.0.0.1:9876/proxy"; or
            "spawn", which opens one.
        scene: An environment of softmode (its task in this process), a a :class:`softmode.scenes.SplatScene`,
            or a :class:`RerunScene`.
        worlds: Which worlds.
        options: What the recording holds.

    Raises:
        ConfigError: If no viewer answers at the address, the scene is none of these, or a world does not exist.
        StorageError: If the file cannot be written there.
        MissingExtraError: If rerun is not installed.
    """

    def __init__(
        self, target: str | Path, scene: object, *, worlds: Sequence[int] = (0,), options: RerunOptions | None = None
    ) -> None:
        """Open the recording and write what does not change."""
        check_target(target)
        import rerun as rr

        self._rr = rr
        self.options = options if options is not None else RerunOptions()
        self.worlds = _whole(worlds)
        self._source = source_of(scene, self.worlds or (0,))
        count = max(int(self._source.model.world_count), 1)
        if not self.worlds or len(set(self.worlds)) < len(self.worlds) or not set(self.worlds) <= set(range(count)):
            raise ConfigError(f"worlds must name different ones of 0..{count - 1}, got {list(worlds)}")
        self._prefix = {w: "" if self.worlds == (0,) and count == 1 else f"world_{w}/" for w in self.worlds}
        self._written: dict[tuple[int, int], NDArray[np.float32]] = {}
        self._marks: dict[int, NDArray[np.float32]] = {}
        self._lenses: dict[str, NDArray[np.float32]] = {}
        self._cameras: tuple[str, ...] | None = None
        self.frame_count = 0
        """Frames recorded."""
        self._stream = RerunStream(target, self._source.name)
        try:
            self._prepare()
        except BaseException:
            self.discard()
            raise

    # -- the file -----------------------------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        """Return the logger."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Publish the file, or discard it after an error."""
        if kind is None:
            self.publish()
        else:
            self.discard()

    def publish(self) -> None:
        """End the recording and put the file in place; does nothing the second time.

        Raises:
            StorageError: If what was written cannot be read back, as on a full disk, or the viewer has gone.
        """
        self._stream.publish()

    def discard(self) -> None:
        """End the recording and remove the file unless it was published."""
        self._stream.discard()

    # -- what does not change -----------------------------------------------------------------------------------------

    def _prepare(self) -> None:
        """Write meshes, places of the worlds and the layout; allocate what reads the device."""
        source, rr, options = self._source, self._rr, self.options
        model, seen = source.model, source.solver.view
        self._stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._meshes, self._paths = {}, {}
        for place, w in enumerate(self.worlds):
            if len(self.worlds) > 1:
                shift = (0.0, options.world_spacing * place, 0.0)
                self._stream.log(f"{self._prefix[w]}scene", rr.Transform3D(translation=shift), static=True)
            self._meshes[w] = scene_meshes(model, world=w, plane_extent=options.plane_extent)
            self._write_meshes(w)
        self._write_joints()
        layout = seen.layout
        instances = range(int(layout.instance_start[0]), int(layout.instance_start[1]))
        self._starts = {w: int(layout.instance_start[w]) for w in self.worlds}
        self._soft = _distinct([layout.bodies[layout.asset[i]].name for i in instances])
        objects = source.objects or (None,) * len(self._soft)
        self._shown = {o: thing.splats for o, thing in enumerate(objects) if thing is not None and thing.splats}
        self._splats = None
        if options.splats and self._shown:
            # as if colours were the same from everywhere: those of higher degrees would turn with every splat
            self._splats = BoundSplats(model, objects, worlds=self.worlds, sh_degree=0)
        self._energies = SoftEnergies(source.solver)
        self._samples = {
            (w, o): (int(seen.instances.particle_start.numpy()[i]), int(seen.instances.sample_count.numpy()[i]))
            for w in self.worlds
            for o, i in enumerate(range(self._starts[w], self._starts[w] + len(self._soft)))
        }
        self._contacts = None
        if options.contacts:
            self._contacts = ContactSensor(source.solver, list(range(-1, _bodies_per_world(model))))

    def _write_meshes(self, w: int) -> None:
        """Write the meshes of a world, each body's under its own entity."""
        rr, model = self._rr, self._source.model
        bodies = sorted({mesh.body for mesh in self._meshes[w]})
        names = _distinct(["fixed" if b < 0 else str(model.body_label[b]) for b in bodies])
        root = f"{self._prefix[w]}scene"
        folder = {b: f"{root}/{n}" if b < 0 else f"{root}/bodies/{n}" for b, n in zip(bodies, names, strict=True)}
        self._paths[w] = {b: path for b, path in folder.items() if b >= 0}
        for mesh in self._meshes[w]:
            carrier = "world" if mesh.body < 0 else str(model.body_label[mesh.body])
            path = f"{folder[mesh.body]}/{_part(mesh.label.removeprefix(f'{carrier}/'))}"
            color = [round(255 * c) for c in (*mesh.color, mesh.opacity)]
            look: dict[str, Any] = {"vertex_normals": mesh.normals, "albedo_factor": color}
            shape = rr.Mesh3D(vertex_positions=mesh.vertices, triangle_indices=mesh.faces, **look)
            self._stream.log(path, shape, static=True)

    def _write_joints(self) -> None:
        """Find the joints with one degree of freedom of each world, and write their names."""
        model, count = self._source.model, self._source.model.joint_count
        self._joints: dict[int, NDArray[np.intp]] = {}
        if not count:
            return
        first = host(model.joint_q_start)[:count]
        single = np.diff(np.append(first, model.joint_coord_count)) == 1
        owner = np.maximum(host(model.joint_world)[:count], 0)
        for w in self.worlds:
            chosen = np.flatnonzero(single & (owner == w))
            if not len(chosen):
                continue
            self._joints[w] = first[chosen]
            names = [str(model.joint_label[j]).rpartition("/")[2] for j in chosen]
            for kind in ("position", "target"):
                path = f"{self._prefix[w]}joints/{kind}"
                self._stream.log(path, self._rr.SeriesLines(names=[f"{name} {kind}" for name in names]), static=True)

    # -- a frame ------------------------------------------------------------------------------------------------------

    def record(
        self,
        state: newton.State | None = None,
        *,
        time: float | None = None,
        scalars: Mapping[str, float] | None = None,
    ) -> None:
        """Write a frame: after ``reset`` and every ``step`` of an environment, or with state and time of a scene.

        Args:
            state: State of a scene of one's own; nothing for an environment.
            time: Its time [s].
            scalars: More numbers, by path.

        Raises:
            ConfigError: If the recording has ended, or what a scene needs is missing.
        """
        source, rr, stream = self._source, self._rr, self._stream
        if stream.ended:
            raise ConfigError("the recording has ended", hint="record before publish, inside the with block")
        moment = source.moment(state, time)
        stream.set_moment(moment.step, moment.time)
        self._energies.update(moment.state)
        energies = {n: getattr(self._energies, n).numpy() for n in ("kinetic", "elastic", "gravitational")}
        cameras = list(source.cameras()) if self.options.images else []
        if self._cameras is None:
            self._cameras = tuple(_part(camera.name) for drawn in cameras for camera in drawn.cameras)
            task = hasattr(source, "task")
            layout = make_blueprint(list(self._prefix.values()), self._soft, self._cameras, task, self.options.eye)
            stream.send_blueprint(layout)
        self._log_poses(moment)
        self._log_joints(moment)
        self._log_soft(moment)
        self._log_contacts()
        for w in self.worlds:
            prefix = self._prefix[w]
            for o, name in enumerate(self._soft):
                for kind, values in energies.items():
                    self._stream.log(f"{prefix}energy/{name}/{kind}", rr.Scalars(float(values[self._starts[w] + o])))
            for path, value in source.scalars(w).items():
                self._stream.log(f"{prefix}{path}", rr.Scalars(value))
            self._log_marker(source.marker(w), w)
            for level, text in source.remarks(w):
                self._stream.log(f"{prefix}log", rr.TextLog(text, level=level))
            for drawn in cameras:
                self._log_images(drawn, w)
        for path, value in (scalars or {}).items():
            self._stream.log(path, rr.Scalars(float(value)))
        self.frame_count += 1

    def _log_poses(self, moment: Moment) -> None:
        """Write where the links are."""
        for w in self.worlds:
            poses = scene_poses(self._meshes[w], moment.state)
            where = {mesh.body: pose for mesh, pose in zip(self._meshes[w], poses, strict=True)}
            for body, path in self._paths[w].items():
                pose = where[body]
                self._stream.log(path, self._rr.Transform3D(translation=pose[:3], quaternion=pose[3:]))

    def _log_joints(self, moment: Moment) -> None:
        """Write where the joints are, and where they are driven."""
        control, position = self._source.control, host(moment.state.joint_q)
        target = host(control.joint_target_q) if control is not None else np.zeros(0)
        for w, columns in self._joints.items():
            for kind, values in (("position", position), ("target", target)):
                if len(values):
                    numbers = values[columns].astype(float).tolist()
                    self._stream.log(f"{self._prefix[w]}joints/{kind}", self._rr.Scalars(numbers))

    def _log_soft(self, moment: Moment) -> None:
        """Write splats and surface samples."""
        rr = self._rr
        frames = {}
        if self._splats is not None:
            self._splats.update(moment.state)
            frames = self._splats.frames()
        for (place, o), frame in frames.items():
            w = self.worlds[place]
            path = f"{self._prefix[w]}scene/soft/{self._soft[o]}"
            fields: dict[str, Any] = {"centers": frame.means}
            if self._changed((w, o), frame):
                fields["scales"], fields["quaternions"] = frame.axes(self._source.model.device)
            if self.frame_count == 0:
                fields |= splat_colors(self._shown[o])
            self._stream.log(path, rr.GaussianSplats3D.from_fields(**fields))
        if not self.options.surface:
            return
        # rerun keeps what it is given, and on CPU this is the state's own memory
        points = host(moment.state.particle_q).copy()
        for (w, o), (first, count) in self._samples.items():
            path = f"{self._prefix[w]}scene/soft/{self._soft[o]}/surface"
            fields: dict[str, Any] = {"positions": points[first : first + count]}
            if self.frame_count == 0:
                fields |= {"radii": [0.0012], "colors": [(250, 190, 60)]}
            self._stream.log(path, rr.Points3D.from_fields(**fields))

    def _log_marker(self, marker: Splats | None, w: int) -> None:
        """Write the splats that mark the goal, when they change."""
        if marker is None or (w in self._marks and np.array_equal(self._marks[w], marker.means)):
            return
        fields: dict[str, Any] = {"centers": marker.means}
        if w not in self._marks:
            fields |= {"scales": marker.scales, "quaternions": marker.quats, **splat_colors(marker)}
        self._marks[w] = marker.means
        self._stream.log(f"{self._prefix[w]}scene/marker", self._rr.GaussianSplats3D.from_fields(**fields))

    def _changed(self, key: tuple[int, int], frame: SplatFrame) -> bool:
        """Return whether scales and orientations of an object are to be written, and note that they are."""
        before, now = self._written.get(key), frame.covariances
        if before is not None:
            twice = np.array([1, 2, 2, 1, 2, 1], np.float32)  # the entries beside the diagonal stand for two
            change, size = (((a**2) * twice).sum(axis=1) for a in (now - before, before))
            if (change <= self.options.covariance_tolerance**2 * size).all():
                return False
        self._written[key] = now
        return True

    def _log_contacts(self) -> None:
        """Write the forces of the soft bodies on the rigid ones at their centres of pressure."""
        if self._contacts is None:
            return
        sensor, scale = self._contacts, self.options.force_scale
        sensor.update()
        force, place = sensor.force_matrix.numpy(), sensor.position_matrix.numpy()
        for w in self.worlds:
            pressed = np.linalg.norm(force[w], axis=-1) > 1e-3
            vectors, origins = force[w][pressed], place[w][pressed]
            labels = [f"{np.linalg.norm(v):.2f} N" for v in vectors]
            look: dict[str, Any] = {"colors": [(230, 60, 60)], "radii": [0.0025], "show_labels": False}
            arrows = self._rr.Arrows3D(vectors=scale * vectors, origins=origins, labels=labels, **look)
            self._stream.log(f"{self._prefix[w]}scene/contacts", arrows)

    def _log_images(self, camera: SplatCamera, w: int) -> None:
        """Write the last pictures of the cameras of one size."""
        rr = self._rr
        for view in camera.cameras:
            path = f"{self._prefix[w]}scene/camera/{_part(view.name)}"
            matrix = camera.extrinsics(view.name).numpy()[w]
            lens = np.append(matrix.ravel(), camera.intrinsics(view.name).numpy()[w])
            if path not in self._lenses or not np.array_equal(self._lenses[path], lens):
                self._lenses[path] = lens
                fx, fy, cx, cy = lens[16:].tolist()
                turn = matrix[:3, :3].T
                self._stream.log(path, rr.Transform3D(translation=-turn @ matrix[:3, 3], mat3x3=turn))
                view_of, size = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], (camera.width, camera.height)
                pinhole = rr.Pinhole(image_from_camera=view_of, resolution=size, image_plane_distance=0.07)
                self._stream.log(path, pinhole)
            pixels = camera.images(view.name).numpy()[w].copy()
            self._stream.log(f"{path}/rgb", encoded(pixels, self.options.jpeg_quality))
            self._stream.log(f"{path}/depth", encoded_depth(camera.images(view.name, "depth").numpy()[w]))


def splat_colors(splats: Splats) -> dict[str, Any]:
    """Return the fields of colour and opacity; higher degrees would have to turn with every splat."""
    rgba = np.concatenate([splats.colors(), splats.opacities[:, None]], axis=1)
    return {"colors": np.round(255.0 * np.clip(rgba, 0.0, 1.0)).astype(np.uint8), "spherical_harmonics_degree": 0}


def _whole(worlds: Sequence[int]) -> tuple[int, ...]:
    """Return whole numbers as a tuple.

    Raises:
        ConfigError: If they are none.
    """
    try:
        return tuple(operator.index(w) for w in worlds)
    except TypeError as error:
        raise ConfigError(f"worlds must be whole numbers, got {worlds!r}", hint="give them like (0, 2)") from error


def _bodies_per_world(model: newton.Model) -> int:
    """Return how many rigid bodies every world has."""
    worlds = max(int(model.world_count), 1)
    if worlds == 1 or model.body_count == 0:
        return int(model.body_count)
    return int(np.diff(host(model.body_world_start)[: worlds + 1]).min())


def _part(label: str) -> str:
    """Return a label as one part of an entity path."""
    return "".join(c if c.isalnum() or c in "_-." else "_" for c in label) or "_"


def _distinct(labels: Sequence[str]) -> list[str]:
    """Return labels as parts of entity paths, no two alike."""
    seen: set[str] = set()
    return [distinct(_part(label), seen) for label in labels]
