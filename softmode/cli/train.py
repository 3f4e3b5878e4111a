"""The commands ``softmode train``, ``softmode evaluate`` and ``softmode export``."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Annotated, Any, Literal

from softmode.checks import require_choice, require_number
from softmode.cli.common import (
    one_place,
    optional_argument,
    own_group,
    quiet_warp,
    same_fields,
    short_name,
    warn_of_env,
)
from softmode.cli.object_options import ObjectOptions
from softmode.cli.robot_options import RobotOptions
from softmode.envs.catalogue import is_soft, registered_id
from softmode.errors import ConfigError
from softmode.learning.players import require_torch
from softmode.learning.run_folder import checkpoint_in
from softmode.learning.train_options import RunOptions, TrainOptions


@dataclasses.dataclass(frozen=True, kw_only=True)
class Train(RunOptions):
    """Train a policy with PPO.

    Example: softmode train softmode/LiftSoft-v0 --splat toy.ply
    """

    algo: Literal["ppo"] = "ppo"
    """Algorithm."""
    processes: int | None = None
    """Processes that share the worlds on a CPU; one for each core if omitted."""
    obs_type: Literal["state", "pixels", "pixels_agent_pos"] | None = None
    """What the policy sees; the environment's own choice if omitted."""
    env_options: str = "{}"
    """Further keyword arguments of the environment as JSON."""
    total_steps: float | None = None
    """Environment steps of all worlds together after which training ends; 1e7 if no limit is given."""
    run_dir: Annotated[Path | None, short_name("-o")] = None
    """Folder of the run, not there yet; runs/<Env>/<time>[_name] if omitted."""
    set: tuple[str, ...] = ()
    """Hyperparameters other than the preset's, as NAME=VALUE, for example discount=0.97 hidden=[64,64]."""
    arm: Annotated[RobotOptions, own_group()] = dataclasses.field(default_factory=RobotOptions)
    """Another robot in place of the built-in arm."""
    toy: Annotated[ObjectOptions, own_group()] = dataclasses.field(default_factory=ObjectOptions)
    """Your own object; what is left out is as the task, the policy's run or the file has it."""

    def run(self) -> int:
        """Train; return the exit code."""
        require_torch()
        if self.resume and (self.toy.is_given or self.arm != RobotOptions()):
            hint = "leave the options of object and robot out"
            raise ConfigError("--resume goes on with object and robot of the run", hint=hint)
        from softmode.learning.environments import make_vector_env
        from softmode.learning.trainer import train

        def make(*arguments: Any) -> Any:
            """Return the worlds, and say what there is to say about their object."""
            env = make_vector_env(*arguments)
            if os.environ.get("RANK", "0") == "0":
                warn_of_env(env)
            return env

        given = same_fields(self, TrainOptions)
        given["env_options"] = self.toy.env_options(self.env, parse_env_options(self.env_options, self.obs_type))
        given["env_options"] |= self.arm.env_options()
        given["total_steps"] = None if self.total_steps is None else int(self.total_steps)
        given["processes"] = self.process_count()
        options = TrainOptions(**given, overrides=parse_overrides(self.set))
        with quiet_warp():
            try:
                train(options, make=make, report=lambda line: print(line, flush=True))
            except KeyboardInterrupt:
                return 130
        return 0

    def process_count(self) -> int:
        """Return the processes of this rank: as asked for, or this machine's cores shared among its ranks."""
        if self.processes is not None:
            return self.processes
        if self.device != "cpu" or not is_soft(self.env):
            return 1
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        return max(1, min(cores // int(os.environ.get("LOCAL_WORLD_SIZE", "1")), self.num_envs))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Print how often a trained policy succeeds in whole episodes.

    Example: softmode evaluate softmode/LiftSoft-v0 toy.npz
    """

    env: str
    """Id of the environment, for example softmode/LiftSoft-v0, or module:id of your own."""
    policy: Path
    """Checkpoint of a run, for example best.npz, or the run's folder."""
    checkpoint: Literal["best", "latest"] = "best"
    """Which one, of a folder."""
    episodes: int = 200
    """Number of episodes."""
    num_envs: int = 16
    """Worlds that play them."""
    device: str = "cpu"
    """cpu or cuda:0."""
    seed: int = 1_000_000_000
    """Seed of the first world; the others' count up."""
    obs_type: Literal["state", "pixels", "pixels_agent_pos"] | None = None
    """What the policy sees; as in its run if omitted."""
    env_options: str = "{}"
    """Further keyword arguments of the environment as JSON."""
    strain_limit: float | None = None
    """Largest principal strain of a safe success; as in the policy's run, or 0.3."""
    force_limit: float | None = None
    """Largest contact force of a safe success [N]; as in the policy's run, or 15, or thrice what holds the weight."""
    over: tuple[str, ...] = ()
    """Keyword arguments of the environment to go through, as NAME=[VALUES], for example yaw_range=[0.5,3.0]; of several
    all combinations."""
    ray: str | None = None
    """Play on the machines of a Ray cluster, each episode from a seed of its own: HOST:PORT of its head, auto, or local
    to use this machine's cores."""
    out: Annotated[Path | None, short_name("-o")] = None
    """With --ray: name of the folder for parts of the work, out/evaluate-ENV if omitted; removed when all is done."""
    arm: Annotated[RobotOptions, own_group()] = dataclasses.field(default_factory=RobotOptions)
    """Another robot in place of the built-in arm."""
    toy: Annotated[ObjectOptions, own_group()] = dataclasses.field(default_factory=ObjectOptions)
    """Your own object; what is left out is as the task, the policy's run or the file has it."""

    def run(self) -> int:
        """Evaluate; return the exit code."""
        require_torch()
        from softmode.cli import on_ray
        from softmode.learning.distributed import local_device
        from softmode.learning.environments import make_vector_env
        from softmode.learning.policy import evaluate, load_policy

        require_number("num_envs", self.num_envs, at_least=1, hint="give a count like 16")
        require_number("episodes", self.episodes, at_least=1, hint="give a count like 200")
        policy = load_policy(checkpoint_in(self.policy, self.checkpoint), self.device)
        options = {**policy.env_options, **parse_env_options(self.env_options, self.obs_type)}
        options = self.toy.env_options(self.env, options) | self.arm.env_options()
        limits = {"strain_limit": self.strain_limit, "force_limit": self.force_limit}
        options |= {name: limit for name, limit in limits.items() if limit is not None}
        over = parse_overrides(self.over)
        if self.ray is not None:
            job = {name: getattr(self, name) for name in ("env", "device", "episodes", "num_envs", "seed")}
            job = on_ray.job_of(checkpoint_in(self.policy, self.checkpoint), **job, env_options=options, over=over)
            out = self.out or Path("out", f"evaluate-{registered_id(self.env).rpartition('/')[2]}")
            for chosen, found in on_ray.evaluate_on_ray(self.ray, job, out):
                print(*(f"{name}={value}" for name, value in chosen.items()), found)
            return 0
        device = local_device(self.device)
        with quiet_warp():
            for chosen in on_ray.combinations(over):
                env = make_vector_env(self.env, self.num_envs, device, {**options, **chosen})
                warn_of_env(env)
                try:
                    policy.check(env)
                    found = evaluate(env, policy, self.episodes, seed=self.seed, device=device)
                    print(*(f"{name}={value}" for name, value in chosen.items()), found)
                finally:
                    env.close()
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Export:
    """Write the policy of a checkpoint to a file of its own.

    Example: softmode export runs/toy/best.npz toy.npz
    """

    checkpoint: Path
    """Checkpoint of a run, for example best.npz."""
    file: Annotated[Path | None, optional_argument()] = None
    """File to write, not there yet: .npz, which play, evaluate, --init and --teacher read, or .onnx for elsewhere."""
    out: Annotated[Path | None, short_name("-o")] = None
    """The same file, as an option."""

    def run(self) -> int:
        """Write the file; return the exit code."""
        require_torch()
        from softmode.learning.checkpoints import policy_only, read_checkpoint, write_checkpoint
        from softmode.learning.policy import load_policy

        out = one_place(self.file, self.out)
        if out.exists():
            raise ConfigError(f"{out} exists", hint="remove it, or write another file")
        require_choice("the ending of the file", out.suffix, (".npz", ".onnx"))
        policy = load_policy(self.checkpoint)  # refuses a file whose actor does not fit its header
        if out.suffix == ".onnx":
            from softmode.learning.onnx_export import export_onnx

            export_onnx(policy, out)
        else:
            write_checkpoint(policy_only(read_checkpoint(self.checkpoint)), out)
        print(f"{out}: {out.stat().st_size / 1e3:.0f} kB")
        return 0


def parse_env_options(text: str, obs_type: str | None = None) -> dict[str, Any]:
    """Return the keyword arguments in a JSON object, ``obs_type`` among them where it is given.

    Raises:
        ConfigError: If it is none.
    """
    try:
        options = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"env-options is no JSON ({error})", hint='write it like {"obs_type": "state"}') from error
    if not isinstance(options, dict):
        raise ConfigError("env-options is no JSON object", hint='write it like {"obs_type": "state"}')
    return options if obs_type is None else {**options, "obs_type": obs_type}


def parse_overrides(pairs: tuple[str, ...]) -> dict[str, Any]:
    """Return the values of NAME=VALUE pairs; a value is JSON, or a word.

    Raises:
        ConfigError: If a pair is none.
    """
    overrides: dict[str, Any] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals or not name:
            raise ConfigError(f"{pair!r} is no NAME=VALUE", hint="write it like discount=0.97")
        try:
            overrides[name.replace("-", "_")] = json.loads(text)
        except (ValueError, RecursionError):
            overrides[name.replace("-", "_")] = text
    return overrides
