"""A robot of an OpenUSD stage as a MuJoCo specification: Newton's importer reads UsdPhysics, this turns its result.

The stage is opened in a process of its own, see :mod:`softmode.foreign.process`; what Newton reads is the checked crate
that comes back. Newton resolves the schemas (UsdPhysics, and Newton's, PhysX' and MuJoCo's own attributes), units and
axes; each of its joints becomes hinges and slides of a link, each loop a constraint, each drive an affine actuator.

Others do not serve: MuJoCo 3.17 writes OpenUSD and reads none, and what `SolverMuJoCo(save_to_mjcf=...)` writes of the
same model has its fixed base as a mocap body and contact masks of its own.
"""

from __future__ import annotations

import importlib
import math
import os
import tempfile
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import newton
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softmode.deformables.coupling.rigid_solver import mujoco_warnings
from softmode.deformables.reduction.cache import cache_directory, fingerprint_of, is_trusted, writable_cache
from softmode.errors import AssetError, SoftmodeError, needs_extra
from softmode.files import whole_file
from softmode.foreign import process
from softmode.robots.assets import RobotAsset

Array = NDArray[np.float64]
_UNLIMITED = 1.0e6
"""Efforts from which on Newton means none [N or N m]; limits from 1e9 on."""
_PRIMITIVES = {
    newton.GeoType.SPHERE: "SPHERE",
    newton.GeoType.CAPSULE: "CAPSULE",
    newton.GeoType.CYLINDER: "CYLINDER",
    newton.GeoType.BOX: "BOX",
    newton.GeoType.ELLIPSOID: "ELLIPSOID",
}
_LOOP_LEVER = 0.01
"""How far from the joint the two points lie that a hinge which closes a loop holds together [m]."""
_MESHES = (newton.GeoType.MESH, newton.GeoType.CONVEX_MESH)


def read_stage(asset: RobotAsset) -> tuple[Any, list[str]]:
    """Return the editable MuJoCo specification of all rigid bodies of a stage, and notes.

    Args:
        asset: A `.usd`, `.usda`, `.usdc` or `.usdz` file.

    Raises:
        AssetError: If the file is damaged, reads what lies outside the asset root, holds no rigid body, or a joint or
            loop of a kind that robots cannot have.
        MissingExtraError: If the extra ``[usd]`` is not installed.
    """
    name = f"robot file {asset.path}"
    with tempfile.TemporaryDirectory() as folder:
        crate = os.path.join(folder, "robot.usdc")
        root = asset.asset_root if asset.root_given else None
        said = process.read("robot", asset.path, name=name, asset_root=root, copy=crate, strict=True).described
        scene, notes = _import(crate, name)
    for schema, there in (("RigidBodyAPI", scene.body_count), ("ArticulationRootAPI", said["articulations"])):
        if not there:
            raise AssetError(f"{name} has no prim with Physics{schema}", hint="export the robot as an articulation")
    if said["deformables"]:
        notes.append(f"deformables are left out: {', '.join(said['deformables'])}")
    return _Translation(scene, asset, notes).specification(said), notes


def _import(crate: str, name: str) -> tuple[newton.ModelBuilder, list[str]]:
    """Return what Newton reads of a crate, and its warnings."""
    scene = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(scene)
    resolvers = [newton.usd.SchemaResolverNewton(), newton.usd.SchemaResolverMjc(), newton.usd.SchemaResolverPhysx()]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            with needs_extra("usd", f"{name}: Newton reads OpenUSD stages with newton-usd-schemas"):
                scene.add_usd(crate, skip_mesh_approximation=True, schema_resolvers=resolvers)
        except SoftmodeError:
            raise
        except (TypeError, ValueError, RuntimeError, KeyError, IndexError, AttributeError, ArithmeticError) as error:
            raise AssetError(f"{name}: Newton cannot import it ({error})", hint="mend the stage") from error
    return scene, list(dict.fromkeys(f"Newton's importer: {warning.message}" for warning in caught))


def _short(paths: list[str]) -> list[str]:
    """Return the last part of each path where that is unique, else as much of its end as makes it so."""
    parts = [path.strip("/").split("/") for path in paths]
    names = [part[-1] for part in parts]
    for depth in range(2, max((len(part) for part in parts), default=1) + 1):
        count = Counter(names)
        names = [name if count[name] == 1 else "/".join(part[-depth:]) for name, part in zip(names, parts, strict=True)]
    return names


class _Translation:
    """Bodies, joints and shapes of a builder, put into a specification."""

    def __init__(self, scene: newton.ModelBuilder, asset: RobotAsset, notes: list[str]) -> None:
        """Begin an empty specification."""
        self.mujoco = importlib.import_module("mujoco")
        self.scene, self.asset, self.notes = scene, asset, notes
        self.spec = self.mujoco.MjSpec()
        self.spec.compiler.degree = False
        self.spec.compiler.balanceinertia = True
        self.spec.compiler.inertiafromgeom = self.mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
        self.names = _short(scene.body_label)
        self.joints = _short(scene.joint_label)
        labels: Any = scene.custom_attributes["mujoco:joint_dof_label"].values or {}
        self.paths = [str(labels.get(dof, "")) for dof in range(scene.joint_dof_count)]
        """Per degree of freedom the prim that it comes from; one that has several says which behind a colon."""
        self.dofs = _short(self.paths)
        self.scalars: dict[int, list[tuple[str, int]]] = {}
        """Per joint the names of its hinges and slides in the specification, and their degrees of freedom."""
        self.targets: dict[str, float] = {}
        """Targets of the drives of UsdPhysics, by hinge or slide."""

    def specification(self, said: dict[str, Any]) -> Any:
        """Return the specification.

        Args:
            said: The answer of `softmode.foreign.child.robot`.
        """
        scene = self.scene
        tree = [j for j in range(scene.joint_count) if scene.joint_articulation[j] >= 0]
        below: dict[int, list[int]] = {}
        for j in tree:
            below.setdefault(scene.joint_parent[j], []).append(j)
        moved = {scene.joint_child[j] for j in tree}
        links = {-1: self.spec.worldbody}
        for body in range(scene.body_count):
            if body not in moved:
                links[body] = self._body(self.spec.worldbody, body, *_pose(scene.body_q[body]))
        open_ends = list(links)
        while open_ends:
            parent = open_ends.pop()
            for j in below.get(parent, []):
                child = scene.joint_child[j]
                links[child] = self._link(links[parent], j)
                open_ends.append(child)
        for j in set(range(scene.joint_count)) - set(tree):
            self._close_loop(j)
        offsets: dict[str, float] = {}
        for mimic in said["mimics"]:
            if not set(mimic["leader"]) & set(scene.joint_label):
                raise AssetError(
                    f"robot file {self.asset.path}: {mimic['path']} follows {mimic['leader'] or 'nothing'}, which is "
                    "no joint of it",
                    hint="name the joint that leads, or take the mimic schema away",
                )
            if mimic["offset"] is not None:  # Newton takes PhysX' degrees for radians
                offsets[mimic["path"]] = mimic["offset"]
        for j, leader in enumerate(scene.joint_mimic_joint):
            if leader >= 0:
                offset, ratio = scene.joint_mimic_coeffs[j]
                self._tie(j, leader, (offsets.get(scene.joint_label[j], offset), ratio))
        self.notes += [f"{path} is kinematic in the stage: here its joints move it" for path in said["kinematic"]]
        self._actuate(said)
        self._set_home()
        return self.spec

    # -- links --------------------------------------------------------------------------------------------------------

    def _body(self, parent: Any, body: int, position: Array, turn: Rotation) -> Any:
        """Add a link with its inertia and shapes."""
        scene = self.scene
        link = parent.add_body(name=self.names[body], pos=position, quat=_quat(turn))
        if scene.body_mass[body] > 0.0:
            inertia = np.array(scene.body_inertia[body], float).reshape(3, 3)
            link.mass, link.ipos = float(scene.body_mass[body]), np.array(scene.body_com[body], float)
            link.fullinertia = [inertia[i, k] for i, k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
            link.explicitinertial = True
        for shape in scene.body_shapes.get(body, []):
            self._shape(link, shape)
        return link

    def _link(self, parent: Any, j: int) -> Any:
        """Add the link behind a joint, with the joint as hinges and slides."""
        scene, kinds = self.scene, self.mujoco.mjtJoint
        kind = newton.JointType(scene.joint_type[j])
        (at, at_turn), (anchor, inside) = _pose(scene.joint_X_p[j]), _pose(scene.joint_X_c[j])
        child = scene.joint_child[j]
        position, turn = at - (at_turn * inside.inv()).apply(anchor), at_turn * inside.inv()
        if kind == newton.JointType.FREE:
            position, turn = _pose(scene.body_q[child])
        link = self._body(parent, child, position, turn)
        self.scalars[j] = []
        if kind == newton.JointType.FREE:
            link.add_joint(name=self.joints[j], type=kinds.mjJNT_FREE)
        elif kind == newton.JointType.BALL:
            link.add_joint(name=self.joints[j], type=kinds.mjJNT_BALL, pos=anchor)
        elif kind in (newton.JointType.REVOLUTE, newton.JointType.PRISMATIC, newton.JointType.D6):
            slides, hinges = scene.joint_dof_dim[j]
            for k in range(slides + hinges):
                dof = scene.joint_qd_start[j] + k
                name = self.dofs[dof].replace(":", "_")
                axis = inside.apply(np.array(scene.joint_axis[dof], float))
                moving = kinds.mjJNT_SLIDE if k < slides else kinds.mjJNT_HINGE
                link.add_joint(name=name, type=moving, pos=anchor, axis=axis, **self._properties(dof))
                self.scalars[j].append((name, dof))
        elif kind != newton.JointType.FIXED:
            raise self._refusal(j, "has no counterpart in a robot")
        return link

    def _properties(self, dof: int) -> dict[str, Any]:
        """Return limits, losses and springs of a degree of freedom."""
        scene = self.scene
        low, high, effort = scene.joint_limit_lower[dof], scene.joint_limit_upper[dof], scene.joint_effort_limit[dof]
        stiffness = scene.joint_stiffness[dof] or 0.0
        return {
            "limited": bool(low > -1.0e9 or high < 1.0e9),
            "range": (float(low), float(high)),
            "armature": float(scene.joint_armature[dof]),
            "frictionloss": float(scene.joint_friction[dof]),
            "damping": [float(scene.joint_damping[dof] or 0.0), 0.0, 0.0],
            "stiffness": [float(stiffness), 0.0, 0.0],
            "springref": float(scene.joint_rest_q[dof] or 0.0) if stiffness else 0.0,
            "actfrclimited": bool(effort < _UNLIMITED),
            "actfrcrange": (-float(effort), float(effort)) if effort < _UNLIMITED else (0.0, 0.0),
        }

    # -- shapes -------------------------------------------------------------------------------------------------------

    def _shape(self, link: Any, shape: int) -> None:
        """Add a shape: one that collides, one that is only seen, or a site."""
        scene, kinds = self.scene, self.mujoco.mjtGeom
        position, turn = _pose(scene.shape_transform[shape])
        flags, kind = scene.shape_flags[shape], newton.GeoType(scene.shape_type[shape])
        if flags & newton.ShapeFlags.SITE:
            link.add_site(name=scene.shape_label[shape].rpartition("/")[2], pos=position, quat=_quat(turn))
            return
        size = np.array(scene.shape_scale[shape], float)
        solid = bool(flags & newton.ShapeFlags.COLLIDE_SHAPES)
        color = scene.shape_color[shape]
        options: dict[str, Any] = {
            "pos": position,
            "quat": _quat(turn),
            "density": 0.0,
            "group": 3 if solid else 2,
            "rgba": [*(float(value) for value in color), 1.0],
            "friction": [float(scene.shape_material_mu[shape]), 0.005, 0.0001],
        }
        if not solid:
            options |= {"contype": 0, "conaffinity": 0}
        if kind in _PRIMITIVES:
            link.add_geom(type=getattr(kinds, f"mjGEOM_{_PRIMITIVES[kind]}"), size=size, **options)
            return
        source = scene.shape_source[shape]
        if kind == newton.GeoType.CONE:
            source = newton.Mesh.create_cone(size[0], size[1], up_axis=newton.Axis.Z, compute_inertia=False)
            size = np.ones(3)
        elif kind not in _MESHES:
            self.notes.append(f"{scene.shape_label[shape]}: a {kind.name.lower()} on a link is left out")
            return
        link.add_geom(type=kinds.mjGEOM_MESH, meshname=self._mesh(source, size), **options)

    def _mesh(self, mesh: newton.Mesh, scale: Array) -> str:
        """Keep a mesh in the cache, where MuJoCo and Newton find it; return its name in the specification."""
        points = np.asarray(mesh.vertices, float).reshape(-1, 3) * scale
        faces = np.asarray(mesh.indices).reshape(-1, 3)
        faces = faces[:, ::-1] if np.prod(scale) < 0.0 else faces
        name = f"mesh_{fingerprint_of('stage mesh 1', points, faces)}"
        if self.spec.mesh(name) is None:
            file = cache_directory() / "robot_meshes" / f"{name}.obj"
            if not is_trusted(file):
                writable_cache(file.parent)
                text = trimesh.Trimesh(points, faces, process=False).export(file_type="obj", digits=9)
                with whole_file(file, "mesh") as target:
                    target.write(str(text).encode())
            shell = self.mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # its mass is the link's; a sheet has no volume
            self.spec.add_mesh(name=name, file=str(Path(file).resolve()), inertia=shell)
        return name

    # -- constraints and drives ---------------------------------------------------------------------------------------

    def _refusal(self, j: int, why: str) -> AssetError:
        """Return the error for a joint."""
        kind = newton.JointType(self.scene.joint_type[j]).name.lower()
        text = f"robot file {self.asset.path}: {self.scene.joint_label[j]} is a {kind} joint, which {why}"
        return AssetError(text, hint="use hinges, slides and fixed joints")

    def _close_loop(self, j: int) -> None:
        """Add the constraint of a joint that is no part of the tree: points that coincide, or a weld."""
        scene, equality = self.scene, self.mujoco.mjtEq
        kind = newton.JointType(scene.joint_type[j])
        anchor, turn = _pose(scene.joint_X_p[j])
        points = [anchor]
        if kind == newton.JointType.REVOLUTE:
            axis = turn.apply(np.array(scene.joint_axis[scene.joint_qd_start[j]], float))
            points = [anchor - _LOOP_LEVER * axis, anchor + _LOOP_LEVER * axis]
        elif kind not in (newton.JointType.BALL, newton.JointType.FIXED):
            raise self._refusal(j, "cannot close a loop")
        ends = [self.names[body] if body >= 0 else "world" for body in (scene.joint_parent[j], scene.joint_child[j])]
        for k, point in enumerate(points):
            loop = self.spec.add_equality(objtype=self.mujoco.mjtObj.mjOBJ_BODY, name=f"{self.joints[j]}_{k}")
            loop.type = equality.mjEQ_WELD if kind == newton.JointType.FIXED else equality.mjEQ_CONNECT
            loop.name1, loop.name2 = ends
            loop.data[:3] = point
            loop.data[10] = 1.0 if kind == newton.JointType.FIXED else 0.0

    def _tie(self, j: int, leader: int, coefficients: Any) -> None:
        """Add q_j = offset + ratio q_leader."""
        ends = self.scalars.get(j, []), self.scalars.get(leader, [])
        if any(len(end) != 1 for end in ends):
            raise self._refusal(j, "follows another: both must be a hinge or a slide")
        tie = self.spec.add_equality(name=f"{self.joints[j]}_tie", type=self.mujoco.mjtEq.mjEQ_JOINT)
        tie.name1, tie.name2 = ends[0][0][0], ends[1][0][0]
        tie.data[:2] = [float(value) for value in coefficients]

    def _actuate(self, said: dict[str, Any]) -> None:
        """Add drives of UsdPhysics as affine actuators, those without gains as motors; then MuJoCo's actuators."""
        scene, kinds = self.scene, newton.JointTargetMode
        inertia = self._inertias() if said["accelerations"] else {}
        # Newton makes drives of MuJoCo's actuators too, without their limits and gears.
        skipped = {path for given in said["actuators"] for path in given["target"]}
        for j, scalars in self.scalars.items():
            for name, dof in scalars:
                mode, path = kinds(scene.joint_target_mode[dof]), self.paths[dof].partition(":")[0]
                if mode == kinds.NONE or path in skipped:
                    continue
                factor = inertia[name] if path in said["accelerations"] else 1.0
                self.targets[name] = float(scene.joint_target_q[scene.joint_q_start[j] + dof - scene.joint_qd_start[j]])
                stiffness, damping = factor * scene.joint_target_ke[dof], factor * scene.joint_target_kd[dof]
                if mode in (kinds.POSITION, kinds.POSITION_VELOCITY):
                    self._actuator(name, [stiffness], [0.0, -stiffness, -damping])
                else:
                    self._actuator(name, [1.0], [])
        if inertia:
            self.notes.append("gains of drives by acceleration are scaled by the inertia at zero coordinates")
        self._add_mujoco_actuators(said)

    def _actuator(self, joint: str, gain: list[float], bias: list[float]) -> Any:
        """Add an actuator on a joint; an affine one if there is a bias."""
        kinds = self.mujoco.mjtBias
        return self.spec.add_actuator(
            target=joint,
            trntype=self.mujoco.mjtTrn.mjTRN_JOINT,
            gaintype=self.mujoco.mjtGain.mjGAIN_FIXED,
            biastype=kinds.mjBIAS_AFFINE if bias else kinds.mjBIAS_NONE,
            gainprm=[*gain, *[0.0] * (10 - len(gain))],
            biasprm=[*bias, *[0.0] * (10 - len(bias))],
        )

    def _add_mujoco_actuators(self, said: dict[str, Any]) -> None:
        """Add the actuators of MuJoCo's schema that act on joints, or on fixed tendons over joints."""
        by_path = {self.paths[dof]: name for scalars in self.scalars.values() for name, dof in scalars}
        tendons: dict[str, str] = {}
        for tendon in said["tendons"]:
            known = [by_path.get(path) for path in tendon["joints"]]
            if tendon["kind"] != "fixed" or None in known or len(known) != len(tendon["coefficients"]):
                self.notes.append(f"{tendon['path']}: a tendon that is not fixed on hinges and slides is left out")
                continue
            tendons[tendon["path"]] = tendon["path"].rpartition("/")[2]
            made = self.spec.add_tendon(name=tendons[tendon["path"]])
            for joint, coefficient in zip(known, tendon["coefficients"], strict=True):
                made.wrap_joint(joint, coefficient)
        for given in said["actuators"]:
            path = given["target"][0] if given["target"] else ""
            if path not in by_path and path not in tendons:
                self.notes.append(f"{given['path']}: acts on no joint and no fixed tendon, and is left out")
                continue
            affine = given["biasType"] == "affine"
            made = self._actuator(by_path.get(path, ""), given["gainPrm"][:10] or [1.0], given["biasPrm"][:10])
            if path in tendons:
                made.trntype, made.target = self.mujoco.mjtTrn.mjTRN_TENDON, tendons[path]
            made.biastype = self.mujoco.mjtBias.mjBIAS_AFFINE if affine else self.mujoco.mjtBias.mjBIAS_NONE
            made.gear[: len(given["gear"][:6])] = given["gear"][:6]
            for limit, low, high in (("ctrl", *_ends(given, "ctrl")), ("force", *_ends(given, "force"))):
                if low < high and given[f"{limit}Limited"] != "false":
                    setattr(made, f"{limit}range", [low, high])
                    setattr(made, f"{limit}limited", True)

    @mujoco_warnings()
    def _inertias(self) -> dict[str, float]:
        """Return what each hinge or slide moves at zero coordinates, by name."""
        model, data = self._compiled()
        mass = np.zeros((model.nv, model.nv))
        self.mujoco.mj_forward(model, data)
        self.mujoco.mj_fullM(model, data, mass)
        return {
            name: float(mass[k, k])
            for scalars in self.scalars.values()
            for name, _ in scalars
            for k in [int(model.jnt_dofadr[model.joint(name).id])]
        }

    def _set_home(self) -> None:
        """Add the key frame "home": the joint states of the stage, else the targets of its drives."""
        coordinates = [
            (name, self.scene.joint_q[self.scene.joint_q_start[j] + k])
            for j, scalars in self.scalars.items()
            for k, (name, _) in enumerate(scalars)
        ]
        states = {name: float(value) for name, value in coordinates if value}
        home = states or {name: value for name, value in self.targets.items() if value}
        if not home:
            return
        model, data = self._compiled()
        for name, value in home.items():
            data.qpos[model.jnt_qposadr[model.joint(name).id]] = value
        self.spec.add_key(name="home", qpos=data.qpos.tolist())
        which = "joint states" if states else "targets of drives"
        self.notes.append(f"key frame 'home': {which} of the stage")

    @mujoco_warnings()
    def _compiled(self) -> tuple[Any, Any]:
        """Return the model of what has been added so far, and its data; links without mass get a little."""
        spec = self.spec.copy()
        spec.compiler.boundmass = spec.compiler.boundinertia = 1.0e-9
        try:
            model = spec.compile()
        except (ValueError, RuntimeError) as error:
            raise AssetError(f"robot file {self.asset.path}: {error}", hint="mend the stage") from error
        return model, self.mujoco.MjData(model)


def _ends(given: dict[str, Any], what: str) -> tuple[float, float]:
    """Return the range of an actuator's control or force."""
    low, high = given[f"{what}Range:min"], given[f"{what}Range:max"]
    return (low, high) if math.isfinite(low) and math.isfinite(high) else (0.0, 0.0)


def _pose(transform: Any) -> tuple[Array, Rotation]:
    """Return position and rotation of one of Newton's transforms."""
    numbers = np.array([float(value) for value in transform])
    return numbers[:3], Rotation.from_quat(numbers[3:])


def _quat(turn: Rotation) -> Array:
    """Return a rotation as MuJoCo's quaternion (wxyz)."""
    return np.roll(turn.as_quat(), 1)
