"""A soft bar with a stiff core, beside one without: how much less does it stretch, and how much less does it bend?

A field of Young's moduli is given at build time, so that the functions of the body know the core. Two equal bars are
clamped at one end, hang or stick out under a small load, and are compared with composite beams in closed form:

    stretch u = rho g L^2 / (2 <E>),    <E> A = sum E_i A_i      bend w = rho A g L^4 / (8 <EI>),    <EI> = sum E_i I_i

A core of a quarter of the section carries most of a pull, but hardly helps against bending: it lies in the middle.

Run: ``python examples/heterogeneous_body.py [--ratio 20] [--short]``; writes ``out/heterogeneous_body.png``
"""

import argparse
from pathlib import Path

import newton
import numpy as np
import warp as wp
from PIL import Image

from softmode.deformables import BuildOptions, Material, Region, SolverReducedOptions, build_body, quadrature_from_box
from softmode.objects import Placed, SoftObject
from softmode.scenes import SplatScene
from softmode.splats import PinholeCamera, Splats

LENGTH, CLAMP, EDGE, CORE = 0.32, 0.04, 0.04, 0.02
"""The bar and what of it is clamped; edges of its section and of its core [m]."""
MODULUS, DENSITY, GRAVITY = 1.5e5, 1000.0, 9.81


def in_core(x: np.ndarray) -> np.ndarray:
    """Return which points of the bar, (N, 3), lie in its core."""
    return np.abs(x[:, 1:]).max(axis=1) < 0.5 * CORE


def make_bar(ratio: float) -> SoftObject:
    """Build a bar along x whose core is `ratio` times as stiff; splats show a milky shell, and a core that is red."""
    wide = float("inf")
    root = Region(name="root", box=((-wide,) * 3, (-0.5 * LENGTH + CLAMP, wide, wide)))
    quadrature = quadrature_from_box((LENGTH, EDGE, EDGE), point_count=16000)  # 12 across
    options = BuildOptions(mode_count=3, handles="quadratic", cubature_count=512, poissons_ratio=0.3)
    field = np.where(in_core(quadrature.points), ratio, 1.0)
    body = build_body(quadrature, options, regions=(root,), stiffness_scale=field)
    rng = np.random.default_rng(0)
    means = rng.uniform(-0.5, 0.5, (40000, 3)) * (LENGTH, EDGE, EDGE) - body.offset
    core = in_core(means + body.offset)
    colors = np.where(core[:, None], (0.80, 0.16, 0.12) if ratio > 1.0 else (0.62, 0.72, 0.82), (0.62, 0.72, 0.82))
    splats = Splats(
        means=means,
        quats=np.tile((0.0, 0.0, 0.0, 1.0), (len(means), 1)),
        scales=np.full((len(means), 3), 0.0014),
        opacities=np.where(core & (ratio > 1.0), 0.8, 0.07),
        sh=((colors - 0.5) / 0.28209479177387814)[:, None],
    )
    material = Material(youngs_modulus=MODULUS, poissons_ratio=0.3, density=DENSITY)
    return SoftObject(body=body, splats=splats, material=material)


def settle(bars: list[SoftObject], gravity: tuple[float, float, float], edge: int = 0) -> tuple[list, list]:
    """Let both bars come to rest; return the mean displacement of their free ends [m] and, with `edge`, a picture."""
    placed = [Placed(object=bar, position=(0.0, 0.1 * k, 0.0)) for k, bar in enumerate(bars)]
    view, size = {"position": (0.30, -0.60, 0.10), "target": (0.0, 0.03, -0.08), "fov_y": 0.45}, max(edge, 64)
    camera = PinholeCamera.look_at("bars", width=size, height=size // 2, **view)
    cameras, exact = [camera] * bool(edge), SolverReducedOptions(tolerance=1.0e-8)
    wall, away = newton.ModelBuilder(), wp.transform((-0.5 * LENGTH + 0.5 * CLAMP, 0.05, 0.0), wp.quat_identity())
    wall.default_shape_cfg.has_particle_collision = False
    wall.add_shape_box(-1, xform=away, hx=0.49 * CLAMP, hy=0.09, hz=0.05, color=(0.42, 0.44, 0.48))
    scene = SplatScene(wall, placed, cameras=cameras, dt=0.1, options=exact)
    scene.model.set_gravity(gravity)
    for _ in range(20):
        scene.step()
    moved = []
    for k, body in enumerate(bar.body for bar in bars):
        end = body.surface.points[:, 0] > body.surface.points[:, 0].max() - 1.0e-6
        moved.append((scene.surface(k) - body.surface.points - placed[k].position)[end].mean(axis=0))
    return moved, [scene.draw()] if edge else []


def test_final(stretch: float, bend: float, ratio: float) -> None:
    """The core stiffens the bar as composite beams in closed form say."""
    area, inertia = (CORE / EDGE) ** 2, (CORE / EDGE) ** 4
    print(
        f"expected: {1.0 + (ratio - 1.0) * area:.2f} times less stretch, {1.0 + (ratio - 1.0) * inertia:.2f} less bend"
    )
    assert abs(stretch / (1.0 + (ratio - 1.0) * area) - 1.0) < 0.05
    assert abs(bend / (1.0 + (ratio - 1.0) * inertia) - 1.0) < 0.05


def main(arguments: list[str] | None = None) -> None:
    """Load both bars along and across, compare, draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ratio", type=float, default=20.0, help="stiffness of the core over that of the shell")
    parser.add_argument("--short", action="store_true", help="a small picture")
    given = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    bars = [make_bar(ratio) for ratio in (1.0, given.ratio)]
    small = 0.01 * GRAVITY
    (soft, stiff), _ = settle(bars, (small, 0.0, 0.0))
    stretch = soft[0] / stiff[0]
    print(f"hanging: {1e6 * soft[0]:.1f} and {1e6 * stiff[0]:.1f} um, {stretch:.2f} times less")
    (soft, stiff), _ = settle(bars, (0.0, 0.0, -small))
    bend = soft[2] / stiff[2]
    print(f"sticking out: {1e6 * soft[2]:.0f} and {1e6 * stiff[2]:.0f} um, {bend:.2f} times less")
    test_final(stretch, bend, given.ratio)
    _, (picture,) = settle(bars, (0.0, 0.0, -GRAVITY), 256 if given.short else 960)
    Path("out").mkdir(exist_ok=True)
    Image.fromarray(picture).save("out/heterogeneous_body.png")


if __name__ == "__main__":
    main()
