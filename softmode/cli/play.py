"""The command ``softmode play``: episodes of an environment, filmed."""

from __future__ import annotations

import contextlib
import dataclasses
import shlex
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from softmode.checks import require_number, require_numbers
from softmode.cli.common import BuildBar, bar_interval, own_group, quiet_warp, short_name, warn_of_env
from softmode.cli.object_options import ObjectOptions
from softmode.cli.robot_options import RobotOptions
from softmode.envs.catalogue import registered_id
from softmode.errors import ConfigError
from softmode.learning.config_values import split_config
from softmode.learning.players import check_policy, policy_factory, trained_policy
from softmode.viz.film import Film

if TYPE_CHECKING:
    import gymnasium as gym

    from softmode.envs.tasks.lift_soft.log import LiftLog
    from softmode.splats.splats import Splats


@dataclasses.dataclass(frozen=True, kw_only=True)
class Play:
    """Play episodes of an environment and film them.

    Example: softmode play softmode/LiftSoft-v0 --splat toy.ply
    """

    env: str
    """Id of the environment, for example softmode/LiftSoft-v0, or module:id of your own."""
    policy: str = "scripted"
    """scripted, random, zero, or the checkpoint of a run, for example runs/LiftSoft-v0/*/best.npz."""
    episodes: int = 1
    """Episodes to play."""
    seed: int = 0
    """Seed of the first episode; the next ones count up."""
    video: Annotated[Path | None, short_name("-o")] = None
    """Film to write (.mp4 or .gif): a camera that follows beside an overview. A contact sheet (.png) is written beside
    it."""
    width: int = 640
    """Width of the film [px], of two square views: a multiple of 4 from 128 to 2048."""
    background: Path | None = None
    """Splat file of a captured room to film the scene in; it stands still and is touched by nothing."""
    background_pose: tuple[float, float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    """Where it is: x y z of its origin [m], roll pitch yaw [deg] about the axes of the world, and the factor on its
    size. The table's top is z = 0; a file whose -y is up has roll -90."""
    rerun: str | None = None
    """Recording to write for the rerun viewer (.rrd); or the address of a running one, like
    rerun+http://127.0.0.1:9876/proxy; or spawn, which opens one."""
    usd: Path | None = None
    """OpenUSD stage to write (.usdc, .usd or .usda)."""
    usd_mode: Literal["handles", "baked"] = "handles"
    """What the stage samples: handle matrices only, or also every splat."""
    device: str | None = None
    """Warp device, for example cpu or cuda:0."""
    arm: Annotated[RobotOptions, own_group()] = dataclasses.field(default_factory=RobotOptions)
    """Another robot in place of the built-in arm."""
    toy: Annotated[ObjectOptions, own_group()] = dataclasses.field(default_factory=ObjectOptions)
    """Your own object; what is left out is as the task, the policy's run or the file has it."""

    def run(self) -> int:
        """Play; return the exit code."""
        check_policy(self.policy)
        registered_id(self.env)
        require_number("episodes", self.episodes, at_least=1, hint="give a count like 3")
        require_number("seed", self.seed, at_least=0, hint="give a whole number like 0")
        require_number("width", self.width, at_least=128, at_most=2048, unit="px")
        if self.width % 4:
            raise ConfigError(f"width is {self.width}", hint="give a multiple of 4, like 640")
        if self.background is not None and self.video is None:
            raise ConfigError(f"background {self.background} without a film", hint="give --video too")
        self.toy.check()
        if self.rerun is not None:
            from softmode.viz.rerun_stream import check_target

            check_target(self.rerun)
        if self.usd is not None:
            from softmode.usd.openusd import check_stage

            check_stage(self.usd)
        with contextlib.nullcontext() if self.video is None else Film(self.video) as film:
            return _play(self, film)


def _play(options: Play, film: Film | None) -> int:
    """Build the environment, play, publish the film."""
    import gymnasium as gym

    started = time.perf_counter()
    trained = trained_policy(options.policy, options.env)
    given = options.toy.env_options(options.env, dict(trained.env_options) if trained else {})
    config, given = split_config(options.env, given)
    if options.video:
        config = dataclasses.replace(config, render_size=options.width // 2)
    background = None if options.background is None else _background(options.background, options.background_pose)
    with quiet_warp():
        with BuildBar() as progress:
            given |= options.arm.env_options()
            given |= {"config": config, "device": options.device, "progress": progress}
            env = gym.make(options.env, render_mode="rgb_array" if film or options.rerun else None, **given)
        warn_of_env(env)
        try:
            if trained:
                trained.check(env)
            body = env.unwrapped.scene.soft.body  # type: ignore[attr-defined]
            print(
                f"body {body.name!r}: {body.function_count} functions, {body.point_count} cubature points, "
                f"built in {body.build_seconds:.2f} s; scene ready after {time.perf_counter() - started:.1f} s"
            )
            if film and background is not None:
                env.unwrapped.scene.film.surround(background)  # type: ignore[attr-defined]
            fps = env.metadata["render_fps"]
            policy = policy_factory(options.policy, env, trained)
            seeds = range(options.seed, options.seed + options.episodes)
            with _recorders(options, env) as logs:
                successes = sum(_play_episode(env, options, policy, seed, film, logs, fps) for seed in seeds)
        finally:
            env.close()
    if film:
        film.publish()
        print(f"wrote {film.path} and {film.sheet_path}")
    if options.rerun and Path(options.rerun).suffix.lower() == ".rrd":
        print(f"wrote {options.rerun}; open it with: rerun {shlex.quote(options.rerun)}")
    if options.usd:
        print(f"wrote {options.usd}; read it with softmode.usd.read_animation, or open it in any viewer of OpenUSD")
    if options.episodes > 1:
        print(f"{successes} of {options.episodes} episodes succeeded")
    return 0


@contextlib.contextmanager
def _recorders(options: Play, env: gym.Env) -> Iterator[list[Any]]:
    """Yield what records the state of the environment after every step, each publishing its file at the end."""
    with contextlib.ExitStack() as stack:
        logs: list[Any] = []
        if options.rerun is not None:
            from softmode.viz.rerun_logger import RerunLogger

            logs.append(stack.enter_context(RerunLogger(options.rerun, env)))
        if options.usd is not None:
            from softmode.usd.animation import UsdAnimation, UsdAnimationOptions

            usd = UsdAnimationOptions(mode=options.usd_mode, fps=env.metadata["render_fps"])
            logs.append(stack.enter_context(UsdAnimation.of_env(options.usd, env, options=usd)))
        yield logs


def _play_episode(
    env: Any, options: Play, factory: Callable[[int], Any], seed: int, film: Film | None, logs: list[Any], fps: int
) -> bool:
    """Play one episode, print its outcome, return whether it succeeded."""
    import gymnasium as gym
    from tqdm import tqdm

    from softmode.envs.tasks.lift_soft.log import LiftLog
    from softmode.envs.tasks.lift_soft.task import LiftSoftConfig

    observation, info = env.reset(seed=seed)
    policy = factory(seed)
    for log in logs:
        log.record()
    total, steps, seconds = 0.0, 0, 0.0
    story = LiftLog(config) if isinstance(config := env.unwrapped.config, LiftSoftConfig) else None
    limit = gym.spec(registered_id(options.env)).max_episode_steps
    with tqdm(total=limit, desc=f"seed {seed}", unit="step", mininterval=bar_interval()) as bar:
        done = False
        while not done:
            action = policy(observation)
            clock = time.perf_counter()
            observation, reward, terminated, truncated, info = env.step(action)
            seconds += (time.perf_counter() - clock) if steps else 0.0  # the first step compiles and records
            total, steps, done = total + float(reward), steps + 1, terminated or truncated
            if film:
                film.add(env.render(), fps)
            for log in logs:
                log.record()
            if story is not None:
                story.record(info)
            bar.update()
    why = "" if info["is_success"] else _why(story, policy, info)
    modulus = info["parameters"]["youngs_modulus"]
    print(
        f"seed {seed}: E {modulus:.3g} Pa, {1e3 * seconds / max(steps - 1, 1):.1f} ms per control step, "
        f"return {total:.1f}, success: {info['is_success']}{why}"
    )
    return bool(info["is_success"])


def _why(story: LiftLog | None, policy: Any, info: dict[str, Any]) -> str:
    """Return why an episode failed, as the end of a line; empty where nothing is known."""
    told = [] if story is None else [story.reason(info)]
    if trouble := getattr(policy, "trouble", ""):
        told.append(f"no grasp fits where it lies now: {trouble}")
    return "".join(f", {reason}" for reason in told)


def _background(path: Path, pose: tuple[float, ...]) -> Splats:
    """Return the splats of a captured room where they belong."""
    from scipy.spatial.transform import Rotation

    from softmode.splats.formats import read_splats

    require_numbers("background-pose", pose, 7, hint="give x y z roll pitch yaw size")
    require_number("background-pose: the factor on its size", pose[6], above=0.0)
    turn = Rotation.from_euler("xyz", pose[3:6], degrees=True).as_matrix()
    return read_splats(path).transformed(rotation=turn, translation=pose[:3], scale=pose[6])
