"""The commands ``softmode splat show``, ``from-mesh``, ``info`` and ``convert``."""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path
from typing import Annotated, Any, Literal

from softmode.checks import require_number
from softmode.cli.common import bar_interval, one_place, optional_argument, quiet_warp, short_name, warp_device
from softmode.errors import AssetError, ConfigError
from softmode.files import check_place
from softmode.stages import stage


@dataclasses.dataclass(frozen=True, kw_only=True)
class SplatFromMesh:
    """Make splats of a textured or vertex-coloured mesh: sample its surface, then fit the splats to pictures of it.

    Example: softmode splat from-mesh toy.glb --count 20000
    """

    mesh: Path
    """Mesh file of any kind that trimesh reads (.glb, .obj, .ply, .stl, ...), with its textures."""
    out: Annotated[Path | None, short_name("-o")] = None
    """Splat file to write, of the kind its suffix names; MESH_splats.ply beside the mesh if omitted."""
    count: int = 10_000
    """Number of splats."""
    size: float | None = None
    """Longest edge of the result [m]; as in the file if omitted."""
    iterations: int = 200
    """Steps of the fit; 0 writes the splats as they were sampled."""
    pixels: int = 128
    """Edge of the pictures [px]."""
    views: int = 64
    """Pictures to fit; a quarter as many more, from other directions, only measure the result."""
    seed: int = 0
    """Seed; the same one gives the same splats."""
    device: str | None = None
    """Warp device, for example cpu or cuda:0."""

    def run(self) -> int:
        """Sample, fit, write; return the exit code."""
        out = self.out if self.out is not None else self.mesh.with_name(f"{self.mesh.stem}_splats.ply")
        check_splat_target(out)
        if self.size is not None:
            require_number("size", self.size, above=0.0, hint="give it in metres, like 0.08")
        require_number("count", self.count, at_least=1, hint="give a number of splats like 10000")

        from tqdm import tqdm

        from softmode.objects.mesh_file import read_mesh
        from softmode.splats.formats import write_splats

        with quiet_warp():
            from softmode.objects.mesh_fit import FitOptions, splats_from_mesh

            views: dict[str, Any] = {"view_count": self.views, "held_out_count": max(self.views // 4, 1)}
            options = FitOptions(iterations=self.iterations, size=self.pixels, seed=self.seed, **views)
            mesh = read_mesh(self.mesh)
            print(f"{mesh.name}: {len(mesh.corners)} triangles, {len(mesh.textures)} textures", flush=True)
            with tqdm(total=options.iterations, desc="fitting", unit="step", mininterval=bar_interval()) as bar:

                def advance(done: int, loss: float) -> None:
                    bar.set_postfix_str(f"loss {loss:.2e}", refresh=False)
                    bar.update(done - bar.n)

                fit = splats_from_mesh(
                    mesh, count=self.count, options=options, device=warp_device(self.device), progress=advance
                )
        splats = fit.splats
        if self.size is not None:
            low, high = splats.bounds()
            extent = float((high - low).max())
            splats = splats.transformed(scale=self.size / extent)
        write_splats(out, splats)
        print(
            f"PSNR over {options.held_out_count} held-out views of {options.size} px: "
            f"{fit.history[0][1]:.1f} dB sampled, {fit.psnr:.1f} dB fitted"
        )
        print(f"wrote {splats.count} splats to {out}")
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class SplatInfo:
    """Print what a splat file holds.

    Example: softmode splat info toy.ply
    """

    file: Path
    """The splat file."""

    def run(self) -> int:
        """Print count, degree, box, scales and opacities."""
        import numpy as np

        from softmode.objects.captures import bundled
        from softmode.splats.formats import read_splats

        splats = read_splats(bundled(self.file) or self.file)
        low, high = splats.bounds()
        deciles = [0.1, 0.5, 0.9]

        def row(values: object, digits: int = 4) -> str:
            return "  ".join(f"{value:.{digits}g}" for value in np.ravel(np.asarray(values)))

        print(f"splats      {splats.count}")
        print(f"sh degree   {splats.sh_degree}")
        print(f"centres     {row(low)}  to  {row(high)}")
        print(f"98 % within {row(splats.bounds(quantile=0.01)[0])}  to  {row(splats.bounds(quantile=0.01)[1])}")
        print(f"size        {row(high - low)}")
        print(f"scales      {row(np.quantile(splats.scales.max(axis=1), deciles))}  (10, 50, 90 %, longest axis)")
        print(f"flatness    {row(np.median(splats.scales.min(axis=1) / splats.scales.max(axis=1)))}")
        print(f"opacities   {row(np.quantile(splats.opacities, deciles))}  (10, 50, 90 %)")
        for note in splats.notes:
            print(f"note        {note}")
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class SplatShow:
    """Draw a capture before it is built: four views, what would be cut, the section of the solid that fills it.

    Example: softmode splat show toy.ply --up -y
    """

    file: Path
    """The splat file."""
    out: Annotated[Path | None, short_name("-o")] = None
    """Sheet to write (.png); FILE_sheet.png in the working folder if omitted."""
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None = None
    """Axis of the file that points up; -y if omitted."""
    crop: tuple[float, float, float, float, float, float] | None = None
    """Box x0 y0 z0 x1 y1 z1 of the file, once turned up, outside which splats are dropped."""
    part: Literal["thickest", "tallest", "largest", "all"] | tuple[int, ...] = "thickest"
    """Which of the separate parts is the object: a rule, or numbers of candidates on the sheet, like 1 2."""

    def run(self) -> int:
        """Look, draw, write; return the exit code."""
        from softmode.objects.captures import bundled
        from softmode.objects.config import ObjectConfig
        from softmode.splats.formats import read_splats

        out = self.out if self.out is not None else Path(f"{self.file.stem}_sheet.png")
        check_place(out, "sheet", make_folders=False)
        up = self.up or "-y"
        with stage(f"reading {self.file.name}"):
            splats = read_splats(bundled(self.file) or self.file).oriented(up)
        if self.crop is not None:
            splats = splats.cropped(self.crop[:3], self.crop[3:])
        with quiet_warp():
            from softmode.viz.splat_sheet import candidate_lines, survey_splats, write_splat_sheet

            survey = survey_splats(splats, ObjectConfig(part=self.part))
            print("\n".join(candidate_lines(survey)), flush=True)
            taken = f"up {up} of the file{'' if self.up else ' (a guess: change it with --up)'}; z is up here"
            with stage("drawing the sheet"):
                write_splat_sheet(out, survey, title=self.file.name, notes=[taken])
        kept = int(survey.kept.sum())
        print(
            f"{kept} of {splats.count} splats would be taken, and {survey.choice.told.get('floor_splats', 0)} close it"
        )
        if survey.fill is None:
            print(f"it cannot be built: {survey.why}")
        print(f"wrote {out}")
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class SplatConvert:
    """Read a splat file and write it as another kind, named by the suffix.

    Example: softmode splat convert toy.ply toy.spz --convention spz
    """

    source: Path
    """File to read."""
    target: Annotated[Path | None, optional_argument()] = None
    """File to write: .ply, .compressed.ply, .splat, .spz, .usd, .usda or .usdc."""
    out: Annotated[Path | None, short_name("-o")] = None
    """The same file, as an option."""
    convention: Literal["z-up", "spz", "trained"] | None = None
    """Whom the written file is turned for: softmode (z-up); readers that keep to SPZ's specification, and three.js
    (spz: y up); those that take a file as training leaves it (trained: y down). Without it the numbers stay."""
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None = None
    """Axis of the file to read that points up, with --convention; -y for splats, +z for OpenUSD if omitted."""
    drop_invalid: bool = False
    """Leave out splats that are not finite or have no rotation or size; without it a file with such is refused."""

    def run(self) -> int:
        """Read and write."""
        from softmode.foreign import tokens
        from softmode.splats.formats import CONVENTIONS, read_splats, write_splats

        target = one_place(self.target, self.out)
        check_splat_target(target)
        if self.convention is None and self.up is not None:
            raise ConfigError("--up says nothing without a convention", hint="give --convention too, like spz")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # said below, or refused
            splats = read_splats(self.source)
        if splats.dropped_count and not self.drop_invalid:
            problem = (
                f"splat file {self.source}: {splats.dropped_count} splats are not finite or have no rotation or size"
            )
            raise AssetError(problem, hint=f"add --drop-invalid to leave them out and keep {splats.count}")
        if self.convention is None:
            write_splats(target, splats)
        else:
            own = "+z" if self.source.suffix.lower() in tokens.SUFFIXES else "-y"
            write_splats(target, splats.oriented(self.up or own), up=CONVENTIONS[self.convention])
        for note in splats.notes:
            print(f"note: {note}")
        print(f"wrote {splats.count} splats of degree {splats.sh_degree} to {target}")
        return 0


def check_splat_target(path: Path) -> None:
    """Refuse a file that cannot be written before any work is done."""
    from softmode.splats.formats import WRITABLE

    if not path.name.lower().endswith(WRITABLE):
        raise AssetError(
            f"splat file {path}: cannot write {path.suffix or '(no suffix)'!r}",
            hint=f"name it like toy.ply; writable are {', '.join(WRITABLE)}",
        )
    check_place(path, "splat file", make_folders=False)
