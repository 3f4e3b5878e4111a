"""The commands ``softmode radiance info``, ``bake`` and ``sample``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

from softmode.cli.common import bar_interval, quiet_warp, short_name, warp_device


@dataclasses.dataclass(frozen=True, kw_only=True)
class RadianceInfo:
    """Print what a radiance field holds.

    Example: softmode radiance info toy.npz
    """

    file: Path
    """The field: .npz, also Plenoxels' and PlenOctree's, or .nvdb."""

    def run(self) -> int:
        """Print nodes, degree, box, densities and what solid they show."""
        import numpy as np

        from softmode.deformables.quadrature.quadrature_density import FOGGY, is_doubtful, quadrature_from_density
        from softmode.radiance.formats import read_radiance

        with quiet_warp():
            field = read_radiance(self.file)
        low, high = field.bounds
        density = field.density[field.occupied if field.occupied.any() else field.density > 0.0].astype(float)
        deciles = np.quantile(density, [0.1, 0.5, 0.9])
        solid = quadrature_from_density(field.densities, field.surroundings, surface_count=16)
        fog, filled, opened = (float(solid.report[name]) for name in ("fog", "filled_share", "open_share"))
        unit = "not known" if field.metres is None else f"{field.metres:.4g} m"

        def row(values: object) -> str:
            return "  ".join(f"{value:.4g}" for value in np.ravel(np.asarray(values)))

        print(f"nodes       {' x '.join(map(str, field.shape))}, {field.occupied.mean():.0%} not empty")
        print(f"sh degree   {field.sh_degree}")
        print(f"unit        {unit}")
        print(f"spacing     {row(np.linalg.norm(field.axes, axis=0))}")
        print(f"not empty   {row(low)}  to  {row(high)}")
        print(f"size        {row(high - low)}")
        print(f"densities   {row(deciles)}  per unit of length (10, 50, 90 % of what is not empty)")
        print(f"opacities   {row(-np.expm1(-deciles * field.spacing))}  of a voxel, likewise")
        print(f"solid       {solid.volume:.4g} units of length cubed; half its level moves it by {fog:.2g} voxels")
        print(f"voids       {filled:.0%} of it were filled, {opened:.0%} that only something thin or faint closes")
        if fog > FOGGY:
            print("            this is fog (walls: 0 to 0.6): the solid is doubtful, and cavities may be full")
        patch, allowed = field.contradicted or 0.0, field.allowed or 0.0
        if field.allowed is not None:
            print(f"pictures    contradict a patch of {patch:.1%} of its surface, allow {allowed:.2g} times its volume")
        if is_doubtful(patch, allowed):
            print("            the solid is doubtful: cavities may be full, or their walls too thick")
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class RadianceBake:
    """Make splats that stand for a radiance field, fitted to pictures of it.

    Example: softmode radiance bake toy.npz --count 12000
    """

    file: Path
    """The field: .npz, also Plenoxels', or .nvdb."""
    out: Annotated[Path | None, short_name("-o")] = None
    """Splat file to write, of the kind its suffix names; FILE_splats.ply beside the field if omitted."""
    count: int = 12_000
    """Number of splats, about."""
    iterations: int = 200
    """Steps of the fit; 0 writes the splats as they cover the field."""
    pixels: int = 128
    """Edge of the pictures [px]."""
    seed: int = 0
    """Seed; the same one gives the same splats."""
    device: str | None = None
    """Warp device, for example cpu or cuda:0."""

    def run(self) -> int:
        """Read, fit, write; return the exit code."""
        from tqdm import tqdm

        from softmode.cli.splat import check_splat_target
        from softmode.radiance.formats import read_radiance
        from softmode.splats.formats import write_splats

        out = self.out if self.out is not None else self.file.with_name(f"{self.file.stem}_splats.ply")
        check_splat_target(out)
        with quiet_warp():
            from softmode.radiance.bake import splats_from_radiance
            from softmode.splats.fit.picture_fit import FitOptions

            options = FitOptions(iterations=self.iterations, size=self.pixels, seed=self.seed, samples=2)
            field = read_radiance(self.file)

            def advance(done: int, _: float) -> None:
                bar.update(done - bar.n)

            with tqdm(total=options.iterations, desc="fitting", unit="step", mininterval=bar_interval()) as bar:
                fit = splats_from_radiance(
                    field,
                    count=self.count,
                    options=options,
                    device=warp_device(self.device),
                    progress=advance,
                )
        write_splats(out, fit.splats)
        print(
            f"PSNR over {options.held_out_count} held-out views of {options.size} px: "
            f"{fit.history[0][1]:.1f} dB covered, {fit.psnr:.1f} dB fitted"
        )
        print(f"wrote {fit.splats.count} splats of degree {fit.splats.sh_degree} to {out}")
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class RadianceSample:
    """Sample a field in Python, such as a trained network, onto a grid.

    Example: softmode radiance sample my_nerf:field toy.npz
    """

    function: str
    """MODULE:FUNCTION; it maps points (N, 3) to densities (N,) and colours 0..1 (N, 3), see from_function. The module
    is imported, from the working folder first: its code runs."""
    out: Path
    """The field to write (.npz)."""
    bounds: tuple[float, float, float, float, float, float] | None = None
    """Box x0 y0 z0 x1 y1 z1 around the object; looked for around the origin if omitted."""
    resolution: int | None = None
    """Nodes along the longest edge; as many as its surface needs if omitted, 64 to 256."""
    metres: float | None = None
    """Metres of a unit of length, if they are known."""

    def run(self) -> int:
        """Import, look for the object, sample, write; return the exit code."""
        import sys
        from importlib import import_module

        import numpy as np

        from softmode.errors import ConfigError
        from softmode.radiance.formats import write_radiance
        from softmode.radiance.sample import sampled_field

        module, _, name = self.function.partition(":")
        sys.path.insert(0, str(Path.cwd()))
        try:
            field = getattr(import_module(module), name)
        except (ImportError, AttributeError, ValueError) as error:
            hint = "give MODULE:FUNCTION, of a module in the working folder or installed"
            raise ConfigError(f"{self.function}: {error}", hint=hint) from error
        finally:
            sys.path.pop(0)
        box = None if self.bounds is None else np.reshape(self.bounds, (2, 3))
        with quiet_warp():
            found = sampled_field(field, box, self.resolution, name=self.function, metres=self.metres)
            write_radiance(self.out, found)
        low, high = (" ".join(f"{x:.4g}" for x in corner) for corner in found.bounds)
        print(f"wrote {' x '.join(map(str, found.shape))} nodes to {self.out}; the object fills {low} to {high}")
        return 0
