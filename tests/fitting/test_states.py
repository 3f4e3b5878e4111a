"""Coordinates of a batch of worlds in one call, and the frame of an object's file.

Builds a small pear that cannot stand as its file has it.
"""

from __future__ import annotations

import newton
import numpy as np
import pytest
import trimesh

from softmode.deformables import SolverReduced, add_reduced_body, set_states
from softmode.deformables.model.namespaces import soft
from softmode.errors import ConfigError
from softmode.fitting.worlds import FitWorlds
from softmode.objects import ObjectConfig, build_object, file_frame, load
from softmode.objects.frame import in_body
from softmode.objects.source import object_source
from softmode.splats.colored_mesh import ColoredMesh
from tests.bodies import cube, freeform


def test_states_of_a_batch() -> None:
    """Each world takes its own coordinates and velocities; particles follow, and the step before is forgotten.

    Worlds of a fit that were not reset fall from rest: by 3 g dt^2 in two implicit steps.
    """
    body = cube()
    world, builder = newton.ModelBuilder(), newton.ModelBuilder()
    add_reduced_body(world, body)
    builder.replicate(world, 3)
    model = builder.finalize(device="cpu")
    solver, state = SolverReduced(model, [body]), model.state()
    soft(state).dt_before.fill_(0.01)
    soft(state).stick_shape.fill_(1)
    q = np.array([body.affine(np.eye(3), (0.0, 0.0, z)) for z in (0.0, 1.0, 2.0)])
    qd = body.linear_coordinates[:, 3:] * np.array([0.5, 0.0, 0.0])
    dent = np.full((body.surface_count, 3), 1e-4)
    set_states(solver, state, q=q, qd=qd, dent=dent)
    n, s = body.function_count, body.surface_count
    np.testing.assert_array_equal(soft(state).q.numpy(), q.reshape(-1, 3))
    np.testing.assert_array_equal(soft(state).qd.numpy().reshape(3, n, 3), np.broadcast_to(qd, (3, n, 3)))
    assert np.ptp(soft(state).dent.numpy()) == 0.0 and not soft(state).dt_before.numpy().any()
    assert (soft(state).stick_shape.numpy() == -1).all()
    x = state.particle_q.numpy().reshape(3, s, 3)
    np.testing.assert_allclose(x - body.surface.points - dent, [[[0, 0, z]] for z in (0, 1, 2)] + 0 * x, atol=3e-4)
    for wrong in (q[:2], np.full_like(q, np.nan)):
        with pytest.raises(ConfigError, match="q: 3 worlds"):
            set_states(solver, state, q=wrong)
    worlds = FitWorlds(model, body, dt=0.01)
    worlds.step_twice()  # no reset has to come first
    fallen = (soft(worlds.pair[0]).q.numpy() - soft(model.state()).q.numpy()).reshape(3, n, 3)
    np.testing.assert_allclose(body.mean_basis @ fallen, [[0.0, 0.0, -9.81 * 3.0e-4]] * 3, rtol=1e-3, atol=1e-7)


def test_frame_of_the_file() -> None:
    """Splats of a file lie in the body frame where `file_frame` takes them: laid down or not, by both ways of a build.

    Vertices are within the size of what rounding to float32 leaves.
    """
    mesh = trimesh.creation.icosphere(2, 0.04)
    mesh.vertices[:, 2] = np.where(mesh.vertices[:, 2] < 0, 3.0, 1.0) * mesh.vertices[:, 2]  # a tip below
    mesh.vertices[:, 0] *= 1.0 + 2.0 * np.maximum(mesh.vertices[:, 2], 0.0)
    config = ObjectConfig(
        mesh=ColoredMesh.from_trimesh(mesh), splat_count=200, surface_count=200, build=freeform(3, 80, 64)
    )
    for thing in (load(config), load(config, pose="captured"), build_object(config)[0]):
        source = object_source(config).splats.means
        np.testing.assert_allclose(in_body(thing.body, source), thing.visible_splats.means, atol=1e-7 + 1e-5 * 0.16)
    assert not np.allclose(file_frame(load(config).body)[:3, :3], np.eye(3), atol=0.01)
