"""softmode's own rows, and Simplicits' neural weights in softmode's solver.

Neural weights replace the eigenmodes and nothing else: they carry the same affine functions and go through the same
orthonormalisation, cubature and step.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from benchmarks.baselines.common import CLAMP, SCENE, SOFT, STIFFNESS, Row, measure, sample
from benchmarks.baselines.neural_weights import NeuralWeights, NeuralWeightsOptions, train_neural_weights
from softmode.deformables.body.records import BodyCubature
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.body.skinning_weights import SkinningWeights
from softmode.deformables.materials.material import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.deformables.model.authoring import add_pins, add_reduced_body, register_custom_attributes
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.quadrature.quadrature_mesh import quadrature_from_mesh
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.cache import fingerprint_of
from softmode.deformables.reduction.cubature import select_cubature
from softmode.deformables.reduction.functions import RANK_TOLERANCE, RawFunctions, affine_first, orthonormalise
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.solver.options import Integrator, SolverReducedOptions
from softmode.deformables.solver.solver_reduced import SolverReduced

POINTS = 5000
"""Quadrature points, as in the papers."""
KERNELS = 1000
"""Reproducing kernels, as in FreeForm."""


def run_softmode(
    options: BuildOptions, steps: int, *, exact: bool, label: str, integrator: Integrator = "euler"
) -> Row:
    """Bend the beam with a basis of softmode's.

    Args:
        options: The basis.
        steps: Number of steps.
        exact: Hold the clamp exactly, as a region known to the build; else by springs that the build does not know
            (FreeForm's reading), with the same springs in the reference.
        label: Name of the row.
        integrator: Of the step.
    """
    regions = (Region(name="clamp", box=np.array([[-np.inf] * 3, [CLAMP, np.inf, np.inf]])),) if exact else ()
    body = build_body(_quadrature(), options, regions=regions, name="beam", progress=False)
    return _run(body, steps, exact=exact, method="softmode", label=label, integrator=integrator)


def run_neural(options: NeuralWeightsOptions, steps: int) -> Row:
    """Bend the beam with weights that a network was trained for."""
    bounds = SCENE.shape.bounds
    network = train_neural_weights(
        _training_points(bounds),
        float(np.prod(bounds[1] - bounds[0])),
        options,
        youngs_modulus=SCENE.youngs_modulus,
        poissons_ratio=SCENE.poissons_ratio,
    )
    body = neural_body(_quadrature(), network, options.mode_count, "beam")
    note = f"trained {body.network.train_seconds:.0f} s; effective weights {body.effective_count:.1f}"
    label = f"m = {options.mode_count}, trained in " + ("the unit cube" if options.unit_cube else "metres")
    return _run(body, steps, exact=False, method="Simplicits' neural weights", label=label, note=note)


@dataclass(frozen=True, kw_only=True)
class NeuralBody(ReducedBody):
    """A body whose weights come from a network instead of reproducing kernels."""

    network: NeuralWeights
    """The network."""
    mean: np.ndarray
    """Mean of its weights over the body, shape (m,)."""
    mix: np.ndarray
    """Orthonormal weights = (network - mean) @ mix, shape (m, independent ones)."""
    effective_count: float
    """Participation ratio (tr G)^2 / tr G^2 of the weights' Gram matrix G: m if all are of one size and orthogonal."""

    def evaluate(self, points: ArrayLike, *, outside: str = "clamp") -> tuple[np.ndarray, np.ndarray]:
        """Evaluate functions (N, n) and gradients [1/m] (N, n, 3) at rest points of the body frame (N, 3) [m]."""
        x = np.asarray(points, dtype=np.float64)
        value, slope = _products(self.network, self.mean, self.mix, x, self.offset, self.length)
        return value @ self.transform, np.stack([slope[:, :, d] @ self.transform for d in range(3)], axis=2)


def _skin(mix: np.ndarray) -> SkinningWeights:
    """Return what the weights carry: all of them affine functions, the constant one first."""
    count = mix.shape[1] + 1
    return SkinningWeights(
        coefficients=np.zeros((1, count)), degrees=np.ones(count, dtype=np.int64), blends=np.full(count, -1)
    )


def _products(
    network: NeuralWeights, mean: np.ndarray, mix: np.ndarray, points: np.ndarray, offset: np.ndarray, length: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the raw functions (N, R) and their gradients [1/m] (N, R, 3) at points of the body frame."""
    value, slope = network.evaluate(points + offset)
    value = np.column_stack([value[:, 0], (value[:, 1:] - mean) @ mix])
    slope = np.concatenate([slope[:, :1], np.einsum("njd,jk->nkd", slope[:, 1:], mix)], axis=1)
    return _skin(mix).products(value, slope, points, length)


def neural_body(
    quadrature: Quadrature,
    network: NeuralWeights,
    mode_count: int,
    name: str,
    *,
    rank_tolerance: float = RANK_TOLERANCE,
) -> NeuralBody:
    """Reduce an object by the weights of a network."""
    options = BuildOptions(mode_count=mode_count, kernel_count=KERNELS)
    body = build_body(quadrature, options, name=name, progress=False)
    mass = quadrature.weights / quadrature.volume
    points = quadrature.points - body.offset
    weight = network.evaluate(quadrature.points)[0][:, 1:]
    mean = mass @ weight
    # The span of the weights counts, not their size: unit columns, then an orthonormal basis of what is independent.
    size = np.sqrt(mass @ (weight - mean) ** 2)
    _, strength, right = np.linalg.svd(np.sqrt(mass)[:, None] * (weight - mean) / size, full_matrices=False)
    kept = strength > 1e-5 * strength[0]
    mix = right[kept].T / size[:, None] / strength[kept]
    spread = np.linalg.eigvalsh((weight * mass[:, None]).T @ weight)
    raw, raw_gradient = _products(network, mean, mix, points, body.offset, body.length)
    skin = _skin(mix)
    lead, others = skin.leading[[3, 0, 1, 2]], np.setdiff1d(np.flatnonzero(~skin.translating), skin.leading)
    kept = np.flatnonzero(skin.translating)
    fields = RawFunctions(raw, raw_gradient, mass, mass)
    free = orthonormalise(
        fields, lead=np.eye(raw.shape[1])[:, lead], kept=kept, others=others, rank_tolerance=rank_tolerance
    )
    found = affine_first(free, skin.leading, body.length)
    gradient = np.stack([raw_gradient[:, :, d] @ found.transform for d in range(3)], axis=2)
    chosen = select_cubature(quadrature.weights, gradient, body.point_count)
    fields = {f.name: getattr(body, f.name) for f in dataclasses.fields(body)}
    fields |= {
        "name": f"{name}, neural weights",
        "cubature": BodyCubature(
            points=points[chosen.index],
            weights=chosen.weights,
            grad_basis=gradient[chosen.index].astype(np.float32),
            stiffness_scale=np.ones(len(chosen.index)),
        ),
        "mean_basis": found.mean,
        "linear_coordinates": found.linear,
        "transform": found.transform,
        "fingerprint": fingerprint_of(body.fingerprint, *network.layers[-1]),
    }
    effective = float(spread.sum() ** 2 / (spread**2).sum())
    made = NeuralBody(**fields, network=network, mean=mean, mix=mix, effective_count=effective)
    surface = made.evaluate(made.surface.points)[0].astype(np.float32)
    return dataclasses.replace(made, surface=dataclasses.replace(made.surface, basis=surface))


@functools.cache
def _quadrature() -> Quadrature:
    return quadrature_from_mesh(*SCENE.shape.surface(), point_count=POINTS)


def _training_points(bounds: np.ndarray) -> np.ndarray:
    """Return the centres of 50 x 10 x 10 cells."""
    size, centre = bounds[1] - bounds[0], 0.5 * (bounds[0] + bounds[1])
    axes = [(np.arange(n) + 0.5) / n * size[d] - size[d] / 2 + centre[d] for d, n in enumerate((50, 10, 10))]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _run(
    body: ReducedBody,
    steps: int,
    *,
    exact: bool,
    method: str,
    label: str,
    note: str = "",
    integrator: Integrator = "euler",
) -> Row:
    """Step the body as the scene says."""
    builder = newton.ModelBuilder()
    register_custom_attributes(builder)
    material = Material(
        model=MaterialModel.STABLE_NEO_HOOKEAN,
        youngs_modulus=SCENE.youngs_modulus,
        poissons_ratio=SCENE.poissons_ratio,
        density=SCENE.density,
        viscosity=0.0,
    )
    instance = add_reduced_body(builder, body, material=material, position=body.offset.tolist())
    if not exact:
        held, volume = SCENE.shape.gauss(SCENE.clamps[0].region, (3, 5, 5))
        add_pins(builder, instance, held - body.offset, stiffness=STIFFNESS * volume, targets=held)
    model: Any = builder.finalize(device="cpu")
    model.set_gravity(SCENE.gravity)
    solver = SolverReduced(
        model, [body], options=SolverReducedOptions(contact_max=1, integrator=integrator, keep_spin=False)
    )
    states, control = [model.state(), model.state()], model.control()
    graphs = []
    for a, b in ((0, 1), (1, 0)):
        with wp.ScopedCapture(device="cpu") as capture:
            solver.step(states[a], states[b], control, None, SCENE.dt)
        graphs.append(capture.graph)
    for state in states:
        state.assign(model.state())
    solver.reset(states[0])
    points, _ = sample()
    basis = body.evaluate(points - body.offset)[0]
    start = states[0].softmode.q.numpy().copy()
    count = 0

    def step() -> None:
        nonlocal count
        wp.capture_launch(graphs[count % 2])
        count += 1

    row = measure(
        method,
        f"{label}, {body.point_count} points",
        3 * (body.function_count - body.driven_count),
        steps,
        step,
        lambda: basis @ (states[count % 2].softmode.q.numpy() - start),
        scene=SCENE.name if exact else SOFT,
        note=note,
    )
    bits = int(solver.status.numpy()[0])
    return dataclasses.replace(row, note="; ".join(filter(None, [row.note, f"status {bits}" if bits else ""])))
