"""The table scene in several worlds: each is the single scene, none touches another."""

from __future__ import annotations

import numpy as np
import pytest

from softmode.errors import ConfigError, MaterialError
from softmode.scenes.table_scene import TableScene, TableSceneConfig

POSITIONS = np.array([[0.45, 0.0], [0.42, -0.06], [0.48, 0.05]])
YAWS = np.array([0.3, -1.0, 2.0])
MODULI = np.array([5.0e4, 2.0e4, 2.0e6])
STEPS = 34


@pytest.fixture(scope="module")
def worlds() -> TableScene:
    """Return a scene of three worlds."""
    return TableScene(TableSceneConfig(), world_count=3, device="cpu")


@pytest.fixture(scope="module")
def single() -> TableScene:
    """Return a scene of one world."""
    return TableScene(TableSceneConfig(), device="cpu")


def reset(scene: TableScene, chosen: slice) -> None:
    """Put the objects of the chosen worlds of the table above in place."""
    scene.reset(position=POSITIONS[chosen], yaw=YAWS[chosen], youngs_modulus=MODULI[chosen])


def actions(world_count: int, step: int) -> np.ndarray:
    """Return actions that go down on the object of world 0, close, and differ in every world."""
    down = np.array([0.0, 0.0, -1.0, 0.0, 1.0 if step < 12 else -1.0], np.float32)
    spread = np.random.default_rng(step).uniform(-0.5, 0.5, (3, 5)).astype(np.float32)
    spread[0] = 0.0
    return (down + spread)[:world_count]


def snapshot(scene: TableScene, world: int) -> list[np.ndarray]:
    """Return copies of all of one world's state that observations are made of."""
    model, state = scene.model, scene.state
    count = scene.soft.body.function_count
    joints = model.joint_coord_world_start.numpy()
    particles = model.particle_world_start.numpy()
    return [
        state.softmode.q.numpy()[world * count : (world + 1) * count].copy(),
        state.softmode.qd.numpy()[world * count : (world + 1) * count].copy(),
        state.joint_q.numpy()[joints[world] : joints[world + 1]].copy(),
        state.particle_q.numpy()[particles[world] : particles[world + 1]].copy(),
        scene.object_position.numpy()[world].copy(),
        scene.finger_force.numpy()[world].copy(),
    ]


def assert_equal(first: list[np.ndarray], second: list[np.ndarray]) -> None:
    """Compare two snapshots bit for bit."""
    for a, b in zip(first, second, strict=True):
        assert a.size
        np.testing.assert_array_equal(a, b)


def test_world_of_three_equals_the_single_scene_bitwise(worlds: TableScene, single: TableScene) -> None:
    """World 0, with contact, among neighbours of other stiffness, place and actions, has the single scene's bits."""
    reset(worlds, slice(0, 3))
    reset(single, slice(0, 1))
    touched = 0.0
    for step in range(STEPS):
        worlds.step(actions(3, step))
        single.step(actions(1, step))
        assert_equal(snapshot(worlds, 0), snapshot(single, 0))
        touched = max(touched, float(np.abs(worlds.finger_force.numpy()[0]).max()))
    assert touched > 0.1
    assert not np.array_equal(worlds.object_position.numpy()[0], worlds.object_position.numpy()[1])


def test_partial_reset_leaves_the_others_untouched(worlds: TableScene, single: TableScene) -> None:
    """Resetting world 1 in mid-motion changes no bit of worlds 0 and 2, then or later; world 1 starts afresh."""
    reset(worlds, slice(0, 3))
    reset(single, slice(0, 1))
    for step in range(STEPS):
        worlds.step(actions(3, step))
        single.step(actions(1, step))
    before = [snapshot(worlds, world) for world in (0, 2)]
    mask = np.array([False, True, False])
    worlds.reset(world_mask=mask, position=POSITIONS[[2, 0, 1]], yaw=YAWS[[2, 0, 1]], youngs_modulus=MODULI[[2, 0, 1]])
    for world, kept in zip((0, 2), before, strict=True):
        assert_equal(snapshot(worlds, world), kept)
    fresh = snapshot(worlds, 1)
    for step in range(STEPS, STEPS + 5):
        worlds.step(actions(3, step))
        single.step(actions(1, step))
    assert_equal(snapshot(worlds, 0), snapshot(single, 0))
    reset(single, slice(0, 1))
    for a, b in zip(fresh, snapshot(single, 0), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_reset_forgets_the_past(single: TableScene) -> None:
    """The same actions after the same reset give the same bits, whatever came before."""
    results = []
    for _ in range(2):
        reset(single, slice(0, 1))
        for step in range(STEPS):
            single.step(actions(1, step))
        results.append(snapshot(single, 0))
    assert_equal(*results)


def test_stiffness_is_checked_at_reset(single: TableScene) -> None:
    """E <= 0 is refused."""
    with pytest.raises(MaterialError, match="youngs_modulus"):
        single.reset(youngs_modulus=np.array([-1.0]))


@pytest.mark.parametrize("given", [{"substeps": 3}, {"substeps": 0}, {"control_hz": 0.0}, {"table_friction": -1.0}])
def test_configuration_is_checked(given: dict) -> None:
    """Every range is checked by name."""
    with pytest.raises(ConfigError, match=next(iter(given))):
        TableSceneConfig(**given)


def test_world_count_is_checked() -> None:
    """A scene has at least one world."""
    with pytest.raises(ConfigError, match="world_count"):
        TableScene(TableSceneConfig(), world_count=0)
