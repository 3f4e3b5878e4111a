"""What the commands share: a quiet Warp, a device by name, progress bars, what is said about objects."""

from __future__ import annotations

import contextlib
import mmap
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from softmode.errors import ConfigError
from softmode.stages import moved

if TYPE_CHECKING:
    from softmode.deformables.reduction.report import Finding
    from softmode.objects.soft_object import SoftObject
    from softmode.robots.arm import ArmDescription
    from softmode.robots.table_robot import TableRobot


def short_name(name: str) -> Any:
    """Return what gives an option a short name; evaluated when tyro reads the annotation, not on import."""
    import tyro

    return tyro.conf.arg(aliases=[name])


@contextlib.contextmanager
def quiet_warp() -> Iterator[None]:
    """Start Warp; of what it tells about every module it loads only a count of those compiled is shown."""
    import warp as wp

    from softmode.quiet import listening

    with contextlib.closing(_KernelCount()) as count, listening(count):
        wp.init()
        yield


class _KernelCount:
    """Counts the modules that Warp compiles: in a bar on a terminal, else one line says what takes so long."""

    def __init__(self) -> None:
        """Show nothing yet."""
        self._bar: Any = None
        self._taken = mmap.mmap(-1, 1)  # shared with child processes: one of them all shows its count

    def __call__(self, line: str) -> None:
        """Take a line of Warp's."""
        if "(compiled)" not in line:
            return
        if self._bar is None:
            if self._taken[0]:
                return
            self._taken[0] = 1
            from tqdm import tqdm

            what, terminal = "compiling kernels (first run only, a minute or two)", sys.stderr.isatty()
            moved()
            if not terminal:
                print(what, file=sys.stderr, flush=True)
            self._bar = tqdm(desc=what, unit=" modules", leave=False, disable=not terminal)
        self._bar.update()

    def close(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.close()


def own_group() -> Any:
    """Return what shows the options of an own object or robot as a group of theirs; evaluated when tyro reads it."""
    import tyro

    return tyro.conf.OmitArgPrefixes


def optional_argument() -> Any:
    """Return what makes a field an argument that may be left out; evaluated when tyro reads it."""
    import tyro

    return tyro.conf.Positional


def one_place(argument: Path | None, option: Path | None) -> Path:
    """Return the file to write, which is given as an argument or as the option -o.

    Raises:
        ConfigError: If it is given both ways or not at all.
    """
    if (argument is None) == (option is None):
        what = "no file to write is given" if option is None else f"{argument} and {option} are two files to write"
        raise ConfigError(what, hint="name one, like -o out/toy.npz")
    return option if argument is None else argument  # type: ignore[return-value]


def finding_line(finding: Finding, stream: TextIO) -> str:
    """Return a finding with its remedy in a line, its severity in colour where a terminal shows it."""
    remedy = finding.remedy[:1].upper() + finding.remedy[1:]
    severity = finding.severity
    if stream.isatty() and not os.environ.get("NO_COLOR"):
        severity = f"\x1b[{'31' if severity == 'broken' else '33'}m{severity}\x1b[0m"
    return f"{severity}: {finding.name}: {finding.what}." + (f" {remedy}." if remedy else "")


def warn_of_env(env: Any) -> None:
    """Print, on stderr, what the user should know about an environment's robot and object that come from files.

    Args:
        env: A single or a vector environment; one that is not softmode's has no such object.
    """
    from softmode.cli.robot_options import tell_of
    from softmode.objects.loader import load
    from softmode.robots.arm import ArmDescription

    base = env.unwrapped
    if not hasattr(base, "task_class"):
        return
    if not isinstance(base.config.scene.arm, ArmDescription):
        tell_of(base.config.scene.arm.robot)
    if base.config.object_set is not None:  # the task has checked them
        return
    scene = base.config.scene
    if scene.object.file is None and scene.object.preset is None:
        return
    try:
        thing = base.task.scene.soft
    except ConfigError:  # The worlds live in other processes, which have put the body into the cache.
        thing = load(scene.object, material=scene.material)
    warn_of(thing, scene.arm if base.task_class.grasps else None)


def warn_of(thing: SoftObject, arm: ArmDescription | TableRobot | None = None) -> None:
    """Print, on stderr, what the user should know about an object that an arm, if any, is to take, and whose it is."""
    from softmode.objects.captures import credit
    from softmode.robots.jaws import ParallelJaw

    file = None if thing.config is None or thing.config.file is None else thing.config.file[1]
    if by := credit(file):
        print(f"softmode: {by}", file=sys.stderr)
    for finding in thing.findings(jaw=None if arm is None else ParallelJaw.of(arm)):
        print(f"softmode: {finding_line(finding, sys.stderr)}", file=sys.stderr, flush=True)


def warp_device(name: str | None) -> Any:
    """Return the device, or raise ConfigError when it is not there."""
    import warp as wp

    if name is None:
        return None
    try:
        return wp.get_device(name)
    except (ValueError, RuntimeError) as error:
        known = ", ".join(str(device) for device in wp.get_devices())
        raise ConfigError(f"device {name!r} is not available", hint=f"use one of {known}") from error


def same_fields(options: Any, kind: type) -> dict[str, Any]:
    """Return the fields of a dataclass that the options of a command have too, by name."""
    return {field.name: getattr(options, field.name) for field in fields(kind) if hasattr(options, field.name)}


def bar_interval() -> float:
    """Return how often a progress bar is drawn [s]: smoothly on a terminal, seldom in a log."""
    return 0.1 if sys.stderr.isatty() else 2.5


class BuildBar:
    """A progress bar over the build of a body, on stderr; it appears with the first report.

    Args:
        also: Told each stage and fraction too.
    """

    def __init__(self, also: Callable[[str, float], None] | None = None) -> None:
        """Show nothing yet."""
        self._bar: Any = None
        self._also = also

    def __deepcopy__(self, memo: object) -> BuildBar:
        """Return itself: Gymnasium copies what an environment was made with, and a terminal cannot be copied."""
        return self

    def __enter__(self) -> BuildBar:
        """Return the bar."""
        return self

    def __call__(self, stage: str, fraction: float) -> None:
        """Show how far a stage of the build is, 0..1."""
        if self._bar is None:
            from tqdm import tqdm

            self._bar = tqdm(total=100, desc="building the body", unit="%", mininterval=bar_interval())
        self._bar.set_postfix_str(stage, refresh=False)
        self._bar.update(round(100.0 * fraction) - self._bar.n)
        moved()
        if self._also is not None:
            self._also(stage, fraction)

    def __exit__(self, *_: object) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()
