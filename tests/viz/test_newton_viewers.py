"""Newton's own viewers on a model with soft bodies: they show its surface particles, and picking drags rigid bodies."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import newton
import numpy as np
import pytest
import warp as wp
from newton.viewer import Picking, ViewerFile, ViewerNull, ViewerUSD

from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from tests.bodies import cube
from tests.scenes import GRAVITY, Scene

EDGE = 0.1
SOFT = Material(youngs_modulus=2.0e5, density=200.0)


def _stack() -> Scene:
    """Return a soft cube on a rigid plate of 1 kg on the ground, coupled both ways."""

    def populate(world: newton.ModelBuilder) -> None:
        body = world.add_body(xform=wp.transform((0.0, 0.0, 0.0251), wp.quat_identity()), label="plate")
        config = newton.ModelBuilder.ShapeConfig(density=1.0 / (0.3 * 0.3 * 0.05), mu=0.8)
        world.add_shape_box(body, hx=0.15, hy=0.15, hz=0.025, cfg=config)
        add_reduced_body(world, cube(), material=SOFT, position=(0.0, 0.0, 0.0502 + 0.5 * EDGE))

    return Scene(populate, [cube()], gravity=(0, 0, -GRAVITY), ground=0.8, coupled=True, dt=0.004)


@pytest.fixture(scope="module")
def stack() -> Scene:
    """Return the stack at its start."""
    return _stack()


def _show(viewer: Any, scene: Scene, frames: int = 3) -> list[np.ndarray]:
    """Show some frames with the surface particles, close the viewer, return where the particles were."""
    scene.restart()
    viewer.set_model(scene.model)
    viewer.show_particles = True
    particles = []
    for k in range(frames):
        viewer.begin_frame(k * 0.02)
        viewer.log_state(scene.state)
        viewer.end_frame()
        particles.append(scene.state.particle_q.numpy().copy())
        scene.step(5)
    viewer.close()
    return particles


def test_particles_are_to_be_seen(stack: Scene) -> None:
    """Every surface sample is an active particle with a radius of the order of the samples' spacing."""
    body, model = cube(), stack.model
    assert model.particle_count == body.surface_count
    assert (model.particle_flags.numpy() & int(newton.ParticleFlags.ACTIVE)).all()
    spacing = np.sqrt(body.surface.areas.mean())
    assert (model.particle_radius.numpy() > 0.1 * spacing).all()
    assert (model.particle_radius.numpy() < spacing).all()


def test_viewer_null(stack: Scene) -> None:
    """The viewer that shows nothing takes the model."""
    _show(ViewerNull(num_frames=3), stack)


def test_viewer_file(stack: Scene, tmp_path: Path) -> None:
    """The recorder of states writes every frame."""
    _show(ViewerFile(str(tmp_path / "stack.json")), stack)
    written = json.loads((tmp_path / "stack.json").read_text())["items"]
    assert len(written["states"]["items"]) == 3


def test_viewer_usd(stack: Scene, tmp_path: Path) -> None:
    """The USD file has the particles as instances, frame by frame where the state had them."""
    usd = pytest.importorskip("pxr.Usd", reason="needs the extra usd")
    path = str(tmp_path / "stack.usda")
    particles = _show(ViewerUSD(path, fps=50, num_frames=None), stack)
    stage = usd.Stage.Open(path)
    points = stage.GetPrimAtPath("/root/model/particles").GetAttribute("positions")
    for k, expected in enumerate(particles):
        np.testing.assert_allclose(np.array(points.Get(k)), expected, atol=1e-6)
    assert not np.array_equal(particles[0], particles[2])


def test_viewer_viser(stack: Scene) -> None:
    """The browser viewer takes model and states, and has a picking controller of the rigid bodies."""
    pytest.importorskip("viser", reason="needs the extra viz")
    viewer = newton.viewer.ViewerViser(host="127.0.0.1", port=_free_port(), verbose=False)
    _show(viewer, stack)
    assert isinstance(viewer.picking, Picking)


def test_viewer_rerun(stack: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Newton's rerun viewer takes model and states while it serves a browser."""
    pytest.importorskip("rerun", reason="needs the extra viz")
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("BROWSER", "true")
    _show(newton.viewer.ViewerRerun(web_port=_free_port(), grpc_port=_free_port()), stack)


def _free_port() -> int:
    """Return a port that nothing listens on."""
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_picking_drags_a_rigid_body_with_its_load(stack: Scene) -> None:
    """A ray picks the plate under the soft cube; its spring lifts both, and letting go drops them.

    The force enters through ``state.body_f``, which the coupled solver adds to the soft bodies' reactions.
    """
    scene, picking = stack, Picking(stack.model)
    scene.restart()
    scene.step(25)
    rest, load = scene.state.body_q.numpy()[0, 2], scene.centre()[2]
    eye, ahead = wp.vec3(0.12, -1.0, 0.025), wp.vec3(0.0, 1.0, 0.0)
    picking.pick(scene.state, wp.vec3(0.12, -1.0, 0.5), ahead)
    assert not picking.is_picking()  # the ray passes over
    picking.pick(scene.state, eye, ahead)
    assert picking.is_picking() and picking.pick_body == 0
    np.testing.assert_allclose(np.array(picking.pick_point), [0.12, -0.15, 0.025], atol=2e-3)
    picking.pick_target = wp.vec3(0.12, -0.15, 0.125)
    for _ in range(75):
        picking.apply_force(scene.state)
        scene.step()
    assert scene.state.body_q.numpy()[0, 2] - rest > 0.01  # one corner is pulled: it tilts and hangs
    assert scene.centre()[2] - load > 0.01
    picking.release()
    for _ in range(150):
        picking.apply_force(scene.state)
        scene.step()
    assert abs(scene.state.body_q.numpy()[0, 2] - rest) < 2e-3
