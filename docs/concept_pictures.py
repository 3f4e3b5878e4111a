"""Draw the pictures of docs/concepts.md from the real code: quadrature, kernels, eigenmodes, handles, step, camera.

Run: ``python docs/concept_pictures.py [docs/images]``; needs matplotlib (``pip install 'softmode[viz]'``).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, get_args

import newton
import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial import KDTree

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.rkpm import make_basis
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.quadrature.quadrature import quadrature_from_splats
from softmode.deformables.quadrature.quadrature_density import Sampling, quadrature_from_density
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.solver.solver_reduced import SolverReduced, SolverReducedOptions
from softmode.objects import SoftObject
from softmode.radiance import RadianceGrid
from softmode.scenes import BoundSplats
from softmode.splats import Splats, make_plush
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.raster.rasterizer import RasterizerOptions, SplatRasterizer, ViewArrays

Array = NDArray[np.float64]

SIZE = 220
"""Edge of a drawn picture [px]."""
INK = "#333333"


class Painter:
    """Draws one set of splats, as it is or moved by reduced coordinates, on white."""

    def __init__(self, body: ReducedBody, splats: Splats) -> None:
        """Tie the splats (in the body frame) to the body."""
        self.rest = splats
        self.bound = BoundSplats(None, [SoftObject(body=body, splats=splats)], worlds=[0])
        self.rasterizer = SplatRasterizer(splats.count, 1, SIZE, SIZE, options=RasterizerOptions())

    def draw(
        self, q: Array, *, target: float = 0.0, fov_y: float = 0.42, colors: Array | None = None
    ) -> dict[str, NDArray[Any]]:
        """Return rgb, alpha and depth of the splats at coordinates q (n, 3), looking at a height [m]."""
        shown = self.bound.arrays
        if colors is not None:
            sh = (colors[:, None] - 0.5) / 0.28209479177387814  # the constant harmonic
            shown.sh.assign(np.ascontiguousarray(sh[None], dtype=np.float32))
        self.bound.move(wp.array(q, dtype=wp.vec3d))
        eye = PinholeCamera.look_at(
            "eye",
            position=(0.21, -0.12, target + 0.08),
            target=(0.0, 0.0, target),
            width=SIZE,
            height=SIZE,
            fov_y=fov_y,
        )
        self.rasterizer.render(shown, ViewArrays.from_cameras([eye]))
        rgb, alpha = self.rasterizer.rgb.numpy()[0], self.rasterizer.alpha.numpy()[0]
        image = np.clip(rgb + (1.0 - alpha[..., None]), 0.0, 1.0)
        return {"rgb": image, "alpha": alpha.copy(), "depth": self.rasterizer.depth.numpy()[0].copy()}


def figure(columns: int, width: float = 10.0, height: float = 2.9, rows: int = 1, **options: Any) -> tuple[Any, Any]:
    """Return a figure and its axes in a row, without frames."""
    import matplotlib.pyplot as plt

    picture, axes = plt.subplots(rows, columns, figsize=(width, height), squeeze=False, **options)
    for axis in axes.flat:
        axis.set_axis_off()
    return picture, axes


def save(picture: Any, folder: Path, name: str) -> None:
    """Write a picture and close it."""
    import matplotlib.pyplot as plt

    picture.tight_layout(pad=0.4)
    picture.savefig(folder / f"concept_{name}.png", dpi=110, facecolor="white", bbox_inches="tight", pad_inches=0.05)
    plt.close(picture)
    print(folder / f"concept_{name}.png")


def quadrature_picture(folder: Path, painter: Painter, body: ReducedBody, quadrature: Quadrature) -> None:
    """The splats, a slice through the points that fill them, and the cubature points that are kept."""
    picture, ((left, middle, right),) = figure(3)
    zero = np.zeros((body.function_count, 3))
    left.imshow(painter.draw(zero)["rgb"])
    left.set_title(f"{painter.rest.count:,} splats: a shell", fontsize=10)
    points, slab = quadrature.points - body.offset, 0.75 * quadrature.spacing
    cut = np.abs(points[:, 1]) < slab
    full = quadrature.weights.max()
    middle.scatter(points[cut, 0], points[cut, 2], s=22 * quadrature.weights[cut] / full, color="#c9742b", lw=0)
    shell = np.abs(painter.rest.means[:, 1]) < slab
    middle.plot(*painter.rest.means[shell][:, [0, 2]].T, ".", color=INK, ms=2.5)
    middle.set_title(f"filled: {len(points):,} points with volumes (a slice)", fontsize=10)
    middle.set_aspect("equal")
    mean = body.cubature.weights.mean()
    right.scatter(
        body.cubature.points[:, 0],
        body.cubature.points[:, 2],
        s=14 * body.cubature.weights / mean,
        color="#2b6cc9",
        alpha=0.55,
        lw=0,
    )
    right.set_title(f"cubature: {body.point_count} points carry the forces (all)", fontsize=10)
    right.set_aspect("equal")
    save(picture, folder, "quadrature")


def kernel_picture(folder: Path, body: ReducedBody, quadrature: Quadrature) -> None:
    """Centres with their radii, one kernel, and the sum of all on a slice through the object."""
    picture, ((left, middle, right),) = figure(3)
    basis = make_basis(quadrature.points - body.offset, body.kernels.centres.shape[0], spacing=quadrature.spacing)
    near = np.abs(basis.centres[:, 1]) < 0.006
    for centre, radius in zip(basis.centres[near], basis.radii[near], strict=True):
        from matplotlib.patches import Circle

        left.add_patch(Circle((centre[0], centre[2]), radius, fill=False, color="#2b6cc9", lw=0.6, alpha=0.5))
    left.plot(basis.centres[near, 0], basis.centres[near, 2], ".", color=INK, ms=4)
    left.autoscale_view()
    left.set_aspect("equal")
    left.set_title(f"centres near a slice, of {basis.kernel_count}, and $r_k$", fontsize=10)
    low, high = body.bounds
    x, z = np.meshgrid(np.linspace(low[0], high[0], 260), np.linspace(low[2], high[2], 260))
    grid = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    inside = KDTree(quadrature.points - body.offset).query(grid)[0] < 0.75 * quadrature.spacing
    value = basis.evaluate(grid[inside]).value
    chosen = int(np.argmin(np.linalg.norm(basis.centres - [0.0, 0.0, -0.01], axis=1)))
    extent = (low[0], high[0], low[2], high[2])
    for axis, data, title in (
        (middle, value[:, [chosen]].toarray()[:, 0], r"one kernel $\tilde\phi_k$"),
        (
            right,
            np.log10(np.abs(np.asarray(value.sum(axis=1))[:, 0] - 1.0) + 1e-17),
            r"$\log_{10}|\sum_k\tilde\phi_k-1|$",
        ),
    ):
        field = np.full(len(grid), np.nan)
        field[inside] = data
        shown = axis.imshow(field.reshape(x.shape), origin="lower", extent=extent, cmap="viridis")
        picture.colorbar(shown, ax=axis, shrink=0.8)
        axis.set_title(title, fontsize=10)
    save(picture, folder, "kernels")


def mode_picture(folder: Path, painter: Painter, body: ReducedBody) -> None:
    """The skinning weights of the first eigenmodes as colours on the splats."""
    from matplotlib import colormaps

    means = painter.rest.means.astype(np.float64)
    covered = np.where(
        body.covers(means)[:, None], means, body.kernels.centres[KDTree(body.kernels.centres).query(means)[1]]
    )
    weight = body.reproducing_kernels.evaluate(covered).value @ body.handles.coefficients
    picture, axes = figure(6, height=2.0)
    zero = np.zeros((body.function_count, 3))
    for j, axis in enumerate(axes[0], start=1):
        w = weight[:, j] / np.abs(weight[:, j]).max()
        colors = colormaps["RdBu_r"](0.5 + 0.5 * w)[:, :3]
        axis.imshow(painter.draw(zero, colors=colors)["rgb"])
        axis.set_title(f"$W_{j}$,  $\\omega$ = {body.eigenvalues[j] * 1e-4:.2f} / cm$^2$", fontsize=9)
    save(picture, folder, "eigenmodes")


def handle_picture(folder: Path, painter: Painter, body: ReducedBody) -> None:
    """What a few coordinates do: affine motion first, then functions of an eigenmode."""
    n = body.function_count
    shear, stretch = np.eye(3), np.diag([0.8, 1.15, 1.1])
    shear[0, 2] = 0.5
    shown = [
        ("rest", np.zeros((n, 3))),
        ("affine: stretch", body.affine(stretch)),
        ("affine: shear", body.affine(shear)),
    ]
    for k, direction in ((4, (0.0, 0.006, 0.0)), (5, (0.0, 0.006, 0.0)), (8, (0.005, 0.0, 0.0))):
        q = np.zeros((n, 3))
        q[k] = direction
        shown.append((f"function $b_{{{k}}}$ along {'xyz'[int(np.argmax(direction))]}", q))
    picture, axes = figure(6, height=2.0)
    for axis, (title, q) in zip(axes[0], shown, strict=True):
        axis.imshow(painter.draw(q)["rgb"])
        axis.set_title(title, fontsize=9)
    save(picture, folder, "handles")


def step_picture(folder: Path, painter: Painter, body: ReducedBody) -> None:
    """A soft bear falls on the ground: pictures, iterations and how far it is squeezed."""
    world = newton.ModelBuilder()
    floor = float(-body.surface.points[:, 2].min())
    material = Material(youngs_modulus=2.5e3, density=250.0, viscosity=0.004)
    add_reduced_body(world, body, material=material, position=(0.0, 0.0, floor + 0.05))
    world.add_ground_plane()
    model = world.finalize()
    solver = SolverReduced(model, [body], options=SolverReducedOptions())
    state: Any = model.state()
    after: Any = model.state()
    dt, rows, pictures = 1.0 / 240.0, [], []
    moments = (0, 24, 30, 36, 48, 100)
    for k in range(144):
        if k in moments:
            pictures.append(
                painter.draw(state.softmode.q.numpy()[: body.function_count], target=0.062, fov_y=0.58)["rgb"]
            )
        solver.step(state, after, None, None, dt)
        state, after = after, state
        z = state.particle_q.numpy()[:, 2]
        rows.append((dt * (k + 1), int(solver.iteration.numpy()[0]), 100.0 * (z.max() - z.min())))
    time, iteration, height = np.array(rows).T
    import matplotlib.pyplot as plt

    picture = plt.figure(figsize=(10.0, 3.9))
    grid = picture.add_gridspec(2, 6, height_ratios=(1.6, 1.0))
    for k, (moment, image) in enumerate(zip(moments, pictures, strict=True)):
        axis = picture.add_subplot(grid[0, k])
        axis.imshow(image)
        axis.set_axis_off()
        axis.set_title(f"t = {moment * dt:.3f} s", fontsize=9)
    left, right = picture.add_subplot(grid[1, :3]), picture.add_subplot(grid[1, 3:])
    left.plot(time, height, color="#c9742b")
    left.set_ylabel("height of the bear [cm]", fontsize=8)
    right.step(time, iteration, where="mid", color="#2b6cc9")
    right.set_ylabel("Newton iterations", fontsize=8)
    right.set_ylim(0, iteration.max() + 1)
    for axis in (left, right):
        axis.set_xlabel("t [s]", fontsize=8)
        axis.tick_params(labelsize=8)
        axis.spines[["top", "right"]].set_visible(False)
    save(picture, folder, "step")


def camera_picture(folder: Path, painter: Painter, body: ReducedBody) -> None:
    """A bent bear: splats as ellipses, then colour, opacity and depth of the same view."""
    from matplotlib import colormaps

    q = body.affine(np.array([[1.0, 0.0, 0.35], [0.0, 0.9, 0.0], [0.0, 0.0, 0.85]]))
    q[4] += (0.0, 0.005, 0.0)
    found = painter.draw(q)
    picture, axes = figure(4, height=2.7)
    means = painter.bound.arrays.means.numpy()[0]
    front = np.argsort(means @ np.array([0.21, -0.12, 0.08]))
    side = np.array([0.12, 0.21, 0.0]) / np.hypot(0.12, 0.21)
    colors = np.clip(0.5 + 0.28209479177387814 * painter.bound.arrays.sh.numpy()[0][:, 0], 0.0, 1.0)
    axes[0, 0].scatter(means[front] @ side, means[front, 2], s=4, c=colors[front], lw=0)
    axes[0, 0].set_aspect("equal")
    seen = found["alpha"] > 0.5
    depth = np.full((SIZE, SIZE, 3), 1.0)
    span = found["depth"][seen]
    depth[seen] = colormaps["magma"]((span - span.min()) / np.ptp(span))[:, :3]
    images = (None, found["rgb"], np.repeat(1.0 - found["alpha"][..., None], 3, axis=2), depth)
    titles = ("centres x(X)", "colour", "opacity", "depth")
    for axis, image, title in zip(axes[0], images, titles, strict=True):
        if image is not None:
            axis.imshow(image)
        axis.set_title(title, fontsize=10)
    save(picture, folder, "camera")


def sampling_picture(folder: Path, plush: Splats) -> None:
    """Draw slices of a field's density and of the points that fill it, on a grid and in Poisson disks."""
    field = RadianceGrid.from_splats(plush, resolution=64)
    low, high = field.bounds
    picture, (axes,) = figure(3)
    x, z = np.meshgrid(*(np.linspace(low[d], high[d], 200) for d in (0, 2)))
    places = np.stack([x, np.full_like(x, 0.5 * (low + high)[1]), z], axis=-1).reshape(-1, 3)
    shown = -np.expm1(-2.0 * field.spacing * field.densities(places)).reshape(x.shape)
    axes[0].imshow(shown, origin="lower", extent=(low[0], high[0], low[2], high[2]), cmap="magma")
    axes[0].set_title("occupancy 1 - exp(-sigma r)", fontsize=10)
    for axis, sampling in zip(axes[1:], get_args(Sampling), strict=True):
        found = quadrature_from_density(field.densities, field.surroundings, sampling=sampling)
        middle = np.abs(found.points[:, 1] - 0.5 * (low + high)[1]) < 0.7 * found.spacing
        size = 16.0 * found.weights[middle] / found.weights.mean()
        axis.scatter(found.points[middle, 0], found.points[middle, 2], s=size, c=size, cmap="viridis", lw=0.0)
        axis.set_title(f"{sampling}: {len(found.points)} points, area as volume", fontsize=10)
    for axis in axes:
        axis.set(xlim=(low[0], high[0]), ylim=(low[2], high[2]), aspect="equal")
    save(picture, folder, "sampling")


def main(arguments: list[str] | None = None) -> None:
    """Write all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=Path("docs/images"))
    folder = parser.parse_args(arguments).folder
    import matplotlib

    matplotlib.use("Agg")
    plush = make_plush(4000)
    quadrature = quadrature_from_splats(plush.means, plush.scales, plush.quats, plush.opacities)
    body = build_body(quadrature, BuildOptions(mode_count=8), name="plush")
    rest = plush.transformed(translation=-body.offset)

    def painter() -> Painter:
        return Painter(body, rest)

    quadrature_picture(folder, painter(), body, quadrature)
    kernel_picture(folder, body, quadrature)
    mode_picture(folder, painter(), body)
    handle_picture(folder, painter(), body)
    step_picture(folder, painter(), body)
    camera_picture(folder, painter(), body)
    sampling_picture(folder, plush)


if __name__ == "__main__":
    main()
