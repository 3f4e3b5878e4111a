"""The range of stiffness, step and Poisson's ratio over which a step must be sound and equal its float64 twin."""

import dataclasses

import numpy as np
import pytest

from benchmarks.range import (
    ERROR_LIMIT,
    FAILED,
    HOLDS,
    ITERATION_LIMIT,
    MODULI,
    RATIOS,
    STEPS,
    Cell,
    hang,
    potential,
    solve_step,
)
from softmode.deformables.materials.material import Material
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from tests import reference

# Corners of the range; stiff and nearly incompressible in large steps costs most iterations and precision.
FAST = [
    ("soft pins", 0.49, 3.0e-2, (1.0e3, 1.0e9), 2),
    ("soft pins", 0.0, 1.0e-3, (1.0e3, 1.0e9), 3),
    ("soft pins", 0.3, 1.0e-2, (1.0e5, 1.0e7), 2),
    ("stiff pins", 0.49, 3.0e-2, (1.0e9,), 2),
    ("stiff pins", 0.0, 1.0e-2, (1.0e9,), 2),
    ("exact region", 0.49, 3.0e-2, (1.0e9,), 3),
    ("exact region", 0.45, 1.0e-3, (1.0e7,), 2),
]
"""What holds the bar, Poisson's ratio, step [s], moduli [Pa], number of steps."""


def check(row):
    """Assert the three bounds of every cell of a row, by name."""
    for cell in row:
        assert cell.iterations <= ITERATION_LIMIT, cell
        assert not cell.status & FAILED, cell
        assert cell.error <= ERROR_LIMIT, cell


@pytest.mark.parametrize(("hold", "ratio", "dt", "moduli", "count"), FAST)
def test_corners_of_the_range(hold, ratio, dt, moduli, count):
    """At most 20 iterations, no status bit of failure, and the tip's sag within 1 % of float64, in every step."""
    check(hang(HOLDS[hold](), moduli, ratio, dt, step_count=count))


@pytest.mark.slow
@pytest.mark.parametrize("hold", HOLDS)
@pytest.mark.parametrize("viscosity", [0.0, 0.002])
@pytest.mark.parametrize("ratio", RATIOS)
@pytest.mark.parametrize("dt", STEPS)
def test_range(hold, viscosity, ratio, dt):
    """The same over the whole range, E 1e3 to 1e9 Pa."""
    check(hang(HOLDS[hold](), MODULI, ratio, dt, viscosity=viscosity))


def test_a_step_cut_short_is_found_out():
    """The check sees a solver that stops too early: one iteration per step raises the limit's bit."""
    (cell,) = hang(
        HOLDS["soft pins"](), (1.0e9,), 0.49, 3.0e-2, step_count=1, options=SolverReducedOptions(iteration_max=1)
    )
    assert cell.status & FAILED
    assert not cell.passed


def test_a_state_that_is_not_finite_does_not_pass():
    """A NaN error is no pass."""
    cell = Cell(youngs_modulus=1.0e5, iterations=1, mean_iterations=1.0, status=0, error=1.0e-6)
    assert cell.passed
    assert not dataclasses.replace(cell, error=float("nan")).passed


@pytest.mark.parametrize("hold", HOLDS)
def test_potential_of_the_twin(hold):
    """The potential that damps the twin's steps has the twin's residual as its gradient: central differences."""
    bar = HOLDS[hold]()
    twin = reference.FreeBody(
        body=bar.body,
        material=Material(youngs_modulus=1.0e5, mass_damping=3.0, viscosity=0.01),
        dt=0.01,
        gravity=(1.0, 2.0, -9.81),
        pin_points=bar.pin_points,
        pin_stiffness=bar.pin_stiffness,
    )
    rng = np.random.default_rng(0)
    q, start, velocity, direction = rng.normal(size=(4, bar.body.function_count, 3)) * 1e-3
    step = 3e-4
    ends = [potential(twin, q + sign * step * direction, start, velocity) for sign in (1.0, -1.0)]
    slope = float((twin.residual(q, start, velocity) * direction).sum())
    assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(slope, rel=1e-5)


def test_step_of_the_twin():
    """The damped twin ends where the reference's full Newton steps end, which solve to rounding."""
    bar = HOLDS["soft pins"]()
    twin = reference.FreeBody(
        body=bar.body,
        material=Material(viscosity=0.002),
        dt=0.01,
        gravity=(0.0, 0.0, -9.81),
        pin_points=bar.pin_points,
        pin_stiffness=bar.pin_stiffness,
    )
    zero = np.zeros((bar.body.function_count, 3))
    np.testing.assert_allclose(solve_step(twin, zero, zero), twin.step(zero, zero)[0], atol=1e-10)
