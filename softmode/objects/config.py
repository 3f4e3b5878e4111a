"""`ObjectConfig`: which soft object, how large and how finely reduced."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from softmode.checks import require_choice, require_fields, require_number
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.deformables.quadrature.surface_samples import SURFACE_COUNT
from softmode.deformables.reduction.options import BuildOptions
from softmode.errors import AssetError, ConfigError
from softmode.objects.captures import bundled
from softmode.objects.fingerprint import file_fingerprint, find_file
from softmode.objects.material_field import read_material
from softmode.objects.paint import StifferColor
from softmode.objects.parts import Part, Rule
from softmode.objects.shapes.presets import find_preset
from softmode.objects.shapes.primitives import Color, Extents, find_axis
from softmode.radiance.grid import RadianceGrid
from softmode.splats.colored_mesh import ColoredMesh
from softmode.splats.splats import Splats, UpAxis

Box = tuple[float, float, float, float, float, float]
Shape = Literal["plush", "box", "cylinder", "capsule", "sphere"]
Pose = Literal["stable", "captured"]
SIZE = 0.08
"""Longest edge of what has no size of its own and is given none [m]."""
PAINTED = ("stiffness", "stiffness_colors", "stiffness_file", "density_colors", "density_file", "material_file")
"""Options that say where the material varies."""
FILES = ("splat", "mesh", "radiance", "body")
"""Options that name a file."""
FIELD_FILES = {f"{name}_file": f"{name}_fingerprint" for name in ("stiffness", "density", "material")}
"""Options that name a file of factors or of properties, and those that hold its fingerprint."""


@dataclass(frozen=True, kw_only=True)
class StifferBox:
    """A part of an object of another stiffness: a core, a bone, a soft belly."""

    box: Box
    """Corners x0, y0, z0, x1, y1, z1 [m] where the object stands: z up, its bounding box centred over the origin and
    standing on z = 0; may be infinite."""
    factor: float
    """Young's modulus inside over that of the body, > 0."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not all(a < b for a, b in zip(self.box[:3], self.box[3:], strict=True)):
            raise ConfigError(
                f"stiffness: box {self.box} is empty", hint="give x0,y0,z0,x1,y1,z1 with every 0 below its 1"
            )
        require_number("stiffness: factor", self.factor, above=0.0)


@dataclass(frozen=True, kw_only=True)
class ObjectConfig:
    """Which soft object, how large, how finely reduced: the built-in plush, a shape, a preset, a file, or a body."""

    shape: Shape = "plush"
    """What it is where no file is given: "plush", or a "box", "cylinder", "capsule" or "sphere" of
    `extents`."""
    extents: Extents | None = None
    """Edges of a shape's bounding box along x, y and z [m]. A round shape needs two that are equal, a sphere three; a
    capsule lies along the third, its longest, a cylinder along the third, its length or the thickness of a disc."""
    preset: str | None = None
    """Name of an object of the library, `PRESETS`: "sponge", "mug", ...; `load` gives it the preset's material."""
    splat: str | Path | Splats | None = None
    """Splat file (.ply, SOG v2, .spz, .splat, OpenUSD), or a point cloud (.npz, see `read_points`, or .ply); or splats
    that have been read; or the name of a bundled capture, "playbot"."""
    mesh: str | Path | ColoredMesh | None = None
    """Mesh file (.obj, .glb, .stl, ... whatever trimesh reads, OpenUSD), or a mesh that has been read. One that is not
    closed stands for what it encloses."""
    radiance: str | Path | RadianceGrid | None = None
    """Radiance field (.npz, Plenoxels, .nvdb, see `read_radiance`), or one that has been read; it is shown by splats
    baked of it, or marched (`march`)."""
    march: bool = False
    """Whether cameras march rays through its field instead of drawing the splats baked of it: sharper and slower."""
    body: str | Path | None = None
    """File of a body (`softmode body build`, `ReducedBody.save`, or a stage with one from `usd.write_usd`): taken as it
    is, with its own size, pose, surface samples, regions and splats."""
    size: float | None = None
    """Longest edge of the bounding box of plush, preset, splat file, mesh or field, upright [m]; None for a preset's
    own and that of a field which says its metres, else 0.08. The gripper opens 0.09 m."""
    colors: tuple[Color, Color] | None = None
    """Two colours, 0..1, of a shape or mesh, as a checker pattern; None for orange and cream, or the mesh's own."""
    splat_count: int | None = None
    """Number of splats on a shape, preset or mesh, or baked of a field; None for 6000 on a preset, else 2000."""
    surface_count: int = SURFACE_COUNT
    """Number of surface samples, the points that feel contact."""
    up: UpAxis | None = None
    """Axis of the file that points up; None for "-y" (splat files: trained captures mostly have y down), "+y" (glTF) or
    "+z" (OpenUSD, which is read with z up, point clouds, other meshes, and what has been read)."""
    crop: tuple[float, float, float, float, float, float] | None = None
    """Box (x0, y0, z0, x1, y1, z1) of the splat file or field, after turning it up, outside which there is nothing;
    cuts an object off what it touched when it was captured."""
    part: Part = "thickest"
    """Which of the separate parts of a splat file is the object: the one with the largest least spread, so that neither
    the ground it was captured on, wide but thin, nor loose small parts win, without the plinth, turntable or stem that
    carries it; the one with the greatest height; the one with most splats; or whatever there is. Numbers, such as
    (1, 2), take those candidates that `softmode splat show` draws."""
    resolution: int | None = None
    """Voxels along the longest edge of the grid in which a splat file is filled; None takes 64 to 384,
    as its thin parts need."""
    pose: Pose = "stable"
    """"stable" lays an object from a file that cannot stand as it is there (on a pointed foot, say) on the side that
    needs the least turn; "captured" lets it topple."""
    contact_radius: float = 0.0
    """How far the surface that touches stands out from the body's [m]. Samples are points: one or two millimetres keep
    an edge that presses between them from catching on them."""
    stiffness: tuple[StifferBox, ...] = ()
    """Parts of another stiffness; where they overlap, the last one counts."""
    stiffness_colors: tuple[StifferColor, ...] = ()
    """Parts of another stiffness by the colour of the nearest splat; times what `stiffness` says."""
    stiffness_file: str | Path | None = None
    """File of points and factors, as `read_field` takes, where the object stands: times what the others say."""
    density_colors: tuple[StifferColor, ...] = ()
    """Parts of another density by the colour of the nearest splat, factors relative to each other: the mass stays that
    of the material's density."""
    density_file: str | Path | None = None
    """File of points and factors of density, likewise; times what `density_colors` says."""
    material_file: str | Path | None = None
    """File of points with Young's modulus, Poisson's ratio and density, as `read_material` takes, where the object
    stands; the options above come on top as factors."""
    clamped_height: float = 0.0
    """Height of the foot that is fixed to the table [m], 0 for an object that stands free. A clamped object keeps its
    scale."""
    build: BuildOptions = field(default_factory=BuildOptions)
    """How the body is reduced."""
    fingerprint: str | None = None
    """`file_fingerprint` of the file that is meant, see `pinned`; None takes whatever lies at the path. The file is
    looked for at its path and by its name in the working folder; another content is refused when it is loaded."""
    stiffness_fingerprint: str | None = None
    """The same for `stiffness_file`."""
    density_fingerprint: str | None = None
    """The same for `density_file`."""
    material_fingerprint: str | None = None
    """The same for `material_file`."""
    fitted: str | None = None
    """What `softmode fit` found of a body that is a .npz, as JSON: its film's fingerprint, values and bars; written by
    `pinned`, so that datasets and checkpoints tell it."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if isinstance(self.splat, str | Path):
            object.__setattr__(self, "splat", bundled(self.splat) or self.splat)
        object.__setattr__(self, "stiffness", tuple(self.stiffness))
        object.__setattr__(self, "stiffness_colors", tuple(self.stiffness_colors))
        object.__setattr__(self, "density_colors", tuple(self.density_colors))
        if isinstance(self.part, int | list):
            object.__setattr__(self, "part", (self.part,) if isinstance(self.part, int) else tuple(self.part))
        if self.size is not None:
            hint = "give the longest edge in metres"
            require_number("size", self.size, at_least=1.0e-3, at_most=10.0, unit="m", hint=hint)
        if self.preset is not None:
            find_preset(self.preset)
        require_fields(self, ("contact_radius", "clamped_height"), at_least=0.0, unit="m")
        if self.splat_count is not None:
            require_number("splat_count", self.splat_count, at_least=100)
        require_number("surface_count", self.surface_count, at_least=16)
        if self.resolution is not None:
            require_number("resolution", self.resolution, at_least=16, at_most=512)
        if self.crop is not None and not all(a < b for a, b in zip(self.crop[:3], self.crop[3:], strict=True)):
            raise ConfigError(f"crop {self.crop} is empty", hint="give x0 y0 z0 x1 y1 z1 with every 0 below its 1")
        numbers = isinstance(self.part, tuple) and self.part and all(isinstance(k, int) for k in self.part)
        for name, known in (("shape", Shape), ("up", UpAxis), ("part", Rule), ("pose", Pose)):
            if not ((name == "up" and self.up is None) or (name == "part" and numbers)):
                require_choice(name, getattr(self, name), get_args(known))
        files = (self.preset, self.splat, self.mesh, self.radiance, self.body)
        if sum(file is not None for file in files) + (self.shape != "plush") > 1:
            raise ConfigError(
                f"shape {self.shape!r}, preset {self.preset!r}, splat {self.splat!r}, mesh {self.mesh!r}, radiance"
                f" {self.radiance!r} and body {self.body!r} exclude each other",
                hint="give one of them",
            )
        if self.march and self.radiance is None and self.body is None:
            raise ConfigError(f"march: a {self.kind} has no radiance field", hint="give a field, or leave it out")
        if self.body is not None and self.clamped_height > 0.0:
            hint = "build it with a region for its foot: softmode body build FILE --region foot=..."
            raise ConfigError(f"clamped_height is {self.clamped_height} m for a body that is built", hint=hint)
        painted = [name for name in PAINTED if getattr(self, name)]
        if self.body is not None and painted:
            raise ConfigError(
                f"{', '.join(painted)} given for the body {self.body}", hint="give it when the body is built"
            )
        self._check_extents()
        if self.colors is not None:
            if self.shape == "plush" and self.mesh is None and self.preset is None:
                raise ConfigError(
                    "colors are for shapes, presets and meshes", hint="leave them out; splats have their own"
                )
            if np.shape(self.colors) != (2, 3) or not all(0.0 <= x <= 1.0 for color in self.colors for x in color):
                raise ConfigError(f"colors {self.colors} are not two colours", hint="give two of (r, g, b) in 0..1")

    @property
    def kind(self) -> str:
        """What it is made from: "preset", "splat", "mesh", "radiance" or "body", else its shape."""
        return next((kind for kind in ("preset", *FILES) if getattr(self, kind) is not None), self.shape)

    @property
    def longest_edge(self) -> float | None:
        """Longest edge that it is brought to [m]; None for what may have its own: shapes, bodies, presets, fields."""
        if self.body is not None or self.extents is not None:
            return None
        return self.size if self.preset is not None or self.radiance is not None else self.size or SIZE

    @property
    def material(self) -> Material | None:
        """What a preset, or an object with a file of its material, is made of; None for anything else."""
        found = None if self.preset is None else find_preset(self.preset).material
        if self.material_file is None:
            return found
        return replace(found or Material(), **read_material(self.material_file).means)

    def for_material(self, material: Material | None) -> ObjectConfig:
        """Return this with a body for a material's own Poisson's ratio, unless its options name one."""
        return self if material is None else replace(self, build=self.build.for_ratio(material.poissons_ratio))

    @property
    def file(self) -> tuple[str, Path] | None:
        """Which of `splat`, `mesh`, `radiance` and `body` names a file, and the file; None where there is none."""
        for kind in FILES:
            if isinstance(given := getattr(self, kind), str | Path):
                return kind, Path(given)
        return None

    def changed(self, **options: Any) -> ObjectConfig:
        """Return this with other options; another file comes without the fingerprint of the one before."""
        if any(options.get(kind) is not None for kind in FILES):
            options = {"fingerprint": None, "fitted": None, **options}
        for name, its in FIELD_FILES.items():
            if options.get(name) is not None:
                options = {its: None, **options}
        return replace(self, **options)

    @property
    def files(self) -> dict[str, tuple[Path, str]]:
        """The files that are named, by the option that names one: the path, and the option of its fingerprint."""
        found = {} if self.file is None else {self.file[0]: (self.file[1], "fingerprint")}
        given = {name: getattr(self, name) for name in FIELD_FILES}
        return found | {name: (Path(path), FIELD_FILES[name]) for name, path in given.items() if path is not None}

    def pinned(self) -> ObjectConfig:
        """Return this with the whole paths and the fingerprints of its files, so that they are found from elsewhere.

        Raises:
            AssetError: If a file cannot be read.
        """
        changes: dict[str, Any] = {}
        for name, (path, its) in self.files.items():
            if getattr(self, its) is None:
                changes |= {name: str(path.resolve()), its: file_fingerprint(path)}
                if name == "body" and path.suffix.lower() == ".npz":
                    changes["fitted"] = ReducedBody.load(path).provenance.get("fit")
        return replace(self, **changes) if changes else self

    def located(self) -> ObjectConfig:
        """Return this with its files where they were found.

        Raises:
            AssetError: If one has a fingerprint, and no file of that content is there.
        """
        changes: dict[str, Any] = {}
        for name, (path, its) in self.files.items():
            fingerprint = getattr(self, its)
            if fingerprint is None:
                continue
            found = find_file(path, fingerprint, Path.cwd())
            if found is None:
                what = "the content has changed since it was recorded" if path.exists() else "no such file any more"
                kind = name if name in FIELD_FILES else "object file"
                option = f"--{name.replace('_', '-')}" if name in FIELD_FILES else "--splat or --object"
                raise AssetError(
                    f"{kind} {path}: {what}, and none of that name and content in the working folder",
                    hint=f"put it back, or name another {'field' if name in FIELD_FILES else 'object'} ({option})",
                )
            changes[name] = str(found)
        return replace(self, **changes) if changes else self

    def for_varied_ratio(self) -> ObjectConfig:
        """Return this with a body for a Poisson's ratio that varies; a clamped or a built one stays as it is."""
        if self.body is not None or self.clamped_height > 0.0:
            return self
        return replace(self, build=self.build.for_varied_ratio())

    def _check_extents(self) -> None:
        """Check that a shape has extents that fit it, and nothing else has any."""
        if (self.extents is None) != (self.shape == "plush"):
            hint = "give a box, cylinder, capsule or sphere three lengths in metres, and anything else a size"
            raise ConfigError(f"shape {self.shape!r} with extents {self.extents}", hint=hint)
        if self.extents is None or self.shape == "plush":
            return
        if len(self.extents) != 3 or not all(1.0e-3 <= x <= 10.0 for x in self.extents):
            raise ConfigError(f"extents must be three lengths in 0.001..10 m, got {self.extents!r}")
        if find_axis(self.shape, self.extents) is None:
            hint = "give a sphere three equal lengths, a cylinder two, a capsule two and a third not below them"
            raise ConfigError(f"extents {self.extents} are not those of a {self.shape}", hint=hint)
