"""Hang a bar by one end over the whole range of stiffness, step and Poisson's ratio; compare with float64.

Run from the repository root: ``python -m benchmarks.range [--holds NAME ...] [--viscosity TAU] [--steps N]``.

A bar of 0.4 x 0.1 x 0.1 m and 300 kg/m^3 is let go at rest under gravity. Each cell of the table shows the most Newton
iterations of any step and the largest error of the tip's sag, relative to the largest sag, against the same steps of
implicit Euler solved in float64 to rounding (``twin_sags``), and marks what went wrong: ``L`` iteration limit, ``D`` no
descent, ``F`` not finite, ``C`` collapsed.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.materials.material import Material
from softmode.deformables.model import status as bits
from softmode.deformables.model.authoring import add_pins, add_reduced_body
from softmode.deformables.quadrature.quadrature import quadrature_from_box
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from tests import reference
from tests.bodies import bar
from tests.scenes import GRAVITY, Scene

MODULI = (1.0e3, 1.0e5, 1.0e7, 1.0e9)
"""Young's moduli [Pa], one world each."""
STEPS = (1.0e-3, 1.0e-2, 3.0e-2)
"""Steps [s]."""
RATIOS = (0.0, 0.3, 0.45, 0.49)
"""Poisson's ratios."""
ITERATION_LIMIT = 20
"""Newton iterations that no step may exceed."""
ERROR_LIMIT = 0.01
"""Error of the sag that no cell may exceed."""
FAILED = bits.WORLD_ITERATION_LIMIT | bits.WORLD_NO_DESCENT | bits.WORLD_NOT_FINITE
"""Status bits that no cell may raise."""
LENGTH, EDGE, CLAMP = 0.4, 0.1, 0.05
"""Bar and length of the part that a clamp holds [m]."""
TIP = np.array([[0.5 * LENGTH, 0.0, 0.0]])
"""Rest position of the middle of the free end [m]."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hold:
    """A bar and what holds it."""

    body: ReducedBody
    pin_points: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """Rest points of springs [m], shape (pin_count, 3)."""
    pin_stiffness: float = 0.0
    """Stiffness of each spring [N/m]."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cell:
    """How one modulus, step and Poisson's ratio came out."""

    youngs_modulus: float
    """[Pa]."""
    iterations: int
    """Most Newton iterations of any step."""
    mean_iterations: float
    """Newton iterations per step."""
    status: int
    """All status bits raised."""
    error: float
    """Largest error of the sag relative to the largest sag; NaN where the state is not finite."""

    @property
    def passed(self) -> bool:
        """Whether every bound holds."""
        sound = self.iterations <= ITERATION_LIMIT and not self.status & FAILED
        return sound and self.error <= ERROR_LIMIT  # false for NaN

    def __str__(self) -> str:
        """Return iterations, error and marks."""
        marks = "".join(
            mark
            for bit, mark in (
                (bits.WORLD_ITERATION_LIMIT, "L"),
                (bits.WORLD_NO_DESCENT, "D"),
                (bits.WORLD_NOT_FINITE, "F"),
                (bits.WORLD_COLLAPSED, "C"),
            )
            if self.status & bit
        )
        return f"{self.iterations:>4} {self.error:8.1e} {marks:<3}"


def soft_pins() -> Hold:
    """Return a bar whose one end hangs by its corners on springs of 2 kN/m."""
    y, z = 0.5 * EDGE * np.array([[-1, -1, 1, 1], [-1, 1, -1, 1]])
    points = np.column_stack([np.full(4, -0.5 * LENGTH), y, z])
    return Hold(body=bar(LENGTH, EDGE), pin_points=points, pin_stiffness=2000.0)


def stiff_pins() -> Hold:
    """Return a bar whose first 5 cm are held by springs of 1e9 N/m per cubic metre, at the centres of 4^3 cells."""
    across = EDGE * ((np.arange(4) + 0.5) / 4 - 0.5)
    along = -0.5 * LENGTH + CLAMP * (np.arange(4) + 0.5) / 4
    points = np.stack(np.meshgrid(along, across, across), axis=-1).reshape(-1, 3)
    return Hold(body=bar(LENGTH, EDGE), pin_points=points, pin_stiffness=1.0e9 * CLAMP * EDGE**2 / len(points))


@functools.cache
def exact_region() -> Hold:
    """Return a bar whose first 5 cm are held exactly."""
    box = np.array([[-np.inf] * 3, [-0.5 * LENGTH + CLAMP, np.inf, np.inf]])
    quadrature = quadrature_from_box((LENGTH, EDGE, EDGE), point_count=2000, surface_count=200)
    options = BuildOptions(mode_count=6, kernel_count=200, cubature_count=200)
    return Hold(body=build_body(quadrature, options, regions=(Region(name="clamp", box=box),), name="clamped bar"))


HOLDS: dict[str, Callable[[], Hold]] = {"soft pins": soft_pins, "stiff pins": stiff_pins, "exact region": exact_region}
"""What holds the bar."""


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--holds", nargs="+", default=list(HOLDS), choices=list(HOLDS))
    parser.add_argument("--viscosity", type=float, nargs="+", default=[0.0, 0.002], metavar="TAU", help="in s")
    parser.add_argument("--steps", type=int, default=20, metavar="N")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    cells, failures = 0, 0
    for name in arguments.holds:
        for viscosity in arguments.viscosity:
            print(f"\n{name}, viscosity {viscosity:g} s, {arguments.steps} steps: iterations, error of the sag")
            print(f"{'nu':>5} {'h [s]':>7}" + "".join(f"   E = {modulus:<12.0e}" for modulus in MODULI))
            for ratio in RATIOS:
                for dt in STEPS:
                    row = hang(HOLDS[name](), MODULI, ratio, dt, viscosity=viscosity, step_count=arguments.steps)
                    print(f"{ratio:>5} {dt:>7.0e} " + "  ".join(str(cell) for cell in row), flush=True)
                    cells += len(row)
                    failures += sum(not cell.passed for cell in row)
    print(
        f"\n{failures} of {cells} cells miss {ITERATION_LIMIT} iterations, an error of {ERROR_LIMIT} or a clean status"
    )


def hang(
    hold: Hold,
    moduli: Sequence[float],
    poissons_ratio: float,
    dt: float,
    *,
    viscosity: float = 0.0,
    step_count: int = 20,
    options: SolverReducedOptions | None = None,
) -> list[Cell]:
    """Let the bar hang, one world per modulus, and compare with the twins.

    Args:
        hold: The bar and what holds it.
        moduli: Young's moduli [Pa].
        poissons_ratio: Poisson's ratio.
        dt: Step [s].
        viscosity: Relaxation time [s].
        step_count: Number of steps.
        options: Solver options.
    """
    material = Material(poissons_ratio=poissons_ratio, viscosity=viscosity)

    def populate(world: object) -> None:
        instance = add_reduced_body(world, hold.body, material=material)  # pyright: ignore[reportArgumentType]
        if len(hold.pin_points):
            add_pins(world, instance, hold.pin_points, stiffness=hold.pin_stiffness)  # pyright: ignore[reportArgumentType]

    scene = Scene(populate, [hold.body], gravity=(0.0, 0.0, -GRAVITY), dt=dt, world_count=len(moduli), options=options)
    scene.set_parameter("youngs_modulus", moduli)
    tip = hold.body.evaluate(TIP)[0][0]
    iterations, sags = np.zeros((step_count, len(moduli)), int), np.zeros((step_count, len(moduli)))
    for k in range(step_count):
        scene.step()
        iterations[k] = scene.reduced.iteration.numpy()
        sags[k] = [tip @ scene.q(i)[:, 2] for i in range(len(moduli))]
    cells = []
    for i, modulus in enumerate(moduli):
        expected = twin_sags(hold, dataclasses.replace(material, youngs_modulus=modulus), dt, step_count)
        cells.append(
            Cell(
                youngs_modulus=modulus,
                iterations=int(iterations[:, i].max()),
                mean_iterations=float(iterations[:, i].mean()),
                status=int(scene.reduced.status.numpy()[i]),  # gathered over all steps
                error=float(np.abs(sags[:, i] - expected).max() / np.abs(expected).max()),
            )
        )
    return cells


def twin_sags(hold: Hold, material: Material, dt: float, step_count: int) -> np.ndarray:
    """Return the tip's height after every step [m], in float64."""
    twin = reference.FreeBody(
        body=hold.body,
        material=reference.with_float32(material),
        dt=dt,
        gravity=(0.0, 0.0, -float(np.float32(GRAVITY))),
        pin_points=hold.pin_points,
        pin_stiffness=float(np.float32(hold.pin_stiffness)),
    )
    tip = hold.body.evaluate(TIP)[0][0]
    q = qd = np.zeros((hold.body.function_count, 3))
    sags = []
    for _ in range(step_count):
        q_next = solve_step(twin, q, qd)
        q, qd = q_next, (q_next - q) / dt
        sags.append(tip @ q[:, 2])
    return np.array(sags)


def solve_step(twin: reference.FreeBody, q_start: np.ndarray, qd_start: np.ndarray) -> np.ndarray:
    """Return the end of a step of implicit Euler by damped Newton, held functions where they are.

    Raises:
        RuntimeError: If Newton does not reach rounding in 100 iterations.
    """
    held = twin.body.driven_count
    size = float(np.linalg.norm(np.ptp(twin.body.bounds, axis=0)))
    q = q_start + twin.dt * qd_start
    q[:held] = q_start[:held]
    value = potential(twin, q, q_start, qd_start)
    rounding = 1e-15 * twin.material.youngs_modulus * twin.body.volume
    for _ in range(100):
        residual = twin.residual(q, q_start, qd_start)[held:].ravel()
        hessian = twin.tangent(q, q_start)[3 * held :, 3 * held :]
        if np.linalg.eigvalsh(hessian)[0] <= 0.0:
            hessian = twin.tangent(q)[3 * held :, 3 * held :]
        dq = np.zeros_like(q)
        dq[held:] = -np.linalg.solve(hessian, residual).reshape(-1, 3)
        if np.linalg.norm(dq) < 1e-8 * size:  # Newton's convergence is quadratic
            return q + dq
        slope, alpha = residual @ dq[held:].ravel(), 1.0
        while True:
            trial = potential(twin, q + alpha * dq, q_start, qd_start)
            # the change of the potential drowns in rounding near the minimum
            if trial <= value + 1e-4 * alpha * slope + rounding or np.linalg.norm(dq) < 1e-6 * size:
                break
            alpha *= 0.5
            if alpha < 2.0**-40:
                raise RuntimeError("the twin found no descent")
        q, value = q + alpha * dq, trial
    raise RuntimeError("the twin did not converge")


def potential(twin: reference.FreeBody, q: np.ndarray, q_start: np.ndarray, qd_start: np.ndarray) -> float:
    """Return the incremental potential [J], whose gradient is ``twin.residual``."""
    m, h, material = twin.mass, twin.dt, twin.material
    moved = q - q_start
    total = (
        0.5 * m / h**2 * ((moved - h * qd_start) ** 2).sum() + 0.5 * m * material.mass_damping / h * (moved**2).sum()
    )
    F, F_start = twin.deformation_gradient(q), twin.deformation_gradient(q_start)
    total += twin.body.cubature.weights @ reference.viscous_energy(
        F, F_start, *twin.hooke_moduli, material.viscosity, h
    )
    total += 0.5 * twin.pin_stiffness * ((twin.pin_basis @ q) ** 2).sum()
    return float(total + twin.elastic_energy(q) - m * twin.body.mean_basis @ q @ np.asarray(twin.gravity))


if __name__ == "__main__":
    main()
