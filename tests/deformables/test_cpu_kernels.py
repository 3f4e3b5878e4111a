"""Device code that takes eight points or samples at a time on CPU, against the kernels that take one, as CUDA does."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables.contact import detection_kernels, sample_cpu_kernels
from softmode.deformables.contact.detection_kernels import CULLED
from softmode.deformables.materials.material import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.model.newton_step_kernels import ALL
from softmode.deformables.potential import constraint_cpu_kernels, evaluate_kernels, point_cpu_kernels
from softmode.deformables.solver import step_kernels
from softmode.deformables.solver.evaluate import assemble, evaluate, gather_gradient, solve
from softmode.deformables.solver.step_tables import StepTables
from softmode.deformables.system import assembly_cpu_kernels, assembly_kernels
from softmode.deformables.tools.body_choice import BodyChoice
from tests.bodies import cube
from tests.deformables.test_fused_system import loaded
from tests.scenes import GRAVITY, Scene, random_rotation

DOUBLE, SINGLE = 1.0e-12, 4.0e-7
"""Relative rounding of sums in double precision in another order, and of results that are kept in single precision."""


def pressed(mode_count: int, model: MaterialModel = MaterialModel.STABLE_NEO_HOOKEAN_LOG) -> Scene:
    """Return a cube under a box at an iterate, of another scale than 1, with points of different moduli."""
    scene = loaded(mode_count)
    t = scene.reduced.tables
    points = t.layout.point_max
    t.basis.stiffness_scale.assign(np.linspace(0.5, 2.0, points))
    t.basis.lame_ratio.assign(np.linspace(3.0, 0.2, points))
    t.instances.material_model.fill_(int(model))
    t.instances.viscosity.fill_(0.002)
    t.instances.scale.fill_(1.02)
    t.newton.active.fill_(1)
    t.newton.refresh.fill_(1)
    t.newton.project.fill_(1)
    t.newton.evaluated.zero_()
    q = t.arrays.q.numpy()
    used = np.abs(q) > 0.0
    t.arrays.q.assign(q + 2.0e-4 * used * np.random.default_rng(mode_count).normal(size=q.shape))
    return scene


def agree(found: np.ndarray, expected: np.ndarray, rounding: float) -> None:
    """Assert that arrays agree up to rounding of their largest number, which is not zero."""
    size = np.abs(expected).max()
    assert 0.0 < size < np.inf
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=rounding * size)


@pytest.mark.parametrize("project", [0, 1])
@pytest.mark.parametrize("model", MaterialModel)
def test_points(model: MaterialModel, project: int) -> None:
    """Energy, stress, J and Hessian of each point, and where it was: 125 points, so that three lanes idle."""
    t = pressed(4, model).reduced.tables
    t.instances.point_count.fill_(125)
    t.newton.project.fill_(project)
    step, one, eight = t.newton_step(0.004), (1, 125), (1, 16)
    t.launch(step_kernels.start_points, one, step)
    start = t.points.start.numpy().copy()
    t.launch(evaluate_kernels.evaluate_points, (*one, 1), step, t.newton.active, t.arrays.q, int(ALL), 1)
    names = {"energy": DOUBLE, "stress": DOUBLE, "volume_ratio": SINGLE, "hessian": SINGLE}
    expected = {name: getattr(t.points, name).numpy().copy() for name in names}
    for name in (*names, "start"):
        getattr(t.points, name).fill_(7.0)
    t.launch(point_cpu_kernels.start_eights, eight, step)
    t.launch(point_cpu_kernels.evaluate_eights, eight, step, t.newton.active, t.arrays.q, int(ALL))
    t.launch(point_cpu_kernels.differentiate_eights, eight, step)
    agree(t.points.start.numpy()[:, :125], start[:, :125], DOUBLE)
    for name, rounding in names.items():
        found = getattr(t.points, name).numpy()
        points = (slice(None),) * (2 if name == "hessian" else 1)
        agree(found[(*points, slice(125))], expected[name][(*points, slice(125))], rounding)
        assert (found[(*points, slice(125, None))] == 7.0).all()  # idle lanes write nothing


@pytest.mark.parametrize("mode_count", [1, 2, 4, 6, 11])
def test_sums(mode_count: int) -> None:
    """Forces, stiffness, columns and the condensed rigid system, of one to six blocks of functions."""
    scene = pressed(mode_count)
    t, dt = scene.reduced.tables, scene.dt
    evaluate(t, dt, derivatives=True)
    gather_gradient(t, dt)
    assemble(t, dt)
    solve(t)
    step, blocks, rigid = t.newton_step(dt), t.layout.block_count, t.rigid.table
    tasks, n = 3 * blocks * blocks + 3 * (blocks * blocks + blocks) // 2, t.rigid.count_max
    right = t.system.scalars.numpy()[:, :, t.system.size : t.system.size + n + 1].copy()
    upper = np.triu(np.ones((3 * blocks, 3 * blocks), dtype=bool)).repeat(8, axis=0)
    forces, stiffness = t.arrays.gradient_chunk.numpy().copy(), t.arrays.stiffness.numpy()[0, 0][upper]
    t.arrays.gradient_chunk.zero_()
    t.arrays.stiffness.zero_()
    t.launch(evaluate_kernels.sum_forces, (1, 1, blocks), step, t.newton.active)
    agree(forces, t.arrays.gradient_chunk.numpy(), DOUBLE)
    t.launch(assembly_kernels.assemble_stiffness, (1, 1, tasks), step)
    agree(stiffness, t.arrays.stiffness.numpy()[0, 0][upper], SINGLE)

    matrices = []
    for launches in (
        (
            (assembly_kernels.assemble_matrix, (1, 24 * blocks, 1), step, 1),
            (assembly_kernels.add_contacts, (1, tasks), step),
        ),
        ((assembly_cpu_kernels.assemble_matrix, 1, step),),
    ):
        t.system.scalars.zero_()
        for kernel, *given in launches:
            t.launch(kernel, *given)
        matrices.append(t.system.scalars.numpy().copy())
    agree(matrices[1], matrices[0], SINGLE)
    t.launch(assembly_kernels.assemble_rigid, (1, n, n), step)
    apart = [rigid.matrix.numpy().copy(), rigid.gradient.numpy().copy()]
    t.launch(assembly_cpu_kernels.assemble_rigid, 1, step)
    agree(rigid.matrix.numpy(), apart[0], SINGLE)
    agree(rigid.gradient.numpy(), apart[1], 1.0e-9)
    assemble(t, dt)
    solve(t)

    condensed = []
    for kernel, dim in ((assembly_kernels.condense, (1, n, n + 1)), (assembly_cpu_kernels.condense, 1)):
        t.launch(assembly_kernels.assemble_rigid, (1, n, n), step)
        t.launch(kernel, dim, step)
        arrays = (rigid.matrix, rigid.direction, rigid.pivot_min)
        condensed.append([array.numpy().copy() for array in arrays])
        condensed[-1][0] = np.tril(condensed[-1][0])
    for expected, found in zip(*condensed, strict=True):
        agree(found, expected, 1.0e-9)  # of what is left of larger numbers

    t.launch(assembly_cpu_kernels.assemble_columns, 1, step)
    columns = t.system.scalars.numpy()[:, :, t.system.size : t.system.size + n + 1].copy()
    t.launch(assembly_kernels.assemble_columns, (1, 3 * blocks, n + 1), step)
    agree(columns, t.system.scalars.numpy()[:, :, t.system.size : t.system.size + n + 1], SINGLE)
    assert not np.array_equal(columns, right)  # which the factorisation has overwritten


@pytest.mark.parametrize("pins", [0, 3])
@pytest.mark.parametrize("memory", ["with memory", "without", "mixed"])
@pytest.mark.parametrize("iteration", [0, 1, 17])
def test_constraints(iteration: int, memory: str, pins: int) -> None:
    """Pins and contacts, deep, shallow, apart, sticking and sliding: 29 of them, so that three lanes idle."""
    scene = pressed(4)
    t, count = scene.reduced.tables, 29
    c, rng, shape = t.constraints, np.random.default_rng(iteration), t.constraints.row.shape
    assert shape[1] >= count and t.rigid.count_max == 6
    normal = rng.normal(size=(*shape, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    length = float(t.instances.smoothing.numpy()[0])
    stick = (
        rng.uniform(1.0, 100.0, shape) * {"with memory": 1.0, "without": 0.0, "mixed": rng.random(shape) < 0.5}[memory]
    )
    values = {
        "count": [count],
        "pair_count": [0],
        "row": rng.integers(0, t.layout.sample_max, shape),
        "partner": np.full(shape, -1),
        "normal": normal,
        "offset": normal * rng.uniform(-6.0, 3.0, (*shape, 1)) * length + rng.normal(size=(*shape, 3)) * length,
        "stiffness": rng.uniform(10.0, 1000.0, shape),
        "dent_compliance": rng.uniform(0.0, 0.1, shape) * (rng.random(shape) < 0.7),
        "dent_depth": rng.uniform(0.0, 2.0 * length, shape),
        "onset": rng.uniform(0.3 * length, 3.0 * length, shape),
        "friction": rng.uniform(0.0, 1.0, shape) * (rng.random(shape) < 0.8),
        "stick": stick,
        "stick_deep": stick * rng.uniform(1.0, 20.0, shape),
        "normal_force": rng.uniform(0.0, 0.1, shape),
        "dof_begin": rng.integers(0, 3, shape),
        "dof_end": rng.integers(2, 7, shape),
        "jacobian": rng.normal(size=(*shape, 6, 3)),
    }
    t.instances.pin_count.fill_(pins)
    t.newton.iteration.fill_(iteration)
    t.newton.friction_lag = 20
    t.newton.exact.fill_(iteration % 2)
    step, names = (
        t.newton_step(0.004),
        ("energy", "force", "displacement", "slip", "normal_force", "hessian", "coupling"),
    )
    step.state.friction_lag = 20
    r = wp.array(1.0e-4 * rng.normal(size=t.rigid.table.r.shape), dtype=wp.float64, device="cpu")
    for derivatives, evaluated in ((0, 0), (1, 0), (1, 1)):
        found = []
        for kernel, dim, lanes in (
            (evaluate_kernels.evaluate_constraints, (*shape, 1), (1,)),
            (constraint_cpu_kernels.evaluate_constraints, 1, ()),
        ):
            for name in names:
                getattr(c, name).fill_(7.0)
            c.displacement.assign(1.0e-3 * np.random.default_rng(3).normal(size=(*shape, 3)))
            for name, value in values.items():
                getattr(c, name).assign(np.asarray(value))
            t.newton.evaluated.fill_(evaluated)
            t.launch(kernel, dim, step, t.newton.active, t.arrays.q, r, derivatives, *lanes)
            found.append({name: getattr(c, name).numpy().copy() for name in names})
        expected, eights = found
        for name in names:
            rounding = SINGLE if name in ("hessian", "coupling") else DOUBLE
            agree(eights[name][:, :count], expected[name][:, :count], rounding)
            np.testing.assert_array_equal(eights[name][:, count:], expected[name][:, count:])  # which are left alone
        forces = np.abs(expected["force"][0, pins:count]).max(-1)
        assert 0 < (forces > 0.0).sum() < count - pins


def test_samples() -> None:
    """Positions and drifts at the start of a step, and particles at its end: 150 samples, so that two lanes idle."""
    scene = pressed(4)
    t, data = scene.reduced.tables, scene.state.softmode
    particles = (scene.state.particle_q, scene.state.particle_qd)
    assert t.layout.sample_max % 8 != 0
    one, eight = t.samples.position.shape, t.sample_tasks
    found = []
    for place, skin, dim in (
        (detection_kernels.place_samples, step_kernels.skin_samples, one),
        (sample_cpu_kernels.place_eights, point_cpu_kernels.skin_eights, eight),
    ):
        for array in (t.samples.position, t.samples.drift, *particles):
            array.fill_(7.0)
        t.launch(place, dim, t.instances, t.basis, t.motion, t.samples)
        t.launch(skin, dim, t.instances, t.basis, data.q, data.qd, data.dent, *particles)
        found.append([array.numpy().copy() for array in (t.samples.position, t.samples.drift, *particles)])
    for (expected, lanes), rounding in zip(zip(*found, strict=True), (DOUBLE, SINGLE, SINGLE, SINGLE), strict=True):
        agree(lanes, expected, rounding)


def crowd(seed: int) -> Scene:
    """Return a cube among shapes of all kinds, on moving bodies and fixed, more than can be culled."""
    rng = np.random.default_rng(seed)
    mesh = newton.Mesh.create_box(0.02, 0.03, 0.04)

    def populate(world: Any) -> None:
        add_reduced_body(world, cube(), position=(0.0, 0.0, 0.0))
        for k in range(int(CULLED) + 6):
            turn = wp.quat_from_matrix(wp.mat33(*random_rotation(rng).ravel()))
            pose = wp.transform(rng.uniform(-0.09, 0.09, 3), turn)
            body = -1
            if k % 3 == 0:
                body = world.add_body(xform=pose)
                pose = wp.transform(rng.uniform(-0.02, 0.02, 3), wp.quat_identity())
            a, b, c = (float(x) for x in rng.uniform(0.01, 0.03, 3))
            kinds = (
                (world.add_shape_box, {"hx": a, "hy": b, "hz": c}),
                (world.add_shape_sphere, {"radius": a}),
                (world.add_shape_capsule, {"radius": a, "half_height": b}),
                (world.add_shape_cylinder, {"radius": a, "half_height": b}),
                (world.add_shape_cone, {"radius": a, "half_height": b}),
                (world.add_shape_ellipsoid, {"rx": a, "ry": b, "rz": c}),
                (world.add_shape_mesh, {"mesh": mesh}),
            )
            add, given = kinds[k % len(kinds)]
            add(body, xform=pose, **given)

    return Scene(populate, [cube()], ground=0.5)


@pytest.mark.parametrize("fresh", [True, False])
def test_culled_shapes_touch_nothing(fresh: bool) -> None:
    """Contacts are the same to the bit whether shapes out of a sample's reach are looked at or not."""
    scene = crowd(1)
    rng = np.random.default_rng(2)
    t, dt, memory = scene.reduced.tables, scene.dt, scene.state.softmode
    scene.state.body_qd.assign(rng.normal(size=(*scene.state.body_qd.shape[:1], 6)))
    memory.qd.assign(0.3 * rng.normal(size=(*memory.qd.shape, 3)))
    memory.stick_shape.assign(rng.integers(-1, scene.model.shape_count, size=(*memory.stick_shape.shape, 2)))
    for _ in range(2):  # the first step allocates what detection reads
        scene.solver.step(scene.state, scene.next_state, scene.control, None, dt)
    memory.dt_before.fill_(0.0 if fresh else dt)
    memory.stick_shape.assign(rng.integers(-1, scene.model.shape_count, size=(*memory.stick_shape.shape, 2)))
    before = (memory.stick_shape, memory.dt_before)
    shapes = (t.candidate, t.near, t.shapes, float(dt))
    t.samples.near.zero_()
    t.launch(sample_cpu_kernels.cull_samples, 1, t.instances, t.basis, *shapes, *before, t.samples)
    culled = t.samples.near.numpy().copy()
    kept = sum((culled >> c) & 1 for c in range(int(CULLED)))
    assert 0.0 < kept.mean() < 0.7 * t.near.numpy()[0, : int(CULLED)].sum()
    found = []
    for mask in (culled, np.full_like(culled, -1)):
        t.samples.near.assign(mask)
        known = (t.instances, t.basis, t.motion, t.candidate, t.near, t.shapes, t.surface.inset, float(dt))
        t.launch(detection_kernels.find_contacts, t.samples.position.shape, *known, *before, t.samples)
        found.append([array.numpy().copy() for array in (t.samples.shape, t.samples.gap, t.samples.normal)])
    touched = found[0][0] >= 0
    assert touched.sum() > 50
    for few, every in zip(*found, strict=True):
        np.testing.assert_array_equal(few[touched], every[touched])
    np.testing.assert_array_equal(found[0][0], found[1][0])


def test_a_chosen_body_touches_where_nothing_is_culled(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on CUDA, where no kernel culls samples: a body that takes its own place lands with the bits of before."""
    launch = StepTables.launch

    def without_culling(tables: StepTables, kernel: Any, *arguments: Any, **options: Any) -> None:
        if kernel is not sample_cpu_kernels.cull_samples:
            launch(tables, kernel, *arguments, **options)

    monkeypatch.setattr(StepTables, "launch", without_culling)
    material, down = Material(), (0.0, 0.0, -GRAVITY)

    def populate(world: Any) -> None:
        add_reduced_body(world, cube(), material=material, position=(0.0, 0.0, 0.0501))

    scene = Scene(populate, [cube()], gravity=down, ground=0.5)
    choice = BodyChoice(scene.reduced, [cube()], [material])
    landed = []
    for _ in range(2):
        scene.restart()
        scene.solver.reset(scene.state)
        scene.step(6)
        assert scene.reduced.instance_force.numpy()[0, 2] > 0.0
        landed.append([array.numpy() for array in (scene.state.particle_q, scene.state.particle_qd)])
        choice.set(wp.zeros(1, dtype=int, device="cpu"), wp.ones(1, dtype=wp.bool, device="cpu"))
    np.testing.assert_array_equal(*landed)
