"""How far Newton steps: to where contact and friction stop the motion, not by trial alone."""

import dataclasses

import numpy as np
import pytest
import warp as wp

from softmode.deformables.solver import minimise
from softmode.deformables.solver import search_kernels as search
from softmode.deformables.solver.step_tables import StepTables
from softmode.envs.presets import rl_scene
from softmode.scenes.table_scene import TableScene
from tests.deformables import probe_kernels

LENGTHS = np.array([0.9, 0.75, 0.6, 0.5, 0.4, 0.3, 0.25, 0.2, 0.125, 0.0625, 0.03125, 0.015625])


def potentials_at(t: StepTables, dt: float, lengths: np.ndarray) -> np.ndarray:
    """Return the potential of each searching world at a length of its step [J]."""
    worlds, step = t.layout.world_count, t.newton_step(dt)
    found = wp.zeros(worlds, dtype=wp.float64, device=t.model.device)
    t.newton.step_length.assign(lengths)
    t.launch(search.trial_functions, (t.layout.instance_count, 1), step, 1)
    t.launch(search.trial_rigid, (worlds, t.rigid.count_max), step)
    minimise.evaluate_trial(t, dt)
    t.launch(probe_kernels.sum_trials, worlds, step, found)
    return found.numpy()


def test_refused_step_goes_to_the_minimum_along_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a full step raises the potential, the next trial has 0.8 of the decrease of the best of twelve lengths.

    Grippers that close on plush toys and jerk them about; the potential at each length is evaluated anew.
    """
    worlds, random = 24, np.random.default_rng(0)
    scene = TableScene(rl_scene(), world_count=worlds)
    shares = []
    before = minimise._try_step

    def try_step(tables: StepTables, dt: float) -> None:
        newton = tables.newton
        full = newton.step_length.numpy() == 1.0
        before(tables, dt)
        searching, chosen = newton.searching.numpy().copy(), newton.step_length.numpy().copy()
        refused = full & (searching != 0) & (chosen < 1.0)
        if not refused.any():
            return
        newton.searching.assign(refused.astype(np.int32))
        start = newton.potential.numpy()
        reached = potentials_at(tables, dt, chosen)
        best = np.min([potentials_at(tables, dt, np.full(worlds, length)) for length in LENGTHS], axis=0)
        newton.step_length.assign(chosen)
        newton.searching.assign(searching)
        refused &= start - best > 1.0e-9 * np.abs(start)
        shares.extend((start - reached)[refused] / (start - best)[refused])

    monkeypatch.setattr(minimise, "_try_step", try_step)
    for step in range(40):
        height = scene.controller.target_position.numpy()[:, 2]
        down = np.clip((scene.soft.height - height) / 0.015, -1.0, 1.0)
        actions = random.uniform(-1.0, 1.0, (worlds, 5)).astype(np.float32)
        actions[:, 2:] = np.column_stack(
            [down, actions[:, 3], np.full(worlds, max(1.0 - 0.15 * max(step - 15, 0), -1.0))]
        )
        actions[:, :2] *= step > 24
        if step < 22:
            scene.step(actions)
            continue
        scene.solver.reduced.tables = dataclasses.replace(scene.solver.reduced.tables, one_launch=False)
        scene.actions.assign(actions)
        scene.control_step()
    assert len(shares) >= 20
    assert min(shares) > 0.8, sorted(shares)[:5]
