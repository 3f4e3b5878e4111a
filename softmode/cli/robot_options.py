"""The options by which every command takes a robot."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softmode.errors import ConfigError

if TYPE_CHECKING:
    from softmode.robots.description import RobotDescription


@dataclasses.dataclass(frozen=True, kw_only=True)
class RobotFile:
    """How a robot's file is to be read."""

    asset_root: Path | None = None
    """Folder outside which the robot's file may refer to nothing; its own, or that of its package, if omitted."""
    end_effector: str | None = None
    """Site or body that carries the robot's tool; found by its usual names if omitted."""
    home: tuple[float, ...] | None = None
    """Coordinates of all joints of the robot's home pose [m or rad]; that of the file if omitted."""

    @property
    def loading(self) -> dict[str, Any]:
        """What `softmode.robots.load` is to be told beside the file, as JSON holds it."""
        given = {"end_effector": self.end_effector, "home": None if self.home is None else list(self.home)}
        given["asset_root"] = None if self.asset_root is None else str(self.asset_root.resolve())
        return {name: value for name, value in given.items() if value is not None}


@dataclasses.dataclass(frozen=True, kw_only=True)
class RobotOptions(RobotFile):
    """Another robot in place of the built-in arm."""

    robot: str | None = None
    """Robot in place of the built-in arm: a name of `softmode robots list`, or an MJCF, URDF or OpenUSD file."""

    def env_options(self) -> dict[str, Any]:
        """Return the keyword argument of environments that names the robot; none if omitted.

        Raises:
            ConfigError: If something is said about a robot that is not named.
        """
        from softmode.robots.assets import names_file

        if self.robot is None and self.loading:
            option = next(iter(self.loading)).replace("_", "-")
            raise ConfigError(f"--{option} without a robot", hint="name it: --robot arm.urdf")
        if self.robot is None:
            return {}
        source = str(Path(self.robot).resolve()) if names_file(self.robot) else self.robot
        return {"robot": {"source": source, **self.loading} if self.loading else source}


def tell_of(robot: RobotDescription) -> None:
    """Print, on stderr, what was chosen for a robot or left out of its file."""
    for note in robot.notes:
        print(f"softmode: robot {robot.name}: {note}", file=sys.stderr, flush=True)
