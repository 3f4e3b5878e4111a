"""Robots as OpenUSD stages: what MuJoCo compiled of an MJCF file, written as UsdPhysics in any unit and axis."""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from softmode.robots import RobotDescription
from softmode.splats.splats import up_rotation
from tests.usd.stages import Author, Gf, UsdGeom, UsdPhysics

mujoco: Any = importlib.import_module("mujoco")
ROOT = "/World/robot"
JOINTS = f"{ROOT}/joints"


class StageRobot:
    """A robot in a stage, whose links lie side by side under one prim."""

    def __init__(self, path: Path, robot: RobotDescription, up: str = "Z", meters: float = 1.0, kilograms: float = 1.0):
        """Author links, joints, drives and shapes; the stage is saved by `save`."""
        self.path, self.robot = path, robot
        self.author = Author.create(path, up, meters, kilograms)
        self.stage = self.author.stage
        self.turn = up_rotation({"X": "+x", "Y": "+y", "Z": "+z"}[up]).T  # type: ignore[arg-type]
        self.length, self.mass = 1.0 / meters, 1.0 / kilograms
        self.model = mujoco.MjModel.from_xml_string(robot.mjcf)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, self.data)
        root = UsdGeom.Xform.Define(self.stage, ROOT)
        UsdPhysics.ArticulationRootAPI.Apply(root.GetPrim())
        for body in range(1, self.model.nbody):
            self._link(body)
            self._joint(body)
        for geom in range(self.model.ngeom):
            self._shape(geom)

    def save(self) -> Path:
        """Save the stage; return its path."""
        self.author.save()
        return self.path

    def joint(self, name: str) -> Any:
        """Return the prim of a joint."""
        return self.stage.GetPrimAtPath(f"{JOINTS}/{name}")

    def _rotation(self, rotation: Any) -> Any:
        """Return a rotation of a link's frame as the stage has it, whose frames are all turned."""
        return self.turn @ rotation @ self.turn.T

    def _link(self, body: int) -> None:
        """Author a link with its mass."""
        frame = UsdGeom.Xform.Define(self.stage, f"{ROOT}/{self.model.body(body).name}")
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.data.xmat[body].reshape(3, 3), self.data.xpos[body]
        self.author.place(frame.GetPrim(), matrix)
        UsdPhysics.RigidBodyAPI.Apply(frame.GetPrim())
        mass = UsdPhysics.MassAPI.Apply(frame.GetPrim())
        mass.CreateMassAttr(float(self.model.body_mass[body]) * self.mass)
        mass.CreateCenterOfMassAttr(Gf.Vec3f(*self.author.vector(self.model.body_ipos[body])))
        inertia = self.model.body_inertia[body] * self.mass * self.length**2
        mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*inertia.tolist()))
        mass.CreatePrincipalAxesAttr(quaternion(self.turn @ matrix_of(self.model.body_iquat[body])))

    def _joint(self, body: int) -> None:
        """Author what holds a link on its parent: a fixed joint, a hinge or a slide with its drive."""
        model = self.model
        j = int(model.body_jntadr[body])
        hinge = j >= 0 and int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_HINGE)
        kind = UsdPhysics.FixedJoint if j < 0 else UsdPhysics.RevoluteJoint if hinge else UsdPhysics.PrismaticJoint
        name = f"{model.body(body).name}_mount" if j < 0 else model.joint(j).name
        joint = kind.Define(self.stage, f"{JOINTS}/{name}")
        if model.body_parentid[body]:
            joint.CreateBody0Rel().SetTargets([f"{ROOT}/{model.body(model.body_parentid[body]).name}"])
        joint.CreateBody1Rel().SetTargets([f"{ROOT}/{model.body(body).name}"])
        relative = matrix_of(model.body_quat[body])
        anchor = np.zeros(3) if j < 0 else model.jnt_pos[j]
        inside = np.eye(3) if j < 0 else along_x(self.turn @ model.jnt_axis[j])
        joint.CreateLocalPos0Attr(Gf.Vec3f(*self.author.vector(model.body_pos[body] + relative @ anchor)))
        joint.CreateLocalRot0Attr(quaternion(self._rotation(relative) @ inside))
        joint.CreateLocalPos1Attr(Gf.Vec3f(*self.author.vector(anchor)))
        joint.CreateLocalRot1Attr(quaternion(inside))
        if j < 0:
            return
        joint.CreateAxisAttr("X")
        unit = math.degrees(1.0) if hinge else self.length
        k = self.robot.joint_names.index(name)
        if model.jnt_limited[j]:
            joint.CreateLowerLimitAttr(self.robot.joint_lower[k] * unit)
            joint.CreateUpperLimitAttr(self.robot.joint_upper[k] * unit)
        drive = self.robot.drives[k]
        if drive is not None:
            authored = UsdPhysics.DriveAPI.Apply(joint.GetPrim(), "angular" if hinge else "linear")
            gain = self.mass * (self.length**2 / math.degrees(1.0) if hinge else 1.0)
            authored.CreateStiffnessAttr(drive.stiffness * gain)
            authored.CreateDampingAttr(drive.damping * gain)
            authored.CreateTargetPositionAttr(self.robot.home[k] * unit)
            if math.isfinite(drive.effort_limit):
                authored.CreateMaxForceAttr(drive.effort_limit * self.mass * self.length ** (2 if hinge else 1))
        joint.GetPrim().AddAppliedSchema("NewtonJointAPI")
        dof = int(model.jnt_dofadr[j])
        # Newton's own attributes are in SI units in every stage that softmode converts; those of hinges count degrees.
        joint.GetPrim().GetAttribute("newton:armature").Set(float(model.dof_armature[dof]))
        joint.GetPrim().GetAttribute("newton:friction").Set(float(model.dof_frictionloss[dof]))
        damping = float(model.dof_damping[dof]) / (math.degrees(1.0) if hinge else 1.0)
        joint.GetPrim().GetAttribute("newton:damping").Set(damping)

    def _shape(self, geom: int) -> None:
        """Author a shape of a link."""
        model, kinds = self.model, mujoco.mjtGeom
        path = f"{ROOT}/{model.body(model.geom_bodyid[geom]).name}/shape_{geom}"
        size, kind = model.geom_size[geom] * self.length, kinds(int(model.geom_type[geom]))
        scale: Any = 1.0
        if kind == kinds.mjGEOM_BOX:
            shape = UsdGeom.Cube.Define(self.stage, path)
            shape.CreateSizeAttr(2.0)
            scale = size
        elif kind == kinds.mjGEOM_SPHERE:
            shape = UsdGeom.Sphere.Define(self.stage, path)
            shape.CreateRadiusAttr(float(size[0]))
        elif kind in (kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER):
            shape = (UsdGeom.Capsule if kind == kinds.mjGEOM_CAPSULE else UsdGeom.Cylinder).Define(self.stage, path)
            shape.CreateRadiusAttr(float(size[0]))
            shape.CreateHeightAttr(float(2.0 * size[1]))
            shape.CreateAxisAttr("Z")
        else:
            mesh = int(model.geom_dataid[geom])
            first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
            start, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
            shape = UsdGeom.Mesh.Define(self.stage, path)
            points = model.mesh_vert[first : first + count] * self.length
            shape.CreatePointsAttr([Gf.Vec3f(*row) for row in points.tolist()])
            shape.CreateFaceVertexCountsAttr([3] * faces)
            shape.CreateFaceVertexIndicesAttr(model.mesh_face[start : start + faces].ravel().tolist())
        # A shape's own frame is not turned, as its axes are its own.
        matrix = np.eye(4)
        matrix[:3, :3] = self.turn @ matrix_of(model.geom_quat[geom]) * scale
        matrix[:3, 3] = self.author.vector(model.geom_pos[geom])
        UsdGeom.Xformable(shape.GetPrim()).AddTransformOp().Set(Gf.Matrix4d(*matrix.T.ravel().tolist()))
        if model.geom_contype[geom] or model.geom_conaffinity[geom]:
            UsdPhysics.CollisionAPI.Apply(shape.GetPrim())


def matrix_of(quat: Any) -> Any:
    """Return the rotation matrix of a quaternion (wxyz)."""
    return Rotation.from_quat(np.roll(quat, -1)).as_matrix()


def quaternion(rotation: Any) -> Any:
    """Return a rotation matrix as a quaternion of OpenUSD."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return Gf.Quatf(w, x, y, z)


def along_x(axis: Any) -> Any:
    """Return a rotation that takes x to an axis."""
    other = np.eye(3)[int(np.argmin(np.abs(axis)))]
    z = np.cross(axis, other) / np.linalg.norm(np.cross(axis, other))
    return np.stack([axis, np.cross(z, axis), z], axis=1)
