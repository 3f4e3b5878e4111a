"""What goal-conditioned learners (hindsight experience replay) ask of environments, and tasks whose goal is a place."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from types import MethodType
from typing import Any, ClassVar

import numpy as np
import warp as wp

from softmode.deformables.model.structs import filled
from softmode.envs import goal_kernels as kernels
from softmode.envs.observation import Segment, goal_part
from softmode.envs.reward_kernels import EndReason
from softmode.envs.task import Task
from softmode.errors import ConfigError
from softmode.vector_check.tensors import Tensor

Goals = np.ndarray | Tensor
Infos = Mapping[str, Any] | Sequence[Mapping[str, Any]] | np.ndarray | None


class _GoalMethod:
    """A method that environments have only where their observations hold the goals, which is how learners tell them."""

    def __init__(self, method: Callable[..., Any]) -> None:
        self.method, self.__doc__ = method, method.__doc__

    def __get__(self, env: Any, kind: type | None = None) -> Callable[..., Any]:
        if env is None:
            return self.method
        if env.obs_type != "state":
            raise AttributeError(f"{self.method.__name__} needs the goals that obs_type='state' observes")
        return MethodType(self.method, env)


class GoalMethods:
    """Reward and ends of episodes as functions of the goals; only with state observations, which hold them.

    A subclass launches the kernel of the reward; its task has `goal_size`, the numbers of a goal.
    """

    task_class: ClassVar[Any]
    """The task."""
    device: wp.Device
    """Device on which rewards of numpy arrays are computed: that of the task."""

    @_GoalMethod
    def compute_reward(self, achieved_goal: Goals, desired_goal: Goals, info: Infos = None) -> Any:
        """Return the reward of a step that led to `achieved_goal`, bit for bit that of the step on the same device.

        Args:
            achieved_goal: What was reached [m], shape (..., goal_size), a numpy array or a tensor.
            desired_goal: What was to be reached.
            info: Not used.

        Returns:
            Rewards, float32, shape (...): a number, an array, or a tensor on the device of the goals.

        Raises:
            ConfigError: If the shapes do not fit.
        """
        size = self.task_class.goal_size
        pair: tuple[Any, ...] = (achieved_goal, desired_goal)
        if not all(isinstance(goal, Tensor) for goal in pair):
            pair = tuple(np.asarray(goal, np.float32) for goal in pair)
        leading = tuple(pair[0].shape[:-1])
        if any(tuple(goal.shape) != (*leading, size) for goal in pair):
            hint = f"give both the same shape (..., {size})"
            raise ConfigError(f"goals have shapes {tuple(pair[0].shape)} and {tuple(pair[1].shape)}", hint=hint)
        if not isinstance(pair[0], Tensor):
            goals = [wp.array(goal.reshape(-1, size), dtype=float, device=self.device) for goal in pair]
            return self._launch(goals).numpy().reshape(leading)[()]
        with _torch_stream(pair[0]):
            goals = [wp.from_torch(goal.detach().float().reshape(-1, size).contiguous()) for goal in pair]
            return wp.to_torch(self._launch(goals)).reshape(leading)

    def _launch(self, goals: list[wp.array]) -> wp.array:
        """Compute the reward of each row."""
        reward = wp.zeros(goals[0].shape[0], dtype=float, device=goals[0].device)
        self.launch_reward(goals[0], goals[1], reward)
        return reward

    def launch_reward(self, achieved: wp.array, desired: wp.array, reward: wp.array) -> None:
        """Launch the kernel that writes the rewards of pairs of goals.

        Args:
            achieved: What was reached, shape (N, goal_size).
            desired: What was to be reached.
            reward: Receives the rewards, shape (N,).
        """
        raise NotImplementedError

    @_GoalMethod
    def compute_terminated(self, achieved_goal: Goals, desired_goal: Goals, info: Infos = None) -> Any:
        """Return whether the episode ended by a failure, which `info` (one or a sequence) knows; goals end none."""
        if isinstance(info, Mapping):
            return _failed(info)
        if info is None or len(info) == 0:
            return np.zeros(np.shape(achieved_goal)[:-1], bool)[()]
        return np.array([_failed(one) for one in info])

    @_GoalMethod
    def compute_truncated(self, achieved_goal: Goals, desired_goal: Goals, info: Infos = None) -> Any:
        """Return False: the time limit is not the task's."""
        return np.zeros(np.shape(achieved_goal)[:-1], bool)[()]


def _failed(info: Mapping[str, Any]) -> bool:
    """Return whether an info is that of a failure."""
    return bool(info.get("end_reason", EndReason.RUNNING) > EndReason.TIME_LIMIT)


def _torch_stream(tensor: Any) -> contextlib.AbstractContextManager[object]:
    """Return the context in which kernels wait for what torch does on the device of a tensor."""
    if not tensor.is_cuda:
        return contextlib.nullcontext()
    import torch

    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(tensor.device)))


def goal_rules(config: Any, goal_size: int) -> Any:
    """Return what the reward depends on beside the goals, of a configuration with the fields of `PositionGoals`."""
    return filled(kernels.GoalRules, config, goal_size=goal_size, sparse=int(config.reward_mode == "sparse"))


class PositionGoals(Task):
    """A goal-conditioned variant of a task that observes a place as ``goal``; put it before that task.

    A state observation is a dict: ``achieved_goal`` is the object's centre of mass [m], ``desired_goal`` where it is to
    be, the first `goal_size` of x, y, z, and ``observation`` the object's part and proprioception, nothing of the goal.
    The full vector has the parts of the other task as well, so that its scripted policy plays this one too.

    The reward is a function of both goals, ``GoalMethods.compute_reward``; its one term is ``goal``. Success: within
    ``goal_tolerance`` for ``hold_steps`` steps in a row.
    """

    goal_size: ClassVar[int] = 3
    """Numbers of a goal."""
    term_names = ("goal",)

    def object_segments(self) -> tuple[Segment, ...]:
        """Both goals, and what the task adds."""
        reached = goal_part(self.scene.controller.joint_count, self.goal_size)
        return (*reached, Segment("desired_goal", self.goal_size, -2.0, 2.0), *super().object_segments())

    def build(self) -> None:
        """Find the columns."""
        super().build()
        self._goal_columns = self.layout.columns_in(kernels.GoalColumns)
        self._goal_rules = goal_rules(self.config, self.goal_size)

    def observe(self) -> None:
        """Write both goals."""
        super().observe()
        self.launch(kernels.observe_goals, [self._goal_columns, self._goal_rules], [self.result])

    def evaluate(self) -> None:
        """Write the reward and whether the goal is met."""
        self.launch(kernels.evaluate_goals, [self._goal_columns, self._goal_rules], [self.result])


class PositionGoalMethods(GoalMethods):
    """Rewards of places."""

    config: Any

    def launch_reward(self, achieved: wp.array, desired: wp.array, reward: wp.array) -> None:
        """Compute the rewards of pairs of places."""
        inputs = [achieved, desired, goal_rules(self.config, self.task_class.goal_size)]
        wp.launch(kernels.compute_goal_reward, reward.shape[0], inputs=inputs, outputs=[reward], device=reward.device)
