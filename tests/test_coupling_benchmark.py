"""The coupling benchmark's own parts: its energies and penetrations, and a tiny case of every column."""

import numpy as np
import pytest

from benchmarks.coupling import GRASPS, describe, gripper_world, impact, lift, random_grasps, show_impact, squeeze
from benchmarks.coupling_schemes import SCHEMES, Coupled
from softmode.deformables.materials.material import Material
from tests.scenes import GRAVITY

COLUMNS = [pytest.param(s, marks=pytest.mark.slow) if s.startswith("VBD") else s for s in SCHEMES]


@pytest.mark.parametrize("scheme", COLUMNS)
def test_column(scheme):
    """An impact of equal masses: the bodies touch and nothing diverges.

    The joint solve keeps momentum to 1e-5 and never gains energy: the table's first targets.
    """
    error, gain = impact(scheme, 1.0)
    assert np.isfinite([error, gain]).all()
    if scheme == "joint":
        assert error <= 1e-5
        assert gain <= 1e-4


@pytest.mark.parametrize("scheme", COLUMNS)
def test_squeeze_at_small_stiffness(scheme):
    """On a soft cube at 4 ms every scheme presses with what the drive gives, within 5 %."""
    ratio, _ = squeeze(scheme, 5.0e4, 0.004)
    assert ratio == pytest.approx(1.0, abs=0.05)


def test_lift_tells_held_from_dropped():
    """With friction the joint solve holds the cube; with almost none the same measure says that it stays behind."""
    worlds = [gripper_world(Material(friction=friction), slot=0.015) for friction in (0.8, 0.01)]
    held, depth = lift("joint", worlds)
    assert held.tolist() == [True, False]
    assert 0.0 < depth.max() < 2e-3


def test_grasps_are_reproducible():
    """The same grasps are drawn every time, within their ranges, and reported with their parameters."""
    first, second = random_grasps(GRASPS), random_grasps(GRASPS)
    assert [w.soft for w in first] == [w.soft for w in second]
    modulus = np.array([w.soft.material.youngs_modulus for w in first])
    assert modulus.min() >= 5e4 and modulus.max() <= 5e6
    assert "yaw" in describe(first[0])
    assert show_impact(float("nan"), 0.0) == "diverged"


@pytest.mark.slow
def test_tetrahedral_energy_is_quadratic_about_rest():
    """The tetrahedra at rest have no energy; stretched uniaxially by e, E e^2 / 2 per volume to first order."""
    material = Material(youngs_modulus=1.0e5, poissons_ratio=0.3)
    run = Coupled("VBD x1", [gripper_world(material)], dt=0.004, gravity=GRAVITY)
    x = run.state.particle_q.numpy().copy()
    volume = (np.ptp(x, axis=0)).prod()
    assert abs(run._tetrahedral_energy()) < 1e-6 * 1e5 * volume
    strain, centre = 0.01, x.mean(axis=0)
    stretch = np.array([1.0 + strain, 1.0 - 0.3 * strain, 1.0 - 0.3 * strain])
    run.state.particle_q.assign((centre + (x - centre) * stretch).astype(np.float32))
    # VBD's first Lame parameter is the one given, and mu (Ic - 3) / 2 adds mu to its tangent
    assert run._tetrahedral_energy() == pytest.approx(0.5 * 1.0e5 * strain**2 * volume, rel=0.1)
