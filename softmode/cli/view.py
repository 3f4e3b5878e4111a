"""The command ``softmode view``: a soft object or an environment in the browser, to pull, pin and tune."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from softmode import ENVIRONMENTS
from softmode.checks import require_number
from softmode.cli.common import BuildBar, own_group, quiet_warp, same_fields, warn_of, warp_device
from softmode.cli.object_options import ObjectOptions
from softmode.cli.robot_options import RobotOptions, tell_of
from softmode.errors import AssetError, ConfigError, SoftmodeError
from softmode.learning.config_values import split_config
from softmode.learning.players import trained_policy
from softmode.mpm.run import is_morph
from softmode.view.browser import open_browser

if TYPE_CHECKING:
    from softmode.view.app import ViewOptions
    from softmode.view.session import LiveSession

_ELSEWHERE = ("target", "prepare", "toy", "arm", "splat", "object", "up", "crop")
"""Options that the page which prepares a capture writes itself, or ends."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """Show an object or task in the browser; pull, pin, tune it.

    Example: softmode view toy.ply --size 0.12 --scene drop
    """

    target: tuple[str, ...]
    """An environment's id; the file of a splat, a mesh, a radiance field, a saved body (.npz) or an OpenUSD stage; the
    name of a preset, or of a model that stands in its foot (plant, excavator, jelly); the run of `softmode morph`
    (.npz), which is played back; the built-in plush if omitted."""
    scene: Literal["hang", "drop"] = "hang"
    """An object hangs, held by one end, or drops on a table."""
    hold: Literal["top", "base"] = "top"
    """Which end of a hanging object is held."""
    prepare: bool = False
    """Turn a splat file upright and crop it on a page first, then build it; prints the command that repeats it."""
    policy: str = "scripted"
    """What moves the arm of an environment: scripted, random, zero, or the checkpoint of a run."""
    seed: int = 0
    """Seed of an environment's first episode."""
    host: str = "127.0.0.1"
    """Address to listen at; the default is this machine alone. Whoever has the page's address drives the session."""
    port: int = 8080
    """Port to listen at; 0 for any free one."""
    open: bool = True
    """Open a browser, where there is a display."""
    duration: float | None = None
    """Seconds after which to end; until Ctrl-C if omitted."""
    frame_rate: float = 30.0
    """Pictures per second."""
    record_folder: Path = Path("out")
    """Where recordings are written."""
    record_as: Literal["mp4", "npz", "usdc"] = "mp4"
    """What the button records: a video, coordinates, or an OpenUSD stage (extra [usd])."""
    device: str | None = None
    """Warp device, for example cpu or cuda:0."""
    arm: Annotated[RobotOptions, own_group()] = dataclasses.field(default_factory=RobotOptions)
    """Another robot in place of the built-in arm."""
    toy: Annotated[ObjectOptions, own_group()] = dataclasses.field(default_factory=ObjectOptions)
    """Your own object; what is left out is as the task, the policy's run or the file has it."""

    def run(self) -> int:
        """Serve; return the exit code."""
        from softmode.view.app import ViewOptions

        if self.duration is not None:
            require_number("duration", self.duration, above=0.0, hint="give seconds, like 60")
        served = ViewOptions(**same_fields(self, ViewOptions))
        served.check()  # a building that takes a minute need not come first
        if len(self.target) == 1 and is_morph(self.target[0]):
            return _played(self, served)
        with quiet_warp():
            shown = _prepared(self, served) if self.prepare else (self, _session(self))
            while shown is not None and _serve(*shown, served):
                shown = _prepared(shown[0], served)
        return 0


def _serve(options: View, session: LiveSession, served: ViewOptions) -> bool:
    """Serve a session until it ends; return whether somebody asked to prepare its capture instead."""
    from softmode.view.app import ViewApp

    try:
        with ViewApp(session, served, capture=_is_capture(_file(options))) as app:
            print(f"softmode: open {app.url} in a browser; Ctrl-C ends it", flush=True)
            if options.toy.march:
                print("softmode: the page shows splats baked of the field; videos that it records march", flush=True)
            if not served.is_local:
                print(
                    f"softmode: warning: listening at {options.host}: whoever has that address, which travels "
                    "unencrypted, can drive this session",
                    file=sys.stderr,
                )
            if options.open:
                open_browser(app.url)
            try:
                app.run(options.duration)
            except KeyboardInterrupt:
                print("softmode: stopped", file=sys.stderr)
            if session.status().recording:
                print(f"softmode: wrote {session.stop_recording()}")
            return app.asked_to_prepare
    except KeyboardInterrupt:
        print("softmode: stopped", file=sys.stderr)
        return False
    finally:
        session.close()


def _file(options: View) -> Path | None:
    """Return the file that is shown, if it is one."""
    return options.toy.file if not options.target else Path(options.target[0])


def _is_capture(file: Path | None) -> bool:
    """Return whether a file holds splats."""
    from softmode.objects.object_file import file_kind

    return file is not None and file.exists() and file_kind(file) == "splat"


def _played(options: View, served: ViewOptions) -> int:
    """Play a morph back."""
    from softmode.mpm import MorphRun
    from softmode.view.morph_page import MorphPage

    with MorphPage(MorphRun.load(options.target[0]), served) as page:
        print(f"softmode: open {page.url} in a browser; Ctrl-C ends it", flush=True)
        if options.open:
            open_browser(page.url)
        with contextlib.suppress(KeyboardInterrupt):
            page.play(options.duration)
    return 0


def _prepared(options: View, served: ViewOptions) -> tuple[View, LiveSession] | None:
    """Return the options with what a person made of a splat file on a page, and what was built; None without a build.

    The page says how far the build is, and why there is none. It stays until there is one, as Chromium delays a page
    that is refused for half a minute by more than the second after which viser's page gives up and tries again.
    """
    from softmode.view.prepare import PreparePage

    toy, file = options.toy, _file(options)
    if file is None or not _is_capture(file):
        raise AssetError(
            f"nothing to prepare in {file or 'the plush'}", hint="give a splat file, or leave out --prepare"
        )
    with PreparePage(file, served, up=toy.up, crop=toy.crop, rest=_words(options)) as page:
        print(f"softmode: open {page.url} in a browser; Ctrl-C ends it", flush=True)
        if options.open:
            open_browser(page.url)
        try:
            while page.wait(options.duration):
                page.show_progress("the body", 0.0)
                print(f"softmode: to do this again: {page.command}", flush=True)
                made = dataclasses.replace(options, toy=dataclasses.replace(toy, up=page.up, crop=page.crop))
                try:
                    return made, _session(made, page.show_progress)
                except SoftmodeError as error:
                    page.refuse(error)
                    print(f"softmode: {error}", file=sys.stderr)
        except KeyboardInterrupt:
            print("softmode: stopped", file=sys.stderr)
        return None


def _words(options: View) -> list[str]:
    """Return the words of the command line beside the file, and what is chosen on the page."""
    words: list[str] = []
    for group in (options, options.toy):
        plain = View(target=()) if group is options else ObjectOptions()
        for field in dataclasses.fields(group):
            value = getattr(group, field.name)
            if field.name in _ELSEWHERE or value == getattr(plain, field.name):
                continue
            option = field.name.replace("_", "-")
            words += [f"--no-{option}"] if value is False else [f"--{option}"]
            words += [] if value is False else map(str, value if isinstance(value, tuple) else (value,))
    return words


def _session(options: View, show_progress: Callable[[str, float], None] | None = None) -> LiveSession:
    """Make the session that was asked for; `show_progress` is told stages and fractions beside the terminal."""
    from gymnasium.envs.registration import registry

    from softmode.envs.arguments import Shortcuts, checked_config
    from softmode.envs.catalogue import env_class, registered_id
    from softmode.objects.captures import CAPTURES
    from softmode.objects.config import ObjectConfig
    from softmode.objects.models import MODELS
    from softmode.objects.shapes.presets import PRESETS
    from softmode.robots.table_robot import TableRobot
    from softmode.view.live_types import LiveOptions
    from softmode.view.session import LiveSession

    options.toy.check()

    if len(options.target) > 1:
        raise ConfigError(f"{len(options.target)} things to show: {', '.join(options.target)}", hint="name one")
    device, target = warp_device(options.device), next(iter(options.target), None)
    with BuildBar(show_progress) as progress:
        missing = target is not None and target not in (*PRESETS, *CAPTURES, *MODELS) and not Path(target).exists()
        if target is not None and missing and (target.startswith("softmode/") or ":" in target or target in registry):
            registered_id(target)
            _refuse(options, ("scene", "hold"), "an environment")
            trained = trained_policy(options.policy, target)
            given = options.toy.env_options(target, dict(trained.env_options) if trained else {})
            config, rest = split_config(target, given | options.arm.env_options())
            robot = Shortcuts(robot=rest.get("robot"))
            config = checked_config(type(config), config, robot, env_class(target).task_class.any_robot)
            session = LiveSession.from_env(
                target, policy=options.policy, config=config, seed=options.seed, device=device, progress=progress
            )
            if isinstance(config.scene.arm, TableRobot):
                tell_of(config.scene.arm.robot)
            if config.scene.object.file is not None or config.scene.object.preset is not None:
                grasps = env_class(target).task_class.grasps
                warn_of(session.object, config.scene.arm if grasps else None)
            return session
        if missing:
            raise AssetError(
                f"{target} is neither a file nor an environment",
                hint=f"give a splat, mesh or .npz file, or one of {', '.join([*ENVIRONMENTS, *PRESETS, *MODELS])}",
            )
        _refuse(options, ("policy", "seed"), "an object")
        if options.arm != RobotOptions():
            raise ConfigError("a robot says nothing about an object", hint="leave its options out, or name a task")
        source = target
        if options.toy.shape or options.toy.file is not None or target in PRESETS:
            if target is not None and options.toy.file is not None:
                raise ConfigError(f"{target} and {options.toy.file} are two objects", hint="name one")
            file = options.toy.object if target is None else Path(target)
            source = dataclasses.replace(options.toy, object=file).object_of(ObjectConfig())
        if target in MODELS:
            _refuse(options, ("scene", "hold"), "a model")
        live = LiveOptions(substep=MODELS[target]) if target in MODELS else None
        session = LiveSession.from_object(
            source, scene=options.scene, hold=options.hold, options=live, device=device, progress=progress
        )
        session.set_parameters(**options.toy.material)
        if source is not None:
            warn_of(session.object)
        return session


def _refuse(options: View, names: tuple[str, ...], what: str) -> None:
    """Refuse options that say nothing about what is shown."""
    for field in dataclasses.fields(View):
        if field.name in names and getattr(options, field.name) != field.default:
            raise ConfigError(f"--{field.name} says nothing about {what}", hint=f"leave --{field.name} out")
