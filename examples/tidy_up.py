"""Tidy up: every episode has another number of toys, one to four, and all of them go into the bin.

The environment has room for four toys of a set. A reset draws how many there are and which; those that are not there
touch nothing, are not drawn and take no part in the solve. The scripted policy places one after another. The toys are
presets of the library: a letter block, a ball, a sponge and a bear.

Run: ``python examples/tidy_up.py [--robot panda] [--short]``; writes ``out/tidy_up.png``
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from PIL import Image

from softmode.deformables import BuildOptions
from softmode.envs import PlaceInBinConfig, PlaceInBinEnv, scripted_policy
from softmode.objects import ObjectConfig, ObjectSet

MOST, STEPS = 4, 900
SCENE, BUILD = PlaceInBinConfig().scene, BuildOptions(mode_count=3, cubature_count=128)
SIZES = {"block-a": 0.045, "ball": 0.045, "sponge": 0.065, "bear": 0.06}
"""Presets and their longest edges [m]."""
TOYS = tuple(ObjectConfig(preset=name, size=x, surface_count=160, build=BUILD) for name, x in SIZES.items())


def make_env(edge: int, robot: str | None = None) -> PlaceInBinEnv:
    """Return PlaceInBin with an empty bin and room for several toys on the table, before a robot of one's choice."""
    config = PlaceInBinConfig(
        objects=ObjectSet(TOYS, resample=True, per_world=(1, MOST)),
        scene=replace(SCENE, others=()),
        position_range=(0.02, 0.02),
        others_clearance=0.05,
        render_size=edge,
        mesh_samples=4,
    )
    return PlaceInBinEnv(config=config, robot=robot, render_mode="rgb_array")


def picture_of(env: PlaceInBinEnv) -> np.ndarray:
    """Return what the overview camera sees of toys and bin."""
    env.task.film.forget(np.ones(1, bool))
    picture = env.render()
    assert picture is not None
    edge = len(picture)
    return picture[int(0.47 * edge) : int(0.99 * edge), edge + int(0.3 * edge) : edge + int(0.82 * edge)]


def tidy(env: PlaceInBinEnv, policy: Any, objects: list[int]) -> dict[str, Any]:
    """Play an episode with these toys; return the last info with pictures of start and end."""
    env.reset(seed=0, options={"object": objects + [-1] * (MOST - len(objects))})
    policy.reset()
    for _ in range(15):  # the toys settle
        env.step(np.array([0.0, 0.0, 0.0, 0.0, 1.0]))
    before, steps, info = picture_of(env), 0, {}
    for step in range(STEPS):
        *_, info = env.step(policy())
        steps = step + 1
        if info["is_success"]:
            break
    print(f"{len(objects)}: {', '.join(info['object_name'])}: {steps} steps, success {info['is_success']}")
    for _ in range(20):  # the gripper rises
        *_, info = env.step(policy())
    return {**info, "before": before, "after": picture_of(env)}


def test_final(env: PlaceInBinEnv, episodes: list[list[int]], ends: list[dict[str, Any]], graph: object) -> None:
    """All toys lie in the bin, none is there that was not asked for, and no graph was captured anew."""
    for objects, end in zip(episodes, ends, strict=True):
        assert end["is_success"] and end["others_inside"] == len(objects) - 1
        assert end["object_name"] == tuple(env.config.objects.names[k] for k in objects)
    assert env.task.graph is graph


def main(arguments: list[str] | None = None) -> None:
    """Tidy up with one toy, two, three and four; save what it looked like before and after."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", help="a name such as panda, or the path of a robot file; else the built-in arm")
    parser.add_argument("--short", action="store_true", help="two episodes, small pictures")
    given = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    episodes = [[0], [1, 3], [3, 0, 1], [0, 3, 2, 1]]
    episodes = episodes[:2] if given.short else episodes
    env = make_env(96 if given.short else 640, given.robot)
    graph, policy = env.task.graph, scripted_policy(env)
    ends = [tidy(env, policy, objects) for objects in episodes]
    Path("out").mkdir(exist_ok=True)
    rows = [np.concatenate([end[when] for end in ends], axis=1) for when in ("before", "after")]
    Image.fromarray(np.concatenate(rows, axis=0)).save("out/tidy_up.png")
    test_final(env, episodes, ends, graph)


if __name__ == "__main__":
    main()
