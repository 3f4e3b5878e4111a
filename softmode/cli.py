"""The command line: ``softmode play`` and ``softmode list-envs``."""

from __future__ import annotations

import dataclasses
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from softmode import ENVIRONMENTS
from softmode.errors import ConfigError, MissingExtraError, SoftmodeError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

POLICIES = ("scripted", "random", "zero")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Play:
    """Play episodes of an environment and film them."""

    env: str
    """Id of the environment, for example softmode/LiftSoft-v0."""
    policy: str = "scripted"
    """scripted, random or zero."""
    episodes: int = 1
    """Episodes to play."""
    seed: int = 0
    """Seed of the first episode; the next ones count up."""
    video: Path | None = None
    """Film to write (.mp4): the camera's view beside an overview. A contact sheet (.png) is written beside it."""
    splat: Path | None = None
    """Splat file of the object (INRIA .ply, or a SOG v2 folder, meta.json or .sog); the built-in plush if omitted."""
    size: float | None = None
    """Longest edge of the object [m]; the gripper opens 0.09 m."""
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z"] = "-y"
    """Axis of the splat file that points up."""
    crop: tuple[float, float, float, float, float, float] | None = None
    """Box x0 y0 z0 x1 y1 z1 of the splat file, once turned up, outside which splats are dropped."""
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


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; errors that softmode expects print one line and return 2."""
    try:
        try:
            import tyro
        except ImportError as error:
            raise MissingExtraError(
                "the command line needs tyro", hint="install it with: pip install 'softmode[demo]'"
            ) from error
        command = tyro.cli(
            Annotated[Play, tyro.conf.subcommand("play")] | Annotated[ListEnvs, tyro.conf.subcommand("list-envs")],  # type: ignore[arg-type]
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


def play(options: Play) -> int:
    """Play episodes; see :class:`Play`."""
    if options.policy not in POLICIES:
        raise ConfigError(f"unknown policy {options.policy!r}", hint=f"use one of {', '.join(POLICIES)}")
    if options.env not in ENVIRONMENTS:
        raise ConfigError(f"unknown environment {options.env!r}", hint=f"use one of {', '.join(ENVIRONMENTS)}")
    if options.episodes < 1:
        raise ConfigError(f"episodes must be at least 1, got {options.episodes}")
    if options.video is not None:
        if options.video.suffix.lower() != ".mp4":
            raise ConfigError(f"video {options.video} is no .mp4 file", hint="name it like out/lift.mp4")
        _require_imageio()

    import gymnasium as gym
    import warp as wp

    wp.config.quiet = True
    started = time.perf_counter()
    with _Progress() as progress:
        env = gym.make(
            options.env,
            render_mode="rgb_array" if options.video else None,
            config=_scene_config(options),
            device=_device(options.device),
            progress=progress,
        )
    body = env.unwrapped.scene.soft.body  # type: ignore[attr-defined]
    print(
        f"body {body.name!r}: {body.function_count} functions, {body.point_count} cubature points, "
        f"built in {body.build_seconds:.2f} s; scene ready after {time.perf_counter() - started:.1f} s"
    )
    film = _Film(options.video, fps=env.metadata["render_fps"]) if options.video else None
    successes = 0
    try:
        for episode in range(options.episodes):
            successes += _play_episode(env, options, options.seed + episode, film)
        if film:
            film.publish()
            print(f"wrote {film.path} and {film.sheet_path}")
    finally:
        if film:
            film.discard()
        env.close()
    if options.episodes > 1:
        print(f"{successes} of {options.episodes} episodes succeeded")
    return 0


def _play_episode(env: Any, options: Play, seed: int, film: _Film | None) -> bool:
    """Play one episode, print its outcome, return whether it succeeded."""
    import gymnasium as gym
    from tqdm import tqdm

    given = {} if options.youngs_modulus is None else {"youngs_modulus": options.youngs_modulus}
    observation, info = env.reset(seed=seed, options=given)
    env.action_space.seed(seed)
    policy = _policy(options.policy, env)
    total, steps, seconds = 0.0, 0, 0.0
    with tqdm(total=gym.spec(options.env).max_episode_steps, desc=f"seed {seed}", unit="step", leave=False) as bar:
        done = False
        while not done:
            action = policy(observation)
            clock = time.perf_counter()
            observation, reward, terminated, truncated, info = env.step(action)
            seconds += (time.perf_counter() - clock) if steps else 0.0  # the first step compiles and records
            total, steps, done = total + float(reward), steps + 1, terminated or truncated
            if film:
                film.add(env.render())
            bar.update()
    print(
        f"seed {seed}: E {info['youngs_modulus']:.3g} Pa, {1e3 * seconds / max(steps - 1, 1):.1f} ms per control step, "
        f"return {total:.1f}, success: {info['is_success']}"
    )
    return bool(info["is_success"])


def _policy(name: str, env: Any) -> Any:
    """Return a callable from observation to action."""
    if name == "scripted":
        from softmode.envs.scripted import ScriptedLift

        return ScriptedLift(env)
    if name == "random":
        return lambda observation: env.action_space.sample()
    zero = env.action_space.low * 0
    return lambda observation: zero


def _scene_config(options: Play) -> Any:
    """Turn the options that concern the object into a configuration."""
    from softmode.envs.lift_soft import LiftSoftConfig
    from softmode.envs.objects import ObjectConfig
    from softmode.envs.table_scene import TableSceneConfig

    size = ObjectConfig().size if options.size is None else options.size
    thing = ObjectConfig(splat=options.splat, size=size, up=options.up, crop=options.crop)
    return LiftSoftConfig(scene=TableSceneConfig(object=thing))


def _device(name: str | None) -> Any:
    """Return the device, or raise ConfigError when it is not there."""
    import warp as wp

    if name is None:
        return None
    try:
        return wp.get_device(name)
    except (ValueError, RuntimeError) as error:
        known = ", ".join(str(device) for device in wp.get_devices())
        raise ConfigError(f"device {name!r} is not available", hint=f"use one of {known}") from error


def _require_imageio() -> None:
    """Raise MissingExtraError when films cannot be written."""
    try:
        import imageio.v2  # noqa: F401
        import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        raise MissingExtraError(
            "writing a video needs imageio and imageio-ffmpeg", hint="install them with: pip install 'softmode[demo]'"
        ) from error


class _Progress:
    """A progress bar over the build of a body, on stderr."""

    def __enter__(self) -> _Progress:
        from tqdm import tqdm

        self._bar = tqdm(total=1.0, desc="building the body", bar_format="{desc} {percentage:3.0f}%|{bar}|", leave=False)
        return self

    def __call__(self, stage: str, fraction: float) -> None:
        self._bar.set_description_str(f"building the body: {stage}")
        self._bar.update(fraction - self._bar.n)

    def __exit__(self, *_: object) -> None:
        self._bar.close()


class _Film:
    """A video and its contact sheet that appear complete or not at all."""

    SHEET_FRAMES = 12

    def __init__(self, path: Path, *, fps: int) -> None:
        """Open a temporary file beside ``path``."""
        import imageio.v2 as imageio

        self.path = path
        self.sheet_path = path.with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=".mp4", dir=path.parent)
        os.close(handle)
        self._temporary: Path | None = Path(name)
        self._frames: list[NDArray[np.uint8]] = []
        self._writer: Any = imageio.get_writer(
            name, format="FFMPEG", fps=fps, codec="libx264", quality=8, macro_block_size=8  # type: ignore[arg-type]
        )

    def add(self, frame: NDArray[np.uint8]) -> None:
        """Append a frame."""
        self._writer.append_data(frame)
        self._frames.append(frame)

    def publish(self) -> None:
        """Put video and contact sheet in place."""
        import numpy as np
        from PIL import Image

        self._writer.close()
        assert self._temporary is not None
        chosen = np.linspace(0, len(self._frames) - 1, self.SHEET_FRAMES).round().astype(int)
        rows = [np.concatenate([self._frames[i] for i in chosen[k : k + 3]], axis=1) for k in range(0, len(chosen), 3)]
        sheet = self._temporary.with_suffix(".png")
        try:
            Image.fromarray(np.concatenate(rows, axis=0)).save(sheet)
            os.replace(sheet, self.sheet_path)
        finally:
            sheet.unlink(missing_ok=True)
        os.replace(self._temporary, self.path)
        self._temporary = None

    def discard(self) -> None:
        """Remove what was not published."""
        self._writer.close()
        if self._temporary is not None:
            self._temporary.unlink(missing_ok=True)
            self._temporary = None


if __name__ == "__main__":
    sys.exit(main())
