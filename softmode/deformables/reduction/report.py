"""What is good and bad about a body: measures, and findings each with a remedy. Arrays only, no pictures.

Nothing is taken on trust from the build: mass, stiffness, coverage and Jacobians are measured anew over the interior
(`softmode.deformables.quadrature.interior`), with the functions that the body evaluates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from softmode.checks import require_number
from softmode.deformables.quadrature.interior import Interior, interior_from_quadrature, interior_from_surface
from softmode.deformables.quadrature.occupancy import KEPT_EXTENT, KEPT_SHARE
from softmode.deformables.quadrature.quadrature_density import FOGGY, is_doubtful
from softmode.deformables.reduction.basis import KERNEL_POINTS
from softmode.deformables.reduction.cubature import POISSON_RATIO
from softmode.deformables.reduction.elastic_functions import EXCESS, EXCESS_WARNING
from softmode.deformables.reduction.functions import RANK_TOLERANCE
from softmode.deformables.reduction.reduced_stiffness import elastic_modes, reduced_stiffness
from softmode.errors import BasisError

if TYPE_CHECKING:
    from softmode.deformables.body.reduced_body import ReducedBody
    from softmode.deformables.quadrature.quadrature_grid import Quadrature

Array = NDArray[np.float64]
Severity = Literal["note", "warning", "broken"]

MODES = 12
"""How many elastic modes are looked at: the lowest carry most of a body's motion."""
STRAIN = 0.1
"""Strain (root mean square over the body) at which the Jacobian of a mode is measured."""
CONDITION_WARNING = 1e6
"""Condition number of a moment matrix from which on gradients lose more digits than float32 has to spare."""
SLENDER = 0.3
"""Ratio of the least to the largest extent under which affine handles lock a body in bending."""
BARE = 3.0
"""Surface farther than so many spacings of splats from the nearest one is not shown."""
EMPTY = 1e-10
"""Elastic eigenvalues under this fraction of the largest cost no energy; a rope of 25:1 has 4e-7."""
WALL, WALL_VOXELS, WALL_SHARE = 0.02, 2.5, 0.05
"""Walls thinner than this part of the body's size, or than so many voxels of a fill, count as thin; so much of the
surface may bound thin walls."""
BURIED_SHARE = 0.005
"""Share of a capture's splats deeper than a voxel in its solid above which something hollow may have been filled. Clean
captures of 20,000 splats have at most 0.0008, a cup that is filled in a few places 0.0085, a filled one 0.09."""
VOID_SHARE = 0.05
"""Share of a solid above which a filled void of its field is worth a word."""
SIZE_ERROR = 0.05
"""Longest edge that may differ so much from the size that was asked for."""
PATCH = 3
"""Surface samples under what presses a body from which on it presses about as it should."""
FAST_FUNCTIONS = 56
"""Functions up to which a GPU takes all Newton iterations of a step in one launch, see ``solver.step_tables``."""
FULL_FUNCTIONS = 100
"""From so many functions on a body wants six cubature points for each."""


@dataclass(frozen=True, kw_only=True)
class Measure:
    """One number about a body."""

    name: str
    """What it is."""
    value: float
    """The number."""
    unit: str = ""
    """Its unit, empty for a ratio or a count."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that is wrong, or worth knowing."""

    severity: Severity
    """"note": good to know; "warning": works, but not as well as it could; "broken": do not simulate this."""
    name: str
    """Short name, the same for the same kind of finding."""
    what: str
    """What was found, with numbers."""
    remedy: str
    """What to do about it."""


@dataclass(frozen=True, kw_only=True)
class BodyReport:
    """Measures and findings of a body."""

    measures: tuple[Measure, ...]
    """What was measured."""
    findings: tuple[Finding, ...]
    """What was found, the worst first."""

    @property
    def severity(self) -> int:
        """0 if all is well, 1 if there are warnings, 2 if something is broken."""
        return max([0, *({"note": 0, "warning": 1, "broken": 2}[finding.severity] for finding in self.findings)])

    def measure(self, name: str) -> float:
        """Return the value of a measure.

        Raises:
            KeyError: If there is none of that name.
        """
        return {measure.name: measure.value for measure in self.measures}[name]


class _Notes:
    """What the checks write down."""

    def __init__(self) -> None:
        self.measures: list[Measure] = []
        self.findings: list[Finding] = []

    def measure(self, name: str, value: float, unit: str = "") -> float:
        self.measures.append(Measure(name=name, value=float(value), unit=unit))
        return float(value)

    def find(self, severity: Severity, name: str, what: str, remedy: str) -> None:
        self.findings.append(Finding(severity=severity, name=name, what=what, remedy=remedy))

    def report(self) -> BodyReport:
        order = {"broken": 0, "warning": 1, "note": 2}
        found = sorted(self.findings, key=lambda finding: order[finding.severity])
        return BodyReport(measures=tuple(self.measures), findings=tuple(found))


def report_body(
    body: ReducedBody,
    *,
    quadrature: Quadrature | None = None,
    splats: Array | None = None,
    size: float | None = None,
    finger: float | None = None,
) -> BodyReport:
    """Examine a body.

    Args:
        body: The body.
        quadrature: What it was built from, if at hand: mass and stiffness are then compared to rounding, else to the
            5 to 20 % that filling the surface samples anew is worth.
        splats: Centres of the splats that show it, in the body frame [m], shape (N, 3).
        size: Longest edge that was asked for [m]; None where nothing was.
        finger: Width of what is to press it [m]; None where nothing was said.

    Returns:
        Measures and findings.

    Raises:
        BasisError: If the quadrature belongs to another body.
    """
    notes = _Notes()
    _check_geometry(body, notes)
    _check_tables(body, notes)
    interior = None
    if quadrature is not None:
        interior = interior_from_quadrature(body, quadrature)
    else:
        try:
            interior = interior_from_surface(body)
        except BasisError as error:
            notes.find("broken", "open surface", error.message, error.hint)
    if interior is not None:
        _check_parts(body, interior, notes)
        _check_functions(body, interior, notes)
    _check_build(body, notes)
    _check_object(body, notes, splats, size)
    _check_samples(body, notes, finger)
    return notes.report()


def object_findings(
    body: ReducedBody, *, splats: Array | None = None, size: float | None = None
) -> tuple[Finding, ...]:
    """Return what the user of an object should know before it is simulated: the warnings that take no time to find.

    Args:
        body: Its body.
        splats: Centres of its splats, in the body frame [m], shape (N, 3).
        size: Longest edge that was asked for [m]; None where nothing was.

    Returns:
        Findings from "warning" on: what was left out of its file, its size, what is bare or thin.
    """
    notes = _Notes()
    _check_shape(body, notes)
    _check_object(body, notes, splats, size)
    return tuple(finding for finding in notes.report().findings if finding.severity != "note")


def _check_object(body: ReducedBody, notes: _Notes, splats: Array | None, size: float | None) -> None:
    """Compare the body with its file: what was left out, its size, the splats that show it."""
    _check_asset(body, _numbers_told(body), notes)
    if size is not None:
        longest = float(np.ptp(body.bounds, axis=0).max())
        if abs(notes.measure("longest edge over the size asked for", longest / size) - 1.0) > SIZE_ERROR:
            notes.find(
                "warning",
                "size",
                f"its longest edge is {1e3 * longest:.0f} mm where {1e3 * size:.0f} mm were asked for: splats that are"
                " no part of the solid were measured, or it was laid on another side",
                f"give --size {size * size / longest:.3g}, or crop away what is not the object (--crop)",
            )
    if splats is not None:
        _check_splats(body, np.asarray(splats, dtype=np.float64), notes)


def _check_samples(body: ReducedBody, notes: _Notes, finger: float | None) -> None:
    """Say how wide a finger has to be for the surface samples to carry it, and how many a narrower one needs."""
    area = body.surface.areas.sum()
    width = notes.measure("narrowest finger that its samples carry", np.sqrt(PATCH * area / body.surface_count), "m")
    if finger is None:
        return
    require_number("finger", finger, above=0.0, unit="m")
    if finger < width:
        under = f"{PATCH * (finger / width) ** 2:.1f} of its {body.surface_count} surface samples"
        notes.find(
            "warning",
            "samples",
            f"{under} lie under a finger of {1e3 * finger:.3g} mm, which sinks in between fewer than {PATCH}",
            f"build it with --surface {math.ceil(PATCH * area / finger**2 - 1.0e-6)}",
        )


def _numbers_told(body: ReducedBody) -> dict[str, float]:
    """Return the numbers that the build wrote down."""
    return {key: float(value) for key, value in body.provenance.items() if isinstance(value, int | float)}


def _check_geometry(body: ReducedBody, notes: _Notes) -> None:
    """Compare volume, hull and what the surface samples enclose by the divergence theorem; find thin bodies."""
    extent = np.ptp(body.bounds, axis=0)
    area = float(body.surface.areas.sum())
    volume = notes.measure("volume", body.volume, "m^3")
    notes.measure("mass at 1000 kg/m^3", 1000.0 * volume, "kg")
    for axis, length in zip("xyz", extent, strict=True):
        notes.measure(f"extent {axis}", length, "m")
    notes.measure("surface area", area, "m^2")
    try:
        hull = float(ConvexHull(body.surface.points).volume)
    except QhullError:
        hull = 0.0
    box = float(np.prod(extent))
    notes.measure("volume over convex hull", volume / hull if hull > 0.0 else np.inf)
    flux = float(body.surface.areas @ (body.surface.normals * body.surface.points).sum(axis=1)) / 3.0
    enclosed = notes.measure("volume by surface samples over volume", flux / volume)
    closure = float(np.linalg.norm(body.surface.areas @ body.surface.normals)) / area
    notes.measure("mean normal of the surface", closure)
    # Samples lie inside the corners of their hull, so a box fills a little more than it: 1.08 with 80 samples.
    if volume > 1.05 * box or (hull > 0.0 and volume > 1.5 * hull):
        notes.find(
            "broken",
            "volume",
            f"the volume, {volume:.4g} m^3, is larger than the hull of the surface, {hull:.4g} m^3",
            "build the body again from a closed asset",
        )
    elif abs(enclosed - 1.0) > 0.1 or closure > 0.05:
        notes.find(
            "warning",
            "surface",
            f"the surface samples enclose {100.0 * enclosed:.0f} % of the volume; their normals add up to "
            f"{closure:.3f} of the area (a closed surface: 0)",
            "close the asset's surface and turn all its faces outwards, or take more surface samples (--surface)",
        )
    _check_shape(body, notes)
    spread = np.sqrt(np.linalg.eigvalsh(np.cov(body.surface.points.T)))
    slender = notes.measure("slenderness", spread[0] / spread[-1])
    points, kernels = body.provenance.get("quadrature_count"), len(body.kernels.centres)
    if isinstance(points, int) and kernels * KERNEL_POINTS > points:
        notes.find(
            "warning",
            "kernels",
            f"its {kernels} kernels move between {points} quadrature points at no cost of energy: too soft",
            "build it with more points, or without a number of kernels",
        )
    for key, (measure, finding, what, remedy) in EXCESS.items():
        excess = body.provenance.get(key)
        if excess is not None and notes.measure(measure, float(excess)) > EXCESS_WARNING:
            notes.find("warning", finding, f"{key} {100.0 * float(excess):.0f} %: {what}", remedy)
    complete = body.provenance.get("complete_functions")
    if isinstance(complete, float) and complete > body.function_count + 1:  # A pair may be near each other by chance.
        notes.find(
            "note",
            "cluster",
            f"its last functions are some of a cluster that contribute alike, as on symmetric bodies:"
            f" {complete:.0f} would have all of it",
            f"build it with --functions {complete:.0f}",
        )
    if "frequency_error" in body.provenance or body.regions.names:
        return
    affine = not (body.handles.degrees == 2).any()
    tolerance = float(body.provenance.get("option_rank_tolerance") or 0.0)
    if slender < SLENDER and (affine or tolerance >= RANK_TOLERANCE):
        what = " and has affine handles, which make it a third too stiff in bending"
        remedy = "leave --modes and --handles away: then its functions are chosen by elastic energy"
        if not affine:
            what = f", and a rank tolerance of {tolerance:.0e} takes the thin functions of its bending for noise"
            remedy = "build it with --rank-tolerance 1e-9"
        notes.find("warning", "slender", f"the body is slender or flat ({slender:.2f} of its length){what}", remedy)


def _check_shape(body: ReducedBody, notes: _Notes) -> None:
    """Find bodies that are thin as a whole, and thin walls."""
    size = float(np.ptp(body.bounds, axis=0).max())
    thickness = notes.measure("mean thickness over size", 2.0 * body.volume / body.surface.areas.sum() / size)
    voxel = _numbers_told(body).get("quadrature_voxel", 0.0)
    limit = max(WALL * size, WALL_VOXELS * voxel)
    share = float(body.surface.areas[_wall_thickness(body) < limit].sum() / body.surface.areas.sum())
    notes.measure("surface that bounds thin walls", share)
    if thickness < 0.005:
        notes.find(
            "warning",
            "thin",
            f"the body is {1e3 * thickness * size:.2g} mm thick on average, 1/{1.0 / thickness:.0f} of its size: too"
            " thin to be integrated and touched as a solid",
            "thicken the asset to a hundredth of its size",
        )
    elif share > WALL_SHARE:
        notes.find(
            "warning",
            "thin walls",
            f"{100.0 * share:.0f} % of the surface bounds walls thinner than {1e3 * limit:.2g} mm: they may come out"
            " thicker and stiffer than they are, and what presses on them may pass",
            "raise --resolution" if voxel else "thicken them",
        )


def _wall_thickness(body: ReducedBody) -> Array:
    """Return how thick the body is under each surface sample [m], shape (S,); infinite where nothing lies opposite.

    The line along the inward normal is cut with the tangent planes of the samples that face the other way and lie
    within a spacing of samples beside it; the nearest cut counts. Behind the planes of an inner wall that curves away
    the surface is deeper, by 1/2 dn . d where the normal changes by dn over the distance d.
    """
    points, normals = body.surface.points.astype(np.float64), body.surface.normals.astype(np.float64)
    pitch2 = body.surface.areas.sum() / body.surface_count
    found = np.empty(len(points))
    for part in np.array_split(np.arange(len(points)), max(1, len(points) // 256)):
        way = points[None] - points[part, None]
        facing = normals[part] @ normals.T
        depth = -np.einsum("ijc,ic->ij", way, normals[part])
        beside = (way**2).sum(axis=2) - depth**2
        with np.errstate(divide="ignore", invalid="ignore"):
            along = np.einsum("ijc,jc->ij", way, normals)
            cut = -along / facing - np.minimum(0.5 * (facing * depth + along), 0.0)
        opposite = (facing < -0.5) & (depth > 0.0) & (beside < pitch2) & (cut > 0.0)
        found[part] = np.where(opposite, cut, np.inf).min(axis=1)
    return found


def _check_tables(body: ReducedBody, notes: _Notes) -> None:
    """Compare the stored tables with the functions that the body evaluates, and with affine motion."""
    moment = body.mean_basis @ body.linear_coordinates
    off = float(np.abs(moment[:3]).max()) / body.length + abs(float(moment[3]) - 1.0)
    linear = np.column_stack([body.surface.points, np.ones(body.surface_count)])
    reproduced = np.abs(body.surface.basis.astype(np.float64) @ body.linear_coordinates - linear)
    affine = notes.measure("error of affine motion", float((reproduced / [*[body.length] * 3, 1.0]).max()))
    gradient = body.evaluate(body.cubature.points)[1]
    slope = np.abs(gradient - body.cubature.grad_basis).max() / max(np.abs(gradient).max(), 1e-300)
    value = np.abs(body.evaluate(body.surface.points)[0] - body.surface.basis).max()
    stored = notes.measure("error of stored tables", max(float(slope), float(value)))
    if not (affine < 1e-4 and stored < 1e-4 and off < 1e-6):
        notes.find(
            "broken",
            "tables",
            f"stored functions are not those of the kernels: affine motion errs by {affine:.1e}, tables by"
            f" {stored:.1e}, the centre of mass by {off:.1e} (rounding: 1e-6)",
            "build the body again; the file was changed or mixed up",
        )
    notes.measure("cubature volume over volume", float(body.cubature.weights.sum() / body.volume))


def _check_parts(body: ReducedBody, interior: Interior, notes: _Notes) -> None:
    """Count connected parts of the interior, and parts that no function holds together."""
    share = np.bincount(interior.parts(), interior.weights) / interior.weights.sum()
    # A few cells of the refilled grid that the samples cut off are no part.
    share = share[share > (1e-4 if interior.exact else 0.005)]
    notes.measure("separate parts", len(share))
    if len(share) > 1:
        rest = ", ".join(f"{100.0 * s:.2g}" for s in share[1:5]) + (", ..." if len(share) > 5 else "")
        notes.find(
            "warning",
            "separate parts",
            f"the body falls into {len(share)} parts that do not touch; all but the largest hold {rest} % of its"
            " volume. Kernels that reach across glue them together",
            "keep one part (--crop, or for splats --part), or build one body for each",
        )
    first = float(body.eigenvalues[1:].min(initial=np.inf)) * body.length**2
    if first < 1e-6 and not body.regions.names:
        notes.find(
            "broken",
            "loose parts",
            f"the first eigenvalue is {first:.1e} / length^2: parts of the body can drift apart without a force",
            "build one body for each part",
        )


def _check_functions(body: ReducedBody, interior: Interior, notes: _Notes) -> None:
    """Measure coverage, conditioning, mass, stiffness and Jacobians over the interior."""
    covered = notes.measure("interior within reach of kernels", float(body.covers(interior.points).mean()))
    touched = notes.measure("surface within reach of kernels", float(body.covers(body.surface.points).mean()))
    if covered < 0.99 or touched < 0.99:
        notes.find(
            "warning",
            "kernel coverage",
            f"kernels reach {100.0 * covered:.1f} % of the interior and {100.0 * touched:.1f} % of the surface; beyond"
            " them the functions are continued as constants",
            "take more kernels (--kernels)",
        )
    inside = np.concatenate([interior.points[body.covers(interior.points)], body.cubature.points])
    worst = float(body.reproducing_kernels.conditions(inside).max()) if body.skinned else 1.0
    condition = notes.measure("worst condition of a moment matrix", worst)
    if not condition < CONDITION_WARNING:
        notes.find(
            "warning",
            "conditioning",
            f"the condition number of a moment matrix is {condition:.1e} (a good body: under 1e4)",
            "take fewer kernels (--kernels), or thicken thin parts of the asset",
        )
    value, gradient = body.evaluate(interior.points)
    fraction = interior.weights / interior.weights.sum()
    if not body.provenance.get("heterogeneous"):
        gram = value.T @ (fraction[:, None] * value)
        mass = float(np.linalg.norm(gram - np.eye(len(gram)))) / np.sqrt(len(gram))
        notes.measure("error of orthonormality in mass", mass)
        # Cells that the face of a region cuts were refined at build time: 0.02 is what that is worth.
        limit = 0.35 if not interior.exact else 0.1 if body.regions.names else 1e-6
        if not mass < limit:
            notes.find(
                "broken",
                "mass",
                f"the functions are not orthonormal in mass: {mass:.1e} from it, where {limit:.0e} is the most that the"
                " quadrature explains",
                "build the body again; inertia would be wrong",
            )
    _check_stiffness(body, interior, gradient, notes)


def _check_stiffness(body: ReducedBody, interior: Interior, gradient: Array, notes: _Notes) -> None:
    """Compare the cubature's stiffness with that of the interior; look for motions without energy and inversions."""
    free = slice(body.driven_count, None)
    few = body.cubature.grad_basis.astype(np.float64)[:, free].transpose(1, 2, 0)
    modulus = body.cubature.weights * body.cubature.stiffness_scale
    chosen = np.linalg.eigvalsh(reduced_stiffness(few, modulus, POISSON_RATIO, body.cubature.lame_ratio))
    rigid = 0 if body.driven_count else 6
    gradient = gradient[:, free]
    stiffness = reduced_stiffness(np.ascontiguousarray(gradient.transpose(1, 2, 0)), interior.weights, POISSON_RATIO)
    eigenvalue, mode = elastic_modes(stiffness)
    eigenvalue = eigenvalue[eigenvalue > EMPTY * eigenvalue[-1]]
    mode = mode[:, -len(eigenvalue) :]
    # What costs nothing over the whole interior is a loose part; what does so at the cubature points only is a defect.
    empty = int((chosen <= EMPTY * chosen[-1]).sum()) - (len(chosen) - len(eigenvalue))
    notes.measure("motions without energy", max(empty, 0))
    if empty > 0:
        notes.find(
            "broken",
            "motions without energy",
            f"{empty} motions beside the {rigid} rigid ones cost no energy at the cubature points",
            "take more cubature points (--points)",
        )
    first = len(chosen) - len(eigenvalue)
    count = min(MODES, len(eigenvalue))
    if not body.provenance.get("heterogeneous") and count:
        ratio = chosen[first : first + count] / eigenvalue[:count]
        error = notes.measure("error of soft modes by cubature", float(np.sqrt(np.mean((ratio - 1.0) ** 2))))
        if not error < (0.05 if interior.exact else 0.3):
            notes.find(
                "warning",
                "cubature",
                f"the lowest elastic eigenvalues at the cubature points err by {100.0 * error:.1f} %",
                "take more cubature points (--points), six for each function at least",
            )
    # F = I + s grad u of each mode at a strain of a tenth, both signs: where is the body nearest to inversion?
    motion = mode[:, :count].T.reshape(count, 3, -1)
    slope = np.einsum("mck,pkd->mpcd", motion, gradient)
    strain = 0.5 * (slope + slope.swapaxes(2, 3))
    fraction = interior.weights / interior.weights.sum()
    rms = np.sqrt(np.einsum("p,mpcd->m", fraction, strain**2))
    slope *= (STRAIN / np.maximum(rms, 1e-300))[:, None, None, None]
    jacobian = np.minimum(np.linalg.det(np.eye(3) + slope), np.linalg.det(np.eye(3) - slope))
    worst = notes.measure(f"worst Jacobian of a mode at {100 * STRAIN:.0f} % strain", float(jacobian.min(initial=1.0)))
    if worst < 0.0:
        notes.find(
            "warning",
            "inversion",
            f"a soft mode strained by {100 * STRAIN:.0f} % on average already turns the material inside out somewhere"
            f" (det F = {worst:.2f}): thin necks take all of the strain",
            "thicken thin necks of the asset, or take more kernels and modes (--kernels, --modes)",
        )


def _check_build(body: ReducedBody, notes: _Notes) -> None:
    """Read what the build has measured and left out."""
    told = _numbers_told(body)
    held = bool(body.regions.names)
    notes.measure("functions", body.function_count)
    notes.measure("cubature points", body.point_count)
    force = told.get("cubature_force_error")
    if force is not None:
        notes.measure("error of cubature forces", force)
        if force > (0.1 if held else 0.05):
            notes.find(
                "warning",
                "cubature",
                f"elastic forces at the {body.point_count} cubature points err by {100.0 * force:.1f} %",
                "take more cubature points (--points)",
            )
    if body.function_count >= FULL_FUNCTIONS and body.point_count < min(
        6 * body.function_count, int(told.get("quadrature_count", np.inf))
    ):
        notes.find(
            "warning",
            "cubature",
            f"{body.point_count} cubature points for {body.function_count} functions",
            f"take six for each, --points {6 * body.function_count}",
        )
    if body.function_count > FAST_FUNCTIONS:
        notes.find(
            "note",
            "many functions",
            f"with {body.function_count} functions a GPU takes a launch for each phase of a Newton iteration;"
            f" one launch for all of them takes bodies of at most {FAST_FUNCTIONS}",
            f"where many worlds are to be fast, take fewer (--functions {FAST_FUNCTIONS})",
        )


def _check_asset(body: ReducedBody, told: dict[str, float], notes: _Notes) -> None:
    """Read what became of the asset: holes that were closed, parts that were left out."""
    mended, capped = body.provenance.get("quadrature_source") == "splats", told.get("quadrature_capped_holes", 0.0)
    if body.provenance.get("asset_kind") == "mesh" and (mended or capped):
        how = "when its surface is covered smoothly" if mended else f"when its holes ({capped:.0f}) are capped"
        notes.find(
            "warning",
            "open mesh",
            f"the mesh is not closed: the body is what it encloses {how}",
            "close the holes (trimesh.repair.fill_holes, or a modelling tool), and build again",
        )
    if (fog := told.get("quadrature_fog", 0.0)) > FOGGY:
        notes.find(
            "warning",
            "fog",
            f"the field is fog: half the level moves its surface by {fog:.2g} voxels (walls: 0 to 0.6)."
            f" Its solid is taken at {told['quadrature_level_share']:.2g} of full occupancy; cavities may be full",
            "train it with opaque walls (examples/train_field.py), or build from a mesh of the object",
        )
    patch, allowed = told.get("quadrature_contradicted", 0.0), told.get("quadrature_allowed", 0.0)
    if is_doubtful(patch, allowed):
        notes.find(
            "warning",
            "doubtful solid",
            f"its pictures contradict a patch of {100.0 * patch:.1f} % of its surface (a lid over a cavity: 6 and more)"
            f" and allow solids of up to {allowed:.1f} times its volume, since a cavity of one colour does not show how"
            " deep it is and how thick its wall",
            "measure a wall, train with more pictures that look into the cavity, or build from a mesh of the object",
        )
    filled, opened = told.get("quadrature_filled_share", 0.0), told.get("quadrature_open_share", 0.0)
    if max(filled, opened) > VOID_SHARE:
        what = f"{100.0 * filled:.0f} % of the solid are a void of the field, which was filled"
        lid = f"; {100.0 * opened:.0f} % are closed by something thin or faint, and may be an opening"
        notes.find(
            "warning" if opened > VOID_SHARE else "note",
            "filled",
            what + (lid if opened > VOID_SHARE else ""),
            "if the object is hollow, build from a mesh of it; train with pictures that look into it",
        )
    elif body.provenance.get("quadrature_source") == "density":
        notes.find(
            "note",
            "inside",
            f"pictures show no inside: that all {1.0e6 * body.volume:.3g} cm^3 of the solid are full is assumed,"
            " and a cavity that few pictures look into may be closed by a lid",
            "if it is hollow, train with pictures that look into it, or build from a mesh of it",
        )
    told_splats = told.get("quadrature_asset_splats", 0.0)
    given = told.get("asset_splats", told_splats)
    left_out = told.get("asset_left_out", told_splats - told.get("quadrature_part_splats", told_splats))
    if left_out > 0.0:
        notes.measure("splats of the file left out", left_out)
        ground, other = told.get("quadrature_ground_splats", 0.0), told.get("quadrature_other_splats", 0.0)
        what = f"{left_out:.0f} of {given:.0f} splats are floaters or separate parts and were left out"
        remedy = "look at the picture (softmode body show); crop the capture (--crop), or choose --part"
        carrier, bare = told.get("quadrature_carrier_splats", 0.0), told.get("asset_bare_splats", 0.0)
        if ground:
            what += f"; {ground:.0f} of them are the ground beneath"
            remedy += "; --part all keeps the ground"
        if carrier:
            height, score = told["quadrature_carrier_height"], told["quadrature_carrier_score"]
            what += f"; {carrier:.0f} carry it, up to z = {height:.4g} of the upright file (score {score:.2f})"
            remedy += f"; --part {body.provenance['quadrature_carrier_part']} keeps what carries it"
        if bare:
            what += f"; {bare:.0f} have no solid under them"
        if other:
            what += f"; another part has {other:.0f} splats"
            remedy += f"; --crop {body.provenance['quadrature_other_crop']} takes that one, and so does --part"
            remedy += f" {told.get('quadrature_other_part', 2.0):.0f}"
        notes.find("warning" if left_out > 0.002 * given else "note", "left out", what, remedy)
    if doubt := body.provenance.get("quadrature_doubt"):
        notes.find("warning", "carrier", str(doubt), str(body.provenance["quadrature_doubt_remedy"]))
    if crop := body.provenance.get("quadrature_scene_crop"):
        what = "the capture is a room, or a scene of several things: one part of it was taken"
        notes.find("warning", "scene", what, f"take one thing of it, to begin with --crop {crop}, or choose --part")
    _check_fill(told, notes)
    if told.get("quadrature_inside_out"):
        notes.find(
            "note",
            "inside out",
            "all faces of the mesh pointed inwards and were turned",
            "export it with outward faces",
        )
    if told.get("quadrature_overlapping"):
        notes.find(
            "note",
            "overlapping",
            "parts of the mesh overlap; where they do, the volume counts once",
            "unite the parts if that is not meant",
        )
    if told.get("quadrature_detached_volume", 0.0) > 0.01:
        notes.find(
            "warning",
            "detached volume",
            f"{100.0 * told['quadrature_detached_volume']:.1f} % of what the splats enclose is detached and left out",
            "crop the capture (--crop), or build a body for each part",
        )
    if told.get("quadrature_hidden_samples", 0.0) > 0.5:
        notes.find(
            "note",
            "filled",
            f"{100.0 * told['quadrature_hidden_samples']:.0f} % of the splats' area is seen from no side: a cloud that"
            " fills its object, whose surface may come out too small",
            "give surface points only",
        )


def _check_fill(told: dict[str, float], notes: _Notes) -> None:
    """Read how much of a capture the solid holds that was made of it."""
    if "quadrature_volume_uncertainty" in told:
        notes.measure("uncertainty of the volume", told["quadrature_volume_uncertainty"])
    share, extent = told.get("quadrature_kept_share", 1.0), told.get("quadrature_kept_extent", 1.0)
    if "quadrature_kept_share" in told:
        notes.measure("splats of the part in the solid", share)
        notes.measure("extent of the solid over that of the part", extent)
    if (buried := told.get("quadrature_buried_share", 0.0)) > BURIED_SHARE:
        notes.find(
            "warning",
            "filled inside",
            f"{100.0 * buried:.0f} % of the splats or points lie inside the solid: what they enclose was filled, and"
            " the volume is too large if the object is hollow there (closed all round, or its walls are thinner than"
            " twice the distance between points)",
            "if it is hollow, give a mesh, or more points, with normals; if it is solid, crop what is inside",
        )
    if share >= KEPT_SHARE and extent >= KEPT_EXTENT:
        return
    limited = "; finer voxels were over the limit of memory" if told.get("quadrature_resolution_limited") else ""
    notes.find(
        "warning",
        "incomplete fill",
        f"with {told.get('quadrature_resolution', 0.0):.0f} voxels along its longest edge the solid holds"
        f" {100.0 * share:.1f} % of the object's splats and {100.0 * min(extent, 1.0):.0f} % of their extent: thin"
        f" parts or open sheets are missing{limited}",
        "crop to the part that matters (--crop), fill it more finely (--resolution), or capture thin parts from more"
        " sides",
    )


def _check_splats(body: ReducedBody, splats: Array, notes: _Notes) -> None:
    """Find splats without a body, and surface without splats."""
    from scipy.spatial import KDTree

    from softmode.deformables.quadrature.interior import winding_numbers

    size = float(np.linalg.norm(np.ptp(body.bounds, axis=0)))
    pitch = float(np.sqrt(body.surface.areas.sum() / body.surface_count))
    near = KDTree(body.surface.points).query(splats)[0]
    far = near > max(2.0 * pitch, 0.02 * size)
    far[far] = winding_numbers(splats[far], body.surface.points, body.surface.normals, body.surface.areas) < 0.5
    notes.measure("splats", len(splats))
    loose = notes.measure("splats away from the body", float(far.mean()))
    if far.any():
        notes.find(
            "warning" if loose > 0.002 else "note",
            "splats without body",
            f"{int(far.sum())} splats ({100.0 * loose:.2g} %) hover up to {100.0 * near[far].max() / size:.0f} % of the"
            " body's size away from it and move along as if glued on",
            "crop them off (--crop), or keep another part (--part)",
        )
    # The sixth neighbour of a splat is one and a half spacings away.
    tree = KDTree(splats)
    spacing = float(np.median(tree.query(splats, k=min(7, len(splats)))[0][:, -1])) / 1.5
    bare = tree.query(body.surface.points)[0] > BARE * spacing
    share = notes.measure("surface without splats", float(body.surface.areas[bare].sum() / body.surface.areas.sum()))
    if share > 0.05:
        notes.find(
            "warning",
            "surface without splats",
            f"{100.0 * share:.0f} % of the surface has no splat near it: it touches but is not seen (a hole in the"
            " capture that was closed)",
            "capture the object from all sides, or fill the hole with splats",
        )
