"""Derivatives of a run against differences, by everything that it depends on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from softmode.deformables import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.errors import ConfigError
from softmode.mpm import MassLoss, MpmOptions, MpmSimulation, PlaceLoss, position_loss
from softmode.mpm.places import transported
from tests.mpm.scenes import ball, moving, torus

PARAMETERS = ("control", "mass", "mu", "lam", "yield_stress")


def loss_of(s: MpmSimulation, loss: MassLoss) -> float:
    """Step and return the loss of the masses at the end."""
    value = wp.zeros(1, dtype=wp.float64, device="cpu")
    s.forward()
    loss.after(s, value)
    return float(value.numpy()[0])


def gradient_of(s: MpmSimulation, loss: MassLoss) -> dict[str, np.ndarray]:
    """Return all derivatives of the loss after :func:`loss_of`."""
    first, parameters = loss.gradient(s)
    found = {name: getattr(first, name).numpy() for name in ("x", "v", "C", "F")}
    return found | {name: getattr(parameters, name).numpy().copy() for name in PARAMETERS}


def require_derivatives(s: MpmSimulation, loss: MassLoss) -> None:
    """Assert that along a random direction of every input central differences agree with the gradient to 2e-5."""
    loss_of(s, loss)
    found = gradient_of(s, loss)
    rng = np.random.default_rng(2)
    arrays = {name: getattr(s.first, name) for name in ("x", "v", "C", "F")}
    arrays |= {name: getattr(s, name) for name in PARAMETERS if name != "yield_stress" or s.yield_stress.numpy().any()}
    for name, array in arrays.items():
        value = array.numpy().copy()
        size = {"x": 1e-5, "mass": 1e-4, "mu": 1.0, "lam": 1.0, "yield_stress": 0.1}.get(name, 1e-5)
        along = rng.standard_normal(value.shape)
        array.assign(value + size * along)
        above = loss_of(s, loss)
        array.assign(value - size * along)
        below = loss_of(s, loss)
        array.assign(value)
        expected = float((found[name] * along).sum())
        assert (above - below) / (2.0 * size) == pytest.approx(expected, rel=2e-5, abs=1e-9 * abs(above)), name


@pytest.mark.parametrize("model", list(MaterialModel), ids=lambda m: m.name)
@pytest.mark.parametrize(("control", "smoothing"), [("additive", 0.955), ("material", 0.0)])
def test_gradient_against_differences(model: MaterialModel, control: str, smoothing: float) -> None:
    """Along a random direction of every input, central differences agree to 2e-5 in float64."""
    material = Material(youngs_modulus=1.4e5, poissons_ratio=0.2, density=75.0, model=model)
    options = MpmOptions(
        precision="float64", control=control, smoothing=smoothing, damping=0.5, gravity=(0.0, 0.0, -2.0)
    )
    s = moving(ball(2.2, material=material), options, step_count=6, layer_count=2)
    loss = MassLoss(options.grid, torus(2.5, 1.2), dtype=wp.float64, device="cpu")
    require_derivatives(s, loss)


@pytest.mark.parametrize("model", [MaterialModel.NEO_HOOKEAN, MaterialModel.COROTATED], ids=lambda m: m.name)
def test_gradient_through_the_return_to_the_yield_surface(model: MaterialModel) -> None:
    """Most particles flow in every step: derivatives, by the yield stress too, are those of differences."""
    material = Material(youngs_modulus=1.4e5, poissons_ratio=0.2, density=75.0, model=model)
    options = MpmOptions(precision="float64", control="additive", smoothing=0.5, damping=0.5)
    body = replace(ball(2.2, material=material), yield_stress=6000.0)
    s = moving(body, options, step_count=6, layer_count=2)
    require_derivatives(s, MassLoss(options.grid, torus(2.5, 1.2), dtype=wp.float64, device="cpu"))
    by_yield = gradient_of(s, MassLoss(options.grid, torus(2.5, 1.2), dtype=wp.float64, device="cpu"))["yield_stress"]
    assert 0.5 < np.count_nonzero(by_yield) / s.count


def test_float32_gradient() -> None:
    """In float32 the gradient by the controls is that of float64 to 5e-3."""
    found = {}
    for precision, dtype in (("float32", wp.float32), ("float64", wp.float64)):
        options = MpmOptions(precision=precision, control="additive", smoothing=0.955)
        s = moving(ball(2.5), options)
        loss = MassLoss(options.grid, torus(3.0, 1.2), dtype=dtype, device="cpu")
        loss_of(s, loss)
        found[precision] = gradient_of(s, loss)["control"].astype(np.float64)
    error = np.linalg.norm(found["float32"] - found["float64"])
    assert error < 5e-3 * np.linalg.norm(found["float64"])


def test_gradients_by_control_and_by_deformation_differ_by_smoothing() -> None:
    """With additive control dL/dF = dL/dA + gamma dL/dF' over one step: they are not equal, against the paper."""
    gamma = 0.955
    options = MpmOptions(precision="float64", control="additive", smoothing=gamma)
    s = moving(ball(2.2), options, step_count=1)
    s.forward()
    bar, parameters = s.bars()
    bar.zero()
    parameters.mass.zero_()
    rng = np.random.default_rng(3)
    asked = rng.standard_normal((1, s.count, 3, 3))
    bar.F.assign(asked)
    first, parameters = s.backward()
    by_control, by_F = parameters.control.numpy()[0], first.F.numpy()
    assert np.abs(by_F - by_control - gamma * asked).max() < 1e-12 * np.abs(by_F).max()
    assert np.linalg.norm(by_F - by_control) > 0.1 * np.linalg.norm(by_F)


def test_checkpoints_give_the_same_bits() -> None:
    """A run that keeps every sqrt(T)-th state, or all grids, has the gradient of one that keeps all states."""
    target = torus(3.0, 1.2)
    found = []
    for limit, keep_grids in ((2.0e9, False), (4.5e6, False), (2.0e9, True)):
        options = MpmOptions(control="additive", smoothing=0.5, memory_limit=limit)
        s = moving(ball(2.5), options, step_count=90, layer_count=9, keep_grids=keep_grids)
        loss = MassLoss(options.grid, target, device="cpu")
        found.append((loss_of(s, loss), gradient_of(s, loss), s.last.x.numpy().copy()))
    for other in found[1:]:
        assert found[0][0] == other[0]
        for name, value in found[0][1].items():
            assert np.array_equal(value, other[1][name]), name


def test_no_loss_and_no_gradient_at_the_target() -> None:
    """A body that is its own target has loss 0, and a gradient of exactly 0."""
    body = ball(2.5)
    s = MpmSimulation(body, MpmOptions(), device="cpu")
    loss = MassLoss(s.options.grid, body, device="cpu")
    assert loss_of(s, loss) == 0.0
    assert all(not value.any() for name, value in gradient_of(s, loss).items())


@pytest.mark.parametrize("kind", ["log", "squared"])
def test_mass_loss_of_points(kind: str) -> None:
    """Derivatives of a loss by positions and masses of any points are those of differences."""
    body, options = ball(2.0), MpmOptions()
    loss = MassLoss(options.grid, torus(2.5, 1.0), kind=kind, mass_scale=2.0, dtype=wp.float64, device="cpu")
    x, m = body.positions + 0.03, body.masses
    value, by_x, by_m = loss.value_and_gradient(x, m)
    rng = np.random.default_rng(4)
    dx, dm = rng.standard_normal(x.shape), rng.standard_normal(m.shape)
    ends = [loss.value_and_gradient(x + e * dx, m + e * dm)[0] for e in (1e-5, -1e-5)]
    assert (ends[0] - ends[1]) / 2e-5 == pytest.approx((by_x * dx).sum() + by_m @ dm, rel=1e-6)
    assert value > 0.0


@pytest.mark.parametrize("kind", ["log", "squared"])
def test_mass_loss_by_the_target(kind: str) -> None:
    """Derivatives of a loss by positions and masses of the target's particles are those of differences."""
    body, target, options = ball(2.0), torus(2.5, 1.0), MpmOptions()
    loss = MassLoss(options.grid, target, kind=kind, mass_scale=2.0, dtype=wp.float64, device="cpu")
    by_x, by_m = loss.target_gradient(body.positions + 0.03, body.masses)
    rng = np.random.default_rng(5)
    dx, dm = rng.standard_normal(target.positions.shape), rng.standard_normal(target.count)
    ends = []
    for e in (1e-5, -1e-5):
        loss.aim(replace(target, positions=target.positions + e * dx, masses=target.masses + e * dm))
        ends.append(loss.value_and_gradient(body.positions + 0.03, body.masses)[0])
    assert (ends[0] - ends[1]) / 2e-5 == pytest.approx((by_x * dx).sum() + by_m @ dm, rel=1e-6)


def test_places_are_added() -> None:
    """The gradient of the sum is that of differences; weights of 0 leave the loss of masses to the bit."""
    options = MpmOptions(precision="float64")
    s, target = moving(ball(2.2), options, step_count=3), torus(2.5, 1.2)
    fine, places = MassLoss(options.grid, target, dtype=wp.float64, device="cpu"), PlaceLoss(s)
    value = wp.zeros(1, dtype=wp.float64, device="cpu")

    def evaluate() -> float:
        s.forward()
        fine.after(s, value)
        places.add(value)
        return float(value.numpy()[0])

    rng = np.random.default_rng(6)
    places.place(options.grid, target)
    places.aim(s.first.x.numpy() + rng.standard_normal((1, s.count, 3)))
    values = []
    for weights in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)):
        places.weigh(*weights)
        values.append(evaluate())
    assert values[0] == loss_of(s, fine)
    assert values[0] < min(values[1:3])
    assert values[1] + values[2] - values[0] == pytest.approx(values[3], rel=1e-12)
    evaluate()
    first, parameters = fine.gradient(s, places)
    bars = {"x": first.x.numpy().copy(), "mass": parameters.mass.numpy().copy()}
    for name, array in (("x", s.first.x), ("mass", s.mass)):
        start, along = array.numpy().copy(), rng.standard_normal(array.numpy().shape)
        ends = []
        for sign in (1.0, -1.0):
            array.assign(start + sign * 1e-5 * along)
            ends.append(evaluate())
        array.assign(start)
        assert (ends[0] - ends[1]) / 2e-5 == pytest.approx((bars[name] * along).sum(), rel=1e-5), name


def test_places_of_transport() -> None:
    """A ball that is carried to one elsewhere keeps its shape; masses may differ."""
    grid = MpmOptions().grid
    here, there = ball(2.2), ball(2.2).moved(np.array([4.0, -3.0, 2.0]))
    masses = []
    for body, factor in ((here, 1.0), (there, 2.0)):
        loss = MassLoss(grid, replace(body, masses=factor * body.masses), dtype=wp.float64, device="cpu")
        masses.append(loss.target_mass.numpy()[0])
    found = transported(here.positions, *masses, grid)
    assert np.abs(found - there.positions).max() < 0.5
    assert found.mean(axis=0) == pytest.approx(there.positions.mean(axis=0), abs=1e-3)


def test_symmetric_loss() -> None:
    """L(A, B) = L(B, A) at equal density."""
    grid = MpmOptions().grid
    a, b = ball(2.5), torus(3.0, 1.2)
    values = [
        MassLoss(grid, goal, dtype=wp.float64, device="cpu").value_and_gradient(body.positions, body.masses)[0]
        for body, goal in ((a, b), (b, a))
    ]
    assert values[0] == pytest.approx(values[1], rel=1e-12)


def test_position_loss() -> None:
    """1/2 sum |x - x*|^2 and x - x*."""
    rng = np.random.default_rng(5)
    x, goal = rng.standard_normal((2, 1, 7, 3))
    arrays = [wp.array(a, dtype=wp.vec3d, device="cpu") for a in (x, goal)]
    mass = wp.array(np.ones((1, 7)), dtype=wp.float64, device="cpu")
    loss, bar = wp.zeros(1, dtype=wp.float64, device="cpu"), wp.zeros((1, 7), dtype=wp.vec3d, device="cpu")
    position_loss(arrays[0], mass, arrays[1], loss, bar)
    assert loss.numpy()[0] == pytest.approx(0.5 * ((x - goal) ** 2).sum())
    assert np.allclose(bar.numpy(), x - goal)


def test_bad_losses() -> None:
    """Targets outside of the grid and scales out of range are named."""
    grid = MpmOptions().grid
    with pytest.raises(ConfigError, match="target"):
        MassLoss(grid, ball(2.0).moved((15.0, 0.0, 0.0)), device="cpu")
    with pytest.raises(ConfigError, match="mass_scale"):
        MassLoss(grid, ball(2.0), mass_scale=0.0, device="cpu")
    with pytest.raises(ConfigError, match="masses"):
        MassLoss(grid, ball(2.0), device="cpu").value_and_gradient(np.zeros((3, 3)), np.ones(2))
    assert replace(MpmOptions(), control="additive").control == "additive"
