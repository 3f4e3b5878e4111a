"""The command line: play, train, evaluate, new, check, record, view, morph, bench, splat, radiance, body, ..."""

from __future__ import annotations

import contextlib
import functools
import operator
import os
import sys
from typing import Annotated, Any

from softmode import __version__
from softmode.cli.bench import Bench
from softmode.cli.body import BodyBuild, BodyCheck, BodyCut, BodyShow
from softmode.cli.check import Check
from softmode.cli.fit import Fit
from softmode.cli.listing import ListEnvs
from softmode.cli.morph import Morph
from softmode.cli.new import New
from softmode.cli.objects import ObjectsExport, ObjectsList, ObjectsShow
from softmode.cli.plain import plain_output
from softmode.cli.play import Play
from softmode.cli.radiance import RadianceBake, RadianceInfo, RadianceSample
from softmode.cli.record import Record
from softmode.cli.robots import Robots
from softmode.cli.splat import SplatConvert, SplatFromMesh, SplatInfo, SplatShow
from softmode.cli.train import Evaluate, Export, Train
from softmode.cli.view import View
from softmode.errors import SoftmodeError, needs_extra
from softmode.interrupts import ending_on_sigterm

FIRST_STEPS = """softmode simulates soft objects made of splats or meshes, and robots that grasp them. To begin with:

  softmode play softmode/LiftSoft-v0 --video out/lift.mp4                    a robot lifts a toy; the film
  softmode play softmode/LiftSoft-v0 --object mug --video out/mug.mp4        another object; softmode objects list
  softmode view                                                             pull a toy with the mouse, in a browser
  softmode body check toy.ply                                               what your own splats or mesh would become
  softmode play softmode/LiftSoft-v0 --splat toy.ply --video out/toy.mp4     the robot lifts your own
  softmode train softmode/LiftSoft-v0 --splat toy.ply --time-limit 1800      and learns to

softmode list-envs lists the tasks, softmode --help the commands, softmode play --help the options of one."""


Commands = dict[str, "type | tuple[str, Commands]"]
COMMANDS: Commands = {
    **{"play": Play, "train": Train, "evaluate": Evaluate, "export": Export, "bench": Bench, "record": Record},
    **{"view": View, "morph": Morph, "fit": Fit, "new": New, "check": Check, "list-envs": ListEnvs, "robots": Robots},
    "splat": (
        "Draw, make, inspect and convert splat files.",
        {"show": SplatShow, "from-mesh": SplatFromMesh, "info": SplatInfo, "convert": SplatConvert},
    ),
    "radiance": (
        "Inspect fields, bake them to splats, sample trained networks.",
        {"info": RadianceInfo, "bake": RadianceBake, "sample": RadianceSample},
    ),
    "body": (
        "Build, draw, check and cut the bodies of soft objects.",
        {"build": BodyBuild, "show": BodyShow, "check": BodyCheck, "cut": BodyCut},
    ),
    "objects": (
        "List, draw and write the preset objects.",
        {"list": ObjectsList, "show": ObjectsShow, "export": ObjectsExport},
    ),
}
"""The commands by name; of one with commands of its own what it is about, and these."""


def _chosen(given: list[str]) -> tuple[type | Commands, list[str]]:
    """Return the command that the first words name, or the commands there are behind them; and these words."""
    here: type | Commands = COMMANDS
    words: list[str] = []
    for word in given:
        if isinstance(here, type) or word not in here:
            break
        found = here[word]
        here = found if isinstance(found, type) else found[1]
        words.append(word)
    return here, words


def _one_of(commands: Commands) -> Any:
    """Return the choice among commands by name."""
    import tyro

    def choice(name: str, found: type | tuple[str, Commands]) -> Any:
        subcommand = tyro.conf.subcommand
        if isinstance(found, type):
            return Annotated[found, subcommand(name)]
        return Annotated[_one_of(found[1]), subcommand(name, description=found[0])]

    return functools.reduce(operator.or_, (choice(name, found) for name, found in commands.items()))


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit code.

    Errors that softmode expects print one line and return 2. Ctrl-C returns 130, a reader of the output that is gone
    141, SIGTERM 143.
    """
    with ending_on_sigterm() as ended, contextlib.ExitStack() as stack:
        with contextlib.suppress(AttributeError):  # of a stream that is none of Python's own
            sys.stdout.reconfigure(errors="replace")  # pyright: ignore[reportAttributeAccessIssue]
        code = _run(arguments, stack)
    return ended[0] if ended else code


def _run(arguments: list[str] | None, stack: contextlib.ExitStack) -> int:
    """Run the command that is asked for; return its exit code. What it writes is plain until the stack is closed."""
    given = sys.argv[1:] if arguments is None else arguments
    if given == ["--version"]:
        print(f"softmode {__version__}")
        return 0
    if not given:
        print(FIRST_STEPS, file=sys.stderr)
        raise SystemExit(2)
    try:
        with needs_extra("demo", "the command line needs tyro"):
            import tyro
        config = (tyro.conf.PositionalRequiredArgs, tyro.conf.DisallowNone)
        chosen, words = _chosen(given)
        # A command that is named is parsed alone, so that hints name its own help.
        kind = chosen if isinstance(chosen, type) else _one_of(chosen)
        command = tyro.cli(kind, prog=" ".join(["softmode", *words]), args=given[len(words) :], config=config)
        stack.enter_context(plain_output())
        return command.run()
    except SoftmodeError as error:
        print(f"softmode: error: {error}", file=sys.stderr)
        return 2
    except MemoryError as error:
        print(f"softmode: error: more memory is asked for than there is. {error}".rstrip(". "), file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader, such as head, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 141
    except OSError as error:
        print(f"softmode: error: {error}. Check the path and the free space", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("softmode: interrupted, nothing was written", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
