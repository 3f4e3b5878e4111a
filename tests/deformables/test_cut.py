"""Cuts: parts that conserve mass and momentum, fall, store no energy, slits that open, what is refused.

Builds bodies that are cut, with the sources that a cut needs.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import newton
import numpy as np
import pytest
from numpy.typing import NDArray

from softmode.deformables import (
    BuildOptions,
    Material,
    Patch,
    ReducedBody,
    Region,
    SoftEnergies,
    SolverReduced,
    SolverReducedOptions,
    add_pins,
    add_reduced_body,
    build_body,
    carry_over,
    cut_body,
    hold,
    quadrature_from_box,
    quadrature_from_mesh,
)
from softmode.deformables.reduction import basis
from softmode.deformables.reduction.kernel_visibility import lips_of
from softmode.deformables.reduction.local_handles import gather_at_lips
from softmode.deformables.reduction.reduced_stiffness import reduced_stiffness
from softmode.deformables.reduction.sources import mass_points, unpack_sources
from softmode.errors import ConfigError
from tests.shapes import voxels

SIZE = (0.2, 0.05, 0.05)
OPTIONS = BuildOptions(function_count=24, cubature_count=128)
MIDDLE = Patch.plane((0.013, 0.0, 0.0), (1.0, 0.3, -0.1))
LENGTHWISE = Patch.plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
SLIT = Patch.stroke((0.0, 0.0, -1.0), (0.02, 0.0, 0.0), (0.4, 0.0, 0.0))
"""Half way along the bar, in the plane y = 0."""
MATERIAL = Material(youngs_modulus=5e4, density=500.0)


@pytest.fixture(scope="module")
def bar() -> ReducedBody:
    """A bar along x."""
    quadrature = quadrature_from_box(SIZE, point_count=2000, surface_count=300)
    return build_body(quadrature, OPTIONS, name="bar", progress=False)


@pytest.fixture(scope="module")
def halves(bar: ReducedBody) -> tuple[ReducedBody, ...]:
    """The bar in two parts, the cut oblique."""
    return cut_body(bar, MIDDLE).bodies


def motion(body: ReducedBody, size: float = 0.01) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return coordinates and velocities of a body that is bent, stretched and moving."""
    rng = np.random.default_rng(3)
    fade = 1.0 / (1.0 + np.arange(body.function_count))[:, None]
    q = body.affine(np.diag([1.3, 0.9, 0.9])) + size * fade * rng.normal(size=(body.function_count, 3))
    return q, fade * rng.normal(size=q.shape) + body.affine(np.eye(3), (0.3, -0.2, 0.5))


def spin(body: ReducedBody, q: NDArray, qd: NDArray) -> NDArray[np.float64]:
    """Return the angular momentum about the origin of asset coordinates over the density, by the build's points."""
    X, mass = mass_points(body)
    value = body.evaluate(X)[0]
    return (mass[:, None] * np.cross(X + value @ q, value @ qd)).sum(axis=0)


def test_mass_and_momentum_are_conserved(bar: ReducedBody, halves: tuple[ReducedBody, ...]) -> None:
    """Volumes add up to 1e-12, momentum and angular momentum to 1e-9, kinetic energy never grows.

    The volume of the lighter part is that of the geometry within 0.2 %, and so are centre and new area.
    """
    assert len(halves) == 2
    assert abs(sum(part.volume for part in halves) / bar.volume - 1.0) < 1e-12
    np.testing.assert_allclose([part.volume / bar.volume for part in halves], [0.565, 0.435], atol=2e-3)
    centre = sum(part.volume * part.offset for part in halves) / bar.volume
    np.testing.assert_allclose(centre, bar.offset, atol=1e-12)
    added = sum(part.surface.areas.sum() for part in halves) - bar.surface.areas.sum()
    assert added == pytest.approx(2.0 * SIZE[1] * SIZE[2] * np.linalg.norm((1.0, 0.3, -0.1)), rel=0.02)
    q, qd = motion(bar)
    moved = [carry_over(bar, part, q, qd) for part in halves]
    before = bar.volume * bar.mean_basis @ qd
    after = sum(part.volume * part.mean_basis @ rate for part, (_, rate) in zip(halves, moved, strict=True))
    np.testing.assert_allclose(after, before, atol=1e-9 * np.linalg.norm(before))
    turn = sum(spin(part, *state) for part, state in zip(halves, moved, strict=True))
    scale = bar.volume * np.linalg.norm(SIZE) * np.linalg.norm(qd)
    kinetic = sum(part.volume * (rate**2).sum() for part, (_, rate) in zip(halves, moved, strict=True))
    assert 0.9 < kinetic / (bar.volume * (qd**2).sum()) <= 1.0 + 1e-12
    # Of the parts' velocities crossed with the parts' places: exact where the place is affine.
    affine = bar.affine(np.diag([1.3, 0.9, 0.9]), (0.1, 0.2, 0.3))
    moved = [carry_over(bar, part, affine, qd) for part in halves]
    turn = sum(spin(part, *state) for part, state in zip(halves, moved, strict=True))
    np.testing.assert_allclose(turn, spin(bar, affine, qd), atol=1e-9 * scale)


def test_fields_go_with_their_part() -> None:
    """Stiff points stay stiff; mass and momentum of a bar that is heavier at one end, with the densities of the cut."""
    quadrature = quadrature_from_box(SIZE, point_count=1000, surface_count=100)
    fields = {"density_scale": lambda X: 1.0 + 30.0 * (X[:, 0] + 0.1)}
    fields["stiffness_scale"] = lambda X: np.where(X[:, 0] > 0.0, 8.0, 1.0)
    heavy = build_body(quadrature, OPTIONS, **fields, progress=False)
    cut = cut_body(heavy, MIDDLE)
    mass = [density * part.volume for density, part in zip(cut.densities, cut.bodies, strict=True)]
    assert abs(sum(mass) / heavy.volume - 1.0) < 1e-12 and cut.densities[1] < 0.9 < 1.1 < cut.densities[0]
    qd = motion(heavy)[1]
    after = sum(
        m * part.mean_basis @ carry_over(heavy, part, 0.0 * qd, qd)[1] for m, part in zip(mass, cut.bodies, strict=True)
    )
    np.testing.assert_allclose(
        after, heavy.volume * heavy.mean_basis @ qd, atol=1e-9 * heavy.volume * np.linalg.norm(qd)
    )
    for part in cut.bodies:
        stiff = np.where(part.cubature.points[:, 0] + part.offset[0] > 0.0, 8.0, 1.0)
        np.testing.assert_array_equal(part.cubature.stiffness_scale, stiff)


APART = 1.0e-3
"""How far the free half lies from the pinned one [m]: contact begins a little before faces touch."""


def world(parts: tuple[ReducedBody, ...], origin: NDArray[np.float64], pinned: int | None = None) -> Any:
    """Return a model of parts where they were in their body; or one pinned at its far end, the other apart of it."""
    builder = newton.ModelBuilder()
    for number, part in enumerate(parts):
        position = part.offset - origin + np.array([0.0 if pinned in (None, number) else APART, 0.0, 0.0])
        instance = add_reduced_body(builder, part, material=MATERIAL, position=tuple(position.tolist()))
        if number == pinned:
            x = part.surface.points
            end = x[x[:, 0] < x[:, 0].min() + 1e-6]
            add_pins(builder, instance, end, targets=end + position, stiffness=1e3)
    return builder.finalize(device="cpu")


def test_the_free_half_falls(bar: ReducedBody, halves: tuple[ReducedBody, ...]) -> None:
    """Its centre falls by g t (t + dt) / 2 to 1e-6 of that, while the pinned half stays."""
    with pytest.warns(UserWarning, match="built|build"):
        model = world(halves, bar.offset, pinned=0)
        solver = SolverReduced(model, list(halves), options=SolverReducedOptions(tolerance=1e-9))
    state, other, dt, count = model.state(), model.state(), 0.005, 20
    model.set_gravity((0.981, 0.0, 0.0))  # Away from the pins, along the bar: the halves do not rub.
    for _ in range(count):
        solver.step(state, other, model.control(), None, dt)
        state, other = other, state
    q = state.softmode.q.numpy()
    centres = []
    first = 0
    for part in halves:
        centres.append(part.mean_basis @ q[first : first + part.function_count] - part.offset + bar.offset)
        first += part.function_count
    fall = 0.5 * 0.981 * count * dt * (count + 1) * dt
    assert centres[1][0] - APART == pytest.approx(fall, rel=1e-6)
    np.testing.assert_allclose(centres[1][1:], 0.0, atol=1e-6 * fall)
    assert np.abs(centres[0]).max() < 0.2 * fall


def test_a_half_that_was_moved_apart_stores_nothing(bar: ReducedBody, halves: tuple[ReducedBody, ...]) -> None:
    """Turned and moved rigidly before and after the cut, its energy is zero to 1e-12 of E V."""
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    q = bar.affine(turn, (0.1, 0.0, 0.2))
    model = world(halves, bar.offset)
    state = model.state()
    moved = [carry_over(bar, part, q, 0.0 * q)[0] for part in halves]
    moved[1] = moved[1] + halves[1].affine(np.eye(3), (1e-3, 0.0, 0.0))
    state.softmode.q.assign(np.concatenate(moved))
    energies = SoftEnergies(SolverReduced(model, list(halves)))
    energies.update(state)
    assert np.abs(energies.elastic.numpy()).max() < 1e-12 * MATERIAL.youngs_modulus * bar.volume


def test_where_the_body_is(bar: ReducedBody) -> None:
    """A plane in the world cuts a turned and bent body there: at that place, and nowhere else."""
    q = motion(bar, 0.004)[0]
    point, normal = bar.mean_basis @ q, np.array([1.0, 0.2, 0.0])
    cut = cut_body(bar, Patch.plane(point, normal), q)
    sides = []
    for part in cut.bodies:
        X = part.surface.points + part.offset - bar.offset
        level = (X + bar.evaluate(X)[0] @ q - point) @ normal
        sides.append(np.sign(np.median(level)))
        assert (sides[-1] * level > -1e-3 * SIZE[0]).all()
    assert sorted(sides) == [-1.0, 1.0]
    X = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3)) * SIZE
    level = (X + bar.evaluate(X)[0] @ q - point) @ normal
    np.testing.assert_array_equal(cut.owners(X), np.where(np.sign(level) == sides[0], 0, 1))


@pytest.mark.rest
def test_two_cuts_in_a_row(bar: ReducedBody, halves: tuple[ReducedBody, ...]) -> None:
    """A part is cut again, across and along; mass and momentum are still those of the bar."""
    cut = cut_body(halves[0], LENGTHWISE)
    assert len(cut.bodies) == 2 and not cut.missed
    parts = (*cut.bodies, halves[1])
    assert abs(sum(part.volume for part in parts) / bar.volume - 1.0) < 1e-12
    q, qd = motion(bar)
    first = carry_over(bar, halves[0], q, qd)
    after = halves[1].volume * halves[1].mean_basis @ carry_over(bar, halves[1], q, qd)[1]
    after = after + sum(part.volume * part.mean_basis @ carry_over(halves[0], part, *first)[1] for part in cut.bodies)
    before = bar.volume * bar.mean_basis @ qd
    np.testing.assert_allclose(after, before, atol=1e-9 * np.linalg.norm(before))


def test_a_slit_opens(bar: ReducedBody) -> None:
    """Pulled apart, the lips of a slit move against each other; uncut, the same places move together.

    A second cut across its root leaves the two prongs as parts of their own, and a whole rest.
    """
    cut = cut_body(bar, SLIT)
    (slit,) = cut.bodies
    assert "slit" in cut.notes[0] and abs(slit.volume / bar.volume - 1.0) < 1e-12
    assert (
        len(slit.flat()["hidden_pairs"]) and slit.surface.areas.sum() > bar.surface.areas.sum() + 2.0 * 0.07 * SIZE[2]
    )
    lips = np.array([[0.095, side * 0.004, 0.0] for side in (-1.0, 1.0)])

    def opening(body: ReducedBody) -> float:
        """Return how far the lips part under forces of their own, statically and linearly [m/N]."""
        n = body.function_count
        stiffness = reduced_stiffness(
            body.cubature.grad_basis.astype(np.float64).transpose(1, 2, 0), body.cubature.weights, 0.3
        )
        rows = body.evaluate(lips - body.offset)[0]
        load = np.zeros(3 * n)
        load[n : 2 * n] = rows[1] - rows[0]
        held = np.linalg.pinv(stiffness, rcond=1e-9, hermitian=True) @ load
        return float(load @ held)

    assert opening(slit) > 20.0 * opening(bar)
    across = cut_body(slit, Patch.plane((0.05, 0.0, 0.0), (1.0, 0.0, 0.0)))
    assert len(across.bodies) == 3
    np.testing.assert_allclose([part.volume / bar.volume for part in across.bodies], [0.75, 0.125, 0.125], atol=0.01)
    assert len(across.bodies[0].flat()["hidden_pairs"]) and not any(
        len(part.flat()["hidden_pairs"]) for part in across.bodies[1:]
    )


@pytest.mark.rest
def test_lips_have_handles_of_their_own(bar: ReducedBody, monkeypatch: pytest.MonkeyPatch) -> None:
    """The space of a slit that someone waits for is nearly as soft as one of 96 eigenmodes, by handles at the lips.

    Far from the tip each of these acts on one lip. The first six frequencies are 0.6 to 4.1 % higher; with so few
    eigenmodes alone the first one is 15 % higher.
    """
    (slit,) = cut_body(bar, SLIT).bodies
    cells = unpack_sources(slit).quadrature.cells
    lips = lips_of(cells) - slit.offset
    weights = slit.reproducing_kernels.evaluate(lips).value @ gather_at_lips(
        slit.reproducing_kernels, lips, basis.LIP_COUNT
    )
    away = lips[:, 0] > 0.08
    upper, lower = weights[away & (lips[:, 1] > 0.0)], weights[away & (lips[:, 1] < 0.0)]
    assert np.minimum(upper.max(axis=0), lower.max(axis=0)).max() < 0.03
    assert min(weights[lips[:, 1] > 0.0].max(axis=1).min(), weights[lips[:, 1] < 0.0].max(axis=1).min()) > 0.05

    def frequencies(body: ReducedBody) -> NDArray[np.float64]:
        return np.sqrt([float(body.provenance[f"space_eigenvalue_0.4_{k}"] or 0.0) for k in range(1, 7)])

    found = frequencies(slit)
    monkeypatch.setattr(basis, "gather_at_lips", lambda kernels, lips, count: np.zeros((kernels.kernel_count, 0)))
    bare = frequencies(cut_body(bar, SLIT).bodies[0])
    monkeypatch.setattr(basis, "QUICK_SLIT_MODES", 96)
    many = frequencies(cut_body(bar, SLIT).bodies[0])
    assert (found / many).max() < 1.05 and (bare / many).max() > 1.1


@pytest.mark.rest
def test_prongs_that_touch_do_not_grow_together() -> None:
    """The prongs of a fork, bent until they overlap and cut both, are parts of their own, and so is the root."""
    mask = np.zeros((5, 2, 8), dtype=bool)
    mask[:, :, :2] = True
    mask[:2] = mask[3:] = True
    quadrature = quadrature_from_mesh(*voxels(mask, (0.01,) * 3), point_count=1000, surface_count=200)
    fork = build_body(quadrature, OPTIONS, name="fork", progress=False)
    middle = fork.bounds.mean(axis=0)

    def close(X: NDArray[np.float64]) -> NDArray[np.float64]:
        """Bend both prongs inwards."""
        bent = np.zeros_like(X)
        bent[:, 0] = -np.sign(X[:, 0] - middle[0]) * 4.0 * np.maximum(X[:, 2] + 0.02, 0.0) ** 2
        return bent

    q = fork.affine(np.eye(3)) + fork.project(close)
    tips = fork.surface.points[:, 2] > fork.bounds[1, 2] - 0.005
    x = (fork.surface.points + fork.surface.basis @ q)[tips, 0]
    left = fork.surface.points[tips, 0] < middle[0]
    assert x[left].max() > x[~left].min()
    cut = cut_body(fork, Patch.plane((0.0, 0.0, middle[2]), (0.0, 0.0, 1.0)), q)
    assert len(cut.bodies) == 3
    volumes = [part.volume / fork.volume for part in cut.bodies[1:]]
    assert volumes[0] == pytest.approx(volumes[1], rel=0.05)


def test_a_patch_that_misses(bar: ReducedBody) -> None:
    """Nothing is built, and the cut says so."""
    cut = cut_body(bar, Patch.plane((1.0, 0.0, 0.0), (1.0, 0.0, 0.0)))
    assert cut.missed and cut.bodies == (bar,) and cut.notes == ("the patch misses 'bar': nothing is cut",)
    assert (cut.owners(bar.surface.points) == 0).all() and np.isinf(cut.levels(bar.cubature.points)[0]).all()


def test_crumbs_are_dropped(bar: ReducedBody) -> None:
    """A corner of fewer than eight points goes, and the cut says with how much of the mass."""
    corner = 0.5 * np.array(SIZE)
    cut = cut_body(bar, Patch.plane(corner - 0.007, (1.0, 1.0, 1.0)))
    assert len(cut.bodies) == 1 and 0.0 < cut.crumbs < 2e-3
    assert cut.bodies[0].volume == pytest.approx(bar.volume * (1.0 - cut.crumbs), rel=1e-9)
    assert "lost a crumb" in cut.notes[0] and f"{cut.crumbs:.2g} of the mass" in cut.notes[1]
    assert cut.owners(corner[None] - 1e-4)[0] == -1


END = Region(name="end", box=((-1.0, -1.0, -1.0), (-0.08, 1.0, 1.0)))


def test_an_exact_region_goes_with_its_part(bar: ReducedBody) -> None:
    """It is not cut through, and the momentum of the held bar is that of the parts."""
    held = hold(bar, END)
    assert held.function_count == bar.function_count == 24
    qd = motion(held)[1]
    parts = cut_body(held, MIDDLE).bodies
    assert [part.regions.names for part in parts] == [("end",), ()]
    after = sum(part.volume * part.mean_basis @ carry_over(held, part, 0.0 * qd, qd)[1] for part in parts)
    before = held.volume * held.mean_basis @ qd
    np.testing.assert_allclose(after, before, atol=1e-9 * np.linalg.norm(before))
    with pytest.raises(ConfigError, match="cuts the exact region 'end'"):
        cut_body(held, LENGTHWISE)


@pytest.mark.rest
def test_a_soft_region_is_cut_through(bar: ReducedBody) -> None:
    """Each half keeps its share."""
    soft = Region(name="soft", box=((-0.03, -1.0, -1.0), (0.05, 1.0, 1.0)), stiffness=1e4)
    held = hold(bar, END, soft)
    cut = cut_body(held, MIDDLE)
    assert [part.regions.names for part in cut.bodies] == [("end", "soft"), ("soft",)]
    qd = motion(held)[1]
    after = sum(part.volume * part.mean_basis @ carry_over(held, part, 0.0 * qd, qd)[1] for part in cut.bodies)
    before = held.volume * held.mean_basis @ qd
    np.testing.assert_allclose(after, before, atol=5e-3 * np.linalg.norm(before))  # cells at the soft region differ
    assert len(cut_body(held, Patch.plane((-0.05, 0.0, 0.0), (1.0, 0.0, 0.0))).bodies) == 2


def test_a_part_is_an_ordinary_body(halves: tuple[ReducedBody, ...], tmp_path) -> None:
    """It is saved, read, and cut as it was."""
    halves[0].save(tmp_path / "half.npz")
    again = ReducedBody.load(tmp_path / "half.npz")
    assert again.fingerprint == halves[0].fingerprint and len(cut_body(again, LENGTHWISE).bodies) == 2


def test_what_is_refused(bar: ReducedBody) -> None:
    """Bodies without sources or grid, patches that are none."""
    with pytest.raises(ConfigError, match="does not keep what it was built from"):
        cut_body(dataclasses.replace(bar, sources=None), MIDDLE)
    assert bar.sources is not None
    old = {name: value for name, value in bar.sources.items() if name != "cells.place"}
    with pytest.raises(ConfigError, match="keeps no grid"):
        cut_body(dataclasses.replace(bar, sources=old), MIDDLE)
    with pytest.raises(ConfigError, match="q: expected shape"):
        cut_body(bar, MIDDLE, np.zeros((3, 3)))
    with pytest.raises(ConfigError, match="a point and a normal"):
        Patch.plane((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    with pytest.raises(ConfigError, match="no length"):
        Patch.stroke((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 0.0, 0.0))
    with pytest.raises(ConfigError, match="no area"):
        Patch(corners=np.zeros((1, 3, 3)))


def test_crossings() -> None:
    """Of segments with a square of two triangles, also through their common edge and from a point on it."""
    square = Patch(corners=[[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]])
    start = np.array([[0.5, 0.5, 1.0], [0.3, 0.9, 3.0], [1.5, 0.5, 1.0], [0.5, 0.5, 0.0], [0.5, 0.5, 0.0]])
    end = np.array([[0.5, 0.5, -1.0], [0.3, 0.9, -1.0], [1.5, 0.5, -1.0], [0.5, 0.5, 1.0], [0.5, 0.5, -1.0]])
    at, normal = square.crossings(start, end)
    np.testing.assert_allclose(at, [0.5, 0.75, np.nan, np.nan, 0.0], atol=1e-8)
    np.testing.assert_array_equal(normal[:2], [[0.0, 0.0, 1.0]] * 2)
