"""The command line: ``softmode play``, ``record``, ``list-envs``, ``robots`` and ``splat``."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from softmode import ENVIRONMENTS
from softmode.cli_common import bar_interval, quiet_warp, warp_device
from softmode.cli_record import Record
from softmode.cli_splat import SplatConvert, SplatFromMesh, SplatInfo
from softmode.errors import ConfigError, MaterialError, MissingExtraError, SoftmodeError
from softmode.policies import check_policy, policy_factory

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclasses.dataclass(frozen=True, kw_only=True)
class Play:
    """Play episodes of an environment and film them."""

    env: str
    """Id of the environment, for example softmode/LiftSoft-v0."""
    policy: str = "scripted"
    """scripted, random, zero, or the file of a trained policy."""
    episodes: int = 1
    """Episodes to play."""
    seed: int = 0
    """Seed of the first episode; the next ones count up."""
    video: Path | None = None
    """Film to write (.mp4): the camera's view beside an overview. A contact sheet (.png) is written beside it."""
    splat: Path | None = None
    """Splat file of the object (INRIA .ply, or a SOG v2 folder, meta.json or .sog); the built-in plush if omitted."""
    size: float | None = None
    """Longest edge of the object [m], 0.08 if omitted; the gripper opens 0.09 m."""
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z"] = "-y"
    """Axis of the splat file that points up."""
    crop: tuple[float, float, float, float, float, float] | None = None
    """Box x0 y0 z0 x1 y1 z1 of the splat file, once turned up, outside which splats are dropped."""
    part: Literal["thickest", "tallest", "largest", "all"] = "thickest"
    """Which of the separate parts of the splat file is the object."""
    pose: Literal["stable", "captured"] = "stable"
    """Lay an object that cannot stand on its stable side, or let it topple."""
    youngs_modulus: float | None = None
    """Young's modulus of the object [Pa]; random if omitted."""
    device: str | None = None
    """Warp device, for example cpu or cuda:0."""

    def run(self) -> int:
        """Play; return the exit code."""
        return play(self)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ListEnvs:
    """List the environments and their tasks."""

    def run(self) -> int:
        """Print one line per environment."""
        for name, task in ENVIRONMENTS.items():
            print(f"{name}  {task}")
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Robots:
    """List the robots that load by name, or fetch some into the cache so that they load without a network."""

    action: Literal["list", "fetch"]
    """list prints the names, fetch downloads models."""
    names: tuple[str, ...]
    """What to fetch, for example so101 ur5e."""

    def run(self) -> int:
        """Print the names or fetch the models."""
        from softmode.robots import available, fetch

        if self.action == "list":
            print("\n".join(available()))
            return 0
        if not self.names:
            raise ConfigError("robots fetch names no robot", hint="name some, like: softmode robots fetch so101 ur5e")
        for name, folder in zip(self.names, fetch(self.names), strict=True):
            print(f"{name}  {folder}")
        return 0


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; errors that softmode expects print one line and return 2, an interruption returns 130."""
    try:
        try:
            import tyro
        except ImportError as error:
            raise MissingExtraError(
                "the command line needs tyro", hint="install it with: pip install 'softmode[demo]'"
            ) from error
        splat = Annotated[
            Annotated[SplatFromMesh, tyro.conf.subcommand("from-mesh")]
            | Annotated[SplatInfo, tyro.conf.subcommand("info")]
            | Annotated[SplatConvert, tyro.conf.subcommand("convert")],
            tyro.conf.subcommand("splat", description="Make, inspect and convert splat files."),
        ]
        command = tyro.cli(
            Annotated[Play, tyro.conf.subcommand("play")]
            | Annotated[Record, tyro.conf.subcommand("record")]
            | Annotated[ListEnvs, tyro.conf.subcommand("list-envs")]
            | Annotated[Robots, tyro.conf.subcommand("robots")]
            | splat,  # type: ignore[arg-type]
            prog="softmode",
            args=arguments,
            config=(tyro.conf.PositionalRequiredArgs,),
        )
        return command.run()
    except SoftmodeError as error:
        print(f"softmode: error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"softmode: error: {error}. Check the path and the free space", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("softmode: interrupted, nothing was written", file=sys.stderr)
        return 130


def play(options: Play) -> int:
    """Play episodes; see :class:`Play`."""
    check_policy(options.policy)
    if options.env not in ENVIRONMENTS:
        raise ConfigError(f"unknown environment {options.env!r}", hint=f"use one of {', '.join(ENVIRONMENTS)}")
    if options.episodes < 1:
        raise ConfigError(f"episodes must be at least 1, got {options.episodes}", hint="give a count like 3")
    if options.seed < 0:
        raise ConfigError(f"seed must not be negative, got {options.seed}", hint="give a whole number like 0")
    if options.youngs_modulus is not None and not 0.0 < options.youngs_modulus < float("inf"):
        raise MaterialError(
            f"youngs-modulus must be a finite number > 0, got {options.youngs_modulus}", hint="give it in Pa, like 2e5"
        )
    film = None
    try:
        if options.video is not None:
            film = _Film(options.video)
        return _play(options, film)
    finally:
        if film:
            film.discard()


def _play(options: Play, film: _Film | None) -> int:
    """Build the environment, play, publish the film."""
    import gymnasium as gym
    import warp as wp

    started = time.perf_counter()
    with quiet_warp():
        if not any(Path(wp.config.kernel_cache_dir or "").glob("wp_softmode.deformables.kernels_*")):
            print("compiling kernels (first run only, a minute or two)", file=sys.stderr, flush=True)
        with _BuildBar() as progress:
            env = gym.make(
                options.env,
                render_mode="rgb_array" if film else None,
                config=_task_config(options),
                device=warp_device(options.device),
                progress=progress,
            )
        try:
            body = env.unwrapped.scene.soft.body  # type: ignore[attr-defined]
            print(
                f"body {body.name!r}: {body.function_count} functions, {body.point_count} cubature points, "
                f"built in {body.build_seconds:.2f} s; scene ready after {time.perf_counter() - started:.1f} s"
            )
            fps = env.metadata["render_fps"]
            policy = policy_factory(options.policy, env)
            seeds = range(options.seed, options.seed + options.episodes)
            successes = sum(_play_episode(env, options, policy, seed, film, fps) for seed in seeds)
        finally:
            env.close()
    if film:
        film.publish()
        print(f"wrote {film.path} and {film.sheet_path}")
    if options.episodes > 1:
        print(f"{successes} of {options.episodes} episodes succeeded")
    return 0


def _play_episode(
    env: Any, options: Play, factory: Callable[[int], Any], seed: int, film: _Film | None, fps: int
) -> bool:
    """Play one episode, print its outcome, return whether it succeeded."""
    import gymnasium as gym
    from tqdm import tqdm

    given = {} if options.youngs_modulus is None else {"youngs_modulus": options.youngs_modulus}
    observation, info = env.reset(seed=seed, options=given)
    policy = factory(seed)
    total, steps, seconds = 0.0, 0, 0.0
    limit = gym.spec(options.env).max_episode_steps
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
            bar.update()
    modulus = info["parameters"]["youngs_modulus"]
    print(
        f"seed {seed}: E {modulus:.3g} Pa, {1e3 * seconds / max(steps - 1, 1):.1f} ms per control step, "
        f"return {total:.1f}, success: {info['is_success']}"
    )
    return bool(info["is_success"])


def _task_config(options: Play) -> Any:
    """Turn the options that concern the object into a configuration."""
    from softmode.envs.lift_soft import LiftSoftConfig
    from softmode.envs.objects import ObjectConfig
    from softmode.envs.table_scene import TableSceneConfig

    size = ObjectConfig().size if options.size is None else options.size
    thing = ObjectConfig(
        splat=options.splat, size=size, up=options.up, crop=options.crop, part=options.part, pose=options.pose
    )
    return LiftSoftConfig(scene=TableSceneConfig(object=thing), mesh_samples=4 if options.video else 1)


class _BuildBar:
    """A progress bar over the build of a body, on stderr; it appears with the first report."""

    def __init__(self) -> None:
        self._bar: Any = None

    def __enter__(self) -> _BuildBar:
        return self

    def __call__(self, stage: str, fraction: float) -> None:
        if self._bar is None:
            from tqdm import tqdm

            self._bar = tqdm(total=100, desc="building the body", unit="%", mininterval=bar_interval())
        self._bar.set_postfix_str(stage, refresh=False)
        self._bar.update(round(100.0 * fraction) - self._bar.n)

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()


class _Film:
    """A video and its contact sheet that appear complete or not at all.

    Args:
        path: The video to write (.mp4).

    Raises:
        ConfigError: If it cannot be written there.
        MissingExtraError: If what encodes it is not installed.
    """

    SHEET_FRAMES = 12

    def __init__(self, path: Path) -> None:
        """Claim a temporary file beside ``path``."""
        try:
            import imageio.v2  # noqa: F401
            import imageio_ffmpeg  # noqa: F401
        except ImportError as error:
            raise MissingExtraError(
                "writing a video needs imageio and imageio-ffmpeg",
                hint="install them with: pip install 'softmode[demo]'",
            ) from error
        if path.suffix.lower() != ".mp4":
            raise ConfigError(f"video {path} is no .mp4 file", hint="name it like out/lift.mp4")
        self.path = path
        self.sheet_path = path.with_suffix(".png")
        self._made = [folder for folder in path.absolute().parents if not folder.exists()]
        self._temporary = path.with_name(f".{path.stem}-{os.getpid()}.mp4")
        self._sheet = self._temporary.with_suffix(".png")
        self._writer: Any = None
        self._frames: list[NDArray[np.uint8]] = []
        self._count, self._stride = 0, 1
        try:
            if path.is_dir() or self.sheet_path.is_dir():
                raise IsADirectoryError(f"{path} or {self.sheet_path} is a folder")
            path.parent.mkdir(parents=True, exist_ok=True)
            self._temporary.open("xb").close()  # with the permissions that the umask asks for
        except OSError as error:
            self._remove_folders()
            raise ConfigError(
                f"video {path} cannot be written: {error.strerror or error}", hint="choose another folder"
            ) from error

    def add(self, frame: NDArray[np.uint8], fps: int) -> None:
        """Append a frame."""
        if self._writer is None:
            import imageio.v2 as imageio

            self._writer = imageio.get_writer(
                self._temporary,
                format="FFMPEG",
                fps=fps,
                codec="libx264",
                quality=8,
                macro_block_size=8,  # type: ignore[arg-type]
            )
        self._writer.append_data(frame)
        if self._count % self._stride == 0:
            self._frames.append(frame)
        self._count += 1
        if len(self._frames) >= 8 * self.SHEET_FRAMES:  # a long film keeps every second of them
            self._frames, self._stride = self._frames[::2], 2 * self._stride

    def publish(self) -> None:
        """Put video and contact sheet in place."""
        import numpy as np
        from PIL import Image

        self._writer.close()
        if self._temporary.stat().st_size == 0:
            raise OSError(f"the encoder wrote nothing to {self._temporary}")
        # Equal steps in what changed, so that a long rest at the end does not fill the sheet.
        coarse = np.array([frame[::4, ::4] for frame in self._frames], np.float32)
        change = np.abs(np.diff(coarse, axis=0)).mean(axis=(1, 2, 3))
        done = np.append(0.0, np.cumsum(change + 0.2 * change.mean() + 1.0e-6)) if len(change) else np.zeros(1)
        chosen = np.abs(done - np.linspace(0.0, done[-1], self.SHEET_FRAMES)[:, None]).argmin(axis=1)
        rows = [np.concatenate([self._frames[i] for i in chosen[k : k + 3]], axis=1) for k in range(0, len(chosen), 3)]
        Image.fromarray(np.concatenate(rows, axis=0)).save(self._sheet)
        os.replace(self._sheet, self.sheet_path)
        os.replace(self._temporary, self.path)
        self._made = []

    def discard(self) -> None:
        """Remove what was not published."""
        if self._writer is not None:
            with contextlib.suppress(Exception):  # an encoder that was interrupted too has nothing left to say
                self._writer.close()
        self._temporary.unlink(missing_ok=True)
        self._sheet.unlink(missing_ok=True)
        self._remove_folders()

    def _remove_folders(self) -> None:
        """Remove the folders that were made for a film which did not come to be."""
        for folder in self._made:
            with contextlib.suppress(OSError):
                folder.rmdir()


if __name__ == "__main__":
    sys.exit(main())
