"""Tasks made of terms: PushSoft and PressSoft pay the same, every kind of term works, wrong ones are refused."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
import warp as wp
from gymnasium.vector import AutoresetMode

from softmode.envs import EndReason, SoftEnv, SoftVectorEnv, check_vector_env
from softmode.envs.scripted import scripted_policy
from softmode.envs.tasks.press_soft.task import PressSoft, PressSoftConfig
from softmode.envs.tasks.push_soft.task import PushSoft, PushSoftConfig
from softmode.envs.term_task import TermTask
from softmode.envs.terms import (
    CurriculumTerm,
    EventTerm,
    MetricTerm,
    ObservationTerm,
    RewardTerm,
    SuccessTerm,
    TerminationTerm,
    Terms,
)
from softmode.errors import ConfigError
from softmode.learning.config_values import config_of, values_of
from tests.envs import term_kernels as kernels
from tests.envs.conftest import MakeEnv

PUSH = Terms(
    rewards={
        "reach": RewardTerm(kernels.push_reach, weight=0.5, params={"steepness": 8.0}),
        "progress": RewardTerm(kernels.push_progress, memory=-1.0),
        "goal": RewardTerm(kernels.push_goal),
        "rest": RewardTerm(kernels.push_rest, weight=2.0),
    },
    success=SuccessTerm(kernels.push_solved, hold_steps=10),
)
PRESS = Terms(
    rewards={
        "reach": RewardTerm(kernels.press_reach),
        "force": RewardTerm(kernels.press_force, weight=1.5),
        "hold": RewardTerm(kernels.press_hold, weight=2.0),
        "overshoot": RewardTerm(kernels.press_overshoot, weight=-1.0),
    },
    success=SuccessTerm(kernels.press_there, hold_steps=15),
)
MORE = replace(
    PRESS,
    metrics={"height": MetricTerm(kernels.height)},
    observations={
        "tool": ObservationTerm(kernels.tool_height, size=2, part="goal"),
        "tool_again": ObservationTerm(kernels.tool_height, size=2, low=(0.0, 0.0), high=(0.05, 2.0)),
    },
    terminations={"late": TerminationTerm(kernels.late, params={"steps": 5})},
    events={
        "turn": EventTerm(kernels.turn, params={"angle": 0.3}),
        "count": EventTerm(kernels.count_steps, mode="step", memory=0.0),
    },
    curricula={
        "force": CurriculumTerm(
            kernels.harder, params={"step": 0.25}, parameter="goal_force", easy_low=(2.0,), easy_high=(2.5,)
        )
    },
)


@dataclass(frozen=True, kw_only=True)
class PushTermsConfig(PushSoftConfig):
    """PushSoft with terms."""

    terms: Terms = field(default_factory=lambda: PUSH)


@dataclass(frozen=True, kw_only=True)
class PressTermsConfig(PressSoftConfig):
    """PressSoft with terms."""

    terms: Terms = field(default_factory=lambda: PRESS)


class PushTerms(TermTask, PushSoft):
    """PushSoft, whose reward and success are terms."""

    config_class = PushTermsConfig


class PressTerms(TermTask, PressSoft):
    """PressSoft, whose reward and success are terms."""

    config_class = PressTermsConfig


class PushTermsEnv(SoftEnv):
    """The environment."""

    task_class = PushTerms


class PressTermsEnv(SoftEnv):
    """The environment."""

    task_class = PressTerms


class PressTermsVectorEnv(SoftVectorEnv):
    """The vector environment."""

    task_class = PressTerms


@pytest.fixture(scope="module")
def more() -> Iterator[Any]:
    """Return PressSoft with terms of every kind."""
    env = PressTermsEnv(config=PressTermsConfig(terms=MORE))
    yield env
    env.close()


@pytest.mark.parametrize(
    ("made_of_terms", "by_hand"),
    [(PushTermsEnv, "PushSoft"), pytest.param(PressTermsEnv, "PressSoft", marks=pytest.mark.rest)],
)
def test_terms_pay_what_the_kernels_pay(make_env: MakeEnv, made_of_terms: Callable[[], Any], by_hand: str) -> None:
    """A scripted episode, to its success: every term is equal, to float32 where products are taken in another order."""
    ours, theirs = made_of_terms(), make_env(by_hand).unwrapped
    seen, _ = ours.reset(seed=2)
    np.testing.assert_array_equal(seen, theirs.reset(seed=2)[0])
    policy, paid = scripted_policy(theirs), set()
    for _ in range(120):
        action = policy(seen)
        seen, reward, *_, mine = ours.step(action)
        other, expected, *_, info = theirs.step(action)
        np.testing.assert_array_equal(seen, other)
        assert tuple(mine["reward_terms"]) == tuple(info["reward_terms"])
        for name, value in info["reward_terms"].items():
            assert mine["reward_terms"][name] == pytest.approx(value, rel=1e-5, abs=1e-7), name
            paid |= {name} if abs(value) > 1e-3 else set()
        assert reward == pytest.approx(expected, rel=1e-5) and mine["is_success"] == info["is_success"]
        if info["is_success"]:
            break
    assert info["is_success"] and paid >= set(info["reward_terms"]) - {"overshoot"}
    ours.close()


def test_figures_observations_events_and_failures(more: Any) -> None:
    """What the kernels write is in info and observation, within its bounds, where the part says."""
    task = more.task
    _, info = more.reset(seed=1)
    assert info["parameters"]["yaw"] == pytest.approx(0.3) and 2.0 <= info["parameters"]["goal_force"] <= 2.5
    for step in range(6):
        seen, _, terminated, _, info = more.step(np.zeros(5, np.float32))
        assert terminated == (step == 5) and info["end_reason"] == (EndReason.FAILED if terminated else 0)
    assert info["failure"] == "failed"
    z = more.scene.controller.tool_pose.numpy()[0, 2]
    first, second = (task.segments[name][0] for name in ("tool", "tool_again"))
    np.testing.assert_allclose(seen[first], [z, 2.0 * z], rtol=1e-6)
    np.testing.assert_allclose(seen[second], [min(z, 0.05), 2.0 * z], rtol=1e-6)
    assert first.stop <= task.agent_size <= second.start and z > 0.05
    assert info["height"] == pytest.approx(more.scene.object_position.numpy()[0, 0, 2])
    assert task.state_arrays()["memory_step_count"].numpy().tolist() == [6.0]
    more.reset()
    assert task.state_arrays()["memory_step_count"].numpy().tolist() == [0.0]


def test_a_curriculum_goes_up_with_successes(more: Any) -> None:
    """A level of 0 draws from the easy range, each success opens a quarter more; a seed begins anew."""
    task, config = more.task, more.config
    more.reset(seed=4)
    drawn = []
    for _ in range(6):
        drawn.append((float(task.state_arrays()["level_force"].numpy()[0]), task.table.values.numpy()[0].copy()))
        task.success.fill_(True)
        more.reset()
    levels = [level for level, _ in drawn]
    assert levels == [0.0, 0.25, 0.5, 0.75, 1.0, 1.0]
    column, (low, high) = task.table.column("goal_force"), config.force_range
    assert all(low <= row[column] <= 2.5 + level * (high - 2.5) for level, row in drawn)
    assert max(row[column] for _, row in drawn) > 2.5
    task.success.fill_(False)
    more.reset()
    assert task.state_arrays()["level_force"].numpy()[0] == 0.75
    more.reset(seed=4)
    np.testing.assert_array_equal(task.table.values.numpy()[0], drawn[0][1])


@pytest.mark.parametrize(
    "mode", [AutoresetMode.SAME_STEP, pytest.param(AutoresetMode.NEXT_STEP, marks=pytest.mark.rest)]
)
def test_many_worlds_keep_the_rules(mode: AutoresetMode) -> None:
    """The checker finds no broken rule: seeds, ends, isolation, with memories, levels and events."""

    def make(count: int) -> Any:
        config = PressTermsConfig(terms=MORE)
        return PressTermsVectorEnv(count, config=config, autoreset_mode=mode, max_episode_steps=4)

    report = check_vector_env(make, num_envs=2, steps=7)
    assert not report.notes


def test_weights_are_values() -> None:
    """Weights are exchanged by name, travel as JSON values and pickles, and configurations are equal by value."""
    config = PressTermsConfig(terms=PRESS.weighted(hold=5.0))
    assert config.terms.rewards["hold"].weight == 5.0 and config != PressTermsConfig()
    values = values_of(config)
    assert values == {"terms": {"rewards": {"hold": {"weight": 5.0}}}}
    assert config_of(PressTermsConfig, values) == config
    assert pickle.loads(pickle.dumps(config)) == config == copy.deepcopy(config)
    with pytest.raises(ConfigError, match="no reward 'hodl'"):
        PRESS.weighted(hodl=1.0)
    with pytest.raises(ConfigError, match="hodl"):
        config_of(PressTermsConfig, {"terms": {"rewards": {"hodl": {"weight": 5.0}}}})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RewardTerm(kernels.tool_height), r"must write out, shape \(worlds,\)"),
        (lambda: RewardTerm(kernels.always), "float"),
        (lambda: ObservationTerm(kernels.height), r"\(worlds, size\)"),
        (lambda: SuccessTerm(kernels.height), "bool"),
        (lambda: RewardTerm(kernels.writes_nothing), "out"),
        (lambda: RewardTerm(kernels.resting), "@wp.kernel"),
        (lambda: RewardTerm(kernels.height, weight=np.nan), "weight"),
        (lambda: SuccessTerm(kernels.always, hold_steps=0), "hold_steps"),
        (lambda: EventTerm(kernels.turn, mode="often"), "mode"),
        (lambda: ObservationTerm(kernels.tool_height, size=2, low=(0.0,)), "low has 1 numbers"),
        (lambda: Terms(rewards={"height": MetricTerm(kernels.height)}), "Give a RewardTerm"),
    ],
)
def test_wrong_terms_are_refused(make: Callable[[], object], message: str) -> None:
    """Shapes, kinds and numbers are checked where a term is written."""
    with pytest.raises(ConfigError, match=message):
        make()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rewards": {"reach": RewardTerm(kernels.push_reach)}}, "metric_goal_distance"),
        ({"metrics": {"h": MetricTerm(kernels.height, params={"size": 1.0})}}, "takes no 'size'"),
        ({"terminations": {"late": TerminationTerm(kernels.late, params={"steps": 0.5})}}, "whole number"),
        ({"events": {"count": EventTerm(kernels.count_steps)}}, "memory"),
        ({"curricula": {"c": replace(MORE.curricula["force"], parameter="speed")}}, "nothing is drawn as 'speed'"),
        ({"curricula": {"c": replace(MORE.curricula["force"], easy_low=(1.0, 2.0))}}, "must hold 1 numbers"),
    ],
)
def test_terms_that_do_not_fit_the_task_are_refused(more: Any, change: dict[str, Any], message: str) -> None:
    """What a kernel asks for is found by its name, or the name is told."""
    task = copy.copy(more.task)
    task.config = PressTermsConfig(terms=replace(PRESS, **change))
    with pytest.raises(ConfigError, match=message):
        TermTask.build(task)
    assert isinstance(task.device, wp.Device)
