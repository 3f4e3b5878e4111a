"""The build of a body: kernels, weights, orthonormal functions, cubature; and the names users import."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from softmode.deformables.body.records import BodyCubature, BodyRegions, BodySurface
from softmode.deformables.body.reduced_body import FORMAT_VERSION, ReducedBody, Scalar
from softmode.deformables.body.regions import Region
from softmode.deformables.quadrature.octants import octants_of
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.reduction.basis import BodyBasis, Domain, make_body_basis
from softmode.deformables.reduction.cache import cache_directory, cached_body, fingerprint_of
from softmode.deformables.reduction.cubature import POISSON_RATIO, Cubature, select_cubature
from softmode.deformables.reduction.elastic_functions import EXCESS, EXCESS_WARNING, FAR_AFTER
from softmode.deformables.reduction.kernel_visibility import lips_of, material_of
from softmode.deformables.reduction.options import FUNCTION_COUNT, FUNCTION_LIMIT, BuildOptions, HandleName
from softmode.deformables.reduction.region_samples import longest_edge, pieces_near, refine_at_faces, sample_regions
from softmode.deformables.reduction.sources import Sources, pack_sources
from softmode.errors import ConfigError, MaterialError, memory_errors
from softmode.stages import moved
from softmode.stages import stage as under_way

__all__ = [
    "BuildOptions",
    "HandleName",
    "ReducedBody",
    "Region",
    "build_body",
    "cache_directory",
    "cached_body",
    "fingerprint_of",
]

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]
Field = ArrayLike | Callable[[Array], ArrayLike]
"""One value per quadrature point, or a function of points (N, 3) [m] in asset coordinates."""

FREE_VERSION = 3
"""Version of the format since which bodies without regions are what they are: live recordings name them by it."""
PULLED_VERSION = 6
"""That of those with more functions than `FAR_AFTER`, which since then serve pulls."""
NU_LIMIT = 0.495
"""Poisson's ratio from which on the default number of functions is said to be too small."""
_PROGRESS = {"kernels": 0.1, "eigenmodes": 0.2, "responses": 0.35, "functions": 0.45, "cubature": 0.95, "surface": 1.0}
"""Fraction of a build that is done after each stage."""


def build_body(
    quadrature: Quadrature,
    options: BuildOptions | None = None,
    *,
    name: str = "body",
    regions: Sequence[Region] = (),
    stiffness_scale: Field | None = None,
    density_scale: Field | None = None,
    poissons_ratio: Field | None = None,
    progress: bool | Progress | None = None,
) -> ReducedBody:
    """Reduce an object: kernels, weights, orthonormal functions, cubature.

    Args:
        quadrature: The object.
        options: Sizes and seed; defaults when None.
        name: Name for messages and reports.
        regions: Parts that a scene holds, moves or grasps. Exact ones get weights of their own (one on the region,
            zero on the others) and all other weights vanish there, so that holding them costs no accuracy; soft ones
            enter the weights as springs. The more of a scene's supports are known here, the better the body bends.
        stiffness_scale: Young's modulus relative to the body's: one value per quadrature point, shape (P,), or a
            function that returns them (N,) for points (N, 3) of asset coordinates [m]; ones when None. A cell that a
            jump cuts has the values of its points: means over the cell were worse (``docs/accuracy.md``).
        density_scale: Density relative to any common reference, likewise; normalised to volume mean 1.
        poissons_ratio: Poisson's ratio, likewise, 0 <= nu < 0.5: what it is where the material's is that of the
            options. Of another material lambda / mu keeps its proportions. None: that of the material everywhere.
        progress: True or False shows a bar or not; None shows one on a terminal when the build exceeds two seconds; a
            callable receives (stage, fraction done).

    Returns:
        The body, in the frame of its centre of mass.

    Raises:
        MaterialError: If a scale is not finite and positive, or a Poisson's ratio lies outside its range.
        BasisError: If the basis cannot be built, or a region holds too few points or overlaps another.
        ConfigError: If options do not fit the object, or regions share a name.
    """
    # One BLAS thread: the matrices are small, threads that compete for a busy core cost tenfold, and their number would
    # decide the last bits of the result.
    with threadpool_limits(limits=1, user_api="blas"):
        return _build(
            quadrature,
            options or BuildOptions(),
            name,
            tuple(regions),
            (stiffness_scale, density_scale, poissons_ratio),
            progress,
        )


def build_part(
    quadrature: Quadrature,
    options: BuildOptions,
    *,
    name: str,
    regions: Sequence[Region],
    fields: tuple[Array | None, Array | None, Array | None],
    progress: bool | Progress | None,
) -> ReducedBody:
    """Reduce what a cut leaves, while someone waits: as `build_body`, with cubature points that come several at once.

    Args:
        quadrature: The part.
        options: Those of the body that was cut.
        name: Name for messages and reports.
        regions: Regions that the part holds enough of.
        fields: Relative Young's modulus, relative density and Poisson's ratio, each of shape (P,) or None.
        progress: As for `build_body`.
    """
    given = tuple(regions)
    with threadpool_limits(limits=1, user_api="blas"):
        return _build(quadrature, options, name, given, fields, progress, quick=True)


@memory_errors("building a body", hint="take fewer kernels, points or functions")
def _build(
    quadrature: Quadrature,
    options: BuildOptions,
    name: str,
    regions: tuple[Region, ...],
    fields: tuple[Field | None, Field | None, Field | None],
    progress: bool | Progress | None,
    *,
    quick: bool = False,
) -> ReducedBody:
    """Do what :func:`build_body` and :func:`build_part` say."""
    start = time.perf_counter()
    stiffness_scale, density_scale, poissons_ratio = fields
    stiffness = positive_field("stiffness_scale", stiffness_scale, quadrature.points)
    density = positive_field("density_scale", density_scale, quadrature.points)
    ratio = None if poissons_ratio is None else ratio_field(poissons_ratio, quadrature.points)
    fingerprint = body_fingerprint(quadrature, options, name, regions, stiffness, density, ratio)
    sources = Sources(
        quadrature=quadrature,
        options=options,
        regions=regions,
        stiffness_scale=None if stiffness_scale is None else stiffness,
        density_scale=None if density_scale is None else density,
        poissons_ratio=ratio,
    )
    pieces = pieces_near(quadrature, regions)
    places, weights = pieces.points, pieces.weights
    reference = options.mean_ratio
    shear, lame_ratio, scalar = _relative_moduli(stiffness, ratio, reference)
    stiffness, density = stiffness[pieces.parent], density[pieces.parent]
    density = density * (quadrature.volume / (weights @ density))
    mass = weights * density / quadrature.volume
    offset = mass @ places
    seeds, bounds = places - offset, quadrature.bounds - offset
    length = float(np.sqrt(mass @ (seeds**2).sum(axis=1)))
    regions = tuple(region.moved(offset, bounds) for region in regions)
    samples = sample_regions(regions, pieces, offset, stiffness, quadrature.spacing, bounds)
    points, volumes, parent = refine_at_faces(regions, pieces, offset)
    stiffness, scalar = shear[pieces.parent[parent]], scalar[pieces.parent[parent]]
    lame_ratio = None if lame_ratio is None else lame_ratio[pieces.parent[parent]]
    seconds: dict[str, float] = {}
    with under_way(f"building the body of {name}"), _reporter(progress, name) as report:

        def stage(label: str) -> None:
            # Where two bases are compared, stages come again: their seconds add up, and the bar does not go back.
            seconds[label] = seconds.get(label, 0.0) + time.perf_counter() - start - sum(seconds.values())
            report(label, max(_PROGRESS[done] for done in seconds))

        basis = make_body_basis(
            Domain(
                points=points,
                volumes=volumes,
                stiffness=stiffness,
                lame_ratio=lame_ratio,
                scalar_stiffness=scalar,
                density=density[parent],
                surface=quadrature.surface_points - offset,
                seeds=seeds,
                spacing=quadrature.spacing,
                edge=longest_edge(quadrature),
                length=length,
                regions=regions,
                samples=samples,
                added=np.reshape([np.append(*pair) for pair in options.add_kernels], (-1, 4)) - np.append(offset, 0.0),
                material=None if quadrature.cells is None else material_of(quadrature.cells, offset),
                octants=None if quadrature.cells is None else octants_of(quadrature.cells, offset),
                lips=lips_of(quadrature.cells) - offset,
            ),
            options,
            stage,
            quick=quick,
        )
        if not quick:
            _warn_of_stiffness(name, basis, options)
        chosen = _cubature(volumes, basis, stiffness, lame_ratio, options, quick=quick)
        stage("cubature")
        function_count = basis.gradient.shape[1]
        body = ReducedBody(
            name=name,
            cubature=BodyCubature(
                points=points[chosen.index],
                weights=chosen.weights,
                grad_basis=basis.gradient[chosen.index].astype(np.float32),
                stiffness_scale=stiffness[chosen.index],
                lame_ratio=np.zeros(0) if lame_ratio is None else lame_ratio[chosen.index],
            ),
            surface=BodySurface(
                points=quadrature.surface_points - offset,
                normals=quadrature.surface_normals.copy(),
                areas=quadrature.surface_areas.copy(),
                basis=np.zeros((len(quadrature.surface_points), function_count), dtype=np.float32),
            ),
            kernels=basis.kernels,
            handles=basis.weights,
            regions=BodyRegions(
                parts=regions,
                points=samples.points,
                index=samples.index,
                weights=samples.weights,
                drive=basis.drive,
                drive_affine=basis.drive_affine,
                envelope_length=basis.envelope_length,
            ),
            volume=quadrature.volume,
            mean_basis=basis.functions.mean,
            linear_coordinates=basis.functions.linear,
            eigenvalues=basis.eigenvalues,
            bounds=bounds,
            offset=offset,
            transform=basis.functions.transform,
            length=length,
            driven_count=basis.functions.driven_count,
            fingerprint=fingerprint,
            provenance={},
            build_seconds=0.0,
            sources=pack_sources(sources),
        )
        shown = body.evaluate(body.surface.points)[0].astype(np.float32)
        stage("surface")
    provenance: dict[str, Scalar] = {
        **{f"quadrature_{key}": v for key, v in quadrature.report.items() if isinstance(v, str | int | float | bool)},
        **{f"option_{key}": _scalar(v) for key, v in dataclasses.asdict(options).items()},
        **{f"seconds_{key}": v for key, v in seconds.items()},
        "quadrature_count": len(points),
        "function_count": function_count,
        "dropped_functions": 0 if options.chosen else len(basis.functions.transform) - function_count,
        **basis.report,
        "heterogeneous": any(field is not None for field in fields),
        "cubature_count": len(chosen.index),
        "cubature_force_error": chosen.force_error,
        "cubature_stiffness_error": chosen.stiffness_error,
        "soft_mode_error": chosen.soft_mode_error,
        **{f"cubature_force_error_{size}": error for size, error in chosen.trade_off.items()},
    }
    return dataclasses.replace(
        body,
        surface=dataclasses.replace(body.surface, basis=shown),
        provenance=provenance,
        build_seconds=time.perf_counter() - start,
    )


def _warn_of_stiffness(name: str, basis: BodyBasis, options: BuildOptions) -> None:
    """Say what makes a body too stiff.

    Warns:
        RuntimeWarning: If its kernels do not resolve it, or motions of its regions, or its Poisson's ratio wants more
            functions.
    """
    for key in ("space_error", "driven_error"):
        if (error := basis.report.get(key, 0.0)) > EXCESS_WARNING:
            what, remedy = EXCESS[key][2:]
            text = f"body {name!r}: {key} {100.0 * error:.0f} %: {what}; {remedy}"
            warnings.warn(text, RuntimeWarning, stacklevel=4)
    ratio = max(options.poissons_ratios)
    if options.chosen and ratio > NU_LIMIT and (options.function_count or FUNCTION_COUNT) <= FUNCTION_COUNT:
        warnings.warn(
            f"body {name!r}: {FUNCTION_COUNT} functions are up to 4 % too stiff at nu = {ratio:g};"
            " give function_count=80",
            RuntimeWarning,
            stacklevel=4,
        )


def body_fingerprint(
    quadrature: Quadrature,
    options: BuildOptions,
    name: str,
    regions: Sequence[Region],
    stiffness: Array,
    density: Array,
    ratio: Array | None = None,
) -> str:
    """Return the fingerprint of all that a body is built from; stiffness and density are relative, one per point."""
    most = FUNCTION_LIMIT if options.accuracy is not None else options.function_count or FUNCTION_COUNT
    free = PULLED_VERSION if options.chosen and most > FAR_AFTER else FREE_VERSION
    version, varied = FORMAT_VERSION if regions else free, () if ratio is None else (ratio,)
    return fingerprint_of(version, quadrature, options, name, list(regions), stiffness, density, *varied)


def _relative_moduli(stiffness: Array, ratio: Array | None, reference: float) -> tuple[Array, Array | None, Array]:
    """Return mu, lambda / mu and lambda + 4 mu relative to those of a Poisson's ratio, (P,) each; None for ones.

    Raises:
        ConfigError: If the reference is zero, where lambda vanishes.
    """
    if ratio is None:
        return stiffness, None, stiffness
    if reference <= 0.0:
        hint = "name a ratio > 0 in BuildOptions, such as the mean of the field"
        raise ConfigError(f"poissons_ratio: a field beside the material's {reference:g}", hint=hint)
    shear = stiffness * (1.0 + reference) / (1.0 + ratio)
    own, common = ratio / (0.5 - ratio), reference / (0.5 - reference)
    return shear, own / common, shear * (own + 4.0) / (common + 4.0)


def _cubature(
    volumes: Array, basis: BodyBasis, stiffness: Array, lame_ratio: Array | None, options: BuildOptions, *, quick: bool
) -> Cubature:
    """Choose cubature points: fitted to more poses, or more than asked for, where forces of held-out poses want that.

    If none errs as little as was asked for, it is the one that errs least. A quick choice is the first one.

    Warns:
        RuntimeWarning: If these forces still err by more than was asked for.
    """
    trials = options.cubature_trials(len(volumes))[: 1 if quick else None]
    best = None
    for count, poses in trials:
        found = select_cubature(
            volumes,
            basis.gradient,
            count,
            stiffness_scale=stiffness,
            lame_ratio=lame_ratio,
            poissons_ratio=POISSON_RATIO if lame_ratio is None else options.mean_ratio,
            driven_count=basis.functions.driven_count,
            pose_count=poses,
            seed=options.seed,
            quick=quick,
        )
        if options.cubature_error is None or found.force_error <= options.cubature_error:
            return found
        if best is None or found.force_error < best.force_error:
            best = found
    assert best is not None  # There is a first trial.
    if len(trials) > 1:
        warnings.warn(
            f"cubature_error: {len(best.index)} points leave {best.force_error:.2g}, "
            f"{options.cubature_error:g} was asked for; give a larger cubature_count",
            RuntimeWarning,
            stacklevel=4,
        )
    return best


def _scalar(value: Scalar | tuple[object, ...]) -> Scalar:
    """Return an option as the header of a file holds it."""
    if not isinstance(value, tuple):
        return value
    return " ".join(str(_scalar(v)) if isinstance(v, tuple) else f"{v:g}" for v in value)


def positive_field(name: str, value: Field | None, points: Array) -> Array:
    """Return a field's values at points (P, 3), shape (P,)."""
    if value is None:
        return np.ones(len(points))
    found = np.array(value(points) if callable(value) else value, dtype=np.float64)
    if found.shape != (len(points),):
        raise MaterialError(
            f"{name}: expected one value per quadrature point, shape ({len(points)},), got {found.shape}"
        )
    if not (np.isfinite(found).all() and (found > 0.0).all()):
        bad = int(np.flatnonzero(~(np.isfinite(found) & (found > 0.0)))[0])
        raise MaterialError(f"{name}: expected finite values > 0, got {found[bad]} at row {bad}")
    return found


def ratio_field(value: Field, points: Array) -> Array:
    """Return Poisson's ratios at points (P, 3), shape (P,).

    Raises:
        MaterialError: If one lies outside 0 <= nu < 0.5.
    """
    found = np.array(value(points) if callable(value) else value, dtype=np.float64)
    if found.shape != (len(points),):
        what = f"poissons_ratio: expected one value per quadrature point, shape ({len(points)},), got {found.shape}"
        raise MaterialError(what)
    require_ratios("poissons_ratio", found)
    return found


def require_ratios(name: str, values: Array) -> None:
    """Raise unless all Poisson's ratios lie in 0 <= nu < 0.5.

    Raises:
        MaterialError: If one does not.
    """
    bad = np.flatnonzero(~((values >= 0.0) & (values < 0.5)))
    if len(bad):
        raise MaterialError(
            f"{name}: expected 0 <= nu < 0.5, got {values[bad[0]]} at row {bad[0]}",
            hint="what hardly changes its volume has 0.49",
        )


@contextlib.contextmanager
def _reporter(progress: bool | Progress | None, name: str) -> Iterator[Progress]:
    if callable(progress):
        yield progress
        return
    shown = progress if progress is not None else sys.stderr.isatty()
    if not shown:
        yield lambda stage, fraction: None
        return
    from tqdm import tqdm

    with tqdm(total=100, desc=f"build {name}", delay=0.0 if progress else 2.0, unit="%", leave=False) as bar:

        def report(stage: str, fraction: float) -> None:
            bar.set_postfix_str(stage, refresh=False)
            bar.update(round(100.0 * fraction) - bar.n)
            moved()

        yield report
