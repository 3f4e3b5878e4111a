"""The command ``softmode morph``: one shape, mesh or splat turned into another, as a film."""

from __future__ import annotations

import contextlib
import dataclasses
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

from softmode.checks import require_number
from softmode.cli.common import bar_interval, quiet_warp, short_name, warp_device
from softmode.errors import ConfigError
from softmode.files import check_place


def _as() -> object:
    """Return what names the option --as, which is a word of Python; evaluated when tyro reads it."""
    import tyro

    return tyro.conf.arg(name="as")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Morph:
    """Turn shapes, meshes and splats into one another; film it.

    Example: softmode morph sphere cow --video out/morph.mp4
    """

    names: tuple[str, ...]
    """Source and targets: sphere, box, cylinder, torus, star, duck, cow, car, bunny, bear, plush; a letter or digit; a
    mesh or splat file."""
    video: Path | None = None
    """Film to write (.mp4, or a .gif that loops), with a contact sheet beside it."""
    rerun: str | None = None
    """Recording to write for the rerun viewer (.rrd); or the address of a running one, like
    rerun+http://127.0.0.1:9876/proxy; or spawn, which opens one."""
    usd: Path | None = None
    """OpenUSD stage to write (.usdc, .usd or .usda), with every splat or particle of every frame."""
    out: Annotated[Path | None, short_name("-o")] = None
    """Where to keep the run (.npz); one that was cut off is gone on with. out/SOURCE_TARGET.npz if omitted."""
    frames: int = 420
    """Steps on the way to each target."""
    target_accuracy: float | None = None
    """Leave a target when so much of the loss is gone, 0..1."""
    particles: int = 10_000
    """About how many particles."""
    shown: Annotated[Literal["splats", "particles", "mesh"], _as()] = "splats"
    """What film, recording and stage show; with mesh the stage has their surface, the others particles."""
    width: int = 640
    """Width of the film [px]."""
    device: str | None = None
    """Warp device, for example cpu or cuda:0."""

    def run(self) -> int:
        """Fill, plan, film; return the exit code."""
        if len(self.names) < 2:
            raise ConfigError("a morph needs a source and a target", hint="give two names or files, like sphere cow")
        require_number("particles", self.particles, at_least=500, hint="give a number of particles like 10000")
        require_number("width", self.width, at_least=16, at_most=4096, unit="px")
        out = self.out or Path("out", "_".join(Path(name).stem for name in self.names) + ".npz")
        check_place(out, "run")
        if self.rerun is not None:
            from softmode.viz.rerun_stream import check_target

            check_target(self.rerun)
        if self.usd is not None:
            from softmode.usd.openusd import check_stage

            check_stage(self.usd)
        from tqdm import tqdm

        from softmode.mpm import MorphOptions, morph
        from softmode.viz.film import Film

        options = MorphOptions(frame_count=self.frames, target_accuracy=self.target_accuracy)
        with contextlib.ExitStack() as stack:
            film = None if self.video is None else stack.enter_context(Film(self.video))
            stack.enter_context(quiet_warp())
            from softmode.objects.solids import filled, solid_of

            device = warp_device(self.device)
            solids, bodies = filled([solid_of(name) for name in self.names], spacing=None, count=self.particles)
            print(f"{self.names[0]}: {bodies[0].count} particles", flush=True)
            segments = -(-self.frames // options.segment_length) * (len(bodies) - 1)
            with tqdm(total=segments, desc="morphing", unit="segment", mininterval=bar_interval()) as bar:

                def advance(segment: int, loss: float) -> None:
                    bar.set_postfix_str(f"loss {loss:.4g}", refresh=False)
                    bar.update(segment + 1 - bar.n)

                run = morph(bodies[0], bodies[1:], options, file=out, names=self.names, device=device, progress=advance)
            for note in run.notes:
                print(f"softmode: {note}", file=sys.stderr)
            print(f"{100.0 * run.accuracy:.1f} % of the loss is gone; wrote {out}")
            if film is None and self.rerun is None and self.usd is None:
                return 0
            from softmode.viz.morph_film import RATE, MorphScene, film_morph

            scene = MorphScene(run, solids, bodies, options, as_particles=self.shown != "splats", device=device)

            @contextlib.contextmanager
            def showing(doing: str) -> Iterator[None]:
                """Show how far the frames are."""
                total = options.segment_length * run.segment_count
                with tqdm(total=total, desc=doing, unit="step", mininterval=bar_interval()) as bar:
                    scene.progress = lambda step: bar.update(step - bar.n)
                    yield

            if film is not None:
                with showing("filming"):
                    film_morph(film, scene, width=self.width)
                film.publish()
                print(f"wrote {self.video} and {film.sheet_path}")
            if self.rerun is not None:
                from softmode.viz.morph_recording import record_morph

                with showing("recording"):
                    record_morph(self.rerun, scene)
                if Path(self.rerun).suffix.lower() == ".rrd":
                    print(f"wrote {self.rerun}; open it with: rerun {shlex.quote(self.rerun)}")
            if self.usd is not None:
                from softmode.usd.splat_animation import write_splat_animation

                with showing("writing the stage"):
                    frames = (splats for _, splats in scene.splat_frames())
                    shown = "points" if self.shown == "particles" else self.shown
                    write_splat_animation(self.usd, frames, fps=RATE, name="morph", shown=shown)
                print(f"wrote {self.usd}; open it in any viewer of OpenUSD")
        return 0
