"""Newton's iteration in one launch does what the launches per phase do; a carried stiffness only saves time."""

import dataclasses
import functools
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

from softmode.deformables.newton import round_kernels
from softmode.deformables.newton.one_launch_kernels import newton_kernel
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.solver import minimise
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from softmode.deformables.solver.step_tables import StepTables
from softmode.envs.presets import RL_BUILD, RL_SOLVER, rl_scene
from softmode.scenes.table_scene import TableScene, TableSceneConfig
from tests.marks import rest_but

CLOSE = np.array([0.0, 0.0, -1.0, 0.0, 1.0], np.float32)


def grasp(
    device: str,
    *,
    one_launch: bool,
    shared: bool = False,
    rounds: int = 0,
    room: int = 0,
    teams: tuple[int, int] | None = None,
    worlds: int = 2,
    eager: bool = False,
) -> dict[str, np.ndarray]:
    """Lower the open gripper over the object, close it until both fingers press, and return where everything is.

    Args:
        device: Where.
        one_launch: Whether all Newton iterations of a world are one launch.
        shared: Whether that solves in shared memory.
        rounds: Rounds of launches before it.
        room: Most worlds that may go beside the rounds.
        teams: Threads that share a world in the one launch and in rounds; None for what is usual.
        worlds: How many.
        eager: Whether one more step is taken without a graph at the end.
    """
    scene = TableScene(rl_scene(), world_count=worlds, device=device)
    reduced = scene.solver.reduced
    system = reduced.tables.system
    size = (system.size, system.scalars.shape[2]) if shared else ()
    team, round_team = teams or (reduced.tables.world_team, reduced.tables.round_team)
    kernel = newton_kernel(system.unit.dtype, *size, team=team)  # as the solver compiles it
    ways: dict[str, Any] = {
        "world_team": team,
        "round_team": round_team,
        "one_launch": one_launch,
        "shared": shared,
        "rounds": rounds,
        "room": room,
        "held": 0,
        "fused_kernel": kernel,
    }
    reduced.tables = dataclasses.replace(reduced.tables, **ways)
    aside = np.zeros(worlds, bool)
    for step in range(32):
        height = scene.controller.target_position.numpy()[0, 2]
        down = np.clip((scene.soft.height - height) / 0.015, -1.0, 1.0)
        grip = 1.0 if step < 16 else max(1.0 - 0.08 * (step - 15), -0.3)
        scene.step(np.tile(np.array([0.0, 0.0, down, 0.0, grip], np.float32), (worlds, 1)))
        aside |= reduced.tables.newton.aside.numpy() != 0
    if eager:
        scene.control_step()
    assert (np.linalg.norm(scene.finger_force.numpy(), axis=2) > 0.5).all()
    assert not scene.status.any()
    arrays = {"q": scene.state.softmode.q, "joint_q": scene.state.joint_q, "force": scene.finger_force}
    return {"aside": aside} | {name: array.numpy() for name, array in arrays.items()}


@pytest.mark.rest
def test_one_launch_equals_launches_per_phase() -> None:
    """On CPU a team is one thread and every sum has one order: equal to the bit, in a grasp."""
    apart, at_once = (grasp("cpu", one_launch=flag) for flag in (False, True))
    for name, value in apart.items():
        np.testing.assert_array_equal(at_once[name], value)


def test_accepted_trial_serves_the_next_iteration(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the line search has found at an accepted trial is what an evaluation there finds: equal to the bit."""
    kept = grasp("cpu", one_launch=False, worlds=1, eager=True)
    again, seen = minimise.evaluate, []

    def evaluate(tables: StepTables, dt: float, *, derivatives: bool) -> None:
        if not tables.model.device.is_capturing:
            seen.append(tables.newton.evaluated.numpy()[0])
        tables.newton.evaluated.zero_()
        again(tables, dt, derivatives=derivatives)

    monkeypatch.setattr(minimise, "evaluate", evaluate)
    for name, value in grasp("cpu", one_launch=False, worlds=1, eager=True).items():
        np.testing.assert_array_equal(kept[name], value)
    assert 0 < sum(seen) < len(seen)


def test_list_of_acting_contacts() -> None:
    """Sums go over the contacts with a force or a Hessian, in order; at rest most samples of the underside are near."""
    scene = TableScene(rl_scene())
    for _ in range(2):
        scene.step(np.zeros(5, np.float32))
    tables = scene.solver.reduced.tables
    tables.newton.active.fill_(1)
    minimise.evaluate(tables, scene.dt, derivatives=True)
    constraints = tables.constraints
    count, listed = (int(array.numpy()[0]) for array in (constraints.count, constraints.acting_count))
    force, hessian = (array.numpy()[0, :count] for array in (constraints.force, constraints.hessian))
    acts = force.any(axis=1) | hessian.any(axis=(1, 2))
    assert 0 < acts.sum() < count
    np.testing.assert_array_equal(constraints.acting.numpy()[0, :listed], np.flatnonzero(acts))


@pytest.mark.slow
def test_packed_system_grasps_as_the_launches_do() -> None:
    """Single precision sums in another order: places within 1e-6 of 0.1 m, forces within 1e-5."""
    apart, packed = (grasp("cpu", one_launch=shared, shared=shared, worlds=1) for shared in (False, True))
    for name in ("q", "joint_q"):
        np.testing.assert_allclose(packed[name], apart[name], atol=1.0e-7)
    np.testing.assert_allclose(packed["force"], apart["force"], atol=1.0e-5 * np.abs(apart["force"]).max())


@functools.cache
def in_one_launch() -> dict[str, np.ndarray]:
    """Return the grasp of the one launch alone."""
    return grasp("cpu", one_launch=True)


@pytest.mark.parametrize("rounds, room", [(1, 0), (40, 0), (40, 2)])
def test_rounds_of_launches_grasp_as_the_one_launch_does(rounds: int, room: int) -> None:
    """Worlds go on in the one launch from wherever a round left them, end in the rounds, or go beside them.

    Sums have another order, and the one launch evaluates in lanes: both stop within 1e-3 of the forces.
    """
    alone, after = in_one_launch(), grasp("cpu", one_launch=True, rounds=rounds, room=room)
    assert (after["aside"] == (room > 0)).all()
    for name in ("q", "joint_q"):
        np.testing.assert_allclose(after[name], alone[name], atol=1.0e-7)
    np.testing.assert_allclose(after["force"], alone["force"], atol=1.0e-5 * np.abs(alone["force"]).max())


def test_slowest_worlds_go_beside_the_rounds() -> None:
    """They are those with most iterations in the last steps, half an iteration less per step, two at the least."""
    tables = TableScene(rl_scene(), world_count=6, device="cpu").solver.reduced.tables
    step, state = tables.newton_step(0.01), tables.newton

    def chosen(iterations: list[int], room: int) -> list[int]:
        state.iteration.assign(iterations)
        state.level_count.zero_()
        tables.launch(round_kernels.expect_iterations, 6, step)
        tables.launch(round_kernels.start_trials, (6, 1), step, 0, room)
        return state.aside.numpy().tolist()

    assert chosen([1, 2, 3, 5, 9, 20], 6) == [0, 1, 1, 1, 1, 1]
    assert chosen([1, 2, 3, 5, 9, 20], 2) == [0, 0, 0, 0, 1, 1]
    assert chosen([1, 1, 1, 1, 1, 1], 6) == [0, 0, 1, 1, 1, 1]  # of the last four 2.5, 4.5, 8.5 and 19.5 are expected
    assert chosen([1, 1, 1, 8, 1, 1], 2) == [0, 0, 0, 0, 0, 1]  # there is no room for all of which 8 are expected
    assert chosen([1, 1, 1, 1, 1, 1], 0) == [0] * 6


@pytest.mark.slow
def test_numbers_one_by_one_grasp_as_eights_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """The code for CUDA, where a thread takes one number or one function, by one thread on CPU, in all rounds.

    Sums have another order: places within 1e-6 of 0.1 m, forces within 1e-5.
    """
    eights = grasp("cpu", one_launch=True)
    options = {"extra_build_options": wp.ModuleBuildOptions(extra_cpu_preamble="#define SOFTMODE_ONE_BY_ONE")}
    for make in (round_kernels.check_kernel, round_kernels.direct_kernel):
        monkeypatch.setattr(round_kernels, make.__name__, one_by_one(make, options))
    wp.set_module_options(options, module=round_kernels)
    try:
        ones = grasp("cpu", one_launch=True, rounds=40)
    finally:
        wp.set_module_options({"extra_build_options": None}, module=round_kernels)
    for name in ("q", "joint_q"):
        np.testing.assert_allclose(ones[name], eights[name], atol=1.0e-7)
    np.testing.assert_allclose(ones["force"], eights["force"], atol=1.0e-5 * np.abs(eights["force"]).max())


def one_by_one(make: Any, options: dict[str, Any]) -> Any:
    """Return a function that makes kernels as ``make`` does, not those that others have, with options of a module."""

    @functools.cache
    def made(*sizes: int) -> Any:
        kernel = make.__wrapped__(*sizes)
        kernel.module.options.update(options)
        return kernel

    return made


@pytest.mark.gpu
@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a GPU")
@pytest.mark.parametrize(
    "shared, rounds, room", [(False, 0, 0), (True, 0, 0), (True, 1, 0), (True, 40, 0), (True, 5, 2)]
)
def test_one_launch_on_cuda(shared: bool, rounds: int, room: int) -> None:
    """Sums have another order: coordinates agree within the solve's tolerance, 1e-4 of 0.1 m, forces within 1e-3."""
    apart = grasp("cuda:0", one_launch=False)
    teams = (192, 96) if room else None  # as thousands of worlds have
    at_once = grasp("cuda:0", one_launch=True, shared=shared, rounds=rounds, room=room, teams=teams)
    for name in ("q", "joint_q"):
        np.testing.assert_allclose(at_once[name], apart[name], atol=1.0e-5)
    np.testing.assert_allclose(at_once["force"], apart["force"], atol=1.0e-3 * np.abs(apart["force"]).max())


EVALUATED = ("potential.evaluate_kernels", ("evaluate_constraints", "evaluate_points"))


@pytest.mark.skipif(sys.platform != "linux", reason="needs the CUDA compiler of Warp's wheel")
@pytest.mark.parametrize(
    ("module", "entries"),
    rest_but(
        [EVALUATED],
        [
            EVALUATED,
            ("newton.search_kernels", ("check_iterates", "reuse_hessians")),
            ("system.assembly_kernels", ("assemble_matrix", "assemble_columns", "assemble_pins")),
            ("system.tile_kernels", ("assemble_tiles",)),
            ("newton.round_kernels", ("evaluate_trials", "differentiate_points", "assemble_stiffness")),
        ],
    ),
)
def test_no_thread_copies_the_tables(module: str, entries: tuple[str, ...], tmp_path: Path) -> None:
    """Compiled for CUDA, no kernel has the 8 kB of the step's struct in its threads' own memory."""
    name = f"softmode.deformables.{module}"
    for part in (name, f"{name}.phases"):
        if wp.get_module(part).kernels:
            wp.compile_aot_module(wp.get_module(part), arch=90, module_dir=tmp_path, use_ptx=True)
    text = "".join(code.read_text(errors="replace") for code in tmp_path.glob("*.ptx"))
    assert all(f".entry {entry}" in text for entry in entries)
    assert max([int(size) for size in re.findall(r"__local_depot\d+\[(\d+)\];", text)], default=0) < 1000


@pytest.mark.gpu
@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a GPU")
@pytest.mark.parametrize("function_count", [16, 32, 48, 56])
def test_one_launch_of_every_size_on_cuda(function_count: int) -> None:
    """48 to 168 unknowns in shared memory, asked for at the launch from 144 on: places within 1e-4 of 0.1 m."""
    config = rl_scene()
    build = BuildOptions(function_count=function_count)
    config = dataclasses.replace(config, object=dataclasses.replace(config.object, build=build))
    places = []
    for one_launch in (False, True):
        scene = TableScene(config, world_count=2, device="cuda:0")
        reduced = scene.solver.reduced
        assert reduced.tables.one_launch and reduced.tables.shared
        reduced.tables = dataclasses.replace(reduced.tables, one_launch=one_launch)
        for step in range(12):
            scene.step(np.tile(CLOSE if step < 9 else -CLOSE, (2, 1)))
        assert not scene.status.any()
        places.append(scene.state.particle_q.numpy())
    np.testing.assert_allclose(places[1], places[0], atol=1.0e-5)


def test_carried_stiffness_agrees_within_tolerance() -> None:
    """The Hessian of an earlier step changes how Newton gets to the minimum, not where that is: |dx| < 1e-4 size."""
    places = []
    for carry in (False, True):
        options = SolverReducedOptions(carry_stiffness=carry)
        scene = TableScene(TableSceneConfig(substeps=4, solver=options))
        for step in range(12):
            scene.step(CLOSE if step < 9 else -CLOSE)
        assert not scene.status.any()
        places.append(scene.state.particle_q.numpy())
    assert np.abs(places[1] - places[0]).max() < 1.0e-4 * 0.08


def test_carried_stiffness_follows_the_material() -> None:
    """A body at rest that becomes ten times softer sags at once: its kept Hessian does not serve another material."""
    scene = TableScene(rl_scene())
    still = np.zeros(5, np.float32)
    for _ in range(4):
        scene.step(still)
    before = scene.object_position.numpy().reshape(-1, 3)[0, 2]
    modulus = scene.model.softmode.youngs_modulus
    modulus.assign(0.02 * modulus.numpy())
    for _ in range(6):
        scene.step(still)
    assert before - scene.object_position.numpy().reshape(-1, 3)[0, 2] > 2.0e-4
    assert not scene.status.any()


def test_reset_forgets_the_stiffness() -> None:
    """After a reset a world is as new: the same actions give the same bits."""
    scene = TableScene(rl_scene())
    runs = []
    for _ in range(2):
        scene.reset()
        for step in range(4):
            scene.step(CLOSE if step % 2 else -CLOSE)
        runs.append(scene.state.softmode.q.numpy())
    np.testing.assert_array_equal(runs[1], runs[0])


def test_rl_scene_keeps_the_rest() -> None:
    """Only body, solver and substeps change; 1/120 s at 30 control steps per second are four."""
    config = TableSceneConfig(table_friction=0.3, control_hz=30.0)
    scene = rl_scene(config)
    assert (scene.substeps, scene.solver, scene.object.build) == (4, RL_SOLVER, RL_BUILD)
    assert scene.table_friction == 0.3
    assert rl_scene(TableSceneConfig(control_hz=60.0)).substeps == 2
