"""The commands ``softmode radiance info`` and ``bake``."""

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
    """The field: .npz, also Plenoxels', or .nvdb."""

    def run(self) -> int:
        """Print nodes, degree, box and densities."""
        import numpy as np

        from softmode.radiance.formats import read_radiance

        with quiet_warp():
            field = read_radiance(self.file)
        low, high = field.bounds
        deciles = np.quantile(field.density[field.occupied].astype(float), [0.1, 0.5, 0.9])

        def row(values: object) -> str:
            return "  ".join(f"{value:.4g}" for value in np.ravel(np.asarray(values)))

        print(f"nodes       {' x '.join(map(str, field.shape))}, {field.occupied.mean():.0%} not empty")
        print(f"sh degree   {field.sh_degree}")
        print(f"spacing     {row(np.linalg.norm(field.axes, axis=0))}")
        print(f"not empty   {row(low)}  to  {row(high)}")
        print(f"size        {row(high - low)}")
        print(f"densities   {row(deciles)}  per unit of length (10, 50, 90 % of what is not empty)")
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
