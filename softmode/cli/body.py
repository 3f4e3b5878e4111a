"""The commands ``softmode body build``, ``softmode body show`` and ``softmode body check``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from softmode.checks import require_fields
from softmode.cli.common import quiet_warp, same_fields, short_name
from softmode.errors import ConfigError
from softmode.files import check_place

if TYPE_CHECKING:
    from softmode.deformables.body.reduced_body import ReducedBody
    from softmode.deformables.body.regions import Region
    from softmode.deformables.build.report import BodyReport
    from softmode.objects.object_build import StifferBox
    from softmode.splats.splats import Splats


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Asset:
    """A file, and how it becomes a body."""

    file: Path
    """Splats (.ply, .splat, .spz, .sog, meta.json, .usd, ...), a mesh (.glb, .obj, .stl, .usd, ...) or a point cloud
    (.npz with points, normals, colors; .ply)."""
    size: float | None = None
    """Longest edge of the object [m]; 0.08 if omitted."""
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None = None
    """Axis of the file that points up; -y for splats, +y for glTF, +z for the rest if omitted."""
    crop: tuple[float, float, float, float, float, float] | None = None
    """Box x0 y0 z0 x1 y1 z1 of a splat file, once turned up, outside which splats are dropped."""
    part: Literal["thickest", "tallest", "largest", "all"] = "thickest"
    """Which of the separate parts of a splat file is the object."""
    pose: Literal["stable", "captured"] = "stable"
    """Lay an object that cannot stand on its stable side, or leave it as it is in the file."""
    functions: int | None = None
    """Scalar functions, chosen by elastic energy; 48 if omitted."""
    accuracy: float | None = None
    """Or as many as the first six free frequencies take to be this near to those of the whole space, such as 0.02."""
    modes: int | None = None
    """FreeForm's functions instead: so many skinning eigenmodes beside the constant handle; a body with regions has
    those in any case, 8 if omitted."""
    handles: Literal["affine", "quadratic"] | None = None
    """What each eigenmode carries: (X, Y, Z, 1), or all ten monomials up to degree two, for slender and flat bodies."""
    kernels: int | None = None
    """Reproducing kernels; 1000 if omitted, 400 with eigenmodes."""
    points: int = 384
    """Cubature points, at which a step evaluates stress."""
    surface: int = 400
    """Surface samples, which feel contact."""
    splats: int = 2000
    """Splats on a mesh; a splat file keeps its own."""
    rank_tolerance: float | None = None
    """Functions smaller than this are dropped as noise; 1e-5 if omitted, 1e-9 for slender and flat bodies."""
    poissons_ratio: tuple[float, ...] = (0.4,)
    """Poisson's ratio that the functions are made for; any other can be simulated, several serve one that varies."""
    region: tuple[str, ...] = ()
    """NAME=x0,y0,z0,x1,y1,z1: a part that scenes hold, move or grasp [m]; a seventh number makes it soft, stiffness / E
    [1/m^2]. Coordinates: z up, bounding box centred over the origin, standing on z = 0; inf is allowed."""
    stiffness: tuple[str, ...] = ()
    """NAME=x0,y0,z0,x1,y1,z1,FACTOR: a part that is FACTOR times as stiff as the rest, in the same coordinates."""
    seed: int = 0
    """Seed of every random choice of the build."""

    def target(self, path: Path | None, suffix: str) -> Path:
        """Return what to write, beside the file if nothing is said; refuse it before any work if that cannot be."""
        stem = self.file.parent.name if self.file.name == "meta.json" else self.file.stem
        path = self.file.with_name(f"{stem}{suffix}") if path is None else path
        if path.suffix.lower() != suffix:
            raise ConfigError(f"out {path} is no {suffix} file", hint=f"name it like toy{suffix}")
        check_place(path, "file", make_folders=False)
        if path.exists() and self.file.exists() and path.samefile(self.file):
            raise ConfigError(f"{path} is the file that is read", hint="choose another name with --out")
        return path


@dataclasses.dataclass(frozen=True, kw_only=True)
class BodyBuild(_Asset):
    """Build the body of a splat file, mesh or point cloud and save it with its splats."""

    out: Annotated[Path | None, short_name("-o")] = None
    """Body file to write, FILE.npz beside the file if omitted; `softmode play --object`, `body show` and `body check`
    take it, and `ReducedBody.load` reads it."""

    def run(self) -> int:
        """Build, write, say what is wrong; return 0."""
        out = self.target(self.out, ".npz")
        from softmode.objects.object_file import write_object

        body, splats, report = _examined(self)
        write_object(out, body, splats)
        _print_report(report, measures=False)
        print(
            f"wrote {body.name!r} to {out}: {body.function_count} functions, {body.point_count} cubature points, "
            f"{body.surface_count} surface samples, {splats.count} splats; built in {body.build_seconds:.2f} s"
        )
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class BodyShow(_Asset):
    """Draw a body: soft modes, skinning weights, cubature, kernels, spectra, report."""

    out: Annotated[Path | None, short_name("-o")] = None
    """Picture to write, FILE.png beside the file if omitted."""
    youngs_modulus: float = 1.0e5
    """Young's modulus for the frequencies [Pa]."""
    density: float = 300.0
    """Density for the frequencies [kg/m^3]."""

    def run(self) -> int:
        """Draw, print, return 0."""
        out = self.target(self.out, ".png")
        require_fields(self, ("youngs_modulus", "density"), above=0.0)
        from softmode.viz.body_picture import mode_frequencies, write_body_picture

        body, splats, report = _examined(self)
        material = {"youngs_modulus": self.youngs_modulus, "density": self.density}
        with quiet_warp():
            write_body_picture(out, body, splats, report, **material)
        for key, value in body.provenance.items():
            print(f"{key:34} {value:.4g}" if isinstance(value, float) else f"{key:34} {value}")
        print(f"{'eigenvalues [1/m^2]':34} {'  '.join(f'{value:.4g}' for value in body.eigenvalues)}")
        lowest = mode_frequencies(body, **material)[:8]
        print(f"{'frequencies [Hz]':34} {'  '.join(f'{value:.4g}' for value in lowest)}")
        _print_report(report, measures=True)
        print(f"wrote {out}")
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class BodyCheck(_Asset):
    """Examine a body, or the body that a file would become; exit code 0: well, 1: with warnings, 2: broken."""

    def run(self) -> int:
        """Measure, print findings with remedies, return the exit code."""
        body, _, report = _examined(self)
        _print_report(report, measures=True)
        print(f"{body.name}: {('all is well', 'usable, with warnings', 'broken')[report.severity]}")
        return report.severity


def _examined(options: _Asset) -> tuple[ReducedBody, Splats, BodyReport]:
    """Return a body with its splats and its report: read, or built from its asset."""
    from softmode.deformables.build.functions import RANK_TOLERANCE
    from softmode.deformables.build.options import BuildOptions
    from softmode.deformables.build.report import report_body
    from softmode.objects.config import ObjectConfig
    from softmode.objects.loader import load
    from softmode.objects.object_build import build_object
    from softmode.objects.object_file import file_kind

    kind = file_kind(options.file)
    if kind == "body":
        given = [
            field.name.replace("_", "-")
            for field in dataclasses.fields(_Asset)
            if field.name != "file" and getattr(options, field.name) != field.default
        ]
        if given or isinstance(options, BodyBuild):
            raise ConfigError(
                f"{options.file} is a body already{': --' + ', --'.join(given) if given else ''}",
                hint="give the file that it was built from",
            )
        found = load(options.file)
        splats = found.visible_splats
        return found.body, splats, report_body(found.body, splats=splats.means)
    if kind == "mesh" and (options.crop is not None or options.part != "thickest"):
        raise ConfigError(f"{options.file} is a mesh; crop and part are for splats", hint="leave them out")
    given = same_fields(options, BuildOptions)
    given |= {"mode_count": options.modes, "kernel_count": options.kernels, "cubature_count": options.points}
    given["function_count"] = options.functions
    if options.rank_tolerance is None:
        given["rank_tolerance"] = RANK_TOLERANCE
    found, quadrature = build_object(
        options.file,
        regions=[_region(text) for text in options.region],
        stiffness=[_stiffer(text) for text in options.stiffness],
        size=ObjectConfig.size if options.size is None else options.size,
        **{name: getattr(options, name) for name in ("up", "crop", "part", "pose")},
        surface_count=options.surface,
        splat_count=options.splats,
        build=BuildOptions(**given),
    )
    splats = found.visible_splats
    return found.body, splats, report_body(found.body, quadrature=quadrature, splats=splats.means)


def _print_report(report: BodyReport, *, measures: bool) -> None:
    """Print measures and findings."""
    if measures:
        for measure in report.measures:
            print(f"{measure.name:44} {measure.value:.4g} {measure.unit}".rstrip())
    for finding in report.findings:
        remedy = finding.remedy[:1].upper() + finding.remedy[1:]
        print(f"{finding.severity}: {finding.name}: {finding.what}. {remedy}.")


def _named_numbers(option: str, text: str, counts: tuple[int, ...]) -> tuple[str, list[float]]:
    """Return the name and the numbers of NAME=number,number,..."""
    name, _, values = text.partition("=")
    try:
        found = [float(word) for word in values.split(",")]
    except ValueError:
        found = []
    if not name or len(found) not in counts:
        raise ConfigError(
            f"{option} {text!r}: expected NAME= and {' or '.join(map(str, counts))} numbers separated by commas",
            hint=f"give it like --{option} root=-inf,-inf,-inf,inf,inf,0.01" + (",10" if 6 not in counts else ""),
        )
    return name, found


def _region(text: str) -> Region:
    """Return the region NAME=x0,y0,z0,x1,y1,z1[,stiffness]."""
    from softmode.deformables.body.regions import Region

    name, values = _named_numbers("region", text, (6, 7))
    return Region(name=name, box=(values[:3], values[3:6]), stiffness=values[6] if len(values) == 7 else None)


def _stiffer(text: str) -> StifferBox:
    """Return the part NAME=x0,y0,z0,x1,y1,z1,factor."""
    from softmode.objects.object_build import StifferBox

    _, (x0, y0, z0, x1, y1, z1, factor) = _named_numbers("stiffness", text, (7,))
    return StifferBox(box=(x0, y0, z0, x1, y1, z1), factor=factor)
