"""The oracle itself: derivatives, patch test, closed forms, an independent code, convergence in mesh size and time."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import brentq
from threadpoolctl import threadpool_limits

from tests.oracle import fem, frames
from tests.oracle.scenes import BEND, L_SHAPE, SCENES, SPIN, TAPER, Box, Clamp, Motion, Shape

E, NU = 5.0e6, 0.45
ENERGIES = ("stable_neo_hookean", "stable_neo_hookean_log")
CUBE = Shape(boxes=(Box(lower=(0.0, 0.0, 0.0), upper=(1.0, 1.0, 1.0)),))


@pytest.fixture(autouse=True)
def one_thread():
    """Small matrices: threads of BLAS only wait for each other."""
    with threadpool_limits(limits=1):
        yield


def solid(shape=CUBE, cell=0.5, energy="stable_neo_hookean", nu=NU, modulus=E):
    """Return a homogeneous solid."""
    mesh = fem.Mesh(*shape.cells(cell), shape.to_rest, shape.to_reference)
    return fem.Solid(mesh, energy=energy, youngs_modulus=modulus, poissons_ratio=nu)


@pytest.mark.parametrize("energy", [*ENERGIES, "damped"])
def test_energy_derivatives(energy):
    """Stress and Hessian are the central differences of the energy and the stress, J from -1 to 3."""
    rng = np.random.default_rng(0)
    F = np.eye(3) + 0.6 * rng.normal(size=(200, 3, 3))
    if energy == "damped":
        before = fem.strain(F[::-1])
        material = fem.Damped(fem.Energy.make(ENERGIES[1], 1.0, NU), np.full(200, 0.3), np.full(200, 0.7), before)
    else:
        material = fem.Energy.make(energy, 1.0, NU)
    h = 1e-5
    P, H = material.stress(F).reshape(-1, 9), material.hessian(F)
    for k in range(9):
        d = np.zeros((3, 3))
        d.flat[k] = h
        slope = (material.value(F + d) - material.value(F - d)) / (2 * h)
        np.testing.assert_allclose(slope, P[:, k], atol=1e-8 * np.abs(P).max())
        curve = (material.stress(F + d) - material.stress(F - d)).reshape(-1, 9) / (2 * h)
        np.testing.assert_allclose(curve, H[:, k], atol=1e-8 * np.abs(H).max())


@pytest.mark.parametrize("energy", ENERGIES)
def test_small_strains_obey_hooke(energy):
    """At F = I the stress vanishes and the Hessian is mu (I + K) + lambda I x I."""
    mu, lam = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
    material = fem.Energy.make(energy, E, NU)
    eye = np.eye(3)
    hooke = mu * (np.einsum("ij,kl->ikjl", eye, eye) + np.einsum("il,kj->ikjl", eye, eye))
    hooke += lam * np.einsum("ik,jl->ikjl", eye, eye)
    np.testing.assert_allclose(material.stress(eye[None]), 0.0, atol=1e-12 * E)
    np.testing.assert_allclose(material.hessian(eye[None])[0], hooke.reshape(9, 9), atol=1e-12 * lam)


def test_assembly_derivatives():
    """Nodal forces and the tangent are the central differences of the potential, on a distorted and a tapered mesh."""
    rng = np.random.default_rng(1)
    body = solid(Shape(boxes=CUBE.boxes, taper=(1.0, 0.6)), cell=1.0, energy="stable_neo_hookean_log")
    x = body.mesh.nodes + 0.05 * rng.normal(size=body.mesh.nodes.shape)
    force, K = body.force(x), body.tangent(x)[0]
    order = body.mesh.elements[0]
    for a, c in ((0, 0), (13, 1), (26, 2)):
        d = np.zeros_like(x)
        d[order[a], c] = h = 1e-6
        assert (body.potential(x + d) - body.potential(x - d)) / (2 * h) == pytest.approx(force[order[a], c], rel=1e-6)
        column = ((body.force(x + d) - body.force(x - d)) / (2 * h))[order].ravel()
        np.testing.assert_allclose(K[:, 3 * a + c], column, atol=1e-7 * np.abs(K).max())


@pytest.mark.parametrize("energy", ENERGIES)
def test_patch_and_free_sides(energy):
    """A cube between frictionless plates deforms homogeneously; its sides are free of stress: P_lateral(t) = 0."""
    body, stretch = solid(energy=energy), 0.6
    x = body.mesh.nodes
    material = fem.Energy.make(energy, E, NU)
    t = brentq(lambda t: material.stress(np.diag([t, t, stretch])[None])[0, 0, 0], 0.8, 2.0)
    exact = x * [t, t, stretch]
    # Plates hold z only; the mesh holds whole nodes, so the whole surface is prescribed and the inside must follow.
    held = ((x < 1e-9) | (x > 1 - 1e-9)).any(axis=1)
    found = fem.static(body, held=held, target=exact)
    np.testing.assert_allclose(found, exact, atol=1e-9)
    reaction = body.force(found)
    side = (x[:, 0] > 1 - 1e-9) & (x[:, 1] > 0.1) & (x[:, 1] < 0.9) & (x[:, 2] > 0.1) & (x[:, 2] < 0.9)
    np.testing.assert_allclose(reaction[side], 0.0, atol=1e-6 * np.abs(reaction).max())


def test_bandwidth_and_sparse_paths_agree(monkeypatch):
    """The banded Cholesky and the sparse LU solve the same system."""
    scene = dataclasses.replace(L_SHAPE, cell=0.5, steps=2)
    banded = fem.simulate(scene)[1]
    monkeypatch.setattr(fem, "BAND_LIMIT", 0)
    np.testing.assert_allclose(fem.simulate(scene)[1], banded, atol=1e-10)


def test_interpolation_reproduces_quadratics_on_a_tapered_mesh():
    """Triquadratic elements carry any quadratic of the reference coordinates, at any point."""
    mesh = fem.Mesh.of(TAPER, 0.5)
    rng = np.random.default_rng(2)
    reference = rng.uniform([-2.5, -0.5, -0.5], [2.5, 0.5, 0.5], size=(50, 3))

    def field(x):
        return x[:, 0] ** 2 - 0.3 * x[:, 0] * x[:, 1] + x[:, 2] ** 2 + 2.0 * x[:, 1] - 1.0

    found = mesh.interpolation(TAPER.shape.to_rest(reference)) @ field(mesh.reference_nodes)
    np.testing.assert_allclose(found, field(reference), atol=1e-12)
    assert mesh.weights.sum() == pytest.approx(TAPER.shape.volume, rel=1e-12)


def test_against_scikit_fem():
    """The linear displacement of the clamped beam's corner agrees with scikit-fem's on the same mesh to 1e-5.

    The load is so small (a sag of 1e-7 m) that nonlinearity is below that.
    """
    skfem = pytest.importorskip("skfem", reason="pip install scikit-fem")
    from skfem.helpers import ddot, sym_grad, trace

    body = solid(BEND.shape, cell=0.5)
    x, load = body.mesh.nodes, 1e-6  # so little gravity that the answer is linear to 1e-6 of itself
    held = BEND.clamps[0].region.contains(x)
    found = fem.static(body, held=held, target=x, force=body.body_force([0.0, 0.0, -load]), tolerance=1e-14) - x

    lines, _ = BEND.shape.cells(0.5)
    mesh = skfem.MeshHex.init_tensor(*lines)
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementHex2()), intorder=5)
    mu, lam = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))

    @skfem.BilinearForm
    def stiffness(u, v, w):
        return 2 * mu * ddot(sym_grad(u), sym_grad(v)) + lam * trace(sym_grad(u)) * trace(sym_grad(v))

    @skfem.LinearForm
    def weight(v, w):
        return -1000.0 * load * v[2]

    fixed = np.flatnonzero(basis.doflocs[0] <= -2.0 + 1e-9)
    u = skfem.solve(*skfem.condense(stiffness.assemble(basis), weight.assemble(basis), D=fixed))
    tip = np.abs(basis.doflocs - np.array([[2.5], [0.5], [0.5]])).max(axis=0) < 1e-9
    expected = sorted(u[tip], key=abs)
    ours = sorted(found[np.abs(x - [2.5, 0.5, 0.5]).max(axis=1) < 1e-9][0], key=abs)
    np.testing.assert_allclose(ours, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def test_convergence_in_mesh_size():
    """The gradient of a harmonic function solves Navier's equations: its error inside falls with h^3 at least.

    Prescribed on the surface, small enough (1e-4) to be linear.
    """

    def exact(x):
        k = 3.0
        wave = 1e-4 * np.exp(k * (x[:, 0] - 1.0))
        return np.stack([wave * np.sin(k * x[:, 1]), wave * np.cos(k * x[:, 1]), 0.0 * wave], axis=1)

    points = np.random.default_rng(3).uniform(size=(500, 3))
    errors = []
    for cell in (0.5, 0.25):
        body = solid(cell=cell)
        x = body.mesh.nodes
        held = ((x < 1e-9) | (x > 1 - 1e-9)).any(axis=1)
        found = fem.static(body, held=held, target=x + exact(x)) - x
        errors.append(np.linalg.norm(body.mesh.interpolation(points) @ found - exact(points)))
    assert errors[1] < errors[0] / 2**2.8  # h^3, up to a fifth of an order before the limit
    assert errors[1] < 1e-2 * np.linalg.norm(exact(points))


def test_free_motion_keeps_momentum():
    """Without clamps and gravity the linear momentum of implicit Euler stays, and the centre does not move."""
    scene = dataclasses.replace(SPIN, steps=10)
    body, u = fem.simulate(scene, cell=1.0)
    mass = body.mass @ np.ones(len(body.mesh.nodes))
    centre = np.einsum("n,tni->ti", mass, u + body.mesh.nodes) / mass.sum()
    np.testing.assert_allclose(centre, 0.0, atol=1e-9)


@pytest.mark.parametrize(("bdf2", "order"), [(False, 1), (True, 2)])
def test_order_in_time(bdf2, order):
    """The error at t = 0.08 s falls with dt^order: successive differences shrink by 2^order, within a third."""
    scene = dataclasses.replace(SPIN, dt=0.04, steps=2, youngs_modulus=1.0e5)
    ends = [fem.simulate(scene, cell=2.5, substeps=n, bdf2=bdf2)[1][-1] for n in (32, 64, 128)]
    ratio = np.linalg.norm(ends[1] - ends[0]) / np.linalg.norm(ends[2] - ends[1])
    assert abs(ratio / 2**order - 1.0) < 1.0 / 3.0


def test_soft_clamp_tends_to_the_exact_one():
    """Displacements with a penalty clamp approach those of the exact clamp as 1/kappa."""
    scene = dataclasses.replace(BEND, steps=4)
    exact = fem.simulate(scene, cell=1.0)[1][-1]
    gap = [np.linalg.norm(fem.simulate(scene.with_clamp(k), cell=1.0)[1][-1] - exact) for k in (1e11, 1e12)]
    assert 5.0 < gap[0] / gap[1] < 12.0


def test_clamps_move_as_told():
    """Held nodes are exactly where the motion puts them."""
    turned = Clamp(
        region=L_SHAPE.clamps[0].region, motion=Motion(axis=(0.0, 0.0, 1.0), rate=1.0, velocity=(0.1, 0.0, 0.0))
    )
    scene = dataclasses.replace(L_SHAPE, clamps=(turned, L_SHAPE.clamps[1]), steps=3)
    body, u = fem.simulate(scene, cell=0.5)
    for clamp in scene.clamps:
        mine = fem.node_mask(body.mesh, clamp.region)
        expected = clamp.motion.position(body.mesh.nodes[mine], 3 * scene.dt)
        np.testing.assert_allclose((u[-1] + body.mesh.nodes)[mine], expected, atol=1e-12)


def test_frames_survive_storage(tmp_path, monkeypatch):
    """What is read back differs from what was stored by the error stated, and that is below 3e-6 of the length."""
    scene = dataclasses.replace(SPIN, steps=10, cell=1.0)
    body, u = fem.simulate(scene)
    path, error, _ = frames.save(scene, u, tmp_path)
    monkeypatch.setattr(frames, "FOLDER", tmp_path)
    monkeypatch.setitem(SCENES, "spin", scene)
    stored = frames.load.__wrapped__("spin")
    difference = stored.displacement(body.mesh.nodes) - u
    assert np.sqrt((difference**2).sum(axis=2).mean()) == pytest.approx(error, rel=1e-3)
    assert path.exists() and error < 3e-6 * scene.edge


@pytest.mark.parametrize("name", list(SCENES))
def test_stored_frames_start_as_the_scene_says(name):
    """Every scene has frames; the first one is the scene's initial state, and clamped points follow their motion."""
    stored = frames.load(name)
    scene, mesh = stored.scene, stored.mesh
    slack = 1e-5 * scene.edge
    start = scene.initial_position(mesh.nodes) - mesh.nodes
    np.testing.assert_allclose(stored.nodal(0), start, atol=slack)
    for clamp in scene.clamps:
        if clamp.stiffness is None:
            mine = fem.node_mask(mesh, clamp.region)
            expected = clamp.motion.position(mesh.nodes[mine], stored.times[-1]) - mesh.nodes[mine]
            np.testing.assert_allclose(stored.nodal(scene.steps)[mine], expected, atol=slack)
