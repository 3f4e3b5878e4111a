"""Held solids beside finite elements of scikit-fem: what loads do to them, and their frequencies.

Run from the repository root: ``python -m tests.oracle.held [NAME ...]`` makes ``tests/oracle/held.json`` anew, or some
of it. It wants scikit-fem, pypardiso, and for solids of tetrahedra tetgen and manifold3d. Elements are quadratic. Their
mesh ends on the face of the region, where its nodes are fixed: the same support as a body's exact region. Hexahedra are
of level 1, two to four across a section; tetrahedra as fine as `TETRAHEDRA` says. A further level raises the works of
the helix by 0.7, 0.7 and 1.3 %, of the spiral by 0.2, 0.1 and 1.4 %, of Y and fork by 0.1 to 0.4 %.

Builds each solid with its region: bodies to compare.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.quadrature.quadrature import quadrature_from_box, quadrature_from_mesh
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from tests.oracle.solids import stiffness

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STORED = Path(__file__).with_name("held.json")
YOUNGS_MODULUS, DENSITY = 1.0e6, 1000.0
FREQUENCIES = 6
END = 0.1
"""Width of the load that is spread over the end, over the extent: a Gaussian's standard deviation. That of the hollow
box reaches all across, lid and walls: on the middle of the lid it would be one more load at the tip."""
TETRAHEDRA = {"Y": 2500, "hollow box": 6000, "spoon": 6000, "hand": 5000, "fork": 6000}
"""Least number of tetrahedra."""
RATIOS = {"plate, one edge": (0.3, 0.45, 0.49), "plate, two edges": (0.3, 0.45, 0.49)}
"""Poisson's ratios, of the others 0.3 and 0.45."""


@dataclass(frozen=True, kw_only=True)
class Held:
    """A solid and what holds it."""

    quadrature: Callable[[], Quadrature]
    """The object."""
    regions: tuple[Region, ...]
    """Exact regions."""
    elements: Callable[[], tuple[Any, Callable[[Array], Mask]]]
    """A mesh of scikit-fem of what is free, and which of places (3, N) are fixed."""
    tip: tuple[float, float, float]
    """Where the loads at the end are [m]."""
    width: float
    """Standard deviation of the load at the tip [m]."""
    wide: bool = False
    """Whether the load that is spread over the end reaches all across x and y."""


def stored(name: str, poissons_ratio: float) -> dict[str, Any]:
    """Return what finite elements gave: works (9,) [J], frequencies (6,) [Hz], extent [m]."""
    return json.loads(STORED.read_text())[name][f"{poissons_ratio:g}"]


def build_held(name: str, poissons_ratio: float, **options: Any) -> ReducedBody:
    """Return the body as users build it."""
    solid = SOLIDS[name]()
    made = BuildOptions(poissons_ratio=poissons_ratio, **options)
    return build_body(solid.quadrature(), made, name=name, regions=solid.regions, progress=False)


def against_elements(body: ReducedBody, name: str, poissons_ratio: float) -> tuple[Array, Array]:
    """Return works over those of finite elements, of gravity, at the tip and over the end along x, y and z, (9,).

    Second the frequencies over theirs, (6,). Both from the body's own points and gradients.
    """
    solid, reference = SOLIDS[name](), stored(name, poissons_ratio)
    widths = (solid.width,) * 3, _end(solid, reference["extent"])
    quadrature, free = solid.quadrature(), 3 * body.driven_count
    X, value = quadrature.points, body.evaluate(quadrature.points - body.offset)[0]
    loose = np.min([region.distance(X)[0] for region in solid.regions], axis=0) > 0.0
    load = np.zeros((body.function_count, 3, 9))
    for a in range(3):
        load[:, a, a] = DENSITY * body.volume * body.mean_basis
        for k, width in enumerate(widths):
            soft = _gaussian(X.T, solid.tip, width) * quadrature.weights * loose
            load[:, a, 3 + 3 * k + a] = value.T @ (soft / soft.sum())
    K = YOUNGS_MODULUS * stiffness(body, poissons_ratio).reshape((3, body.function_count) * 2)
    n = 3 * body.function_count - free
    K = K[:, body.driven_count :, :, body.driven_count :].reshape(n, n)
    F = load[body.driven_count :].transpose(1, 0, 2).reshape(n, 9)
    works = np.einsum("nk,nk->k", F, np.linalg.solve(K, F))
    squares = np.linalg.eigvalsh(K)[:FREQUENCIES] / (DENSITY * body.volume)
    return works / reference["work"], np.sqrt(squares) / (2.0 * np.pi) / reference["frequency"]


def _end(solid: Held, extent: float) -> tuple[float, float, float]:
    """Return the standard deviations of the load over the end along each axis [m]."""
    across = np.inf if solid.wide else END * extent
    return across, across, END * extent


def _gaussian(x: Array, centre: tuple[float, float, float], width: tuple[float, float, float]) -> Array:
    return np.exp(-0.5 * sum(((x[i] - centre[i]) / width[i]) ** 2 for i in range(3)))


def _grid(*lines: Array) -> Any:
    from skfem import MeshHex

    return MeshHex.init_tensor(*lines)


def _mapped(mesh: Any, place: Callable[[Array], Array]) -> Any:
    from skfem import MeshHex

    return MeshHex(np.ascontiguousarray(place(mesh.p)), mesh.t)


def _surface(mesh: Any) -> Quadrature:
    """Return the quadrature of the closed surface of hexahedra."""
    at = mesh.boundary_facets()
    middle = mesh.p[:, mesh.t[:, mesh.f2t[0, at]]].mean(axis=1).T
    triangles = []
    for corner, inside in zip(mesh.facets[:, at].T, middle, strict=True):
        p = mesh.p[:, corner].T
        away = p - p.mean(axis=0)
        normal = np.cross(away[0], away[1])
        first = away[0] / np.linalg.norm(away[0])
        second = np.cross(normal / np.linalg.norm(normal), first)
        corner = corner[np.argsort(np.arctan2(away @ second, away @ first))]
        for face in (corner[[0, 1, 2]], corner[[0, 2, 3]]):
            p = mesh.p[:, face].T
            outward = np.cross(p[1] - p[0], p[2] - p[0]) @ (p.mean(axis=0) - inside) > 0.0
            triangles.append(face if outward else face[::-1])
    used, index = np.unique(np.array(triangles), return_inverse=True)
    return quadrature_from_mesh(mesh.p[:, used].T, index.reshape(-1, 3))


def _box(lower: Any, upper: Any, name: str = "a") -> Region:
    return Region(name=name, box=(lower, upper))


LOW, HIGH = -np.inf, np.inf


def _plate(*, both: bool) -> Held:
    size, thick, held = 0.2, 0.004, 0.02
    far = size / 2 - (held if both else 0.0)
    regions = [_box((LOW,) * 3, (-size / 2 + held, HIGH, HIGH))]
    regions += [_box((far, LOW, LOW), (HIGH,) * 3, "b")] if both else []
    lines = (
        np.linspace(-size / 2 + held, far, 29),
        np.linspace(-size / 2, size / 2, 27),
        np.linspace(-1, 1, 3) * thick / 2,
    )
    return Held(
        quadrature=lambda: quadrature_from_box((size, size, thick)),
        regions=tuple(regions),
        elements=lambda: (
            _grid(*lines),
            lambda X: (X[0] < -size / 2 + held + 1e-9) | (both & (X[0] > far - 1e-9)),
        ),
        tip=(0.0 if both else size / 2, 0.0, 0.0),
        width=size / 20,
    )


def _bar() -> Held:
    size, thick, held = 0.2, 0.01, 0.01
    lines = np.linspace(-size / 2 + held, size / 2, 81), *[np.linspace(-thick / 2, thick / 2, 5)] * 2
    return Held(
        quadrature=lambda: quadrature_from_box((size, thick, thick)),
        regions=(_box((LOW,) * 3, (-size / 2 + held, HIGH, HIGH)),),
        elements=lambda: (_grid(*lines), lambda X: X[0] < -size / 2 + held + 1e-9),
        tip=(size / 2, 0.0, 0.0),
        width=size / 40,
    )


def _newton(place: Callable[[Array, Array], Array], start: float, goal: float, across: Array) -> Array:
    """Return the parameter along a strip (N,) at which a coordinate is a goal, at places across it."""
    along = np.full_like(across, start)
    for _ in range(50):
        slope = (place(along + 1e-6, across) - place(along - 1e-6, across)) / 2e-6
        along = along - (place(along, across) - goal) / slope
    return along


def _spiral(*, points: bool) -> Held:
    turns, inner, outer, thick, wide, cut = 1.75, 0.015, 0.06, 0.008, 0.012, 0.0097

    def place(p: Array, a: Array, b: Array) -> Array:
        radius, angle = inner + (outer - inner) * p + thick * a, 2 * np.pi * turns * p
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), wide * b])

    def end(a: Array) -> Array:
        if points:
            return np.full_like(a, 1 - 8.02 / 144)
        return _newton(lambda p, a: place(p, a, 0 * a)[0], 1 - 0.01 / (2 * np.pi * turns * outer), -cut, a)

    def elements() -> tuple[Any, Callable[[Array], Mask]]:
        from scipy.spatial import KDTree

        across = np.linspace(-0.5, 0.5, 20001)
        face = KDTree(place(end(across), across, 0 * across)[:2].T)
        lines = np.linspace(0, 1, 145), *[np.linspace(-0.5, 0.5, 3)] * 2
        mesh = _mapped(_grid(*lines), lambda p: place(p[0] * end(p[1]), p[1], p[2]))
        return mesh, lambda X: face.query(X[:2].T)[0] < 2e-5

    if points:
        radius, first = 0.0012, end(np.zeros(1))[0]
        length = 2 * np.pi * turns * np.hypot(outer, (outer - inner) / (2 * np.pi * turns))
        along = np.arange(first + radius / length, 1 + 1e-9, 0.001 / length)
        grid = np.meshgrid(along, np.linspace(-0.5, 0.5, 9), np.linspace(-0.5, 0.5, 13), indexing="ij")
        region = Region(name="a", points=place(*[x.ravel() for x in grid]).T, radius=radius)
    else:
        region = _box((-cut, LOW, LOW), (HIGH, -0.05, HIGH))
    lines = np.linspace(0, 1, 145), *[np.linspace(-0.5, 0.5, 3)] * 2
    return Held(
        quadrature=lambda: _surface(_mapped(_grid(*lines), lambda p: place(*p))),
        regions=(region,),
        elements=elements,
        tip=tuple(place(*np.zeros((3, 1)))[:, 0]),
        width=0.004,
    )


def _helix() -> Held:
    radius, height, turns, thick, cut = 0.04, 0.12, 2.0, 0.010, 0.012

    def place(p: Array, a: Array, b: Array) -> Array:
        angle, r = 2 * np.pi * turns * p, radius + thick * a
        return np.stack([r * np.cos(angle), r * np.sin(angle), height * p + thick * b])

    def end(a: Array) -> Array:
        return _newton(lambda p, a: place(p, a, 0 * a)[1], cut / (2 * np.pi * turns * radius), cut, a)

    lines = np.linspace(0, 1, 145), *[np.linspace(-0.5, 0.5, 3)] * 2
    return Held(
        quadrature=lambda: _surface(_mapped(_grid(*lines), lambda p: place(*p))),
        regions=(_box((0.0, LOW, LOW), (HIGH, cut, 0.03)),),
        elements=lambda: (
            _mapped(_grid(*lines), lambda p: place(end(p[1]) + p[0] * (1 - end(p[1])), p[1], p[2])),
            lambda X: (np.abs(X[1] - cut) < 2e-5) & (X[0] > 0) & (X[2] < 0.02),
        ),
        tip=tuple(place(*np.array([[1.0], [0.0], [0.0]]))[:, 0]),
        width=0.005,
    )


def _l() -> Held:
    edge, first, second = 0.03, 0.15, 0.12

    def bricks(fine: int) -> Any:
        def line(low: float, high: float) -> Array:
            return np.linspace(low, high, round((high - low) / edge * fine) + 1)

        mesh = _grid(line(0, first), line(-edge / 2, edge / 2), line(0, second))
        centre = mesh.p[:, mesh.t].mean(axis=1)
        return mesh.restrict(np.flatnonzero((centre[2] < edge) | (centre[0] > first - edge)))

    def elements() -> tuple[Any, Callable[[Array], Mask]]:
        mesh = bricks(4)
        free = mesh.p[:, mesh.t].mean(axis=1)[0] > edge / 2
        return mesh.restrict(np.flatnonzero(free)), lambda X: X[0] < edge / 2 + 1e-9

    return Held(
        quadrature=lambda: _surface(bricks(1)),
        regions=(_box((LOW,) * 3, (edge / 2, HIGH, HIGH)),),
        elements=elements,
        tip=(first - edge / 2, 0.0, second),
        width=edge / 2,
    )


def _gutter() -> Held:
    """Half a tube with a thin wall: nothing in the method was chosen by it."""
    length, radius, thick, held, half = 0.16, 0.025, 0.003, 0.01, np.pi / 2

    def place(p: Array) -> Array:
        r = radius + thick * p[2]
        return np.stack([p[0], r * np.sin(p[1]), r * np.cos(p[1])])

    whole = np.linspace(-length / 2, length / 2, 33), np.linspace(-half, half, 33), np.linspace(-0.5, 0.5, 2)
    free = np.linspace(-length / 2 + held, length / 2, 25), np.linspace(-half, half, 25), np.linspace(-0.5, 0.5, 3)
    return Held(
        quadrature=lambda: _surface(_mapped(_grid(*whole), place)),
        regions=(_box((LOW,) * 3, (-length / 2 + held, HIGH, HIGH)),),
        elements=lambda: (_mapped(_grid(*free), place), lambda X: X[0] < -length / 2 + held + 1e-9),
        tip=(length / 2, 0.0, radius),
        width=0.01,
    )


def _ribbon() -> Held:
    """A wide strip bent to an S: nothing in the method was chosen by it."""
    radius, thick, wide, cut = 0.03, 0.004, 0.03, 0.008

    def place(p: Array) -> Array:
        angle = 2 * np.pi * p[0]
        first = angle <= np.pi
        turn, r = np.where(first, angle, angle - np.pi), np.where(first, radius - thick * p[1], radius + thick * p[1])
        x, z = np.where(first, radius, 3 * radius) - r * np.cos(turn), np.where(first, 1, -1) * r * np.sin(turn)
        return np.stack([x, wide * p[2], z])

    def free(p: Array) -> Array:
        end = np.arcsin(cut / (radius - thick * p[1])) / (2 * np.pi)
        return place(np.stack([np.where(p[0] <= 0.5, end + p[0] * 2 * (0.5 - end), p[0]), p[1], p[2]]))

    half = np.linspace(0, 0.5, 33)
    lines = np.append(half, half[1:] + 0.5), np.linspace(-0.5, 0.5, 3), np.linspace(-0.5, 0.5, 5)
    whole = np.linspace(0, 1, 97), np.linspace(-0.5, 0.5, 2), np.linspace(-0.5, 0.5, 5)
    return Held(
        quadrature=lambda: _surface(_mapped(_grid(*whole), place)),
        regions=(_box((-0.01, LOW, LOW), (0.01, HIGH, cut)),),
        elements=lambda: (_mapped(_grid(*lines), free), lambda X: (np.abs(X[2] - cut) < 1e-6) & (X[0] < 0.01)),
        tip=tuple(place(np.array([[1.0], [0.0], [0.0]]))[:, 0]),
        width=0.005,
    )


def _tetrahedra(name: str) -> Held:
    import trimesh
    from trimesh.transformations import rotation_matrix

    def box(lower: Any, upper: Any) -> Any:
        return trimesh.creation.box(bounds=[lower, upper])

    def union(*parts: Any) -> Any:
        return trimesh.boolean.union(list(parts), engine="manifold")

    def less(*parts: Any) -> Any:
        return trimesh.boolean.difference(list(parts), engine="manifold")

    def arm(degrees: float, long: float = 0.09, wide: float = 0.02, start: float = 0.0, at: Any = (0, 0, 0)) -> Any:
        part = box([start, -wide / 2, -wide / 2], [long, wide / 2, wide / 2])
        part.apply_transform(rotation_matrix(np.radians(degrees), [0, 0, 1]))
        part.apply_translation(at)
        return part

    lower, upper, tip, width = np.full(3, -1.0), np.ones(3), (0.0, 0.0, 0.05), 0.02
    if name == "Y":
        solid = union(arm(180), arm(55), arm(-65))
        lower, upper = np.array([-0.1, -0.1, -0.1]), np.array([-0.075, 0.1, 0.1])
        tip, width = (0.09 * np.cos(np.radians(55)), 0.09 * np.sin(np.radians(55)), 0.0), 0.01
    elif name == "fork":
        tines = [box([0.005, y - 0.003, -0.005], [0.07, y + 0.003, 0.005]) for y in (-0.018, -0.006, 0.006, 0.018)]
        bridge = box([-0.012, -0.021, -0.005], [0.008, 0.021, 0.005])
        solid = union(box([-0.1, -0.01, -0.005], [0, 0.01, 0.005]), bridge, *tines)
        lower, upper = np.array([-0.2, -0.1, -0.1]), np.array([-0.08, 0.1, 0.1])
        tip, width = (0.07, 0.018, 0.0), 0.004
    elif name == "hollow box":
        solid, upper = less(box([-0.05] * 3, [0.05] * 3), box([-0.042] * 3, [0.042] * 3)), np.array([1.0, 1.0, -0.042])
    elif name == "spoon":
        balls = trimesh.creation.icosphere(3, 0.025), trimesh.creation.icosphere(3, 0.021)
        bowl = less(*balls, box([-0.1, -0.1, 0.004], [0.1, 0.1, 0.1]))
        solid, upper = union(bowl, box([-0.14, -0.006, -0.002], [-0.0225, 0.006, 0.004])), np.array([-0.12, 1.0, 1.0])
        tip, width = (0.023, 0.0, 0.0), 0.006
    else:
        palm = box([-0.09, -0.04, -0.009], [0, 0.04, 0.009]), box([-0.13, -0.025, -0.009], [-0.085, 0.025, 0.009])
        ends = ((-0.0315, 0.06), (-0.0105, 0.075), (0.0105, 0.07), (0.0315, 0.055))
        fingers = [box([-0.005, y - 0.0075, -0.007], [end, y + 0.0075, 0.007]) for y, end in ends]
        solid, upper = (
            union(*palm, *fingers, arm(50, 0.06, 0.016, -0.01, (-0.06, 0.03, 0))),
            np.array([-0.11, 1.0, 1.0]),
        )
        tip, width = (0.075, -0.0105, 0.0), 0.006

    def elements() -> tuple[Any, Callable[[Array], Mask]]:
        import tetgen
        from skfem import MeshTet

        free = less(solid, box(lower, upper))
        maker = tetgen.TetGen(np.asarray(free.vertices, float), np.asarray(free.faces, np.int32))
        volume = float(free.volume) / TETRAHEDRA[name]
        options = {"order": 1, "mindihedral": 12.0, "minratio": 1.4, "fixedvolume": True, "quality": True}
        nodes, corners = maker.tetrahedralize(maxvolume=volume, **options)[:2]
        mesh = MeshTet(np.ascontiguousarray(nodes.T), np.ascontiguousarray(corners[:, :4].T))
        return mesh, lambda X: np.logical_and.reduce(
            (X >= lower[:, None] - 1e-6) & (X <= upper[:, None] + 1e-6), axis=0
        )

    return Held(
        quadrature=lambda: quadrature_from_mesh(solid.vertices, solid.faces),
        regions=(_box(lower, upper),),
        elements=elements,
        tip=tip,
        width=width,
        wide=name == "hollow box",
    )


SOLIDS: dict[str, Callable[[], Held]] = {
    "plate, one edge": partial(_plate, both=False),
    "plate, two edges": partial(_plate, both=True),
    "bar": _bar,
    "L": _l,
    "spiral": partial(_spiral, points=False),
    "spiral, points": partial(_spiral, points=True),
    "helix": _helix,
    "gutter": _gutter,
    "ribbon": _ribbon,
    **{name: partial(_tetrahedra, name) for name in TETRAHEDRA},
}
"""Solids by name: plates 50:1, a bar 20:1, strips and rods 50:1, and so on."""


def solve(name: str, poissons_ratio: float) -> dict[str, Any]:
    """Return what finite elements give."""
    import pypardiso
    import scipy.sparse as sp
    from scipy.sparse.linalg import LinearOperator, eigsh
    from skfem import (
        Basis,
        BilinearForm,
        ElementHex2,
        ElementTetP2,
        ElementVector,
        Functional,
        LinearForm,
        MeshTet,
        asm,
    )
    from skfem.helpers import dot
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    solid = SOLIDS[name]()
    mesh, fixed = solid.elements()
    basis = Basis(mesh, ElementVector(ElementTetP2() if isinstance(mesh, MeshTet) else ElementHex2()), intorder=4)
    K = asm(linear_elasticity(*lame_parameters(YOUNGS_MODULUS, poissons_ratio)), basis).tocsr()
    M = asm(BilinearForm(lambda u, v, w: DENSITY * dot(u, v)), basis).tocsr()
    free = np.setdiff1d(np.arange(K.shape[0]), np.flatnonzero(fixed(basis.doflocs)))
    extent = float(np.ptp(mesh.p, axis=1).max())
    loads = [LinearForm(lambda v, w, a=a: DENSITY * v[a]).assemble(basis) for a in range(3)]
    for width in ((solid.width,) * 3, _end(solid, extent)):
        total = Functional(lambda w, s=width: _gaussian(w.x, solid.tip, s)).assemble(basis)
        for a in range(3):
            form = LinearForm(lambda v, w, a=a, s=width: _gaussian(w.x, solid.tip, s) * v[a])
            loads.append(form.assemble(basis) / total)
    K, M, F = K[free][:, free], M[free][:, free], np.array(loads).T[free]
    half, solver = sp.triu(K, format="csr"), pypardiso.PyPardisoSolver(mtype=2)
    solver.factorize(half)

    def inverse(load: Array) -> Array:
        return solver.solve(half, np.asfortranarray(load))

    operator = LinearOperator(K.shape, matvec=inverse, dtype=float)
    squares = np.sort(eigsh(K, k=FREQUENCIES, M=M, sigma=0.0, OPinv=operator)[0])
    works, frequencies = np.einsum("nk,nk->k", F, inverse(F)), np.sqrt(squares) / (2.0 * np.pi)
    return {
        "unknowns": len(free),
        "extent": extent,
        "work": [float(f"{x:.6g}") for x in works],
        "frequency": [float(f"{x:.6g}") for x in frequencies],
    }


def main() -> None:
    """Store what finite elements give."""
    known = json.loads(STORED.read_text()) if STORED.exists() else {}
    for name in sys.argv[1:] or list(SOLIDS):
        for ratio in RATIOS.get(name, (0.3, 0.45)):
            known.setdefault(name, {})[f"{ratio:g}"] = solve(name, ratio)
            STORED.write_text(json.dumps(known, indent=1) + "\n")
            print(name, ratio, known[name][f"{ratio:g}"], flush=True)


if __name__ == "__main__":
    main()
