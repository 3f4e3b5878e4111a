"""The command line: play, train, evaluate, export, record, view, bench, list-envs, robots, splat and body."""

from __future__ import annotations

import sys
from typing import Annotated

from softmode import __version__
from softmode.cli.bench import Bench
from softmode.cli.body import BodyBuild, BodyCheck, BodyShow
from softmode.cli.listing import ListEnvs, Robots
from softmode.cli.play import Play
from softmode.cli.record import Record
from softmode.cli.splat import SplatConvert, SplatFromMesh, SplatInfo
from softmode.cli.train import Evaluate, Export, Train
from softmode.cli.view import View
from softmode.errors import SoftmodeError, needs_extra


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; errors that softmode expects print one line and return 2, an interruption returns 130."""
    if (sys.argv[1:] if arguments is None else arguments) == ["--version"]:
        print(f"softmode {__version__}")
        return 0
    try:
        with needs_extra("demo", "the command line needs tyro"):
            import tyro
        splat = Annotated[
            Annotated[SplatFromMesh, tyro.conf.subcommand("from-mesh")]
            | Annotated[SplatInfo, tyro.conf.subcommand("info")]
            | Annotated[SplatConvert, tyro.conf.subcommand("convert")],
            tyro.conf.subcommand("splat", description="Make, inspect and convert splat files."),
        ]
        body = Annotated[
            Annotated[BodyBuild, tyro.conf.subcommand("build")]
            | Annotated[BodyShow, tyro.conf.subcommand("show")]
            | Annotated[BodyCheck, tyro.conf.subcommand("check")],
            tyro.conf.subcommand("body", description="Build, draw and check the bodies of soft objects."),
        ]
        command = tyro.cli(
            Annotated[Play, tyro.conf.subcommand("play")]
            | Annotated[Train, tyro.conf.subcommand("train")]
            | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
            | Annotated[Export, tyro.conf.subcommand("export")]
            | Annotated[Bench, tyro.conf.subcommand("bench")]
            | Annotated[Record, tyro.conf.subcommand("record")]
            | Annotated[View, tyro.conf.subcommand("view")]
            | Annotated[ListEnvs, tyro.conf.subcommand("list-envs")]
            | Annotated[Robots, tyro.conf.subcommand("robots")]
            | splat  # type: ignore[arg-type]
            | body,  # type: ignore[arg-type]
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


if __name__ == "__main__":
    sys.exit(main())
