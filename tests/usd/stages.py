"""Stages with deformables, robots and props, authored with OpenUSD itself in any unit and with any axis up."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from softmode.splats.splats import Splats, up_rotation

Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdUtils, UsdVol, Vt = (
    importlib.import_module(f"pxr.{name}")
    for name in ("Gf", "Sdf", "Usd", "UsdGeom", "UsdPhysics", "UsdShade", "UsdUtils", "UsdVol", "Vt")
)

KINDS = ("Mesh", "TetMesh", "Points", "ParticleField3DGaussianSplat")
FAMILIES = {
    # body schema, simulation schemas by kind, namespace of the material's attributes, of the mass
    "aousd": (
        "PhysicsDeformableBodyAPI",
        {
            "Mesh": "PhysicsSurfaceDeformableSimAPI",
            "TetMesh": "PhysicsVolumeDeformableSimAPI",
            "Points": "NewtonPointsDeformableSimAPI",
        },
        "physics",
        "PhysicsVolumeDeformableMaterialAPI",
    ),
    "omni": (
        "OmniPhysicsDeformableBodyAPI",
        {"Mesh": "OmniPhysicsSurfaceDeformableSimAPI", "TetMesh": "OmniPhysicsVolumeDeformableSimAPI"},
        "omniphysics",
        "OmniPhysicsDeformableMaterialAPI",
    ),
    "physx": ("PhysxDeformableBodyAPI", {}, "physxDeformableBodyMaterial", "PhysxDeformableBodyMaterialAPI"),
}
EDGES = (0.10, 0.08, 0.06)
"""Edges of the body [m]."""
MATERIAL = {"youngsModulus": 5.0e4, "poissonsRatio": 0.42, "density": 240.0, "dynamicFriction": 0.55}
"""Its material in SI units."""


@dataclass
class Author:
    """A stage in its unit, to which things are given in metres with z up."""

    stage: Any
    up: str = "Z"
    meters: float = 1.0
    kilograms: float = 1.0

    @classmethod
    def create(cls, path: Path, up: str = "Z", meters: float = 1.0, kilograms: float = 1.0) -> Author:
        """Return a new stage with an Xform /World."""
        stage = Usd.Stage.CreateNew(str(path))
        UsdGeom.SetStageUpAxis(stage, up)
        UsdGeom.SetStageMetersPerUnit(stage, meters)
        UsdPhysics.SetStageKilogramsPerUnit(stage, kilograms)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
        return cls(stage, up, meters, kilograms)

    def save(self) -> None:
        """Save the stage."""
        self.stage.GetRootLayer().Save()

    def points(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return positions as the stage has them."""
        turn = up_rotation({"X": "+x", "Y": "+y", "Z": "+z"}[self.up])  # type: ignore[arg-type]
        with np.errstate(invalid="ignore"):  # infinity is authored on purpose
            return np.asarray(points, dtype=np.float64) @ turn / self.meters

    def vector(self, value: ArrayLike) -> tuple[float, float, float]:
        """Return one position as the stage has it."""
        x, y, z = self.points([value])[0].tolist()
        return x, y, z

    def place(self, prim: Any, matrix: ArrayLike) -> None:
        """Author a transform (4, 4) of columns."""
        m = np.array(matrix, dtype=np.float64)
        turn = up_rotation({"X": "+x", "Y": "+y", "Z": "+z"}[self.up])  # type: ignore[arg-type]
        stage = np.eye(4)
        stage[:3, :3], stage[:3, 3] = turn.T @ m[:3, :3] @ turn, self.vector(m[:3, 3])
        UsdGeom.Xformable(prim).AddTransformOp().Set(Gf.Matrix4d(*stage.T.ravel().tolist()))

    def material(self, path: str, family: str, values: dict[str, float] | None = None) -> Any:
        """Author a physics material of a family of schemas from SI units."""
        _, _, namespace, schema = FAMILIES[family]
        units = {
            "youngsModulus": self.meters / self.kilograms,
            "density": self.meters**3 / self.kilograms,
        }
        material = UsdShade.Material.Define(self.stage, path)
        prim = material.GetPrim()
        prim.AddAppliedSchema(schema)
        prim.AddAppliedSchema("PhysicsMaterialAPI")
        for name, value in (MATERIAL if values is None else values).items():
            of = "physics" if name.endswith("Friction") and family == "aousd" else namespace
            prim.CreateAttribute(f"{of}:{name}", Sdf.ValueTypeNames.Float).Set(float(value * units.get(name, 1.0)))
        return material

    def geometry(self, path: str, kind: str) -> Any:
        """Author the box as a geometry of some kind."""
        define = {
            "Mesh": UsdGeom.Mesh,
            "TetMesh": UsdGeom.TetMesh,
            "Points": UsdGeom.Points,
            "ParticleField3DGaussianSplat": UsdVol.ParticleField3DGaussianSplat,
        }[kind].Define
        geometry = define(self.stage, path)
        if kind == "Mesh":
            mesh = box()
            geometry.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(self.points(mesh.vertices).astype(np.float32)))
            geometry.CreateFaceVertexCountsAttr([3] * len(mesh.faces))
            geometry.CreateFaceVertexIndicesAttr(mesh.faces.ravel().tolist())
        elif kind == "TetMesh":
            points, tets = tet_box()
            geometry.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(self.points(points).astype(np.float32)))
            geometry.CreateTetVertexIndicesAttr([Gf.Vec4i(*row) for row in tets.tolist()])
        elif kind == "Points":
            points, width = grid_points()
            geometry.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(self.points(points).astype(np.float32)))
            geometry.CreateWidthsAttr([width / self.meters] * len(points))
        else:
            self.splats(geometry, shell())
        return geometry.GetPrim()

    def splats(self, prim: Any, splats: Splats) -> None:
        """Author splats of degree 0, given in metres with z up."""
        turned = splats.transformed(
            rotation=up_rotation({"X": "+x", "Y": "+y", "Z": "+z"}[self.up]).T,  # type: ignore[arg-type]
            scale=1.0 / self.meters,
        )
        prim.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(turned.means))
        prim.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(turned.scales))
        prim.CreateOrientationsAttr([Gf.Quatf(float(w), float(x), float(y), float(z)) for x, y, z, w in turned.quats])
        prim.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(turned.opacities))
        prim.CreateRadianceSphericalHarmonicsDegreeAttr(0)
        prim.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(turned.sh.reshape(-1, 3)))

    def body(
        self,
        path: str,
        kind: str = "Mesh",
        family: str = "aousd",
        *,
        matrix: ArrayLike | None = None,
        bound: bool = True,
    ) -> Any:
        """Author the box as a deformable body of some kind and family; return the prim that is the body."""
        schema, simulation, _, _ = FAMILIES[family]
        if family == "physx":  # the schema is on the geometry itself
            root = self.geometry(path, kind)
        else:
            root = UsdGeom.Xform.Define(self.stage, path).GetPrim()
            geometry = self.geometry(f"{path}/Geometry", kind)
            if kind in simulation:
                geometry.AddAppliedSchema(simulation[kind])
        root.AddAppliedSchema(schema)
        if matrix is not None:
            self.place(root, matrix)
        if bound:
            material = self.material(f"{path}_material", family)
            UsdShade.MaterialBindingAPI.Apply(root).Bind(material, UsdShade.Tokens.weakerThanDescendants, "physics")
        return root

    def prop(self, path: str, position: ArrayLike, edge: float = 0.1, density: float = 500.0) -> Any:
        """Author a rigid cube that collides."""
        cube = UsdGeom.Cube.Define(self.stage, path)
        cube.CreateSizeAttr(edge / self.meters)
        cube.AddTranslateOp().Set(Gf.Vec3d(*self.vector(position)))
        UsdPhysics.RigidBodyAPI.Apply(cube.GetPrim())
        UsdPhysics.CollisionAPI.Apply(cube.GetPrim())
        mass = UsdPhysics.MassAPI.Apply(cube.GetPrim())
        mass.CreateDensityAttr(density * self.meters**3 / self.kilograms)
        return cube.GetPrim()

    def robot(self, path: str, position: ArrayLike) -> None:
        """Author a fixed base with a link on a driven hinge and a finger on a driven slide."""
        per_length, per_mass = 1.0 / self.meters, 1.0 / self.kilograms
        root = UsdGeom.Xform.Define(self.stage, path)
        UsdPhysics.ArticulationRootAPI.Apply(root.GetPrim())
        root.AddTranslateOp().Set(Gf.Vec3d(*self.vector(position)))
        for name, height in (("base", 0.05), ("link", 0.2), ("finger", 0.35)):
            frame = UsdGeom.Xform.Define(self.stage, f"{path}/{name}")
            frame.AddTranslateOp().Set(Gf.Vec3d(*self.vector((0.0, 0.0, height))))
            UsdPhysics.RigidBodyAPI.Apply(frame.GetPrim())
            mass = UsdPhysics.MassAPI.Apply(frame.GetPrim())
            mass.CreateMassAttr(0.7 * per_mass)
            mass.CreateDiagonalInertiaAttr(Gf.Vec3f(0.002 * per_mass * per_length**2))
            cube = UsdGeom.Cube.Define(self.stage, f"{path}/{name}/shape")
            cube.CreateSizeAttr(0.08 * per_length)
            UsdPhysics.CollisionAPI.Apply(cube.GetPrim())
        joints = (
            (UsdPhysics.FixedJoint, "root", None, "base", np.add(position, (0.0, 0.0, 0.05)), (0.0, 0.0, 0.0)),
            (UsdPhysics.RevoluteJoint, "hinge", "base", "link", (0.0, 0.0, 0.075), (0.0, 0.0, -0.075)),
            (UsdPhysics.PrismaticJoint, "slide", "link", "finger", (0.0, 0.0, 0.075), (0.0, 0.0, -0.075)),
        )
        for kind, name, parent, child, first, second in joints:
            joint = kind.Define(self.stage, f"{path}/{name}")
            if parent:
                joint.CreateBody0Rel().SetTargets([f"{path}/{parent}"])
            joint.CreateBody1Rel().SetTargets([f"{path}/{child}"])
            joint.CreateLocalPos0Attr(Gf.Vec3f(*self.vector(first)))
            joint.CreateLocalPos1Attr(Gf.Vec3f(*self.vector(second)))
            if kind is UsdPhysics.FixedJoint:
                continue
            hinge = kind is UsdPhysics.RevoluteJoint
            joint.CreateAxisAttr("X")
            unit = 1.0 if hinge else per_length
            joint.CreateLowerLimitAttr((-40.0 if hinge else -0.05) * unit)
            joint.CreateUpperLimitAttr((40.0 if hinge else 0.07) * unit)
            drive = UsdPhysics.DriveAPI.Apply(joint.GetPrim(), "angular" if hinge else "linear")
            of_force = per_mass * (per_length**2 if hinge else 1.0)
            drive.CreateStiffnessAttr(100.0 * of_force)
            drive.CreateDampingAttr(7.0 * of_force)
            drive.CreateMaxForceAttr(50.0 * per_mass * (per_length**2 if hinge else per_length))


def box(edges: ArrayLike = EDGES) -> trimesh.Trimesh:
    """Return the box as triangles."""
    return trimesh.creation.box(np.asarray(edges))


def tet_box() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the box as 6 tetrahedra in each of 2 x 2 x 2 cells, half of them turned inside out."""
    count = 3
    axes = [np.linspace(-0.5 * edge, 0.5 * edge, count) for edge in EDGES]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    tets = []
    for cell in np.ndindex(2, 2, 2):
        for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):  # Kuhn's subdivision
            corner = np.array(cell)
            path = [corner.copy()]
            for axis in order:
                corner[axis] += 1
                path.append(corner.copy())
            tets.append([int(np.ravel_multi_index(tuple(p), (count,) * 3)) for p in path])
    return points, np.array(tets)


def grid_points(count: int = 12) -> tuple[NDArray[np.float64], float]:
    """Return points that fill the box, and their width: they touch, and the outermost ones touch its faces."""
    width = EDGES[2] / count
    numbers = [round(edge / width) for edge in EDGES]
    axes = [(np.arange(n) + 0.5) * width - 0.5 * n * width for n in numbers]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(points, dtype=np.float64), width


def shell(count: int = 3000, color: float = 0.3) -> Splats:
    """Return opaque splats on the surface of the box."""
    points, _ = trimesh.sample.sample_surface_even(box(), count, seed=0)
    n = len(points)
    return Splats(
        means=points,
        quats=np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)),
        scales=np.full((n, 3), 0.0003),
        opacities=np.full(n, 0.95),
        sh=np.full((n, 1, 3), color),
    )


def transform(
    translation: ArrayLike = (0.0, 0.0, 0.0), *, turn: float = 0.0, axis: int = 2, scale: ArrayLike = 1.0
) -> NDArray[np.float64]:
    """Return translation after rotation about an axis by an angle [rad] after scaling, shape (4, 4)."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.eye(3)
    rotation[i, i] = rotation[j, j] = np.cos(turn)
    rotation[j, i], rotation[i, j] = np.sin(turn), -np.sin(turn)
    found = np.eye(4)
    found[:3, :3] = rotation * np.broadcast_to(scale, 3)
    found[:3, 3] = translation
    return found
