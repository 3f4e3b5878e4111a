"""`read_usd_scene`: everything about the deformables of an OpenUSD stage as plain arrays, metres, Z up."""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.materials.material import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.errors import AssetError, MaterialError
from softmode.files import REEXPORT, damage_errors
from softmode.foreign import process, tokens
from softmode.objects.stage.geometry import SurfaceMesh, finite_points, mesh_surface, split_transform, tet_surface
from softmode.splats.formats.usd import UP_AXES, placed, splats_from_prim
from softmode.splats.splats import MAX_SPLATS, Splats, joined, up_rotation

Kind = Literal["Mesh", "TetMesh", "Points", "ParticleField3DGaussianSplat"]
Array = NDArray[np.float64]
_WIDTHS = "Give one width, or one for each point"


@dataclass(frozen=True, kw_only=True)
class UsdDeformable:
    """A deformable body of a stage: its shape in an asset frame of its own, and where that frame lies."""

    path: str
    """Path of the prim that is the body."""
    kind: Kind
    """Type of its simulation geometry; a ParticleField3DGaussianSplat is filled from the splats."""
    surface: SurfaceMesh | None = None
    """Surface of a Mesh or TetMesh, asset frame [m]."""
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """Positions of Points, asset frame [m], shape (N, 3)."""
    point_radii: Array = field(default_factory=lambda: np.zeros(0))
    """Radii of Points [m], half their widths, shape (N,); zero where the stage gives none."""
    splats: Splats | None = None
    """Its picture, asset frame [m]; None where the stage has none."""
    meshes: tuple[SurfaceMesh, ...] = ()
    """Visible meshes of the body beside its simulation geometry, asset frame [m]."""
    rotation: Array
    """R of x = scale R X + t, the place of the asset frame, shape (3, 3)."""
    translation: Array
    """t, the origin of the asset frame [m], shape (3,)."""
    scale: float = 1.0
    """Scale of the asset frame of a body that softmode wrote; the shapes of others are scaled already."""
    properties: dict[str, float] = field(default_factory=dict)
    """What the stage says of `Material`'s fields, in SI units."""
    sources: dict[str, str] = field(default_factory=dict)
    """Where each property comes from: prim path and attribute."""
    mass: float | None = None
    """Mass of the whole body [kg]; goes before any density."""
    bundle: dict[str, Any] | None = None
    """softmode's own attributes, by name; None on bodies of other tools."""
    notes: tuple[str, ...] = ()
    """What was read in another way than it was meant."""

    def material(self, volume: float, default: Material | None = None) -> Material:
        """Return the material of the body.

        What softmode wrote in double precision counts where it agrees with the standard attributes to float32.

        Args:
            volume: Volume of the body [m^3], by which its mass is divided.
            default: What the stage does not say; ``Material()`` when None.

        Raises:
            MaterialError: If the stage gives a value outside its range.
        """
        base = default or Material()
        values: dict[str, Any] = {name: getattr(base, name) for name in Material.__dataclass_fields__}
        exact = self._exact_properties()
        values.update(exact)
        values.update({name: v for name, v in self.properties.items() if not _agree(exact.get(name), v)})
        # The mass that softmode wrote beside a density says nothing new: who edits that density is heard.
        written = exact.get("density", values["density"]) * volume
        if self.mass is not None and not _agree(written, self.mass):
            values["density"] = self.mass / volume
        try:
            return Material(**values)
        except (MaterialError, TypeError) as error:
            where = ", ".join(sorted(set(self.sources.values()))) or self.path
            message, hint = (error.message, error.hint) if isinstance(error, MaterialError) else (str(error), "")
            raise MaterialError(f"{self.path}: {message} (from {where})", hint=hint) from error

    def _exact_properties(self) -> dict[str, Any]:
        """Return the fields of a material that softmode wrote."""
        found: dict[str, Any] = {}
        for name in Material.__dataclass_fields__:
            value = (self.bundle or {}).get(tokens.MATERIAL_PREFIX + name)
            if name == "model" and value is not None:
                found[name] = MaterialModel.__members__.get(str(value), str(value))
            elif isinstance(value, int | float):
                found[name] = float(value)
        return found


def _agree(exact: float | None, stored: float) -> bool:
    """Return whether a stored single-precision number may stand for an exact one."""
    return exact is not None and abs(exact - stored) <= 2.0**-22 * abs(exact)


@dataclass(frozen=True, kw_only=True)
class UsdScene:
    """What a stage holds of deformables."""

    file: str
    """The file."""
    deformables: tuple[UsdDeformable, ...]
    """Its deformable bodies, in the order of the stage."""
    meters_per_unit: float
    """Length of the stage's unit [m]."""
    kilograms_per_unit: float
    """Mass of the stage's unit [kg]."""
    up_axis: str
    """Axis of the stage that points up: X, Y or Z."""
    scenery: Splats | None = None
    """Visible splats that belong to no deformable, in the world [m]; None where there are none."""
    notes: tuple[str, ...] = ()
    """What was not read, or left to Newton's importer."""


def read_usd_scene(path: str | os.PathLike[str], *, asset_root: str | os.PathLike[str] | None = None) -> UsdScene:
    """Read the deformable bodies of an OpenUSD stage.

    A body is a prim with `PhysicsDeformableBodyAPI` (the AOUSD proposal), `OmniPhysicsDeformableBodyAPI`,
    `PhysxAutoDeformableBodyAPI` or `PhysxDeformableBodyAPI`, or a geometry with one of the proposal's or Omni's
    simulation schemas that no body governs. Its geometry is the prim beneath it with a simulation schema, the source of
    an automatic Omni body, itself, or the only TetMesh, Mesh, Points or splats beneath it. Splats beneath a body are
    its picture. Disabled bodies are left out, and with a note what is no soft solid: cables, cloth (a surface
    deformable that is not closed), points that a scene with `NewtonMPMSceneAPI` owns.

    The stage is opened in a process of its own with limited memory and time. What it refers to (layers, payloads,
    textures) must lie inside the asset root.

    Args:
        path: A `.usd`, `.usda`, `.usdc` or `.usdz` file.
        asset_root: Folder that holds whatever the stage may read; None for the file's own.

    Raises:
        AssetError: If the file is damaged, refers out of the root, or a body has no usable geometry.
        MissingExtraError: If the extra `[usd]` is not installed.
    """
    with tempfile.TemporaryDirectory() as folder:
        return open_scene(path, asset_root, folder, copy=False)


def open_scene(
    path: str | os.PathLike[str],
    asset_root: str | os.PathLike[str] | None,
    folder: str,
    *,
    copy: bool,
    only: Sequence[str] | None = None,
    skip: Sequence[str] = (),
) -> UsdScene:
    """Do what `read_usd_scene` says for some deformables; write the rest to `rest.usdc` in the folder if `copy`."""
    name = f"OpenUSD file {path}"
    chosen = {"only": None if only is None else list(only), "skip": list(skip)}
    rest = os.path.join(folder, "rest.usdc") if copy else None
    answer = process.read(
        "scene", path, name=name, asset_root=asset_root, most=MAX_SPLATS, copy=rest, strict=True, **chosen
    )
    stage = answer.described
    frame = stage_frame(stage, name)
    notes = [*warned(stage["warnings"], name), *stage["notes"]]
    with damage_errors(name):
        bodies = tuple(_deformable(body, answer.arrays, frame, name) for body in stage["bodies"])
        scenery = [_splats(prim, answer.arrays, frame, np.eye(4), name) for prim in stage["scenery"]]
    notes += [f"{part.name.removeprefix(f'{name}: ')}: {note}" for part in scenery for note in part.notes]
    return UsdScene(
        file=str(path),
        deformables=bodies,
        meters_per_unit=frame.meters,
        kilograms_per_unit=frame.kilograms,
        up_axis=stage["up"],
        scenery=joined(scenery, name) if scenery else None,
        notes=tuple(notes),
    )


def warned(texts: list[str], name: str) -> list[str]:
    """Return what a stage is to be warned of, having warned of it."""
    for text in texts:
        warnings.warn(f"{name}: {text}", stacklevel=4)
    return texts


@dataclass(frozen=True)
class StageFrame:
    """How a stage is turned and scaled: every frame of it, not only the outermost, so that local shapes agree too."""

    up: Array
    meters: float
    kilograms: float

    def matrix(self, flat: list[float]) -> Array:
        """Return a transform (columns, shape (4, 4)) between frames in metres with Z up from a stage's row matrix."""
        stage = np.array(flat, dtype=np.float64).reshape(4, 4).T
        found = np.eye(4)
        found[:3, :3] = self.up @ stage[:3, :3] @ self.up.T
        found[:3, 3] = self.meters * (self.up @ stage[:3, 3])
        return found

    def points(self, points: NDArray[Any]) -> Array:
        """Return positions in metres with Z up, shape (N, 3)."""
        with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is refused where it is used, by name
            return (self.meters * points.astype(np.float64)) @ self.up.T


def stage_frame(stage: dict[str, Any], name: str) -> StageFrame:
    """Return the units and axes of a stage that the process described.

    Raises:
        AssetError: If they are none.
    """
    meters, kilograms = float(stage["meters"]), float(stage["kilograms"])
    for what, value in (("metersPerUnit", meters), ("kilogramsPerUnit", kilograms)):
        if not (np.isfinite(value) and value > 0.0):
            raise AssetError(f"{name}: {what} is {value}", hint="Set it to the size of the unit in SI units")
    if stage["up"] not in UP_AXES:
        raise AssetError(f"{name}: upAxis is {stage['up'][:20]!r}", hint="Set it to X, Y or Z")
    return StageFrame(up_rotation(UP_AXES[stage["up"]]), meters, kilograms)


def _deformable(body: dict[str, Any], arrays: list[NDArray[Any]], frame: StageFrame, name: str) -> UsdDeformable:
    """Build one body from what the process sent."""
    where = f"{name}: {body['geometry']}"
    world = frame.matrix(body["matrix"] if body["bundle"] is None else body["body_matrix"])
    scale, own = 1.0, frame
    if body["bundle"] is not None:  # in metres with z up whatever stage refers to it, and so are the numbers beside it
        own = StageFrame(np.eye(3), 1.0, 1.0)
        world[:3, :3] = frame.meters * (world[:3, :3] @ frame.up)
    rotation, stretch = split_transform(world, where)
    if body["bundle"] is not None:  # the prim's frame is the body's: its place may turn and scale, no more
        scale = float(stretch[0, 0])
        if not np.array_equal(stretch, scale * np.eye(3)):
            raise AssetError(
                f"{name}: {body['path']}: a body of softmode is stretched or mirrored by its transform",
                hint="Scale it evenly, or delete its softmode: attributes to have the body built anew",
            )
        stretch = np.eye(3)
    to_asset = np.eye(4)  # world -> asset frame
    to_asset[:3, :3], to_asset[:3, 3] = rotation.T / scale, -rotation.T @ world[:3, 3] / scale
    shape = body["shape"]
    notes = list(body["notes"])
    kind = body["kind"]
    surface, points, radii = None, np.zeros((0, 3)), np.zeros(0)
    if kind == "Mesh":
        surface = mesh_surface(parts_of(shape, arrays, frame), stretch, where)
        if body["surface"]:
            notes.append("a surface deformable, simulated as the solid that it encloses")
    elif kind == "TetMesh":
        surface = tet_surface(parts_of(shape, arrays, frame), stretch, where)
    elif kind == "Points":
        parts = parts_of(shape, arrays, own)
        points = finite_points(parts, where) @ stretch.T
        widths = np.asarray(parts.get("widths", 0.0), dtype=np.float64)
        if not (widths.size in (1, len(points)) and np.isfinite(widths).all() and (widths >= 0.0).all()):
            raise AssetError(f"{where}: {widths.size} widths for {len(points)} points, or negative ones", hint=_WIDTHS)
        size = abs(float(np.linalg.det(stretch))) ** (1.0 / 3.0)
        radii = np.broadcast_to(0.5 * size * widths.reshape(-1), (len(points),)).copy()
    pictures = [_splats(prim, arrays, frame, to_asset, name) for prim in body["splats"]]
    notes += [f"{part.name.removeprefix(f'{name}: ')}: {note}" for part in pictures for note in part.notes]
    meshes = []
    for mesh in body["meshes"]:
        relative = _snapped(to_asset @ frame.matrix(mesh["matrix"]))
        meshes.append(
            mesh_surface(parts_of(mesh, arrays, frame), relative[:3, :3], f"{name}: {mesh['path']}", relative[:3, 3])
        )
    for mesh in (*meshes, *((surface,) if surface is not None and not meshes and not pictures else ())):
        notes += mesh.notes
    properties, sources = _properties(body, own)
    mass = body["mass"]
    if mass is None and "masses" in shape:
        mass = float(np.sum(arrays[shape["masses"]], dtype=np.float64)) or None
    if mass is not None and not 0.0 < mass < np.inf:
        raise AssetError(f"{name}: {body['path']}: its mass is {mass}", hint="Give the mass in the stage's unit, > 0")
    return UsdDeformable(
        path=body["path"],
        kind=kind,
        surface=surface,
        points=points,
        point_radii=radii,
        splats=joined(pictures, f"{name}: {body['path']}") if pictures else None,
        meshes=tuple(meshes),
        rotation=rotation,
        translation=world[:3, 3],
        scale=scale,
        properties=properties,
        sources=sources,
        mass=None if mass is None else mass * own.kilograms,
        bundle=_bundle(body["bundle"], arrays),
        notes=tuple(notes),
    )


def _splats(prim: dict[str, Any], arrays: list[NDArray[Any]], frame: StageFrame, into: Array, name: str) -> Splats:
    """Return the splats of a prim in another frame than the world, given the map there; untouched if it is theirs."""
    part = splats_from_prim(prim, arrays, f"{name}: {prim['path']}")
    if frame.meters != 1.0 or not np.array_equal(frame.up, np.eye(3)):
        part = part.transformed(rotation=frame.up, scale=frame.meters)
    relative = _snapped(into @ frame.matrix(prim["matrix"]))
    return part if np.array_equal(relative, np.eye(4)) and not any(part.offset) else placed(part, relative)


def _snapped(matrix: Array) -> Array:
    """Return a transform without the rounding of inverting and multiplying, so that what was at rest stays exact."""
    near = np.round(matrix, 12)
    return near if np.allclose(near, np.eye(4), atol=1e-9) else matrix


def parts_of(shape: dict[str, Any], arrays: list[NDArray[Any]], frame: StageFrame) -> dict[str, Any]:
    """Return the arrays of a geometry in metres, its own frame."""
    found: dict[str, Any] = {key: arrays[value] for key, value in shape.items() if type(value) is int}
    points = found.get("points", np.zeros((0, 3)))
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind != "f":
        raise AssetError(f"{shape['path']}: points of shape {points.shape}", hint=REEXPORT)
    found["points"] = frame.points(points)
    if "widths" in found:
        found["widths"] = frame.meters * found["widths"].astype(np.float64)
    if "look" in shape:
        found["look"] = _resolved(shape["look"], arrays)
    return {**found, "path": shape["path"], "left_handed": shape["left_handed"]}


def _resolved(look: dict[str, Any], arrays: list[NDArray[Any]]) -> dict[str, Any]:
    """Return how a geometry looks, its arrays in place of their numbers."""

    def of(given: Any) -> Any:
        if isinstance(given, dict):
            return {key: arrays[value] if type(value) is int else of(value) for key, value in given.items()}
        return [of(one) if isinstance(one, dict) else one for one in given] if isinstance(given, list) else given

    return of(look)


def _properties(body: dict[str, Any], frame: StageFrame) -> tuple[dict[str, float], dict[str, str]]:
    """Return material properties in SI units and where they come from."""
    units = {
        "youngs_modulus": frame.kilograms / frame.meters,
        "density": frame.kilograms / frame.meters**3,
        "poissons_ratio": 1.0,
        "friction": 1.0,
    }
    material = body["material"] or {}
    values = {key: shortest(material[key]) * unit for key, unit in units.items() if key in material}
    sources = {key: f"{material['path']}.{material[f'{key}_from']}" for key in values}
    if body["density"] is not None:
        values["density"] = shortest(body["density"]) * units["density"]
        sources["density"] = f"{body['path']}.density"
    return values, sources


def shortest(value: float | np.floating) -> float:
    """Return the double of fewest digits that is a float32 number: 0.4, not 0.4000000059604645; others as they are."""
    with np.errstate(over="ignore"):
        single = np.float32(value)
    return float(str(single)) if single == value else float(value)


def _bundle(sent: dict[str, Any] | None, arrays: list[NDArray[Any]]) -> dict[str, Any] | None:
    """Return softmode's own attributes by name."""
    if sent is None:
        return None
    return {**sent["values"], **{name: arrays[number] for name, number in sent["arrays"].items()}}
