"""The commands ``softmode body build``, ``softmode body show`` and ``softmode body check``."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from softmode.cli.common import finding_line, optional_argument, own_object, quiet_warp, same_fields, short_name
from softmode.cli.object_options import ObjectOptions, named_numbers
from softmode.errors import ConfigError, GraspError
from softmode.files import check_place

if TYPE_CHECKING:
    from softmode.deformables.body.reduced_body import ReducedBody
    from softmode.deformables.body.regions import Region
    from softmode.deformables.build.report import BodyReport
    from softmode.splats.splats import Splats


SHOWN = {"youngs_modulus": 1.0e5, "density": 300.0}
"""Material of frequencies where nothing is said: Young's modulus [Pa] and density [kg/m^3]."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Asset:
    """A file, and how it becomes a body."""

    file: Annotated[Path | None, optional_argument()] = None
    """Splats (.ply, .splat, .spz, .sog, meta.json, .usd, ...), a mesh (.glb, .obj, .stl, .usd, ...) or a point cloud
    (.npz with points, normals, colors; .ply); --splat and --object name one too."""
    functions: int | None = None
    """Scalar functions, chosen by elastic energy; 48 if omitted."""
    accuracy: float | None = None
    """Or as many as the first six frequencies take to be this near to those of the whole space, such as 0.02."""
    modes: int | None = None
    """FreeForm's functions instead: so many skinning eigenmodes beside the constant handle."""
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
    seed: int = 0
    """Seed of every random choice of the build."""
    toy: Annotated[ObjectOptions, own_object()] = dataclasses.field(default_factory=ObjectOptions)
    """Your own object; what is left out is as the task, the policy's run or the file has it."""

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
    """Draw a body: soft modes, skinning weights, cubature, kernels, grasps, spectra, report.

    Example: softmode body show toy.npz -o toy.png
    """

    out: Annotated[Path | None, short_name("-o")] = None
    """Picture to write, FILE.png beside the file if omitted."""

    def run(self) -> int:
        """Draw, print, return 0."""
        out = self.target(self.out, ".png")
        from softmode.viz.body_picture import mode_frequencies, rest_grasps, write_body_picture

        body, splats, report = _examined(self)
        material = _material(body)
        with quiet_warp():
            write_body_picture(out, body, splats, report, **material)
        for key, value in body.provenance.items():
            print(f"{key:34} {value:.4g}" if isinstance(value, float) else f"{key:34} {value}")
        print(f"{'eigenvalues [1/m^2]':34} {'  '.join(f'{value:.4g}' for value in body.eigenvalues)}")
        lowest = mode_frequencies(body, **material)[:8]
        print(f"{'frequencies [Hz]':34} {'  '.join(f'{value:.4g}' for value in lowest)}")
        try:
            best = rest_grasps(body, **material)[0]
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

        body, _, report = _examined(self)
        material = _material(body)
        print(f"{'made of, stored or given':44} {body.provenance.get('material', 'nothing said')}")
        print(f"{'first frequency [Hz]':44} {mode_frequencies(body, **material)[0]:.4g}")
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
    from softmode.objects.object_file import file_kind, stored_material

    options.toy.check()
    path = options.path
    toy = options.toy if options.file is None else dataclasses.replace(options.toy, object=path)
    if toy.splat is None and file_kind(path) == "body":
        given = [f.name for f in dataclasses.fields(_Asset) if getattr(options, f.name) != f.default]
        given = [*(name.replace("_", "-") for name in given if name not in ("file", "toy")), *toy.shape]
        if given or isinstance(options, BodyBuild):
            raise ConfigError(
                f"{path} is a body already{': --' + ', --'.join(given) if given else ''}",
                hint="give the file that it was built from",
            )
        found, quadrature = load(path), None
    else:
        given = same_fields(options, BuildOptions)
        given |= {"mode_count": options.modes, "kernel_count": options.kernels, "cubature_count": options.points}
        given["function_count"] = options.functions
        if options.rank_tolerance is None:
            given["rank_tolerance"] = RANK_TOLERANCE
        counts = {"surface_count": options.surface, "splat_count": options.splats}
        config = dataclasses.replace(toy.object_of(ObjectConfig()), **counts, build=BuildOptions(**given))
        found, quadrature = build_object(config, regions=[_region(text) for text in options.region])
    body, splats = found.body, found.visible_splats
    made_of = {**stored_material(body), **toy.material}
    if made_of:
        body = dataclasses.replace(body, provenance={**body.provenance, "material": json.dumps(made_of)})
    report = report_body(body, quadrature=quadrature, splats=splats.means, size=found.size_asked)
    return body, splats, report


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


def _region(text: str) -> Region:
    """Return the region NAME=x0,y0,z0,x1,y1,z1[,stiffness]."""
    from softmode.deformables.body.regions import Region

    name, values = named_numbers("region", text, (6, 7))
    return Region(name=name, box=(values[:3], values[3:6]), stiffness=values[6] if len(values) == 7 else None)
