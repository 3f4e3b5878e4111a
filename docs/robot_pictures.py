"""Draw the robots of docs/howto/own_robot.md, each with the plush that it has lifted.

Run: ``python docs/robot_pictures.py [docs/images/robots.png]`` in the root of the repository; the robots but the first
two come from the MuJoCo Menagerie (``pip install 'softmode[robots]'``). One row: the built-in arm, the ALOHA arm, the
Panda, a UR5e with a 2F-85, the xArm7 with its gripper.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from softmode.envs import LiftSoftConfig, LiftSoftEnv, scripted_policy
from softmode.robots import load

SIZE, GAP = 384, 6
"""Edge of a view and the white between two [pixels]."""
SKY, HEIGHT = 30, 300
"""First row and number of rows of a view that are kept [pixels]."""
ROBOTS: tuple[tuple[str, dict[str, Any]] | None, ...] = (
    None,
    ("aloha_arm", {}),
    ("panda", {}),
    ("ur5e", {"hand": "robotiq_2f85"}),
    ("xarm7", {}),
)


def picture(robot: Any) -> NDArray[np.uint8]:
    """Return the overview of a scripted episode when the plush is at its goal, uint8 (HEIGHT, SIZE, 3)."""
    env = LiftSoftEnv(robot=robot, render_mode="rgb_array", config=LiftSoftConfig(render_size=SIZE))
    observation, info = env.reset(seed=0)
    policy, step = scripted_policy(env), 0
    while not info["is_success"]:
        observation, _, _, _, info = env.step(policy(observation))
        step += 1
        if step > 250:
            raise SystemExit(f"{robot} has not lifted the plush after {step} steps")
    views = env.render()
    assert views is not None
    return np.asarray(views[SKY : SKY + HEIGHT, -views.shape[0] :])


def main() -> None:
    """Write the row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", nargs="?", type=Path, default=Path("docs/images/robots.png"))
    out = parser.parse_args().out
    white = np.full((HEIGHT, GAP, 3), 255, np.uint8)
    row: list[NDArray[np.uint8]] = []
    for given in ROBOTS:
        row += [picture(None if given is None else load(given[0], **given[1])), white]
    Image.fromarray(np.concatenate(row[:-1], axis=1)).save(out)
    print(f"wrote {out}")


if __name__ == "__main__":
    main()
