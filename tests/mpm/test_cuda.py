"""Particles on a GPU: steps, gradients and morphs agree with the CPU, and captured steps with eager ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from softmode.mpm import MassLoss, MorphOptions, MpmOptions, MpmSimulation, morph
from tests.mpm.scenes import ball, torus

OPTIONS = MpmOptions(precision="float64", control="additive", smoothing=0.5, damping=0.5)


def started(device: str) -> MpmSimulation:
    """Return a ball that yields, with random velocities and controls, on a device."""
    body, rng = replace(ball(2.5), yield_stress=6000.0), np.random.default_rng(0)
    found = MpmSimulation(body, OPTIONS, step_count=10, device=device)
    found.start(v=rng.standard_normal((1, body.count, 3)))
    found.control.assign(0.02 * rng.standard_normal((*found.control.shape, 3, 3)))
    return found


def run(device: str) -> dict[str, np.ndarray]:
    """Return the state after ten steps, the loss and its gradient."""
    s = started(device)
    loss = MassLoss(OPTIONS.grid, torus(3.0, 1.2), dtype=wp.float64, device=device)
    value = wp.zeros(1, dtype=wp.float64, device=device)
    s.forward()
    loss.after(s, value)
    _, bars = loss.gradient(s)
    found = {"x": s.last.x, "F": s.last.F, "loss": value, "control": bars.control, "yield stress": bars.yield_stress}
    return {name: array.numpy() for name, array in found.items()}


@pytest.mark.gpu
def test_cuda_agrees() -> None:
    """Ten steps in float64, the loss after them and its gradient are those of the CPU: sums in another order, 1e-9."""
    expected, found = run("cpu"), run("cuda:0")
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=0.0, atol=1e-9 * np.abs(value).max(), err_msg=name)


@pytest.mark.gpu
def test_captured_equals_eager_on_cuda() -> None:
    """Steps replayed from a graph are those launched one by one, but for the order of atomic sums, 1e-12."""
    eager, recorded = started("cuda:0"), started("cuda:0")
    eager.forward()
    recorded.forward()  # Kernels are compiled before the capture.
    with wp.ScopedCapture(device="cuda:0") as capture:
        recorded.forward()
    recorded.last.x.zero_()
    wp.capture_launch(capture.graph)
    np.testing.assert_allclose(recorded.last.x.numpy(), eager.last.x.numpy(), rtol=0.0, atol=1e-12 * 32.0)


def test_captured_equals_eager() -> None:
    """On a CPU steps recorded in a graph and replayed give the bits of those launched one by one."""
    eager, recorded = started("cpu"), started("cpu")
    eager.forward()
    recorded.forward()
    with wp.ScopedCapture(device="cpu") as capture:
        recorded.forward()
    recorded.last.x.zero_()
    wp.capture_launch(capture.graph)
    assert np.array_equal(recorded.last.x.numpy(), eager.last.x.numpy())


@pytest.mark.gpu
def test_a_morph_on_cuda_reaches_what_the_cpu_reaches() -> None:
    """Line searches part after rounding; the loss that is left differs by less than a twentieth."""
    options = MorphOptions(frame_count=60)
    left = [morph(ball(6.93, 1.0), torus(7.0, 3.2, 1.0), options, device=device).losses for device in ("cpu", "cuda:0")]
    assert (np.diff(left[1][:6]) < 0.0).all()
    assert abs(left[1][-1] / left[0][-1] - 1.0) < 0.05
