"""The command ``softmode bench``: environment steps per second."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any, Literal

from softmode.cli.common import own_group, quiet_warp, warn_of_env
from softmode.cli.object_options import ObjectOptions
from softmode.cli.robot_options import RobotOptions
from softmode.errors import ConfigError
from softmode.learning.config_values import split_config


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bench:
    """Time a vector environment with random actions.

    Example: softmode bench softmode/LiftSoft-v0 --num-envs 1 16
    """

    env: str
    """Id of the environment, for example softmode/LiftSoft-v0, or module:id of your own."""
    num_envs: tuple[int, ...] = (1, 16)
    """Numbers of worlds, one measurement each."""
    device: str | None = None
    """Warp device, for example cpu or cuda:0."""
    processes: int = 1
    """Processes that share the worlds on CPU."""
    obs_type: Literal["state", "pixels", "pixels_agent_pos"] = "state"
    """What observations hold."""
    image_size: int | None = None
    """Edge of pixel observations [px], the task's own if omitted."""
    preset: str | None = None
    """Named variant of the task, such as beam of LiftSoft."""
    steps: int = 500
    """Measured control steps."""
    warmup: int = 100
    """Control steps before them."""
    actions: Literal["random", "grasp"] = "random"
    """random, or grasp: noise around going to the object and closing on it, so that contact is active."""
    output: Literal["numpy", "torch"] | None = None
    """What observations are; torch on CUDA and numpy on CPU if omitted."""
    stages: bool = False
    """Print the time of the parts of a step."""
    arm: Annotated[RobotOptions, own_group()] = dataclasses.field(default_factory=RobotOptions)
    """Another robot in place of the built-in arm."""
    toy: Annotated[ObjectOptions, own_group()] = dataclasses.field(default_factory=ObjectOptions)
    """Your own object; what is left out is as the task, the policy's run or the file has it."""

    def run(self) -> int:
        """Measure; return the exit code."""
        from softmode.envs.arguments import checked_device
        from softmode.envs.throughput import report_throughput

        if not self.num_envs:
            raise ConfigError("num-envs names no number of worlds", hint="give some, like --num-envs 1 16")
        if self.stages and self.processes > 1:
            raise ConfigError("--stages looks into this process only", hint="leave --processes at 1")
        with quiet_warp():
            device = checked_device(self.device)
            chosen = {} if self.preset is None else {"preset": self.preset}
            config, _ = split_config(self.env, self.toy.env_options(self.env, chosen))
            robot = self.arm.env_options()
            if self.image_size is not None:
                config = dataclasses.replace(config, image_size=self.image_size)
            given: dict[str, Any] = {"obs_type": self.obs_type, "config": config, "processes": self.processes}
            given |= robot | {"device": str(device), "output": self.output or ("torch" if device.is_cuda else "numpy")}
            how = {"steps": self.steps, "warmup": self.warmup, "actions": self.actions, "stages": self.stages}
            for count in self.num_envs:
                tell = warn_of_env if count == self.num_envs[0] else None
                report_throughput(self.env, count, given, made=tell, **how)
        return 0
