"""The commands ``softmode body build``, ``body show``, ``body check`` and ``body cut``."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from softmode.cli.common import finding_line, optional_argument, own_group, quiet_warp, same_fields, short_name
from softmode.cli.object_options import ObjectOptions, named_numbers, typed
from softmode.errors import ConfigError, GraspError
from softmode.files import check_place

if TYPE_CHECKING:
    from softmode.deformables.body.reduced_body import ReducedBody
    from softmode.deformables.body.regions import Region
    from softmode.deformables.reduction.report import BodyReport
    from softmode.objects.soft_object import SoftObject


SHOWN = {"youngs_modulus": 1.0e5, "density": 300.0}
"""Material of frequencies where nothing is said: Young's modulus [Pa] and density [kg/m^3]."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Asset:
    """A file, and how it becomes a body."""

    file: Annotated[Path | None, optional_argument()] = None
    """Splats (.ply, .splat, .spz, .sog, meta.json, .usd, ...), a mesh (.glb, .obj, .stl, .usd, ...) or a point cloud
    (.npz with points, normals, colors; .ply), or a preset's name; --splat and --object name one too."""
    functions: int | None = None
    """Functions chosen by elastic energy; 48 if omitted."""
    accuracy: float | None = None
    """Or as many as the first six frequencies take to be this near to those of the whole space, such as 0.02."""
    modes: int | None = None
    """FreeForm's instead: so many eigenmodes beside the constant handle."""
    handles: Literal["affine", "quadratic", "local", "qgmls"] | None = None
    """What each carries: (X, Y, Z, 1), or ten monomials; or local handles, or Q-GMLS, in their place."""
    local_count: int | None = None
    """Local handles, or kernels of Q-GMLS; 16 if omitted."""
    kernels_at: tuple[str, ...] = ()
    """X,Y,Z,RADIUS of more of them [m]."""
    kernels: int | None = None
    """Reproducing kernels; 1000 if omitted, 400 with eigenmodes."""
    points: int = 384
    """Cubature points, at which a step evaluates stress."""
    surface: int | None = None
    """Surface samples, which feel contact; 800 if omitted."""
    splats: int | None = None
    """Splats on a mesh, 2000 if omitted, or on a preset, 6000."""
    rank_tolerance: float | None = None
    """Functions smaller than this are dropped as noise; 1e-5 if omitted, 1e-9 for slender and flat bodies."""
    poissons_ratio: tuple[float, ...] = ()
    """Poisson's ratio of the functions, a preset's own, else 0.4, if omitted; several serve one that varies."""
    region: tuple[str, ...] = ()
    """NAME=x0,y0,z0,x1,y1,z1: a part that scenes hold, move or grasp [m]; a seventh makes it soft,
    stiffness / E [1/m^2]. Coordinates: z up, the box centred over the origin, on z = 0; inf is allowed."""
    seed: int = 0
    """Seed of what the build draws."""
    toy: Annotated[ObjectOptions, own_group()] = dataclasses.field(default_factory=ObjectOptions)
    """Your own object; what is left out is as the task, the policy's run or the file has it."""
    finger: float | None = None
    """Width of what is to press it [m]: a warning says how many surface samples that takes, if there are too few."""

    @property
    def path(self) -> Path:
        """The file that is given.

        Raises:
            ConfigError: If there is none, or two.
        """
        given = [file for file in (self.file, self.toy.splat, self.toy.object) if file is not None]
        if len(given) != 1:
            said = f"{len(given)} files are given" if given else "no file is given"
            raise ConfigError(said, hint="name one, like: softmode body check toy.ply")
        return given[0]

    def target(self, path: Path | None, suffix: str) -> Path:
        """Return what to write, beside the file if nothing is said; refuse it before any work if that cannot be."""
        file = self.path
        stem = file.parent.name if file.name == "meta.json" else file.stem
        path = file.with_name(f"{stem}{suffix}") if path is None else path
        if path.suffix.lower() != suffix:
            raise ConfigError(f"out {path} is no {suffix} file", hint=f"name it like toy{suffix}")
        check_place(path, "file", make_folders=False)
        if path.exists() and file.exists() and path.samefile(file):
            raise ConfigError(f"{path} is the file that is read", hint="choose another name with --out")
        return path


@dataclasses.dataclass(frozen=True, kw_only=True)
class BodyBuild(_Asset):
    """Build the body of a splat file, mesh or point cloud and save it with its splats and what it is made of.

    Example: softmode body build toy.ply --size 0.08 --youngs-modulus 2e5 -o toy.npz
    """

    out: Annotated[Path | None, short_name("-o")] = None
    """Body file to write, FILE.npz beside the file if omitted; `softmode play --object`, `body show` and `body check`
    take it, and `ReducedBody.load` reads it."""

    def run(self) -> int:
        """Build, write, say what is wrong; return 0."""
        out = self.target(self.out, ".npz")
        from softmode.objects.object_file import write_object

        thing, report = _examined(self)
        body, splats = thing.body, thing.visible_splats
        write_object(out, body, splats, thing.radiance)
        _print_report(report, measures=False)
        print(
            f"wrote {body.name!r} to {out}: {body.function_count} functions, {body.point_count} cubature points, "
            f"{body.surface_count} surface samples, {splats.count} splats; built in {body.build_seconds:.2f} s"
        )
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class BodyShow(_Asset):
    """Draw a body: soft modes, skinning weights, cubature, kernels, grasps, spectra, report.

    Example: softmode body show toy.npz -o toy.png
    """

    out: Annotated[Path | None, short_name("-o")] = None
    """Picture to write, FILE.png beside the file if omitted."""

    def run(self) -> int:
        """Draw, print, return 0."""
        out = self.target(self.out, ".png")
        from softmode.objects.rest_grasps import rest_grasps
        from softmode.robots.arm import ArmDescription
        from softmode.robots.jaws import ParallelJaw
        from softmode.viz.body_picture import mode_frequencies, write_body_picture

        thing, report = _examined(self)
        body, splats = thing.body, thing.visible_splats
        material = _material(body)
        with quiet_warp():
            write_body_picture(out, body, splats, report, **material)
        for key, value in body.provenance.items():
            if key != "shown":
                print(f"{key:34} {value:.4g}" if isinstance(value, float) else f"{key:34} {value}")
        print(f"{'eigenvalues [1/m^2]':34} {'  '.join(f'{value:.4g}' for value in body.eigenvalues)}")
        lowest = mode_frequencies(body, **material)[:8]
        print(f"{'frequencies [Hz]':34} {'  '.join(f'{value:.4g}' for value in lowest)}")
        try:
            best = rest_grasps(body, ParallelJaw.of(ArmDescription()), **material)[0]
            width, height = 1e3 * best.width, 1e3 * (best.position[2] - body.bounds[0, 2])
            print(
                f"{'grasp [mm, mm, deg]':34} {width:.0f} wide, {height:.0f} high, turned {math.degrees(best.yaw):.0f}"
            )
        except GraspError as error:
            print(f"{'grasp':34} none: {error}")
        _print_report(report, measures=True)
        print(f"wrote {out}")
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class BodyCheck(_Asset):
    """Examine a body, or the body that a file would become; exit code 0: well, 1: with warnings, 2: broken.

    Example: softmode body check toy.ply --size 0.08
    """

    def run(self) -> int:
        """Measure, print findings with remedies, return the exit code."""
        from softmode.viz.body_picture import mode_frequencies

        thing, report = _examined(self)
        body = thing.body
        material = _material(body)
        print(f"{'made of, stored or given':44} {body.provenance.get('material', 'nothing said')}")
        print(f"{'first frequency [Hz]':44} {mode_frequencies(body, **material)[0]:.4g}")
        _print_report(report, measures=True)
        print(f"{body.name}: {('all is well', 'usable, with warnings', 'broken')[report.severity]}")
        return report.severity


@dataclasses.dataclass(frozen=True, kw_only=True)
class BodyCut(_Asset):
    """Cut a body by planes and save its parts with their splats; exit code 0, or 1 if nothing is cut.

    Example: softmode body cut toy.npz --plane 0,0,0.04,0,0,1
    """

    plane: tuple[str, ...] = ()
    """x,y,z,nx,ny,nz: a point [m] and the normal of a plane, placed as a region is. Several cut in turn."""
    inside: tuple[float, float, float] | None = None
    """Colour 0..1 of the faces that are opened; the mean of the splats if omitted."""
    out: Annotated[Path | None, short_name("-o")] = None
    """Body files to write: FILE-1.npz, FILE-2.npz, ... for FILE.npz; beside the file if omitted."""

    def run(self) -> int:
        """Cut, write, say what happened."""
        if not self.plane:
            raise ConfigError("no plane is given", hint="give one like --plane 0,0,0.04,0,0,1")
        planes = [_six_numbers("plane", text) for text in self.plane]
        if self.out is not None and self.out.suffix.lower() != ".npz":
            raise ConfigError(f"out {self.out} is no .npz file", hint="name it like toy.npz")
        base = self.path.with_suffix(".npz") if self.out is None else self.out
        check_place(base, "file", make_folders=False)
        from softmode.deformables.reduction.patch import Patch
        from softmode.objects.cut import cut_object
        from softmode.objects.object_file import write_object
        from softmode.objects.pose import seat_of

        thing, _ = _examined(self)
        body = thing.body
        seat = seat_of(body.bounds + body.offset)
        parts = [thing]
        for numbers in planes:
            patch = Patch.plane(seat + numbers[:3], numbers[3:])
            found = [cut_object(part, patch, inside=self.inside) for part in parts]
            parts = [made for made_of, _ in found for made in made_of]
            for note in [note for _, cut in found for note in cut.notes if len(found) == 1 or not cut.missed]:
                print(note)
        if len(parts) == 1 and parts[0].body is body:
            return 1
        for number, part in enumerate(parts, 1):
            path = base.with_name(f"{base.stem}-{number}.npz")
            write_object(path, part.body, part.splats)
            count = 0 if part.splats is None else part.splats.count
            print(
                f"wrote {part.body.name!r} to {path}: {part.body.volume / body.volume:.1%} of the volume, "
                f"{part.body.function_count} functions, {part.body.surface_count} surface samples, {count} splats"
            )
        return 0


def _six_numbers(option: str, text: str) -> list[float]:
    """Return six numbers separated by commas."""
    return named_numbers(option, f"plane={text}", (6,))[1]


def _examined(options: _Asset) -> tuple[SoftObject, BodyReport]:
    """Return an object with its splats, and its body's report: read, or built from its asset."""
    from softmode.deformables.reduction.functions import RANK_TOLERANCE
    from softmode.deformables.reduction.options import BuildOptions
    from softmode.deformables.reduction.report import report_body
    from softmode.objects.config import ObjectConfig
    from softmode.objects.loader import build_object, load
    from softmode.objects.object_file import file_kind, stored_material

    options.toy.check()
    path = options.path
    toy = options.toy if options.file is None else dataclasses.replace(options.toy, object=path)
    if toy.splat is None and toy.preset is None and file_kind(path) == "body":
        own = dataclasses.fields(_Asset)[1:-2]  # all but file, toy and finger
        given = [f.name for f in own if getattr(options, f.name) != f.default]
        given = [typed(name) for name in (*given, *toy.shape)]
        if given or isinstance(options, BodyBuild):
            raise ConfigError(
                f"{path} is a body already{': ' + ', '.join(given) if given else ''}",
                hint="give the file that it was built from",
            )
        found, quadrature = load(path), None
    else:
        given = same_fields(options, BuildOptions)
        given |= {"mode_count": options.modes, "kernel_count": options.kernels, "cubature_count": options.points}
        given |= {"function_count": options.functions, "poissons_ratio": options.poissons_ratio or None}
        given["add_kernels"] = tuple(_kernel(text) for text in options.kernels_at)
        if options.rank_tolerance is None:
            given["rank_tolerance"] = RANK_TOLERANCE
        counts: dict[str, int | None] = {"splat_count": options.splats}
        if options.surface is not None:
            counts["surface_count"] = options.surface
        config = dataclasses.replace(toy.object_of(ObjectConfig()), **counts, build=BuildOptions(**given))
        found, quadrature = build_object(config, regions=[_region(text) for text in options.region])
    body, splats = found.body, found.visible_splats
    made_of = {**stored_material(body), **toy.material}
    if made_of:
        body = dataclasses.replace(body, provenance={**body.provenance, "material": json.dumps(made_of)})
    asked = found.size_asked
    report = report_body(body, quadrature=quadrature, splats=splats.means, size=asked, finger=options.finger)
    return dataclasses.replace(found, body=body, splats=splats), report


def _material(body: ReducedBody) -> dict[str, float]:
    """Return Young's modulus [Pa] and density [kg/m^3] for frequencies: of the body, or SHOWN."""
    from softmode.objects.object_file import stored_material

    stored = stored_material(body)
    return {name: stored.get(name, value) for name, value in SHOWN.items()}


def _print_report(report: BodyReport, *, measures: bool) -> None:
    """Print measures and findings."""
    if measures:
        for measure in report.measures:
            print(f"{measure.name:44} {measure.value:.4g} {measure.unit}".rstrip())
    for finding in report.findings:
        print(finding_line(finding, sys.stdout))


def _kernel(text: str) -> tuple[list[float], float]:
    """Return the place and the radius of X,Y,Z,RADIUS."""
    *place, radius = named_numbers("kernels-at", f"at={text}", (4,))[1]
    return place, radius


def _region(text: str) -> Region:
    """Return the region NAME=x0,y0,z0,x1,y1,z1[,stiffness]."""
    from softmode.deformables.body.regions import Region

    name, values = named_numbers("region", text, (6, 7))
    return Region(name=name, box=(values[:3], values[3:6]), stiffness=values[6] if len(values) == 7 else None)
