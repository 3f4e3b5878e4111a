"""The command ``softmode record``: episodes of an environment as a LeRobot dataset."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from softmode.checks import require_number
from softmode.cli.common import (
    BuildBar,
    bar_interval,
    own_group,
    quiet_warp,
    short_name,
    warn_of_env,
)
from softmode.cli.object_options import ObjectOptions
from softmode.cli.robot_options import RobotOptions
from softmode.envs.catalogue import purpose, registered_id
from softmode.errors import ConfigError
from softmode.learning.config_values import with_config
from softmode.learning.players import check_policy, policy_factory, trained_policy

if TYPE_CHECKING:
    import gymnasium as gym

    from softmode.demonstrations.recording import Recorded
    from softmode.demonstrations.writer import DatasetWriter


ROBOT = "softmode_arm"
"""Name of the built-in arm in the dataset; another robot has its own."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Record:
    """Record episodes of an environment as a LeRobot v3.0 dataset.

    Example: softmode record softmode/LiftSoft-v0 -o out/toy
    """

    env: str
    """Id of the environment, for example softmode/LiftSoft-v0, or module:id of your own."""
    out: Annotated[Path | None, short_name("-o")] = None
    """Folder of the dataset, out/NAME if omitted; must not exist, unless --append is given."""
    policy: str = "scripted"
    """scripted, random, zero, or the checkpoint of a run."""
    episodes: int = 10
    """Episodes to record."""
    seed: int = 0
    """Seed of the first episode; the next ones count up."""
    obs_type: Literal["pixels_agent_pos", "state", "pixels"] | None = None
    """What is observed: pictures and the robot's own state, the full state, or pictures alone; the first if omitted, or
    what a trained policy observes."""
    pictures: Literal["video", "png"] = "video"
    """Store pictures as H.264 films, small, or as PNG, exact."""
    only_successes: bool = False
    """Record only episodes that end in success."""
    noise: float = 0.0
    """Standard deviation of random pushes that are added to the actions played, not to those recorded; 0.3 makes
    demonstrations that show how to come back from errors."""
    states: bool = False
    """Record the state in which each episode begins, to begin episodes with."""
    license: str | None = None
    """License that the dataset's card names, such as apache-2.0; your own object may have one of its own."""
    append: bool = False
    """Add to the dataset in the folder, if there is one."""
    ray: str | None = None
    """Record on the machines of a Ray cluster: HOST:PORT of its head, auto, or local to use this machine's cores. The
    same command goes on where it was interrupted."""
    ray_shard: int = 20
    """Episodes that a worker records at a time; the dataset does not depend on it."""
    device: str | None = None
    """Warp device, for example cpu or cuda:0."""
    arm: Annotated[RobotOptions, own_group()] = dataclasses.field(default_factory=RobotOptions)
    """Another robot in place of the built-in arm."""
    toy: Annotated[ObjectOptions, own_group()] = dataclasses.field(default_factory=ObjectOptions)
    """Your own object; what is left out is as the task, the policy's run or the file has it."""

    def run(self) -> int:
        """Record; return the exit code."""
        short_name = registered_id(self.env).rpartition("/")[2]
        check_policy(self.policy)
        out = Path("out", short_name) if self.out is None else self.out
        if not self.append and out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise ConfigError(f"{out} exists", hint="choose another folder, or give --append")
        if self.ray is not None and self.append:
            raise ConfigError("--ray and --append are given", hint="record on the cluster into another folder")

        import gymnasium as gym
        from tqdm import tqdm

        from softmode.demonstrations.recording import check_recording, environment_features, record_episodes
        from softmode.demonstrations.writer import EPISODES_PER_FILE, DatasetWriter

        check_recording(self.episodes, self.seed, self.noise)
        require_number("ray-shard", self.ray_shard, at_least=1, at_most=EPISODES_PER_FILE, hint="give a count like 20")
        trained = trained_policy(self.policy, self.env)
        given: dict[str, Any] = {"obs_type": "pixels_agent_pos"} if trained is None else dict(trained.env_options)
        if self.obs_type is not None:
            given["obs_type"] = self.obs_type
        given = self.toy.env_options(self.env, given) | self.arm.env_options()
        with quiet_warp():
            with BuildBar() as progress:
                made = {**with_config(self.env, given), "device": self.device, "progress": progress}
                env = gym.make(self.env, **made)
            warn_of_env(env)
        try:
            policy = policy_factory(self.policy, env, trained)
            features = environment_features(env, pictures=self.pictures)
            origin = {"env": self.env, "env_options": given}
            origin |= {} if self.license is None else {"license": self.license}
            fps = int(env.metadata["render_fps"])
            robot = ROBOT if self.arm.robot is None else Path(self.arm.robot).stem
            how = {name: getattr(self, name) for name in ("episodes", "seed", "noise", "only_successes", "states")}
            if self.ray is not None:
                return self._on_ray(env, out, origin, how | {"robot": robot, "env_options": given})
            with (
                DatasetWriter(out, features, fps=fps, robot_type=robot, append=self.append, origin=origin) as writer,
                tqdm(total=self.episodes, desc="recording", unit="episode", mininterval=bar_interval()) as bar,
            ):
                before = writer.episode_count
                played = 0

                def tell(seed: int, success: bool, recorded: int) -> None:
                    nonlocal played
                    played = seed + 1 - self.seed
                    bar.set_postfix_str(f"seed {seed}: {'success' if success else 'no success'}")
                    bar.update(recorded - bar.n)

                try:
                    result = record_episodes(env, policy, writer, task=purpose(self.env), progress=tell, **how)
                except KeyboardInterrupt:
                    bar.close()
                    _tell_interrupted(writer, self.episodes - (writer.episode_count - before), self.seed + played)
                    return 130
        finally:
            env.close()
        return _tell(result, out, writer.episode_count)

    def _on_ray(self, env: gym.Env, out: Path, origin: dict[str, Any], how: dict[str, Any]) -> int:
        """Record on a cluster; return the exit code."""
        from softmode.cli import on_ray

        given = {"env": self.env, "pictures": self.pictures, "device": self.device or "cpu", "shard": self.ray_shard}
        job = on_ray.job_of(self.policy, **how, **given, task=purpose(self.env), owner=on_ray.owner_of(env))
        env.close()
        try:
            result = on_ray.record_on_ray(str(self.ray), job, out, origin)
        except KeyboardInterrupt:
            where = on_ray.folder_of(out)
            print(f"softmode: interrupted; the same command goes on from what is in {where}", file=sys.stderr)
            return 130
        return _tell(result, out, result.episodes)


def _tell(result: Recorded, out: Path, count: int) -> int:
    """Say what was recorded; return the exit code."""
    print(
        f"{result.successes} of {result.episodes} recorded episodes succeeded, {result.attempts} were played; "
        f"{out} holds {count} episodes"
    )
    return 0


def _tell_interrupted(writer: DatasetWriter, missing: int, seed: int) -> None:
    """Say what is there after an interruption, and how to go on."""
    if not writer.episode_count:
        print("softmode: interrupted, nothing was written", file=sys.stderr)
        return
    print(
        f"softmode: interrupted; {writer.folder} holds {writer.episode_count} complete episodes, record the other "
        f"{missing} with --append --seed {seed} --episodes {missing}",
        file=sys.stderr,
    )
