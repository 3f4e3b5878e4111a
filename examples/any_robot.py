"""A robot from a file plays LiftSoft: it is placed at the table, grasps the plush and lifts it to the goal.

The default robot is one arm of an ALOHA station, which ships with mujoco-warp, so nothing is downloaded. Any arm of
five to eight joints with two driven fingers will do: a name, an MJCF, URDF or OpenUSD file; built-in is the arm of the
environments. The scripted policy is the same for all; the table shows for soft and stiff plushes whether they were
lifted, how hard the fingers pressed, how far the plush moved in the hand, and from which height it was lost.

Run: ``python examples/any_robot.py [--robot ur5e --hand robotiq_2f85] [--episodes 20] [--short]``
"""

import argparse

import numpy as np
import warp as wp

from softmode.envs import LiftSoftEnv, scripted_policy
from softmode.robots import TableRobot, load

Row = dict[str, float]


def lift(env: LiftSoftEnv, seed: int, youngs_modulus: float) -> Row:
    """Play one episode and return what it came to."""
    observation, info = env.reset(seed=seed, options={"youngs_modulus": np.array([youngs_modulus])})
    policy, scene = scripted_policy(env), env.scene
    pressed, hung, slip, dropped, step = 0.0, None, 0.0, 0.0, 0
    while step < 250 and not info["is_success"]:
        observation, _, failed, _, info = env.step(policy(observation))
        step += 1
        if failed:
            break
        if info["is_success"] or step % 5 == 0:
            force = np.linalg.norm(scene.finger_force.numpy()[0], axis=1)
            centre = scene.object_position.numpy()[0, 0]
            rise = centre[2] - scene.soft.height
            if hung is not None and force.max() == 0.0:
                dropped = max(dropped, 1e3 * rise)
            if rise > 0.02 and force.min() > 0.5:  # in the air, between both fingers
                offset = centre - scene.controller.tool_pose.numpy()[0, :3]
                hung = offset if hung is None else hung
                slip = max(slip, float(np.linalg.norm(offset - hung)))
                pressed = max(pressed, float(force.max()))
    row = {"E": youngs_modulus, "success": info["is_success"], "steps": step, "force": pressed, "slip": 1e3 * slip}
    return row | {"dropped": dropped}


def test_final(rows: list[Row]) -> None:
    """All plushes were lifted; no finger pressed harder than its drive can; none slipped by a quarter of its size."""
    assert all(row["success"] for row in rows)
    assert all(0.0 < row["force"] <= 60.0 and row["slip"] < 15.0 for row in rows)


def main() -> None:
    """Print one row per episode."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="aloha_arm", help="a name, the path of a robot file, or built-in")
    parser.add_argument("--hand", help="a gripper for a robot that has none, likewise")
    parser.add_argument("--episodes", type=int, default=8, help="how many, from soft to stiff")
    parser.add_argument("--short", action="store_true", help="2 episodes")
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    env = LiftSoftEnv(robot=None if given.robot == "built-in" else load(given.robot, hand=given.hand))
    arm = env.config.scene.arm
    if isinstance(arm, TableRobot):
        print(f"{given.robot} stands at {np.round(arm.base, 3)}, its fingers open by {1e3 * arm.gripper.stroke:.0f} mm")
    print("   E [Pa]  lifted  steps  force [N]  moved in the hand [mm]  dropped from [mm]")
    rows = []
    for seed, modulus in enumerate(np.geomspace(2.0e4, 2.0e6, 2 if given.short else given.episodes)):
        rows.append(lift(env, seed, float(modulus)))
        print("{E:9.0f}{success!s:>8}{steps:7}{force:11.1f}{slip:14.1f}{dropped:23.0f}".format(**rows[-1]))
    print(f"lifted {sum(row['success'] for row in rows)} of {len(rows)}")
    test_final(rows)


if __name__ == "__main__":
    main()
