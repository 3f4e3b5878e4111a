"""What a page takes for granted: names and files that its first snippet uses without making them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

SetUp = Callable[[Path], dict[str, Any]]

SETUPS: dict[str, SetUp] = {}
"""By the page's path below the checkout: a function of the folder in which the page runs, which returns names."""


def _setup(page: str) -> Callable[[SetUp], SetUp]:
    """Register a function for a page."""

    def register(function: SetUp) -> SetUp:
        SETUPS[page] = function
        return function

    return register


@_setup("docs/coupling.md")
def _coupling(folder: Path) -> dict[str, Any]:
    """A gripper about to close on a soft cube."""
    from newton.solvers import SolverMuJoCo

    from softmode.deformables import add_reduced_body
    from tests.bodies import cube
    from tests.scenes import Scene, add_gripper

    body, fingers = cube(0.06), []

    def populate(world: Any) -> None:
        fingers.extend(add_gripper(world, 0.03)[1:])
        add_reduced_body(world, body, position=(0.0, 0.0, 0.0301))

    scene = Scene(populate, [body], coupled=True, ground=0.8)
    return {
        "model": scene.model,
        "body": body,
        "state": scene.state,
        "next_state": scene.next_state,
        "control": scene.control,
        "dt": scene.dt,
        "SolverMuJoCo": SolverMuJoCo,
        "fingers": fingers,
    }


@_setup("docs/sensing.md")
def _sensing(folder: Path) -> dict[str, Any]:
    """A soft cube between two fingers, stuck to the first."""
    import newton
    import warp as wp

    from softmode.deformables import SolverCoupledReduced, add_reduced_body, attach
    from tests.bodies import cube

    body = cube()
    world = newton.ModelBuilder()
    links = []
    for name, y in (("finger_left", 0.07), ("finger_right", -0.0695)):
        link = world.add_body(xform=wp.transform((0.0, y, 0.05), wp.quat_identity()), label=f"hand/{name}")
        world.add_shape_box(link, hx=0.02, hy=0.02, hz=0.05)
        links.append(link)
    instance = add_reduced_body(world, body, position=(0.0, 0.0, 0.0501))
    attachment = attach(world, instance, body, link=links[0], box=((-1.0, 0.04, -1.0), (1.0, 1.0, 1.0)))
    world.add_ground_plane()
    model = world.finalize()
    state, after = model.state(), model.state()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    return {
        "solver": SolverCoupledReduced(model, [body]),
        "instance": instance,
        "attachment": attachment,
        "state": state,
        "state_out": after,
        "control": model.control(),
        "dt": 1.0 / 240.0,
    }


@_setup("docs/gradients.md")
def _gradients(folder: Path) -> dict[str, Any]:
    """A soft bar that falls, and tracks of 20 markers that stand still."""
    import newton

    from softmode.deformables import add_reduced_body
    from tests.bodies import bar

    body = bar()
    world = newton.ModelBuilder()
    add_reduced_body(world, body, position=(0.0, 0.0, 1.0))
    observed = body.surface.points[:20] + np.array([0.0, 0.0, 1.0])
    return {"body": body, "model": world.finalize(), "dt": 1.0 / 240.0, "observed": observed}


@_setup("docs/splats_from_mesh.md")
def _splats_from_mesh(folder: Path) -> dict[str, Any]:
    """A textured mesh."""
    from tests.splats.meshes import painted_box

    painted_box().export(folder / "toy.glb")
    return {}


@_setup("docs/training.md")
def _training(folder: Path) -> dict[str, Any]:
    """A trained policy."""
    import shutil

    from tests.documentation.pages import ROOT

    pytest.importorskip("torch")
    shutil.copy(ROOT / "policies" / "push_soft.npz", folder / "best.npz")
    return {}


@_setup("docs/howto/train.md")
def _howto_train(folder: Path) -> dict[str, Any]:
    """The checkout's policies."""
    from tests.documentation.pages import ROOT

    pytest.importorskip("torch")
    (folder / "policies").symlink_to(ROOT / "policies")
    return {}


@_setup("docs/vector_envs.md")
def _vector_envs(folder: Path) -> dict[str, Any]:
    """The libraries of reinforcement learning."""
    for library in ("torch", "stable_baselines3", "rsl_rl", "skrl"):
        pytest.importorskip(library)
    return {}


@_setup("docs/splat_files.md")
@_setup("docs/usd.md")
def _usd(folder: Path) -> dict[str, Any]:
    """OpenUSD."""
    pytest.importorskip("pxr", reason="needs the extra [usd]")
    return {}


@_setup("docs/robots.md")
@_setup("docs/howto/own_robot.md")
def _robots(folder: Path) -> dict[str, Any]:
    """A robot that needs no download."""
    from softmode import robots

    if "aloha_arm" not in robots.available():
        pytest.skip("this mujoco-warp ships no ALOHA arm")
    return {}
