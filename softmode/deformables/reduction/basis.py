"""The basis of a body: from quadrature points and regions to orthonormal functions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.qgmls import BasisQGMLS
from softmode.deformables.body.raw_functions import QuadraticFunctions
from softmode.deformables.body.regions import Envelope, Region
from softmode.deformables.body.rkpm import BasisRKPM, ShapeFunctions, make_basis, sample_farthest
from softmode.deformables.body.skinning_weights import SkinningWeights, constant_handle, enveloped
from softmode.deformables.quadrature.octants import Octants
from softmode.deformables.reduction.eigenmodes import Eigenmodes, solve_eigenmodes
from softmode.deformables.reduction.elastic_functions import (
    SPACE_ERROR,
    SPACE_MODE_COUNTS,
    TURN_COUNT,
    ElasticChoice,
    Held,
    Pulled,
    choose_functions,
)
from softmode.deformables.reduction.functions import (
    HELD_RANK_TOLERANCE,
    Functions,
    RawFunctions,
    affine_first,
    driven_first,
    orthonormalise,
    split_at_regions,
)
from softmode.deformables.reduction.galerkin import mass_matrix
from softmode.deformables.reduction.kernel_visibility import Material, divide_at_gaps
from softmode.deformables.reduction.local_handles import gather_at_lips, gather_weights, place_kernels
from softmode.deformables.reduction.options import EIGENMODE_COUNT, KERNEL_LEAST, BuildOptions
from softmode.deformables.reduction.region_samples import RegionSamples, drive_matrices, rigid_motions
from softmode.deformables.reduction.static_response import (
    lame_parameters,
    solve_harmonic_weights,
    solve_static_responses,
)
from softmode.errors import ConfigError

Array = NDArray[np.float64]

SWUNG_COUNT = 16
"""Eigenmodes of the held body among those of the space, where exact regions move against each other: without them a
beam twisted by 720 degrees has twice the error."""
ALONE_QUADRATIC = 24
"""Where one exact region holds a body, the first space has all eigenmodes of the second one, of which those beyond so
many carry affine motion alone: gravity moved a helix of nu = 0.45 by 0.946 of what it should with 48 quadratic ones,
and by 0.971 with these, which are as many functions."""
ALONE_ERROR = 0.0225
"""That space is made larger where it lowers frequencies by more than this against its quadratic half: there is more in
it than in the second half of other spaces, 0.0216 on a plate 50:1 where these have 0.0191."""
KERNEL_MODES = 12
"""Elastic modes of the kernels, translations of which join the space of a held body."""
KERNEL_EDGE = 1.3
"""Kernels of held bodies are no narrower than so many of the longest edges of octants: with 6 mm on octants of 6 mm a
plate gave way in its plane 4 % too far, between the points."""
KERNEL_POINTS, MODE_POINTS = 3, 32
"""Free quadrature points for each kernel that acts among them, and for each quadratic eigenmode, where exact regions
hold the rest: with fewer, displacements hide between points. Ten millimetres between two clamps were half as stiff."""
FAR_COUNT, FAR_REACH, FAR_LEVEL = 4, 0.1, 0.5
"""So many farthest points of a free body are pulled, with all within so much of the longest edge, and weigh so many
times unit energy; its two ends weigh one."""
THIN = 0.7
"""A held body that has room for fewer kernels than this fraction of those asked for is thin, as plates and strips of
50:1, and wants the large space: it is made at once, which takes a quarter less time."""
LIP_COUNT = 20
"""Handles along the lips of slits, among the space that functions are chosen from. Eigenmodes resolve a slit slowly:
48, 64, 96 and 128 of them each lower the first frequency of a slit plush, by 2 to 3 %."""
QUICK_SLIT_MODES = 28
"""Eigenmodes beside these handles while someone waits for a cut. The first six frequencies are then at most 2.1 %
above those with 96 eigenmodes alone on the slit plush, 4.1 % on a bar slit over 0.4 of its length, for a third of the
time; without the handles 15 % on that bar."""


@dataclass(frozen=True, kw_only=True)
class Domain:
    """What the functions live on: quadrature and fields in the body frame, and the regions."""

    points: Array
    """Quadrature points, refined at the faces of exact regions [m], shape (P, 3)."""
    volumes: Array
    """Their volumes [m^3], shape (P,)."""
    stiffness: Array
    """Relative shear modulus, shape (P,)."""
    lame_ratio: Array | None
    """lambda / mu relative to the body's, shape (P,); None where Poisson's ratio does not vary."""
    scalar_stiffness: Array
    """Relative lambda + 4 mu, the weight of the eigenmodes, shape (P,)."""
    density: Array
    """Relative density of volume mean one, shape (P,)."""
    surface: Array
    """Points of the surface [m], shape (N, 3)."""
    seeds: Array
    """Points among which kernel centres are chosen [m], shape (S, 3)."""
    spacing: float
    """Spacing of the seeds [m]."""
    edge: float
    """Longest edge of an octant [m]."""
    length: float
    """Unit of length [m]."""
    regions: tuple[Region, ...]
    """Regions."""
    samples: RegionSamples
    """Points of the regions."""
    added: Array
    """Places and radii of further local handles [m], shape (A, 4)."""
    material: Material | None
    """Which points of the material touch, so that kernels do not act across gaps; None: they do."""
    octants: Octants | None
    """What distances of kernels run through; None: straight lines."""
    lips: Array
    """Points on both sides of slits [m], shape (N, 3)."""

    def weighed(self, value: Array, gradient: Array) -> RawFunctions:
        """Return raw functions (P, R) and their gradients [1/m] (P, R, 3) with what the points weigh."""
        fraction = self.volumes / self.volumes.sum()
        return RawFunctions(value, gradient, fraction * self.density, fraction * self.stiffness, self.lame_ratio)

    def envelope(self, kernels: BasisRKPM) -> Envelope | None:
        """Return the envelope of the exact regions, if any: one kernel radius wide."""
        exact = tuple(region for region in self.regions if region.stiffness is None)
        return Envelope(exact, float(np.median(kernels.radii))) if exact else None


@dataclass(frozen=True, kw_only=True)
class BodyBasis:
    """Kernels, weights and functions of a body."""

    kernels: BasisRKPM | BasisQGMLS
    """Kernels."""
    weights: SkinningWeights
    """Skinning weights; of Q-GMLS the constant handle alone."""
    eigenvalues: Array
    """Eigenvalues of the eigenmodes, or of local handles, the constant handle's 0 first [1/m^2], shape (m + 1,)."""
    functions: Functions
    """Orthonormal functions."""
    gradient: Array
    """Their gradients at the quadrature points [1/m], shape (P, n, 3)."""
    drive: Array
    """Driven coordinates from displacements of the region samples, shape (r, N)."""
    drive_affine: Array
    """Driven coordinates from affine motions of the regions, shape (R, r, 4)."""
    envelope_length: float
    """Width of the envelope of exact regions [m], or 0."""
    report: dict[str, float]
    """What the choice of the functions says of itself."""


def make_body_basis(
    domain: Domain, options: BuildOptions, stage: Callable[[str], None], *, quick: bool = False
) -> BodyBasis:
    """Build kernels, weights and functions.

    Args:
        domain: The object.
        options: Sizes and seed.
        stage: Called with the name of each stage when it is done.
        quick: Whether a body with a slit is content with its first space, which then has fewer eigenmodes.

    Raises:
        BasisError: If the basis cannot be built.
        ConfigError: If options do not fit the object.
    """
    if options.handles == "qgmls":
        return _quadratic_basis(domain, options, stage)
    ground = _ground(domain, options)
    stage("kernels")
    if options.local:
        return _basis(ground, domain, options, _local_modes(ground, domain, options), stage)
    if not options.chosen:
        modes = _modes(ground, domain, options, options.mode_count or EIGENMODE_COUNT)
        return _basis(ground, domain, options, modes, stage)
    counts = (QUICK_SLIT_MODES, QUICK_SLIT_MODES) if quick and len(domain.lips) else SPACE_MODE_COUNTS
    small, large = (min(count, ground.most_modes) for count in counts)
    if domain.regions and ground.kernels.kernel_count < THIN * options.kernels(len(domain.seeds)):
        small = large
    alone = ground.envelope is not None and len(domain.regions) == 1 and large > small > ALONE_QUADRATIC
    modes = _modes(ground, domain, options, large if alone else small)
    basis = _basis(ground, domain, options, modes, stage, quadratic=ALONE_QUADRATIC if alone else None)
    if basis.report["space_error"] > (ALONE_ERROR if alone else SPACE_ERROR) and large > small:
        modes = modes if alone else _modes(ground, domain, options, large)
        basis = _basis(ground, domain, options, modes, stage)
    return basis


@dataclass(frozen=True, kw_only=True)
class _Ground:
    """Kernels at the quadrature points, and what regions ask of the weights."""

    kernels: BasisRKPM
    envelope: Envelope | None
    plain: ShapeFunctions
    shape: ShapeFunctions
    blend: Array
    blend_slope: Array
    scalar: float
    """E over the factor of the weight-space Hessian, FreeForm eq. (35)."""
    springs: Array | None
    """What soft regions add to the stiffness of the kernels, per E [m], (K, K)."""
    region_weights: Array
    most_modes: int
    """How many eigenmodes kernels and points have room for."""


def _ground(domain: Domain, options: BuildOptions) -> _Ground:
    """Return the kernels of a domain and the weights of its regions."""
    count, exact = options.kernels(len(domain.seeds)), [r for r in domain.regions if r.stiffness is None]
    free = int(np.all([region.distance(domain.seeds)[0] > 0.0 for region in exact], axis=0).sum()) if exact else None

    def place() -> tuple[BasisRKPM, bool]:
        """Return the kernels, and whether there are too many for the points."""
        found = make_basis(domain.seeds, count, kernel=options.kernel, spacing=domain.spacing, seed=options.seed)
        many = np.median(found.radii) < KERNEL_EDGE * domain.edge
        if free is not None and not many:
            reach = [region.distance(found.centres)[0] + found.support for region in exact]
            many = KERNEL_POINTS * np.all(np.array(reach) > 0.0, axis=0).sum() > free
        return found, bool(many)

    kernels, many = place()
    while many and domain.regions and options.kernel_count is None and count > KERNEL_LEAST:
        count = max(count * 4 // 5, KERNEL_LEAST)
        kernels, many = place()
    if domain.material is not None:
        kernels = divide_at_gaps(kernels, domain.material, domain.seeds, domain.spacing, domain.octants)
    envelope = domain.envelope(kernels)
    plain = kernels.evaluate(domain.points)
    shape, blend, blend_slope = enveloped(plain, envelope)
    springs, pull = _springs(kernels, envelope, domain)
    mu, lame = lame_parameters(options.mean_ratio)
    scalar = 1.0 / (lame + 4.0 * mu)
    return _Ground(
        kernels=kernels,
        envelope=envelope,
        plain=plain,
        shape=shape,
        blend=blend,
        blend_slope=blend_slope,
        scalar=scalar,
        springs=springs,
        region_weights=_region_weights(domain, shape, *(None if x is None else scalar * x for x in (springs, pull))),
        most_modes=min([shape.centre_count - 1, *([] if free is None else [max(free // MODE_POINTS, 3 * TURN_COUNT)])]),
    )


def _modes(ground: _Ground, domain: Domain, options: BuildOptions, count: int) -> Eigenmodes:
    """Return a number of eigenmodes, and handles along the lips of slits after them."""
    envelope, apart = ground.envelope, 0
    if envelope is not None and options.chosen:
        apart = min(SWUNG_COUNT, count // 3) if len(envelope.regions) > 1 else 0
    found = Eigenmodes(coefficients=np.ones((ground.shape.centre_count, 1)), eigenvalues=np.zeros(1))
    if envelope is None or apart or not options.chosen:
        found = solve_eigenmodes(
            ground.shape,
            domain.volumes,
            apart or count,
            stiffness_scale=domain.scalar_stiffness,
            springs=None if ground.springs is None else ground.scalar * ground.springs,
            vanishing=envelope is not None,
        )
    if len(found.eigenvalues) <= count:
        # Times the envelope, which takes from modes of the free body what they have at the faces, and no more: modes of
        # the held one rise slowly, and a plate 50:1 of nu = 0.49 was 17 % too stiff where it bends most.
        rest = count - len(found.eigenvalues)
        free = solve_eigenmodes(ground.plain, domain.volumes, rest, stiffness_scale=domain.scalar_stiffness)
        found = Eigenmodes(
            coefficients=np.concatenate([found.coefficients, free.coefficients], axis=1),
            eigenvalues=np.concatenate([found.eigenvalues, free.eigenvalues]),
        )
    if not (options.chosen and len(domain.lips)):
        return found
    return _with_handles(found, gather_at_lips(ground.kernels, domain.lips, LIP_COUNT), ground, domain)


def _local_modes(ground: _Ground, domain: Domain, options: BuildOptions) -> Eigenmodes:
    """Return local handles in the place of eigenmodes."""
    constant = Eigenmodes(coefficients=np.ones((ground.shape.centre_count, 1)), eigenvalues=np.zeros(1))
    return _with_handles(constant, gather_weights(ground.kernels, options.local, domain.added), ground, domain)


def _with_handles(modes: Eigenmodes, local: Array, ground: _Ground, domain: Domain) -> Eigenmodes:
    """Return modes and, after them, local handles (K, J) with their Rayleigh quotients as eigenvalues."""
    fraction = domain.volumes / domain.volumes.sum()
    size = fraction @ np.square(ground.shape.value @ local)
    slope = sum((fraction * domain.scalar_stiffness) @ np.square(along @ local) for along in ground.shape.gradient)
    return Eigenmodes(
        coefficients=np.concatenate([modes.coefficients, local], axis=1),
        eigenvalues=np.concatenate([modes.eigenvalues, slope / np.maximum(size, 1e-300)]),
        local_count=local.shape[1],
    )


def _quadratic_basis(domain: Domain, options: BuildOptions, stage: Callable[[str], None]) -> BodyBasis:
    """Return the basis of Q-GMLS."""
    if domain.regions:
        raise ConfigError("regions: functions of Q-GMLS know none", hint="build it without, or with handles='local'")
    kernels = place_kernels(domain.points, domain.volumes, options.local, domain.added, seed=options.seed)
    stage("kernels")
    stage("eigenmodes")
    stage("responses")
    raw = domain.weighed(*QuadraticFunctions(kernels=kernels, length=domain.length).evaluate(domain.points))
    every = np.arange(raw.value.shape[1])
    lead, none, others = np.eye(len(every))[:, [3, 0, 1, 2]], every[:0], every[4:]
    report: dict[str, float] = {}
    if options.chosen:
        quadratic = every[:10]
        choice = choose_functions(raw, lead=lead, kept=none, others=others, options=options, quadratic=quadratic)
        transform, report = choice.transform, choice.report()
    else:
        tolerance = _rank_tolerance(domain, options)
        transform = orthonormalise(raw, lead=lead, kept=none, others=others, rank_tolerance=tolerance)
    found = affine_first(transform, every[:4], domain.length)
    skin = constant_handle(len(kernels.centres))
    basis = _finished(kernels, skin, np.zeros(1), found, raw.gradient, None, domain, report)
    stage("functions")
    return basis


def _basis(
    ground: _Ground,
    domain: Domain,
    options: BuildOptions,
    modes: Eigenmodes,
    stage: Callable[[str], None],
    *,
    quadratic: int | None = None,
) -> BodyBasis:
    """Return the basis of eigenmodes or local handles: the handles themselves, or the space of the functions.

    Of a space the modes beyond `quadratic` carry affine motion alone.
    """
    kernels, shape, blend, blend_slope = ground.kernels, ground.shape, ground.blend, ground.blend_slope
    envelope, springs = ground.envelope, ground.springs
    stage("eigenmodes")
    skin = _weights(domain, options, modes, ground.region_weights, shape, blend_slope.shape[1], springs, quadratic)
    stage("responses")
    raw = domain.weighed(*skin.products(*skin.evaluate(shape, blend, blend_slope), domain.points, domain.length))
    samples = domain.samples

    def at_regions(rows: NDArray[np.bool_]) -> Array:
        """Return the raw functions at region samples, (rows, R)."""
        at = samples.points[rows]
        return skin.products(*skin.evaluate(*enveloped(kernels.evaluate(at), envelope)), at, domain.length)[0]

    trace = None if envelope is None else at_regions(samples.exact)
    leading = np.concatenate([skin.leading[[3, 0, 1, 2]], skin.leading[4:]])  # 1 first: then only it has a mean.
    count = raw.value.shape[1]
    lead, driven = np.eye(count)[:, leading], np.zeros((count, 0))
    if trace is not None:
        lead, driven = split_at_regions(lead, raw, trace)
    report: dict[str, float] = {}
    if options.chosen:
        springs_at = np.sqrt(_strength(domain) / domain.volumes.sum())[:, None] * at_regions(~samples.exact)
        choice = _chosen(raw, skin, modes, domain, options, lead, driven, trace, springs_at, quadratic)
        transform, report = choice.transform, choice.report()
    else:
        kept, others = np.flatnonzero(skin.translating), np.setdiff1d(np.flatnonzero(~skin.translating), leading)
        tolerance = _rank_tolerance(domain, options)
        transform = orthonormalise(raw, lead=lead, kept=kept, others=others, rank_tolerance=tolerance)
    if trace is None:
        found = affine_first(transform, skin.leading, domain.length)
    else:
        found = driven_first(driven, transform, raw, skin.leading, domain.length)
    basis = _finished(kernels, skin, modes.eigenvalues, found, raw.gradient, trace, domain, report)
    stage("functions")
    return basis


def _chosen(
    raw: RawFunctions,
    skin: SkinningWeights,
    modes: Eigenmodes,
    domain: Domain,
    options: BuildOptions,
    lead: Array,
    driven: Array,
    trace: Array | None,
    springs: Array,
    quadratic: int | None,
) -> ElasticChoice:
    """Return functions chosen by elastic energy, those that carry exact regions apart.

    Args:
        raw: Raw functions.
        skin: Skinning weights.
        modes: Eigenmodes and local handles, which are among them after the constant handle and the regions.
        domain: What the body is.
        options: How many functions, and for which Poisson's ratios.
        lead: Functions = raw @ lead of affine motion that come first, shape (R, f).
        driven: Those that carry exact regions, shape (R, r).
        trace: Raw functions at points that fill the exact regions, (T, R); None without such regions.
        springs: Raw functions at points of soft regions, times the root of their springs per E and volume, (S, R).
        quadratic: Beyond so many the eigenmodes carry affine motion alone; None: they do not.
    """
    motions = np.zeros((0, 0))
    if trace is not None:
        motions = rigid_motions(domain.samples, trace @ driven, len(domain.regions))
    soft = (skin.owner > 0) & (skin.owner < len(domain.regions))
    others = np.setdiff1d(np.flatnonzero(~soft), skin.leading)
    first_mode, mode_count = max(1, len(domain.regions)), len(modes.eigenvalues) - 1 - modes.local_count
    turned, level = np.zeros(0, dtype=np.intp), np.zeros(0)
    if motions.shape[1] and not options.local:
        turned = np.flatnonzero(
            (skin.owner >= first_mode) & (skin.owner < first_mode + TURN_COUNT) & (skin.monomial < 4)
        )
        level = np.sqrt(modes.eigenvalues[1] / modes.eigenvalues[1 + skin.owner[turned] - first_mode])
    late = (skin.owner >= first_mode + (quadratic or mode_count // 2)) & (skin.owner < first_mode + mode_count)
    return choose_functions(
        raw,
        lead=lead,
        kept=np.setdiff1d(np.flatnonzero(soft), skin.leading),
        others=others,
        options=options,
        half=None if options.local else others[~late[others]],
        quadratic=np.arange(10) if trace is None else None,
        held=Held(driven=driven, motions=motions, springs=springs, turned=turned, level=level)
        if domain.regions
        else None,
        pulled=() if domain.regions else _pulled_parts(raw, domain),
    )


def _pulled_parts(raw: RawFunctions, domain: Domain) -> tuple[list[Pulled], list[Pulled]]:
    """Return the parts of a free body that are pulled apart: around its farthest points, and its two ends."""
    surface, points, fraction = domain.surface, domain.points, domain.volumes / domain.volumes.sum()
    first = int((surface**2).sum(axis=1).argmax())
    far = [np.linalg.norm(points - x, axis=1) for x in surface[sample_farthest(surface, FAR_COUNT, first=first)]]
    axis = int(np.argmax(np.ptp(surface, axis=0)))
    size = float(np.ptp(surface[:, axis]))
    ends = [points[:, axis] - surface[:, axis].min(), surface[:, axis].max() - points[:, axis]]

    def part(distance: Array, level: float) -> Pulled:
        near = distance <= max(FAR_REACH * size, distance.min())
        return Pulled(raw.value[near], fraction[near] / size**2, level)

    return [part(distance, FAR_LEVEL) for distance in far], [part(distance, 1.0) for distance in ends]


def _finished(
    kernels: BasisRKPM | BasisQGMLS,
    skin: SkinningWeights,
    eigenvalues: Array,
    functions: Functions,
    raw_gradient: Array,
    trace: Array | None,
    domain: Domain,
    report: dict[str, float],
) -> BodyBasis:
    """Return the basis with what follows from its functions: gradients, and how regions drive it.

    Args:
        kernels: Kernels.
        skin: Skinning weights.
        eigenvalues: Of the eigenmodes or local handles, shape (m + 1,).
        functions: The functions.
        raw_gradient: Gradients of the raw functions [1/m], (P, R, 3).
        trace: Raw functions at points that fill the exact regions, (T, R); None without such regions.
        domain: What the body is.
        report: What the provenance keeps.
    """
    driven = np.zeros((0, 0)) if trace is None else trace @ functions.transform[:, : functions.driven_count]
    drive, drive_affine = drive_matrices(domain.samples, driven, len(domain.regions))
    envelope = None if isinstance(kernels, BasisQGMLS) else domain.envelope(kernels)
    return BodyBasis(
        kernels=kernels,
        weights=skin,
        eigenvalues=eigenvalues,
        functions=functions,
        gradient=np.stack([raw_gradient[:, :, d] @ functions.transform for d in range(3)], axis=2),
        drive=drive,
        drive_affine=drive_affine,
        envelope_length=0.0 if envelope is None else envelope.length,
        report=report,
    )


def _rank_tolerance(domain: Domain, options: BuildOptions) -> float:
    """Return which directions of FreeForm's functions are dropped: fewer on a body with regions, or local handles."""
    return min(options.rank_tolerance, HELD_RANK_TOLERANCE if domain.regions or options.local else np.inf)


def _springs(kernels: BasisRKPM, envelope: Envelope | None, domain: Domain) -> tuple[Array | None, Array | None]:
    """Return what soft regions add, per E: springs [m] (K, K), and the pull of each on its weight [m] (K, S)."""
    samples = domain.samples
    soft = np.flatnonzero(~samples.exact)
    if not len(soft):
        return None, None
    strength = _strength(domain)
    shape = enveloped(kernels.evaluate(samples.points[soft]), envelope)[0]
    own = samples.index[soft][:, None] == np.unique(samples.index[soft])
    return mass_matrix(shape, strength), np.asarray(shape.value.T @ (strength[:, None] * own))


def _strength(domain: Domain) -> Array:
    """Return the springs of the samples of soft regions, per E [m], (S,)."""
    samples = domain.samples
    stiffness = np.array([region.stiffness or 0.0 for region in domain.regions])[samples.index[~samples.exact]]
    return stiffness * samples.weights[~samples.exact]


def _region_weights(domain: Domain, shape: ShapeFunctions, springs: Array | None, pull: Array | None) -> Array:
    """Return coefficients of the weights of all regions but one, exact ones first, (K, R - 1).

    The weights of exact regions sum to one, and so do those of soft ones where there are no others: beside the constant
    handle the last adds nothing. Those of exact regions are their blends as they are: eigenmodes cannot cancel what
    kernels would add, and edges of a plate 40:1 were 1.4 times too stiff when one moved out of its plane.
    """
    exact = sum(region.stiffness is None for region in domain.regions)
    blends = np.zeros((shape.centre_count, max(exact - 1, 0)))
    if springs is None or pull is None:
        return blends
    given = {"stiffness_scale": domain.scalar_stiffness, "springs": springs, "spring_load": pull}
    soft = solve_harmonic_weights(shape, domain.volumes, **given)
    return np.concatenate([blends, soft[:, 0 if exact else 1 :]], axis=1)


def _weights(
    domain: Domain,
    options: BuildOptions,
    modes: Eigenmodes,
    region_weights: Array,
    shape: ShapeFunctions,
    exact_count: int,
    springs: Array | None,
    quadratic: int | None,
) -> SkinningWeights:
    """Gather the weights: constant handle, regions, eigenmodes or local handles, static responses."""
    degree = 1 if not (options.chosen or options.local or options.handles == "quadratic") else 2
    region_count = region_weights.shape[1]
    # Squares and products of coordinates do not vanish on a region: there the constant handle stays affine.
    handles = modes.coefficients
    parts, degrees = [handles[:, :1], region_weights], [degree if exact_count == 0 else 1, *[1] * region_count]
    parts.append(handles[:, 1:])
    count, late = handles.shape[1] - 1, 0
    if quadratic is not None:
        late = count - modes.local_count - quadratic
    degrees += [degree] * (count - modes.local_count - late) + [1] * late + [degree] * modes.local_count
    if domain.regions and options.static_responses:
        responses = solve_static_responses(
            shape,
            domain.volumes,
            density=domain.density,
            poissons_ratio=options.mean_ratio,
            stiffness_scale=domain.stiffness,
            lame_ratio=domain.lame_ratio,
            springs=springs,
            derivative_count=0 if options.chosen else options.response_derivatives,
            mode_count=KERNEL_MODES if options.chosen else 0,
        )
        parts.append(responses)
        degrees += [0] * responses.shape[1]
    blends = np.full(len(degrees), -1, dtype=np.int64)
    blends[1:exact_count] = np.arange(exact_count - 1)
    return SkinningWeights(
        coefficients=np.concatenate(parts, axis=1), degrees=np.array(degrees, dtype=np.int64), blends=blends
    )
