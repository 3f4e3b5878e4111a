"""The command ``softmode check``: a task is held to the rules of environments."""

from __future__ import annotations

import dataclasses
from typing import Annotated

from softmode.cli.common import own_group, quiet_warp
from softmode.cli.object_options import ObjectOptions
from softmode.cli.robot_options import RobotOptions, tell_of
from softmode.envs.catalogue import registered_id


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """Check that a task keeps the rules of environments.

    Example: softmode check softmode/PushSoft-v0
    """

    env: str
    """Id of the environment, for example softmode/LiftSoft-v0, or module:id of your own."""
    episodes: int = 5
    """Episodes of the scripted policy."""
    arm: Annotated[RobotOptions, own_group()] = dataclasses.field(default_factory=RobotOptions)
    """Another robot in place of the built-in arm."""
    toy: Annotated[ObjectOptions, own_group()] = dataclasses.field(default_factory=ObjectOptions)
    """Your own object; what is left out is as the task has it."""

    def run(self) -> int:
        """Print a line per check; return 1 if one fails."""
        from softmode.envs.robots import loaded
        from softmode.learning.config_values import with_config
        from softmode.robots.description import RobotDescription
        from softmode.testing import check_task

        registered_id(self.env)

        with quiet_warp():
            given = self.toy.env_options(self.env, {}) | self.arm.env_options()
            options = with_config(self.env, given) if given else {}
            if "robot" in given:
                options["robot"] = robot = loaded(given["robot"])
                if isinstance(robot, RobotDescription):
                    tell_of(robot)
            found = check_task(self.env, episodes=self.episodes, **options)
        words = {True: "ok", False: "FAILED", None: "skipped"}
        for check in found:
            print(f"{check.name:28}{words[check.passed]:9}{check.note}")
        return int(any(check.passed is False for check in found))
