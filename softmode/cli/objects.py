"""The commands ``softmode objects list``, ``show`` and ``export``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from softmode.cli.common import BuildBar, one_place, optional_argument, quiet_warp, short_name
from softmode.errors import ConfigError
from softmode.files import check_place

if TYPE_CHECKING:
    from softmode.objects.config import ObjectConfig

MESHES = (".glb", ".obj", ".stl")
STAGES = (".usd", ".usda", ".usdc")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ObjectsList:
    """List the preset objects and what they are made of.

    Example: softmode objects list
    """

    def run(self) -> int:
        """Print a line per preset."""
        from softmode.objects.captures import CAPTURES
        from softmode.objects.shapes.presets import PRESETS

        print(f"{'name':10} {'E [Pa]':>8} {'nu':>5} {'kg/m^3':>7} {'friction':>9}  what")
        for name, preset in PRESETS.items():
            made = preset.material
            print(
                f"{name:10} {made.youngs_modulus:8.0e} {made.poissons_ratio:5.2f} {made.density:7.0f}"
                f" {made.friction:9.2f}  {preset.what} ({preset.why})"
            )
        for name, by in CAPTURES.items():
            print(f"{name:10} a capture, with the material of the task: {by}")
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class ObjectsShow:
    """Draw preset objects with their sizes on a sheet.

    Example: softmode objects show mug fish -o out/two.png
    """

    names: tuple[str, ...]
    """What to draw; all if omitted."""
    out: Annotated[Path, short_name("-o")] = Path("presets.png")
    """Sheet to write (.png)."""
    splats: int = 12_000
    """Splats on each."""

    def run(self) -> int:
        """Draw, write; return the exit code."""
        check_place(self.out, "sheet")
        from softmode.objects.config import ObjectConfig
        from softmode.objects.shapes.presets import PRESETS

        things = [ObjectConfig(preset=name, splat_count=self.splats) for name in self.names or PRESETS]
        with quiet_warp():
            from softmode.viz.preset_sheet import write_preset_sheet

            write_preset_sheet(self.out, things)
        print(f"wrote {self.out}")
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class ObjectsExport:
    """Write a preset object as splats, a mesh, a body or an OpenUSD stage.

    Example: softmode objects export banana out/banana.spz
    """

    name: str
    """Which preset."""
    file: Annotated[Path | None, optional_argument()] = None
    """File to write: splats (.ply, .compressed.ply, .splat, .spz), a mesh (.glb, .obj, .stl without colours), a body
    with splats and material (.npz), or a stage with these (.usdc, .usd, .usda). In metres, z up; in .glb y up."""
    out: Annotated[Path | None, short_name("-o")] = None
    """The same file, as an option."""
    size: float | None = None
    """Longest edge [m]; the preset's own if omitted."""
    splats: int | None = None
    """Number of splats; 6000 if omitted."""

    @property
    def place(self) -> Path:
        """The file to write."""
        return one_place(self.file, self.out)

    def run(self) -> int:
        """Make, write; return the exit code."""
        from softmode.objects.config import ObjectConfig
        from softmode.splats.formats import WRITABLE, write_splats

        config = ObjectConfig(preset=self.name, size=self.size, splat_count=self.splats)
        suffix = self.place.suffix.lower()
        kinds = (*(kind for kind in WRITABLE if kind not in STAGES), *MESHES, ".npz", *STAGES)
        if not self.place.name.lower().endswith(kinds):
            raise ConfigError(f"cannot write {self.place}", hint=f"name it like toy.ply; there are {', '.join(kinds)}")
        check_place(self.place, "file")
        if suffix in STAGES:
            from softmode.usd.openusd import check_stage

            check_stage(self.place)
        with quiet_warp():
            if suffix in (".npz", *STAGES):
                self._write_body(config)
            elif suffix in MESHES:
                self._write_mesh(config)
            else:
                from softmode.objects.source import object_source

                write_splats(self.place, object_source(config).splats)
        print(f"wrote {self.place}")
        return 0

    def _write_body(self, config: ObjectConfig) -> None:
        """Build the body and write it, with its splats and material."""
        from softmode.objects.loader import load

        with BuildBar() as progress:
            thing = load(config, progress=progress)
        if self.place.suffix.lower() == ".npz":
            from softmode.objects.object_file import write_object

            write_object(self.place, thing.body, thing.splats, thing.radiance)
            return
        from softmode.objects.placed import Placed
        from softmode.usd.writer import write_usd

        self.place.parent.mkdir(parents=True, exist_ok=True)
        write_usd(self.place, Placed(object=thing, position=(0.0, 0.0, thing.height)))

    def _write_mesh(self, config: ObjectConfig) -> None:
        """Write the surface, which files of glTF hold with y up."""
        from softmode.files import whole_file
        from softmode.objects.shapes.presets import preset_surface
        from softmode.splats.splats import up_rotation

        mesh = preset_surface(self.name)
        if config.size is not None:
            mesh.apply_scale(config.size / float(mesh.extents.max()))
        suffix = self.place.suffix.lower()
        if suffix == ".glb":
            mesh.vertices = mesh.vertices @ up_rotation("+y")
        with whole_file(self.place, "mesh") as file:
            mesh.export(file, file_type=suffix[1:])
