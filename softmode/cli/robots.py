"""The command ``softmode robots``."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from softmode.cli.common import own_group, short_name
from softmode.cli.robot_options import RobotFile
from softmode.errors import ConfigError
from softmode.files import check_place

if TYPE_CHECKING:
    from softmode.robots.description import RobotDescription


@dataclasses.dataclass(frozen=True, kw_only=True)
class Robots:
    """List the robots known by name, fetch some, check a file.

    Example: softmode robots check arm.urdf -o arm.png
    """

    action: Literal["list", "fetch", "check"]
    """list prints the names, fetch downloads models, check prints what was found in a file and what was guessed."""
    names: tuple[str, ...]
    """What to fetch or check, for example so101 ur5e arm.urdf arm.usd."""
    out: Annotated[Path | None, short_name("-o")] = None
    """Picture that check writes, NAME.png here if omitted; one robot only."""
    root: str | None = None
    """Body whose subtree is the robot, for check."""
    drive_bandwidth: float = 8.0
    """Natural frequency of the drives of joints without a servo [Hz], for check."""
    file: Annotated[RobotFile, own_group()] = dataclasses.field(default_factory=RobotFile)
    """How the file is to be read, for check."""

    def run(self) -> int:
        """Print the names, fetch the models, or check the files."""
        from softmode.robots.assets import available, fetch

        if self.action == "list":
            print("\n".join(available()))
            return 0
        if not self.names:
            example = "fetch so101 ur5e" if self.action == "fetch" else "check arm.urdf"
            raise ConfigError(
                f"robots {self.action} names no robot", hint=f"name some, like: softmode robots {example}"
            )
        if self.action == "fetch":
            for name, folder in zip(self.names, fetch(self.names), strict=True):
                print(f"{name}  {folder}")
            return 0
        if self.out is not None and len(self.names) > 1:
            raise ConfigError(f"out {self.out} is one picture for {len(self.names)} robots", hint="check them in turn")
        for name in self.names:
            self._check(name)
        return 0

    def _check(self, name: str) -> None:
        """Print the table of a robot and draw it."""
        from softmode.robots.loading import load
        from softmode.viz.robot_picture import write_robot_picture

        out = Path(f"{Path(name).stem}.png") if self.out is None else self.out
        if out.suffix.lower() != ".png":
            raise ConfigError(f"out {out} is no .png file", hint="name it like arm.png")
        check_place(out, "picture", make_folders=False)
        robot = load(name, root=self.root, drive_bandwidth=self.drive_bandwidth, **self.file.loading)
        print("\n".join(robot_table(robot)))
        write_robot_picture(out, robot)
        print(f"picture          {out}")
        print("\n".join(task_lines(robot)))


def robot_table(robot: RobotDescription) -> list[str]:
    """Return what is known about a robot as lines: its parts, a row per joint, and what was guessed."""
    from softmode.robots.chain import serial_chain
    from softmode.robots.jaws import ParallelJaw

    chain = serial_chain(robot)
    x, y, z = robot.tool_pose()[:3]
    gripper = "none found; name its joints: load(..., gripper={'joint': (closed, open)})"
    opening = "-"
    if robot.gripper is not None:
        ends = zip(robot.gripper.joints, robot.gripper.closed, robot.gripper.open, strict=True)
        gripper = ", ".join(f"{name} {closed:.3g}..{wide:.3g}" for name, closed, wide in ends)
        try:
            opening = f"{1e3 * ParallelJaw.of(robot).opening:.1f} mm between two fingers"
        except ConfigError as error:
            opening = f"not measured: {error.message}"
    lines = [
        f"robot            {robot.name}, {len(robot.link_names)} links, {len(robot.joint_names)} joints",
        f"end effector     {robot.end_effector}, moved by {len(chain.joints)} joints",
        f"tool at home     {x:.3f} {y:.3f} {z:.3f} m",
        f"reach            {chain.reach:.3f} m from the first joint",
        f"gripper          {gripper}",
        f"opening          {opening}",
        "",
        f"{'joint':<28}{'lower':>9}{'upper':>9}{'home':>9}{'stiffness':>11}{'damping':>10}{'limit':>9}{'f [Hz]':>8}",
    ]
    frequency = robot.drive_frequencies()
    for j, (name, drive) in enumerate(zip(robot.joint_names, robot.drives, strict=True)):
        row = f"{name[:27]:<28}{robot.joint_lower[j]:>9.3f}{robot.joint_upper[j]:>9.3f}{robot.home[j]:>9.3f}"
        if drive is None:
            lines.append(row + f"{'passive':>11}")
        else:
            row += f"{drive.stiffness:>11.4g}{drive.damping:>10.4g}{drive.effort_limit:>9.3g}{frequency[j]:>8.2g}"
            lines.append(row)
    return ["guessed, left out:", *(f"  {note}" for note in robot.notes), "", *lines, ""]


def task_lines(robot: RobotDescription) -> list[str]:
    """Return a line per task: whether the robot plays it, and why not."""
    from softmode import ENVIRONMENTS
    from softmode.envs.arguments import Shortcuts, checked_config
    from softmode.envs.catalogue import env_class
    from softmode.robots.table_robot import TableRobot

    lines = []
    for name in ENVIRONMENTS:
        task = env_class(name).task_class
        try:
            arm = checked_config(task.config_class, None, Shortcuts(robot=robot), task.any_robot).scene.arm
            assert isinstance(arm, TableRobot)
            x, y, z, turn = arm.base
            said = f"yes, from ({x:.2f}, {y:.2f}, {z:.2f}) m turned by {math.degrees(turn):.0f} deg"
            said += f", in {100 * arm.share:.0f} % of its ranges" if arm.share < 1.0 else ""
        except ConfigError as error:
            said = f"no, because {error.message}"
        lines.append(f"{task.__name__ + ':':<17}{said}")
    return lines
