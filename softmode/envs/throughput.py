"""How many steps a vector environment makes per second, and whether anything happens in them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import warp as wp

from softmode.envs.arguments import checked_device
from softmode.envs.reward_kernels import TOUCH_FORCE
from softmode.envs.soft_vector_env import SoftVectorEnv
from softmode.errors import ConfigError
from softmode.scenes.capture import capture_graph

Actions = Literal["random", "grasp"]


@dataclass(frozen=True, kw_only=True)
class Throughput:
    """What `measure_throughput` found."""

    num_envs: int
    """Worlds."""
    seconds: float
    """Time of all measured steps [s]."""
    steps: int
    """Measured control steps."""
    touching: float
    """Share of worlds and steps in which a finger touched the object."""
    failures: int
    """Episodes that ended by a failure."""
    megabytes: float
    """Device memory taken since before the environment was made, 0 on CPU."""

    @property
    def rate(self) -> float:
        """Environment steps per second, all worlds together."""
        return self.num_envs * self.steps / self.seconds


def measure_throughput(
    env: SoftVectorEnv,
    *,
    steps: int = 500,
    warmup: int = 100,
    actions: Actions = "random",
    seed: int = 0,
    free_before: int = 0,
) -> Throughput:
    """Time `env.step` with random actions.

    Args:
        env: State or pixel observations, numpy or torch.
        steps: Measured control steps.
        warmup: Steps before them.
        actions: "random": uniform in [-1, 1]; "grasp": noise around going to the object, the gripper closing on it
            most of the time, so that contact is active.
        seed: Seed of episodes and actions.
        free_before: Free device memory before the environment was made [bytes].

    Raises:
        ConfigError: If there is no step to measure.
    """
    check_steps(steps, warmup)
    tensors = env.output == "torch"
    env.reset(seed=seed)
    source = _Source(env, actions, seed)
    failures = touching = 0.0
    clock = time.perf_counter()
    column = env.task_columns("finger_force")
    for step in range(warmup + steps):
        if step == warmup:
            wp.synchronize_device(env.device)
            clock, failures, touching = time.perf_counter(), 0.0, 0.0
        _, _, terminated, _, _ = env.step(source(step))
        force = env.state_observation[:, column]
        failures = failures + terminated.sum()
        touching = touching + (force > TOUCH_FORCE).any(1).sum()
    wp.synchronize_device(env.device)
    seconds = time.perf_counter() - clock
    taken = (free_before - env.device.free_memory) / 1e6 if tensors and env.device.is_cuda and free_before else 0.0
    return Throughput(
        num_envs=env.num_envs,
        seconds=seconds,
        steps=steps,
        touching=float(touching) / (steps * env.num_envs),
        failures=int(failures),
        megabytes=max(taken, 0.0),
    )


def report_throughput(
    name: str,
    num_envs: int,
    options: dict[str, Any],
    *,
    steps: int = 500,
    warmup: int = 100,
    actions: Actions = "random",
    stages: bool = False,
    made: Callable[[gym.vector.VectorEnv], None] | None = None,
) -> Throughput:
    """Make the vector environment of an id, measure it, print a line, close it.

    Args:
        name: Id of the environment.
        num_envs: Number of worlds.
        options: Keyword arguments of the environment.
        steps: Measured control steps.
        warmup: Steps before them.
        actions: See :func:`measure_throughput`.
        stages: Whether to print the time of the parts of a step.
        made: Called with the environment before it is measured.
    """
    check_steps(steps, warmup)
    device = checked_device(options.get("device"))
    free = device.free_memory if device.is_cuda else 0
    clock = time.perf_counter()
    env = gym.make_vec(name, num_envs=num_envs, **options)
    assert isinstance(env, SoftVectorEnv)
    seconds = time.perf_counter() - clock
    if made is not None:
        made(env)
    result = measure_throughput(env, steps=steps, warmup=warmup, actions=actions, free_before=free)
    memory = f", {result.megabytes:,.0f} MB" if device.is_cuda else ""
    print(
        f"{num_envs} worlds, {actions} actions: {result.rate:,.0f} env-steps/s, "
        f"{1e3 * result.seconds / result.steps:.2f} ms per step, a finger touches in {100 * result.touching:.0f} %, "
        f"{result.failures} failures{memory}, made in {seconds:.1f} s",
        flush=True,
    )
    if stages and options.get("processes", 1) == 1:
        print("  " + ", ".join(f"{part} {spent:.2f} ms" for part, spent in stage_times(env).items()), flush=True)
    env.close()
    return result


def check_steps(steps: int, warmup: int) -> None:
    """Raise ConfigError if there is no step to measure."""
    if steps < 1 or warmup < 0:
        raise ConfigError(f"steps is {steps}, warmup {warmup}", hint="measure at least one step, after 0 or more")


class _Source:
    """Actions, made where the observations are."""

    KEPT = 32
    """Random batches that are made once and used in turn."""

    def __init__(self, env: SoftVectorEnv, kind: Actions, seed: int) -> None:
        self._env, self._kind = env, kind
        assert env.action_space.shape is not None
        random = np.random.default_rng(seed).uniform(-1.0, 1.0, (self.KEPT, *env.action_space.shape))
        self._batches: Any = random.astype(np.float32)
        if env.output == "torch":
            import torch

            self._batches = torch.from_numpy(self._batches).to(wp.device_to_torch(env.device))
        self._offset = env.task_columns("object_offset")
        self._scale = env.config.scene.control.translation_scale

    def __call__(self, step: int) -> Any:
        noise = self._batches[step % self.KEPT]
        if self._kind == "random":
            return noise
        offset = self._env.state_observation[:, self._offset]
        actions = 0.3 * noise
        aside = (offset[:, :2] ** 2).sum(1) > 0.02**2
        actions[:, :2] += 0.5 * offset[:, :2] / self._scale
        actions[:, 2] += 0.5 * (offset[:, 2] + 0.08 * aside) / self._scale
        # a world's gripper closes in five of six spells of sixteen steps
        actions[:, -1] = 1.0 if (step // 16) % 6 == 0 else -0.6
        return actions.clip(-1.0, 1.0)


def stage_times(env: SoftVectorEnv, repeats: int = 20) -> dict[str, float]:
    """Return the median time of parts of a control step [ms], each captured as a graph of its own.

    Args:
        env: The environment, whose worlds live in this process and go on from where they are.
        repeats: Replays per part.
    """
    task = env.task
    parts: dict[str, Callable[[], None]] = {
        "physics": task.scene.control_step,
        "observe and judge": lambda: task.judge(task.episodes.never),
        "masked reset": lambda: task.restart(task.episodes.never),
    }
    if task.pictures.images:
        parts["camera"] = task.pictures.draw
    graphs = {"whole step": task.graph}
    graphs |= {name: capture_graph(part, task.device) for name, part in parts.items()}
    spent: dict[str, list[float]] = {name: [] for name in graphs}
    for _ in range(repeats + 2):  # in turn, so that all see the same states
        for name, graph in graphs.items():
            wp.synchronize_device(task.device)
            clock = time.perf_counter()
            graph.launch()
            wp.synchronize_device(task.device)
            spent[name].append(1e3 * (time.perf_counter() - clock))
    return {name: float(np.median(times[2:])) for name, times in spent.items()}
