"""A new task in 60 lines: knock over a soft post. Observations, pictures, random draws, vectors and tensors come free.

What stands between the two rules is the task: what is on the table, what is rewarded, when it is solved.
Run: ``python examples/custom_env.py [--short]``; writes ``out/custom_env.mp4``
"""

import argparse
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import warp as wp
from gymnasium.utils.env_checker import check_env

from softmode import envs
from softmode.envs import Segment, SoftEnv, SoftVectorEnv, StepResult, Task, TaskConfig, WorldState, rl_scene
from softmode.objects import ObjectConfig
from softmode.scenes import TableSceneConfig
from softmode.viz import Film

# pyright: reportGeneralTypeIssues=false

# ----------------------------------------------------------------------------------------------------------------------
RADIUS, HEIGHT = 0.02, 0.12  # of the post [m]
POST = TableSceneConfig(object=ObjectConfig(shape="cylinder", extents=(2 * RADIUS, 2 * RADIUS, HEIGHT)))


@dataclass(frozen=True, kw_only=True)
class ToppleConfig(TaskConfig):
    """Ranges of stiffness, size, friction, place and light are in the base class."""

    scene: TableSceneConfig = field(default_factory=lambda: rl_scene(POST))
    fallen: float = 0.5  # height of the centre, relative to a standing post's, below which it has fallen


@wp.struct
class Plan:
    """What the kernels know beside the state, found by the names of the fields."""

    column_upright: int  # where "upright" is in the observation
    rest_height: wp.array[float]  # of the centre of a standing post [m]
    fallen: float


@wp.kernel
def observe(state: WorldState, plan: Plan, result: StepResult):
    """Write how high the centre is to info and observation; 1 for a standing post."""
    w = wp.tid()
    result.metrics[w, 0] = state.object_position[w, 0][2] / plan.rest_height[w]
    result.observation[w, plan.column_upright] = result.metrics[w, 0]


@wp.kernel
def judge(state: WorldState, plan: Plan, result: StepResult):
    """Reward nearness and the fall; the task is solved while the post lies."""
    w = wp.tid()
    gap = wp.length(state.object_position[w, 0] - wp.transform_get_translation(state.tool_pose[w]))
    result.terms[w, 0] = 1.0 - wp.tanh(5.0 * gap)
    result.terms[w, 1] = 3.0 * wp.clamp(1.0 - result.metrics[w, 0], 0.0, 1.0)
    result.success[w] = result.metrics[w, 0] < plan.fallen


class Topple(Task):
    """Knock over a soft post. Reward terms: ``reach`` (0..1), ``fall`` (0..3)."""

    config_class, step_kernels = ToppleConfig, (observe, judge)
    term_names, metric_names = ("reach", "fall"), ("upright",)

    def object_segments(self) -> tuple[Segment, ...]:
        """Add a number to the observation."""
        return (Segment("upright", 1, -2.0, 3.0),)


ToppleEnv = type("ToppleEnv", (SoftEnv,), {"task_class": Topple})
ToppleVectorEnv = type("ToppleVectorEnv", (SoftVectorEnv,), {"task_class": Topple})
gym.register("Topple-v0", entry_point=ToppleEnv, vector_entry_point=ToppleVectorEnv, max_episode_steps=90)
# ----------------------------------------------------------------------------------------------------------------------


def push_over(env: Any) -> np.ndarray:
    """Return the action of a script: beside the post, down, and through it."""
    seen, parts = env.unwrapped.task.observation.numpy()[0], env.unwrapped.task.segments
    tool, post = seen[parts["tool_position"][0]], seen[parts["object_position"][0]]
    low = tool[2] < 0.1
    target = [post[0] + (0.1 if low else -0.07), post[1], 0.09 if low or tool[0] < post[0] - 0.05 else 0.2]
    return np.clip([*(target - tool) / 0.03, 0.0, -1.0], -1.0, 1.0).astype(np.float32)


def test_final(ends: list[dict[str, Any]]) -> None:
    """Every post fell and lies on its side: its centre is a radius high."""
    for end in ends:
        print(f"{end['parameters']['youngs_modulus']:.3g} Pa, centre at {end['upright']:.2f} of where it stood")
        assert end["is_success"] and abs(end["upright"] * 0.5 * HEIGHT - RADIUS) < 1.5e-3 and not end["solver_status"]


def main(arguments: list[str] | None = None) -> None:
    """Check the environment, single and vector, then film the script."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--short", action="store_true", help="one episode instead of three")
    episodes = 1 if parser.parse_args(arguments).short else 3
    wp.config.log_level = wp.LOG_WARNING
    env, ends = gym.make("Topple-v0", render_mode="rgb_array"), []
    check_env(env.unwrapped)
    print(envs.check_vector_env(lambda n: gym.make_vec("Topple-v0", n, max_episode_steps=8), num_envs=2, steps=20))
    with Film(Path("out/custom_env.mp4")) as film:
        for seed in range(episodes):
            ended, _ = [False], env.reset(seed=seed)
            while not any(ended):
                _, _, *ended, info = env.step(push_over(env))
                film.add(np.asarray(env.render()), 30)
            ends.append(info)
        film.publish()
    test_final(ends)


if __name__ == "__main__":
    main()
