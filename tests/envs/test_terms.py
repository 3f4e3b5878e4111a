"""Terms: weights as values, and what is refused where a term is written."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from softmode.envs.tasks.press_soft.task import PressSoftConfig
from softmode.envs.tasks.push_soft.task import PushSoftConfig
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
