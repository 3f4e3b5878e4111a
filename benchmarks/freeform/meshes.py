"""Table 2 on meshes of a folder: held at one end, pulled at four far points, pulled at both ends.

Objects are the meshes themselves, scaled to a longest edge of one metre. The reference has quadratic elements that the
mesh cuts (`tests.oracle.cut_mesh`), refined until two of them agree. Springs act on the same points of the object in
every method. What references give at some points of an object is stored by the bytes of its file; meshes are not.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from benchmarks.freeform.grips import DENSITY, DT, GRAVITY, POISSONS_RATIO, PULL, SPRINGS, Grip
from softmode.deformables.body.regions import Region
from softmode.deformables.body.rkpm import sample_farthest
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.quadrature.quadrature_mesh import cap_holes, quadrature_from_mesh
from softmode.errors import AssetError
from softmode.files import whole_file
from tests.oracle.cut_mesh import CutMesh
from tests.oracle.fem import ConvergenceError, Mesh, Minimiser, Solid

Array = NDArray[np.float64]

HARD = (
    *("boot", "brucewick", "falconstatue", "fandisk", "goathead", "mushroom", "rocker-arm", "springer", "torus"),
    "wingnut",
)
"""Meshes of 1e8 Pa, as things of wood and stone are in the paper; others have 1e5 Pa."""
SUFFIXES = (".obj", ".off", ".ply", ".stl")
POINT_COUNT = 5000
PART = 0.1
"""Depth of a held end and radius of a held point, over the longest edge."""
SAMPLES = 200
"""Points at which motions are compared."""
COUNTS = (6, 8, 11, 15)
"""Elements along the longest edge, from reference to reference."""
STABLE = 1.0e-5
"""A reference stands once the next coarser one is no further from it (nMSE)."""
REFERENCES = Path(__file__).with_name("references.npz")
SHAPES = 6
"""Shapes that a stored motion is made of."""


@dataclass(frozen=True, kw_only=True)
class MeshThing:
    """A mesh of the folder."""

    name: str
    """Its file without suffix."""
    key: str
    """Fingerprint of the file."""
    vertices: Array
    """Positions, scaled [m], (V, 3)."""
    faces: NDArray[np.int64]
    """Triangles, (T, 3)."""
    youngs_modulus: float
    """E [Pa]."""
    axis: int = 1
    """Axis of gravity, towards the held end: these collections stand along y."""
    factors: tuple[float, ...] = (1.0,)
    """E of every part over that."""
    stiffness: None = None
    """Relative Young's modulus of quadrature points; they have one."""

    @cached_property
    def quadrature(self) -> Quadrature:
        """What bodies are built from."""
        return quadrature_from_mesh(self.vertices, self.faces, point_count=POINT_COUNT)

    @property
    def points(self) -> Array:
        """Where motions are compared [m], (S, 3): quadrature points, which are much alike in volume."""
        points = self.quadrature.points
        return points[np.sort(np.random.default_rng(0).permutation(len(points))[:SAMPLES])]

    @property
    def weights(self) -> Array:
        """What these count, (S,)."""
        return np.ones(SAMPLES)

    @property
    def down(self) -> Array:
        """Direction of gravity."""
        return -np.eye(3)[self.axis]

    def grip(self, condition: str) -> Grip:
        """Return the springs of a condition, and what moves them."""
        at, (lower, upper) = self.quadrature.points, self.quadrature.bounds
        if condition == "fix":
            parts = [(at[:, self.axis] < lower[self.axis] + PART, np.zeros(3))]
        elif condition == "boundary":
            axis = int(np.argmax(upper - lower))
            away = PULL * np.eye(3)[axis]
            parts = [(at[:, axis] < lower[axis] + PART, -away), (at[:, axis] > upper[axis] - PART, away)]
        else:
            middle = self.quadrature.weights @ at / self.quadrature.volume
            surface = self.quadrature.surface_points
            first = int(((surface - middle) ** 2).sum(axis=1).argmax())
            parts = []
            for k in sample_farthest(surface, 4, first=first):
                out = surface[k] - middle
                near = np.linalg.norm(at - surface[k], axis=1) < PART
                parts.append((near, PULL * out / np.linalg.norm(out)))
        rows = [np.flatnonzero(mask) for mask, _ in parts]
        return Grip(
            points=at[np.concatenate(rows)],
            stiffness=self.quadrature.weights[np.concatenate(rows)] * (SPRINGS * self.youngs_modulus / PART**2),
            pull=np.concatenate([np.tile(pull, (len(r), 1)) for r, (_, pull) in zip(rows, parts, strict=True)]),
            gravity=GRAVITY if condition == "fix" else 0.0,
            part=np.repeat(np.arange(len(rows)), [len(r) for r in rows]),
        )

    def regions(self, grip: Grip) -> tuple[Region, ...]:
        """Return the held parts as soft regions of a build."""
        return tuple(
            Region(
                name=f"part {k}", points=grip.points[grip.part == k], radius=0.25 * PART, stiffness=SPRINGS / PART**2
            )
            for k in range(grip.part.max() + 1)
        )


def read_folder(folder: Path) -> list[MeshThing]:
    """Return the meshes of a folder by name.

    Raises:
        AssetError: If it has none, or one of them cannot be read or closed.
    """
    paths = sorted(path for path in folder.glob("*") if path.suffix.lower() in SUFFIXES)
    if not paths:
        hint = "take files of github.com/odedstein/meshes or github.com/alecjacobson/common-3d-test-models"
        raise AssetError(f"{folder}: no mesh ({', '.join(SUFFIXES)})", hint=hint)
    return [read_mesh(path) for path in paths]


def read_mesh(path: Path) -> MeshThing:
    """Read a mesh, close its holes and scale its longest edge to one metre.

    Raises:
        AssetError: If it cannot be read.
    """
    import trimesh

    try:
        found = trimesh.load(path, force="mesh", process=False)
        vertices, faces, _ = cap_holes(found.vertices, found.faces)  # type: ignore[attr-defined]
        vertices = (vertices - vertices.min(axis=0)) / np.ptp(vertices, axis=0).max()
    except (ValueError, IndexError, KeyError) as error:
        raise AssetError(f"{path}: no triangle mesh ({error})", hint="take it out of the folder") from error
    return MeshThing(
        name=path.stem,
        key=hashlib.sha256(path.read_bytes()).hexdigest()[:16],
        vertices=vertices,
        faces=faces,
        youngs_modulus=1e8 if path.stem in HARD else 1e5,
    )


def simulate(thing: MeshThing, grip: Grip, points: Array, count: int, steps: int) -> Array:
    """Return displacements [m] of rest points (P, 3) by so many elements along the longest edge, (steps, P, 3)."""
    mesh = CutMesh(thing.vertices, thing.faces, count)
    solid = Solid(mesh, youngs_modulus=thing.youngs_modulus, poissons_ratio=POISSONS_RATIO, density=DENSITY)
    matrix = mesh.interpolation(points)
    membrane = mesh.membrane(thing.youngs_modulus)
    return np.array([matrix @ frame for frame in stepped(mesh, solid, grip, thing.down, steps, membrane)])


def stepped(
    mesh: Mesh, solid: Solid, grip: Grip, down: Array, steps: int, membrane: sparse.csr_matrix | None = None
) -> Iterator[Array]:
    """Step elements by implicit Euler; yield nodal displacements [m], (N, 3).

    Args:
        mesh: The elements.
        solid: What they are made of.
        grip: Springs that hold and pull.
        down: Direction of gravity, (3,).
        steps: Number of steps.
        membrane: Stiffness of a skin [N/m], (N, N).
    """
    at = mesh.interpolation(grip.points)
    pull, inertia = at.T @ sparse.diags(grip.stiffness), solid.mass / DT**2
    stiffness, dead = inertia + pull @ at, solid.body_force(grip.gravity * down)
    if membrane is not None:
        stiffness, dead = stiffness + membrane, dead + membrane @ mesh.nodes
    minimise = Minimiser(solid, stiffness, np.zeros(len(mesh.nodes), bool))
    x, v = mesh.nodes, np.zeros_like(mesh.nodes)
    for n in range(1, steps + 1):
        ahead = x + DT * v
        load = inertia @ ahead + dead + pull @ grip.targets(n, steps)
        try:
            found, _ = minimise(ahead, load, 1e-4)
        except ConvergenceError:  # The inertial guess may turn elements inside out; the last positions do not.
            found, _ = minimise(x, load, 1e-4)
        x, v = found, (found - x) / DT
        yield x - mesh.nodes


def refine(thing: MeshThing, condition: str, steps: int) -> tuple[Array, int, float]:
    """Return the motion of a reference that stands, its elements along the longest edge, and its distance (nMSE)."""
    grip, distance = thing.grip(condition), np.inf
    found, count = simulate(thing, grip, thing.points, COUNTS[0], steps), COUNTS[0]
    for finer in COUNTS[1:]:
        if distance <= STABLE:
            break
        try:
            before, found = found, simulate(thing, grip, thing.points, finer, steps)
        except ConvergenceError:  # Small cut elements may be turned inside out; what is coarser stands, and says so.
            break
        count, distance = finer, float(((found - before) ** 2).sum(axis=2).mean())
    return found, count, distance


def packed(motion: Array, count: int, distance: float) -> dict[str, NDArray]:
    """Return a motion (T, S, 3) as the arrays of a file: its first shapes and their courses."""
    left, size, right = np.linalg.svd(motion.reshape(len(motion), -1), full_matrices=False)
    shapes = right[:SHAPES]
    largest = np.maximum(np.abs(shapes).max(axis=1, keepdims=True), 1e-300)
    courses = left[:, :SHAPES] * size[:SHAPES] * (largest.T / 32767.0)
    about = np.array([count, distance])
    return {"shapes": np.round(shapes / largest * 32767.0).astype(np.int16), "courses": courses, "about": about}


class References:
    """Stored motions of references, made where there are none."""

    def __init__(self, path: Path = REFERENCES) -> None:
        """Read what there is."""
        self.path = path
        self.arrays: dict[str, NDArray] = {}
        if path.exists():
            with np.load(path) as file:
                self.arrays = dict(file)

    def motion(self, thing: MeshThing, condition: str, steps: int) -> Array:
        """Return displacements at the thing's points [m], (steps, S, 3).

        Raises:
            ConvergenceError: If finite elements do not converge.
        """
        key = f"{thing.key}_{condition}_{steps}"
        if f"{key}_about" not in self.arrays:
            self.add(key, packed(*refine(thing, condition, steps)))
            with whole_file(self.path) as file:
                np.savez_compressed(file, allow_pickle=False, **self.arrays)
        shapes = self.arrays[f"{key}_shapes"].astype(np.float64)
        return (self.arrays[f"{key}_courses"] @ shapes).reshape(steps, -1, 3)

    def add(self, key: str, arrays: dict[str, NDArray]) -> None:
        """Store a packed motion."""
        self.arrays |= {f"{key}_{name}": array for name, array in arrays.items()}
