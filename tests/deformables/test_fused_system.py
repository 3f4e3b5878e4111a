"""The system of a world in packed, shared memory: the same code as on CUDA, run by one thread, against the launches."""

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.model.newton_step_kernels import NewtonArrays
from softmode.deformables.model.struct_kernels import Basis, PointConstraints, Rigid
from softmode.deformables.solver.evaluate import assemble, evaluate, gather_gradient, solve
from softmode.deformables.solver.step_tables import ONE_LAUNCH_BLOCKS, fits_in_shared_memory, newton_notes
from softmode.deformables.system.shared_system_kernels import (
    STATIC_BYTES,
    dynamic_floats,
    shared_bytes,
    shared_direction_of,
    shared_floats,
)
from tests.bodies import cube
from tests.marks import rest_but
from tests.scenes import GRAVITY, Scene

EDGE = 0.1
SIZES = [(1, 24), (2, 48), (4, 72), (6, 96), (8, 120), (11, 144), (13, 168)]
"""FreeForm's modes of a cube, and the unknowns of its system: for each a kernel is compiled."""
H100 = 227 * 1024
"""Shared memory of a block [bytes]."""


def loaded(mode_count: int) -> Scene:
    """Return a cube on the ground under a rigid box, after some steps: six joint dofs take part."""

    def populate(world: newton.ModelBuilder) -> None:
        add_reduced_body(world, cube(EDGE, mode_count), position=(0.0, 0.0, 0.5 * EDGE))
        box = world.add_body(xform=wp.transform((0.0, 0.0, 1.2 * EDGE), wp.quat_identity()))
        world.add_shape_box(box, hx=0.4 * EDGE, hy=0.4 * EDGE, hz=0.2 * EDGE)

    scene = Scene(populate, [cube(EDGE, mode_count)], coupled=True, gravity=(0.0, 0.0, -GRAVITY), ground=0.8)
    scene.step(4)
    return scene


@pytest.mark.parametrize(("mode_count", "size"), rest_but([(1, 24), (13, 168)], SIZES))
def test_packed_system_equals_launches(mode_count: int, size: int) -> None:
    """Directions of body and box, and the gradient of the box, agree within single precision times the condition."""
    scene = loaded(mode_count)
    t, dt = scene.reduced.tables, scene.dt
    count = t.rigid.count_max
    assert (3 * t.layout.stride, t.rigid.table.count.numpy()[0]) == (size, 6)
    t.newton.active.fill_(1)
    t.newton.refresh.fill_(1)
    evaluate(t, dt, derivatives=True)
    gather_gradient(t, dt)
    found = []
    for packed in (False, True):
        assemble(t, dt)
        assert t.constraints.acting_count.numpy()[0] > 4
        if packed:
            width = t.system.scalars.shape[2]
            kernel = packed_kernel(size, width)
            rate = float(t.motion.rate.numpy()[0]) / dt
            inertia = float(t.instances.mass.numpy()[0]) * rate * (rate + float(t.instances.mass_damping.numpy()[0]))
            given = (inertia, count, t.basis, t.constraints, t.rigid.table, t.arrays)
            for array in (t.rigid.table.matrix, t.rigid.table.gradient, t.rigid.table.direction):
                array.zero_()
            wp.launch(kernel, dim=1, inputs=[*given], device="cpu")
        else:
            solve(t)
        assert t.system.indefinite.numpy()[0] == 0
        rigid = t.rigid.table
        found.append([array.numpy().copy() for array in (t.arrays.direction, rigid.direction, rigid.gradient)])
        t.arrays.direction.zero_()
    for apart, at_once in zip(*found, strict=True):
        assert np.abs(apart).max() > 0.0
        np.testing.assert_allclose(at_once, apart, atol=1.0e-3 * np.abs(apart).max())


def packed_kernel(size: int, width: int):
    """Return a kernel that calls the system's device function for one world."""
    shared_direction = shared_direction_of(size, width)

    @wp.kernel(module="unique", enable_backward=False)
    def packed(
        inertia: float,
        rigid_max: int,
        basis: Basis,
        constraints: PointConstraints,
        rigid: Rigid,
        arrays: NewtonArrays,
    ):
        shared_direction(inertia, rigid_max, basis, constraints, rigid, arrays, 0, 0, 0, 1)

    return packed


def test_rows_are_packed_without_gaps() -> None:
    """Row block b has W - 8 b columns; only systems above 44 kB ask for memory when they are launched."""
    for size in range(24, 201, 24):
        width = size + 16
        assert shared_floats(size, width) == sum(8 * (width - 8 * b) for b in range(size // 8))
        assert (dynamic_floats(size, width) > 0) == (shared_bytes(size, width) > STATIC_BYTES)
        assert 4 * dynamic_floats(size, width) in (0, shared_bytes(size, width))


def test_fast_path_reaches_bodies_of_the_default_size() -> None:
    """48 functions, and every body that one launch takes, fit into the shared memory of a data centre GPU."""
    size = 24 * ONE_LAUNCH_BLOCKS
    assert size >= 144
    assert fits_in_shared_memory(H100, size, size + 16)
    assert not fits_in_shared_memory(H100, 480, 496)


def test_notes_say_what_is_too_large() -> None:
    """A system off the fast path is named with its size; on a CPU there is nothing to say."""
    assert newton_notes(144, one_launch=True, shared=True) == ()
    for given in ({"one_launch": False, "shared": False}, {"one_launch": True, "shared": False}):
        (note,) = newton_notes(360, **given)
        assert note.startswith("systems of 360 unknowns")
    assert loaded(1).reduced.notes == ()
