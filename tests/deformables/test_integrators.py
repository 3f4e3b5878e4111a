"""BDF2 beside implicit Euler: what a spin and a vibration keep, and the order of convergence."""

import numpy as np
import pytest

from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_pins, add_reduced_body
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from softmode.errors import ConfigError
from tests import reference
from tests.bodies import cube
from tests.scenes import Scene

STIFF = Material(youngs_modulus=1.0e7, viscosity=0.0)


def scene_of(integrator, material, *, dt, spin=(0.0, 0.0, 0.0), world_count=1):
    """Return a free cube without gravity."""
    options = SolverReducedOptions(integrator=integrator, tolerance=1.0e-9)
    body = cube()

    def populate(world):
        add_reduced_body(world, body, material=material, angular_velocity=spin)

    return Scene(populate, [body], options=options, dt=dt, world_count=world_count)


@pytest.mark.parametrize(("dt", "printed"), [(0.05, 7.0 / 3.0), (0.1, np.inf)])
@pytest.mark.filterwarnings("ignore:pins hold")  # a cube that moves as a whole is not stiff there
def test_step_of_a_spring(dt, printed):
    """A spring, m = 1 kg, k = 100 N/m, released at 1 m: implicit Euler takes it to 1 / (1 + h^2 k / m), 0.8 at 0.05 s.

    Feng et al. 2024, equation 18, has the stiffness with the other sign, and not the force of the present iterate: the
    printed increment is x / (1 - h^2 k / m), which goes to 2.33 and is singular at h = 0.1 s.
    """
    body, k = cube(), 100.0

    def populate(world):
        material = Material(youngs_modulus=1.0e6, viscosity=0.0, density=1.0 / body.volume)
        instance = add_reduced_body(world, body, material=material, position=(1.0, 0.0, 0.0))
        add_pins(world, instance, body.cubature.points, stiffness=k * body.cubature.weights / body.volume)

    scene = Scene(populate, [body], options=SolverReducedOptions(tolerance=1.0e-9), dt=dt)
    scene.step()
    found = float((body.mean_basis @ scene.q())[0])
    assert found == pytest.approx(1.0 / (1.0 + dt**2 * k), abs=1e-5)
    with np.errstate(divide="ignore"):
        as_printed = 1.0 + 1.0 / np.abs(np.round(1.0 - dt**2 * k, 12))
    assert as_printed == pytest.approx(printed) and as_printed > found + 1.0


@pytest.mark.parametrize(("omega", "kept"), [(1.0, 1.000), (5.0, 0.995), (10.0, 0.967), (30.0, 0.655)])
def test_free_spin_with_bdf2(omega, kept):
    """A stiff cube spun for 1 s at dt = 1/60 s keeps 1.000, 0.995, 0.967, 0.655 of its spin; Euler 0.48 at 10 rad/s.

    The first step is one of implicit Euler and costs (omega dt)^2 of its own.
    """
    dt = 1.0 / 60.0
    scene = scene_of("bdf2", STIFF, dt=dt, spin=(0.0, 0.0, omega))
    before = scene.momentum()[1][2]
    scene.step(60)
    after = scene.momentum()[1][2] / before
    assert kept - (omega * dt) ** 2 - 1e-3 <= after <= kept + (omega * dt) ** 2 + 1e-3


@pytest.mark.parametrize(("integrator", "order"), [("euler", 1), ("bdf2", 2)])
def test_order_in_the_step(integrator, order):
    """A soft cube that pulses for 32 ms: the error falls as dt^order against a run with steps of 31 us.

    The error is that of 16 moments together: at a single one it depends on where in its swing the cube is.
    """
    material = Material(youngs_modulus=2.0e3, viscosity=0.0)

    def path(dt):
        scene = scene_of(integrator, material, dt=dt)
        scene.set(q=scene.q() + cube().affine(np.diag([1.01, 0.99, 1.0])))
        moments = []
        for _ in range(16):
            scene.step(round(0.002 / dt))
            moments.append(scene.q().copy())
        return np.array(moments)

    exact = path(0.03125e-3)
    errors = [np.linalg.norm(path(dt) - exact) for dt in (0.5e-3, 0.25e-3)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.35)


def test_bdf2_keeps_the_energy_of_a_vibration():
    """A cube that vibrates freely: BDF2 loses less than a fifth of what implicit Euler loses."""
    material = Material(youngs_modulus=2.0e3, viscosity=0.0)
    twin = reference.FreeBody(body=cube(), material=material, dt=1.0)
    lost = {}
    for integrator in ("euler", "bdf2"):
        scene = scene_of(integrator, material, dt=1.0e-3)
        scene.set(q=scene.q() + cube().affine(np.diag([1.05, 0.97, 0.97])))
        start = twin.elastic_energy(scene.q())
        scene.step(100)
        lost[integrator] = 1.0 - (scene.kinetic_energy() + twin.elastic_energy(scene.q())) / start
    assert 0.0 < lost["bdf2"] < 0.2 * lost["euler"]


def test_bdf2_worlds_reset_on_their_own():
    """After a reset a world starts with an Euler step again: it repeats its first run to the bit."""
    scene = scene_of("bdf2", STIFF, dt=0.01, spin=(1.0, 2.0, 3.0), world_count=2)
    scene.step(3)
    first = scene.q(1)
    scene.solver.reset(scene.state)
    scene.step(3)
    np.testing.assert_array_equal(scene.q(1), first)


def test_bdf2_does_not_bounce():
    """A cube dropped on the ground: a body in contact takes Euler steps, so BDF2 rebounds no higher than Euler."""
    heights = {}
    for integrator in ("euler", "bdf2"):
        options = SolverReducedOptions(integrator=integrator)
        material = Material(youngs_modulus=1.0e6, viscosity=0.0)
        scene = Scene(
            lambda world, material=material: add_reduced_body(world, cube(), material=material, position=(0, 0, 0.25)),
            [cube()],
            gravity=(0.0, 0.0, -9.81),
            ground=0.5,
            options=options,
            dt=1.0 / 60.0,
        )
        scene.step(20)
        heights[integrator] = []
        for _ in range(40):
            scene.step()
            heights[integrator].append(scene.centre()[2])
    assert max(heights["bdf2"]) <= max(heights["euler"]) + 0.01


def test_unknown_integrator():
    """Any other name is refused."""
    with pytest.raises(ConfigError, match="integrator"):
        SolverReducedOptions(integrator="rk4")  # type: ignore[arg-type]
