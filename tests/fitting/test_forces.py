"""Young's modulus from forces over a way, against finite elements and Hertz.

Builds two boxes with samples as fine as what presses them.
"""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.interpolate import PchipInterpolator

from softmode.deformables import Material
from softmode.errors import ConfigError, FitError
from softmode.fitting.force_fit import Press, fit_force
from softmode.fitting.tables import ForceLog
from softmode.objects import SoftObject, load
from softmode.splats.colored_mesh import ColoredMesh
from tests.oracle import fem

TRUE = Material(youngs_modulus=8.0e4, poissons_ratio=0.35, density=200.0)
WAY = np.linspace(0.0, 1.0, 13)


def box(*edges: float, samples: int) -> SoftObject:
    """Return a box."""
    mesh = ColoredMesh.from_trimesh(trimesh.creation.box(edges))
    return load(mesh, size=max(edges), surface_count=samples, splat_count=200, pose="captured", material=TRUE)


def test_jaws_against_finite_elements() -> None:
    """Between jaws that hold their faces E comes out within 5 %, from 15 % of compression by quadratic elements."""
    size, cells = (0.06, 0.05, 0.04), (4, 4, 4)
    mesh = fem.Mesh(tuple(np.linspace(0.0, s, n + 1) for s, n in zip(size, cells, strict=True)), np.ones(cells, bool))
    solid = fem.Solid(mesh, youngs_modulus=TRUE.youngs_modulus, poissons_ratio=TRUE.poissons_ratio)
    low, high = mesh.nodes[:, 2] < 1e-9, mesh.nodes[:, 2] > size[2] - 1e-9
    depths, forces, x = [0.0], [0.0], None
    for depth in (0.002, 0.004, 0.006):
        target = mesh.nodes - np.outer(high, [0.0, 0.0, depth])
        x = fem.static(solid, held=low | high, target=target, start=x)
        depths.append(depth)
        forces.append(-float(solid.force(x)[high, 2].sum()))
    way = 0.006 * WAY
    log = ForceLog(way=size[2] - way, force=PchipInterpolator(depths, forces)(way), opening=True)
    thing = box(*size, samples=500)
    found = fit_force(thing, log, Press(between=2), material=TRUE)
    assert found["youngs_modulus"].value == pytest.approx(TRUE.youngs_modulus, rel=0.05)
    assert not any("no single E" in note for note in found.notes)
    softer = ForceLog(way=way, force=np.minimum(log.force, 0.4 * log.force.max()), opening=False)
    assert any("no single E" in note for note in fit_force(thing, softer, Press(between=2), material=TRUE).notes)
    with pytest.raises(FitError, match="depths"):
        fit_force(thing, ForceLog(way=way + 1.0, force=log.force, opening=True), Press(between=2), material=TRUE)


@pytest.mark.rest
def test_ball_against_hertz() -> None:
    """A ball on a block presses as Hertz's, F = 4/3 E / (1 - nu^2) sqrt(R) d^(3/2), of its thickness: E within 10 %.

    The thickness h adds 1 + y + y^2, y = .694 (3 - 2 nu) / (1 - nu) sqrt(R d) / (pi h): a layer that slides, to second
    order (Dimitriadis et al. 2002, doi:10.1016/S0006-3495(02)75620-8). R is five times the distance of the samples.
    """
    thing, radius, way = box(0.1, 0.1, 0.1, samples=4000), 0.02, 0.004 * WAY
    nu, x = TRUE.poissons_ratio, np.sqrt(radius * way) / 0.1
    thick = 2.0 / np.pi * 0.347 * (3.0 - 2.0 * nu) / (1.0 - nu) * x
    force = 4.0 / 3.0 * TRUE.youngs_modulus / (1.0 - nu**2) * radius**0.5 * way**1.5 * (1.0 + thick + thick**2)
    press = Press(point=(0.0, 0.0, 0.1), radius=radius)
    found = fit_force(thing, ForceLog(way=way, force=force, opening=False), press, material=TRUE)
    assert found["youngs_modulus"].value == pytest.approx(TRUE.youngs_modulus, rel=0.1)
    with pytest.raises(ConfigError, match="from the object"):
        Press(point=(0.0, 0.0, 0.3)).forces(thing.body, TRUE, np.array([0.001]))
