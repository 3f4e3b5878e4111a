"""Model predictive control: an arm pushes a soft disc to its goal, with copies of the simulation as the model.

Every eight control steps the state of the environment is given to all worlds of a vector environment. Cross-entropy
search tries another push in each of them and draws new ones about the best; the arm plays the first third of the best.
The model is exact: on a CPU the arm then observes, bit for bit, what the world of that push had predicted.

Run: ``python examples/mpc_push.py [--worlds 256] [--seed 3] [--short]``, writes ``out/mpc_push.mp4``. On one core
32 worlds take a minute
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import warp as wp
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from softmode.envs import EnvState, PushSoftConfig, SoftVectorEnv
from softmode.viz import Film

ENV, AXES = "softmode/PushSoft-v0", 2  # the tool moves in x and y, its height and its fingers stay
KNOTS, HOLD = 3, 8  # a push is so many actions, each held for so many control steps
PLANS, ROUNDS = 15, 2  # of an episode at most, and of a plan's search
ELITE, FLOOR = 0.1, 0.1  # share of the worlds that the next round follows; least spread

Array = NDArray[np.floating]


def actions_of(knots: Array) -> Array:
    """Return the actions (..., 5) of knots (..., 2)."""
    return np.concatenate([knots, np.zeros((*knots.shape[:-1], 5 - AXES), np.float32)], axis=-1)


def imagine(model: SoftVectorEnv, state: EnvState, pushes: Array) -> tuple[Array, Array]:
    """Play a push in each world; return its return (worlds,) and the observation after its first action was held."""
    model.reset(options={"state": state})
    total, seen = np.zeros(model.num_envs, np.float32), np.zeros(0, np.float32)
    for k in range(KNOTS):
        for _ in range(HOLD):
            observation, reward, *_ = model.step(actions_of(pushes[:, k]))
            total += reward
        seen = observation if k == 0 else seen
    return total, seen


def plan(model: SoftVectorEnv, state: EnvState, mean: Array, random: np.random.Generator) -> tuple[Array, Array]:
    """Search around a push, shape (KNOTS, AXES); return the best one, and what its first knot leads to."""
    spread, best, found = np.full(mean.shape, 0.6, np.float32), mean, np.zeros(0, np.float32)
    highest = -np.inf
    for _ in range(ROUNDS):
        drawn = mean + spread * random.standard_normal((model.num_envs, *mean.shape), dtype=np.float32)
        pushes = np.clip(drawn, -1.0, 1.0)
        pushes[0] = best
        total, seen = imagine(model, state, pushes)
        order = np.argsort(-total)
        if total[order[0]] > highest:
            highest, best, found = total[order[0]], pushes[order[0]], seen[order[0]]
        elite = pushes[order[: max(int(ELITE * model.num_envs), 2)]]
        mean, spread = elite.mean(axis=0), np.maximum(elite.std(axis=0), FLOOR)
    return best, found


def drive(
    env: gym.Env, model: SoftVectorEnv, seed: int, plans: int, watch: Callable[[], object] = lambda: None
) -> tuple[list[float], list[float], dict[str, Any]]:
    """Make plans until the disc is there; return distances to the goal, errors of predictions, the last info."""
    base: Any = env.unwrapped
    random, mean = np.random.default_rng(seed), np.zeros((KNOTS, AXES), np.float32)
    observation, info = env.reset(seed=seed)
    distances, errors = [info["goal_distance"]], []
    while len(errors) < plans and not info["is_success"]:
        push, predicted = plan(model, base.get_state(), mean, random)
        for _ in range(HOLD):
            observation, *_, info = env.step(actions_of(push[0]))
            watch()
        errors.append(float(np.abs(observation - predicted).max()))
        distances.append(info["goal_distance"])
        print(f"plan {len(errors):2d}: {100 * distances[-1]:5.2f} cm to the goal, prediction off by {errors[-1]:.1e}")
        mean = np.concatenate([push[1:], np.zeros((1, AXES), np.float32)])
    return distances, errors, info


def test_final(distances: list[float], errors: list[float], success: bool, short: bool, exact: bool) -> None:
    """The disc came to rest at its goal, or nearer in the short run, and every prediction came true."""
    assert max(errors) == 0.0 if exact else max(errors) < 0.05
    assert success or short
    assert distances[-1] < 0.7 * distances[0]


def main(arguments: list[str] | None = None) -> None:
    """Push, film, check."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=256, help="pushes that are tried at once")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--short", action="store_true", help="8 worlds, three plans, small pictures")
    given = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    worlds, plans, edge = (8, 3, 96) if given.short else (given.worlds, PLANS, 256)
    config = PushSoftConfig(render_size=edge)
    env = gym.make(ENV, render_mode="rgb_array", config=config)
    base: Any = env.unwrapped
    model: Any = gym.make_vec(ENV, num_envs=worlds, config=config, autoreset_mode=AutoresetMode.DISABLED)
    with Film(Path("out/mpc_push.mp4")) as film:
        fps = env.metadata["render_fps"]
        distances, errors, info = drive(env, model, given.seed, plans, lambda: film.add(env.render(), fps))
        film.publish()
    ending = "success" if info["is_success"] else "not there"
    print(f"{ending} after {HOLD * len(errors)} control steps, {worlds} worlds")
    print(f"wrote {film.path} and {film.sheet_path}")
    test_final(distances, errors, info["is_success"], given.short, exact=base.task.device.is_cpu)
    env.close()
    model.close()


if __name__ == "__main__":
    main()
