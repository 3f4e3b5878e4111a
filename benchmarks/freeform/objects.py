"""Table 2's protocol: objects fixed on one side, pulled at four farthest points, pulled at both ends, beside FEM.

An object is the union of the cells of a coarse grid, so that both methods have the very same domain: quadratic
hexahedra on the cells, Gauss points inside them for softmode. Boundary conditions are springs at the same points, with
the same stiffness and the same moving targets in both. Every object is scaled to a longest edge of one metre.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy import FINE_RANK, affine
from benchmarks.freeform import simplicits
from benchmarks.freeform.grips import CONDITIONS, DENSITY, DT, GRAVITY, POISSONS_RATIO, PULL, SPRINGS, STEPS, Grip
from benchmarks.freeform.meshes import MeshThing, References, read_folder, stepped
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.body.rkpm import sample_farthest
from softmode.deformables.materials.material import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.deformables.model.authoring import add_pins, add_reduced_body
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.cache import fingerprint_of
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from softmode.files import whole_file
from tests.oracle.fem import ConvergenceError, Mesh, Solid
from tests.oracle.solids import SOLIDS
from tests.scenes import Scene
from tests.shape_trials import Voxels, voxelise
from tests.shapes import SHAPES, Shape

Array = NDArray[np.float64]
Basis = BuildOptions | Callable[[Any], ReducedBody]
Motion = Callable[[str, Grip], Array]

ORGANIC = ("bear", "bunny", "hand", "star", "Y", "cluster", "ellipsoid", "torus", "cup", "twisted bar")
"""Objects of 1e5 Pa; the others have 1e8 Pa, as in the paper."""
HARD = (
    *("plate 40:1", "rod 50:1", "cone", "hollow sphere", "L-shape", "cross", "dumbbell", "helix", "frame"),
    "letters on a rule",
)
HETEROGENEOUS = ("bear", "bunny", "hand", "star", "torus", "L-shape", "cross", "dumbbell", "cup", "Y")
"""Objects of several moduli: thirds along the longest axis of 1e6, 1e5 and 1e7 Pa."""
THIRDS = (1.0, 0.1, 10.0)
ELEMENT_LIMIT = 120
"""Elements of an object at most; the grid has as many cells along the longest edge as that allows, 6 to 14."""
EQUAL: dict[str, Basis] = {
    "FreeForm m = 16": affine(16, rank_tolerance=FINE_RANK),
    "default, 68": BuildOptions(function_count=68, poissons_ratio=POISSONS_RATIO, cubature_count=408),
    "FreeForm m = 11": affine(11, rank_tolerance=FINE_RANK),
    "default, 48": BuildOptions(poissons_ratio=POISSONS_RATIO),
}
"""Bases of as many unknowns in pairs, 204 and 144."""
PAIRS = tuple(itertools.pairwise(EQUAL))[::2]
TOLD_LABEL, TOLD = "told, m = 8", BuildOptions(mode_count=8, poissons_ratio=POISSONS_RATIO)
"""A body that was told of the springs when it was built."""


@dataclass(frozen=True, kw_only=True)
class Thing:
    """An object."""

    name: str
    """Its name."""
    voxels: Voxels
    """Its cells, scaled to a longest edge of one metre."""
    youngs_modulus: float
    """E [Pa]."""
    factors: Array
    """E of every cell over that, (cells,), in the order of `np.argwhere`."""

    @cached_property
    def quadrature(self) -> Quadrature:
        """What bodies are built from."""
        return self.voxels.quadrature(5000)

    @property
    def stiffness(self) -> Array:
        """Relative Young's modulus of the quadrature points, (P,)."""
        return self.factors_at(self.quadrature.points)

    @property
    def points(self) -> Array:
        """Where motions are compared [m], (P, 3)."""
        return self.quadrature.points

    @property
    def weights(self) -> Array:
        """What these count, (P,)."""
        return self.quadrature.weights

    @property
    def down(self) -> Array:
        """Direction of gravity, towards the held side."""
        return -np.eye(3)[self.voxels.axis]

    def gauss(self, cells: NDArray[np.intp]) -> tuple[Array, Array]:
        """Return two Gauss points per axis of cells (C, 3 indices): points [m] (8 C, 3), volumes [m^3] (8 C,)."""
        size = self.voxels.cell
        corner = np.stack([self.voxels.lines[d][cells[:, d]] for d in range(3)], axis=1)
        at = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
        offset = np.stack(np.meshgrid(at, at, at, indexing="ij"), axis=-1).reshape(-1, 3) * size
        return (corner[:, None] + offset).reshape(-1, 3), np.full(8 * len(cells), size.prod() / 8.0)

    def grip(self, condition: str) -> Grip:
        """Return the springs of a condition, and what moves them."""
        cells, size = np.argwhere(self.voxels.filled), self.voxels.cell
        if condition == "fix":
            parts = [(cells[cells[:, self.voxels.axis] == 0], np.zeros(3))]
        elif condition == "boundary":
            axis = int(np.argmax(np.ptp(cells, axis=0) * size))
            along, away = cells[:, axis], PULL * np.eye(3)[axis]
            parts = [(cells[along == along.min()], -away), (cells[along == along.max()], away)]
        else:
            centre = np.stack([self.voxels.lines[d][cells[:, d]] + 0.5 * size[d] for d in range(3)], axis=1)
            middle = centre.mean(axis=0)
            surface = self.voxels.quadrature(1000).surface_points
            first = int(((surface - middle) ** 2).sum(axis=1).argmax())
            parts = []
            for k in sample_farthest(surface, 4, first=first):
                near = np.linalg.norm((centre - surface[k]) / size, axis=1) < 1.2
                out = surface[k] - middle
                parts.append((cells[near], PULL * out / np.linalg.norm(out)))
        pieces = [self.gauss(found) for found, _ in parts]
        return Grip(
            points=np.concatenate([points for points, _ in pieces]),
            stiffness=np.concatenate([volumes for _, volumes in pieces])
            * (SPRINGS * self.youngs_modulus / size.max() ** 2),
            pull=np.concatenate([np.tile(p, (len(x), 1)) for (x, _), (_, p) in zip(pieces, parts, strict=True)]),
            gravity=GRAVITY if condition == "fix" else 0.0,
            part=np.repeat(np.arange(len(pieces)), [len(points) for points, _ in pieces]),
        )

    def regions(self, grip: Grip) -> tuple[Region, ...]:
        """Return the held parts as soft regions of a build."""
        size = self.voxels.cell.max()
        return tuple(
            Region(
                name=f"part {k}", points=grip.points[grip.part == k], radius=0.25 * size, stiffness=SPRINGS / size**2
            )
            for k in range(grip.part.max() + 1)
        )

    def factors_at(self, points: Array) -> Array:
        """Return E over the object's at points inside the cells [m], (N, 3)."""
        table = np.ones(self.voxels.filled.shape)
        table[self.voxels.filled] = self.factors
        index = [np.searchsorted(self.voxels.lines[d], points[:, d], side="right") - 1 for d in range(3)]
        return table[tuple(index)]


def make_thing(name: str, *, several: bool = False, limit: int = ELEMENT_LIMIT) -> Thing:
    """Voxelise an object of the tests, of newton or of the oracle."""
    if name in SHAPES:
        shape = SHAPES[name]
    else:
        bricks = SOLIDS[name]()
        shape = Shape(name=name, source="mesh", geometry=bricks.surface, axis=0)
    voxels, count = voxelise(shape, 14), 14
    while voxels.filled.sum() > limit and count > 6:
        count -= 1
        voxels = voxelise(shape, count)
    longest = max(line[-1] - line[0] for line in voxels.lines)
    lines = tuple((line - line[0]) / longest for line in voxels.lines)
    voxels = dataclasses.replace(voxels, lines=lines)  # type: ignore[arg-type]
    cells = np.argwhere(voxels.filled)
    factors, youngs_modulus = np.ones(len(cells)), 1.0e5 if name in ORGANIC else 1.0e8
    if several:
        axis = int(np.argmax(voxels.filled.shape * voxels.cell))
        factors = np.array(THIRDS)[3 * cells[:, axis] // voxels.filled.shape[axis]]
        youngs_modulus = 1.0e6
    return Thing(name=name, voxels=voxels, youngs_modulus=youngs_modulus, factors=factors)


def fem_motion(thing: Thing, grip: Grip, points: Array, steps: int, folder: Path | None) -> Array:
    """Return the displacements [m] of rest points (P, 3) by finite elements, (steps, P, 3), made or stored."""
    mesh = Mesh(thing.voxels.lines, thing.voxels.filled)
    key = fingerprint_of(1, list(thing.voxels.lines), thing.voxels.filled, thing.youngs_modulus, thing.factors)
    path = folder / f"{fingerprint_of(key, grip, POISSONS_RATIO, DENSITY, DT, steps)}.npy" if folder else None
    if path and path.exists():
        frames = np.load(path).astype(np.float64)
    else:
        frames = _simulate_fem(thing, grip, mesh, steps)
        if path:
            with whole_file(path) as file:
                np.save(file, frames.astype(np.float32))
    matrix = mesh.interpolation(points)
    return np.stack([matrix @ frame for frame in frames])


def _simulate_fem(thing: Thing, grip: Grip, mesh: Mesh, steps: int) -> Array:
    """Step the elements by implicit Euler; return nodal displacements [m], (steps, N, 3)."""
    solid = Solid(
        mesh,
        energy="stable_neo_hookean",
        youngs_modulus=thing.youngs_modulus * thing.factors[:, None],
        poissons_ratio=POISSONS_RATIO,
        density=DENSITY,
    )
    return np.array(list(stepped(mesh, solid, grip, thing.down, steps)))


def reduced_motion(
    thing: Thing | MeshThing, grip: Grip, body: ReducedBody, points: Array, steps: int
) -> tuple[Array, float, int]:
    """Return softmode's displacements (steps, P, 3) [m], processor time per step [ms] and status bits."""
    material = Material(
        model=MaterialModel.STABLE_NEO_HOOKEAN,
        youngs_modulus=thing.youngs_modulus,
        poissons_ratio=POISSONS_RATIO,
        density=DENSITY,
        viscosity=0.0,
        mass_damping=0.0,
    )

    def place(builder: Any) -> None:
        instance = add_reduced_body(builder, body, material=material, position=body.offset.tolist())
        add_pins(builder, instance, grip.points - body.offset, stiffness=grip.stiffness, targets=grip.points)

    options = SolverReducedOptions(contact_max=1, keep_spin=False)
    scene = Scene(place, [body], gravity=(grip.gravity * thing.down).tolist(), options=options, dt=DT)
    basis, rest = body.evaluate(points - body.offset)[0], scene.q()
    frames, clock = [], []
    for n in range(1, steps + 1):
        scene.control.softmode.pin_target.assign(grip.targets(n, steps))
        start = time.process_time()
        scene.step()
        clock.append(1e3 * (time.process_time() - start))
        frames.append(basis @ (scene.q() - rest))
    return np.array(frames), float(np.median(clock)), int(scene.reduced.status.numpy()[0])


@dataclass(frozen=True, kw_only=True)
class Error:
    """Distance of a motion from the reference, of an object of longest edge one."""

    mse: float
    """Mean of |x - x_FEM|^2 over points and frames."""
    worst_frame: float
    """Mean over points in the worst frame."""
    largest: float
    """Largest |x - x_FEM| of any point in any frame."""
    moved: float
    """Mean of |u_FEM|^2, for scale."""


def compare(found: Array, expected: Array, weights: Array) -> Error:
    """Compare two motions (T, P, 3) [m] at points of volumes (P,)."""
    square = ((found - expected) ** 2).sum(axis=2)
    share = weights / weights.sum()
    return Error(
        mse=float((square @ share).mean()),
        worst_frame=float((square @ share).max()),
        largest=float(np.sqrt(square.max())),
        moved=float(((expected**2).sum(axis=2) @ share).mean()),
    )


def run_thing(thing: Thing | MeshThing, bases: dict[str, Basis], motion: Motion, steps: int = STEPS) -> dict[str, Any]:
    """Run all conditions of an object with every basis; return a record.

    Args:
        thing: The object.
        bases: Options of a build, or what makes a body, by label.
        motion: Gives the reference's displacements at the object's points, (steps, P, 3).
        steps: Number of steps.
    """
    bodies = {}
    record: dict[str, Any] = {
        "name": thing.name,
        "elements": len(thing.factors),
        "several": len(set(thing.factors)) > 1,
        "youngs_modulus": thing.youngs_modulus,
        "rows": [],
    }

    def built(options: BuildOptions, regions: Sequence[Region] = ()) -> ReducedBody:
        given = {"regions": regions, "stiffness_scale": thing.stiffness, "name": thing.name, "progress": False}
        return build_body(thing.quadrature, options, **given)

    for label, basis in bases.items():
        start = time.process_time()
        bodies[label] = built(basis) if isinstance(basis, BuildOptions) else basis(thing)
        record[f"seconds {label}"] = time.process_time() - start
    for condition in CONDITIONS:
        grip = thing.grip(condition)
        start = time.process_time()
        try:
            expected = motion(condition, grip)
        except ConvergenceError as error:
            print(f"{thing.name:<18}{len(thing.factors):>5} {condition:<10} no reference: {error}", flush=True)
            record["no_reference"] = [*record.get("no_reference", []), condition]
            continue
        fem_seconds = time.process_time() - start
        line, moved = f"{thing.name:<18}{len(thing.factors):>5} {condition:<10}", 0.0
        start = time.process_time()
        told = built(TOLD, thing.regions(grip))
        record[f"seconds {TOLD_LABEL}"] = time.process_time() - start
        for label, body in (bodies | {TOLD_LABEL: told}).items():
            found, milliseconds, status = reduced_motion(thing, grip, body, thing.points, steps)
            error = compare(found, expected, thing.weights)
            row = {"condition": condition, "basis": label, "unknowns": 3 * body.function_count, "ms": milliseconds}
            record["rows"].append(row | {"status": status, "fem_seconds": fem_seconds} | dataclasses.asdict(error))
            moved = error.moved
            line += f" {error.mse:>9.1e} {error.largest:>8.1e}" + (f" (status {status})" if status else "")
        print(line + f"   moved {moved:.1e}, FEM {fem_seconds:.0f} s", flush=True)
    return record


def run_objects(
    stored: list[dict[str, Any]], save: Callable[[list[dict[str, Any]]], Any], *, quick: bool = False
) -> list[dict[str, Any]]:
    """Run all objects that are not stored yet; `save` is called after each."""
    bases: dict[str, Basis] = {
        "FreeForm m = 16": affine(16, rank_tolerance=FINE_RANK),
        "default, 48": BuildOptions(poissons_ratio=POISSONS_RATIO),
    }
    work = [(name, False) for name in (*ORGANIC, *HARD)] + [(name, True) for name in HETEROGENEOUS]
    if quick:
        work = [("dumbbell", False), ("dumbbell", True)]
    steps = 10 if quick else STEPS
    print(f"{'object':<18}{'cells':>5} {'condition':<10}", *[f"{label:>18}" for label in (*bases, TOLD_LABEL)])
    for name, several in work:
        if not any(r["name"] == name and r["several"] == several for r in stored):
            thing = make_thing(name, several=several)

            def motion(_: str, grip: Grip, thing: Thing = thing) -> Array:
                return fem_motion(thing, grip, thing.points, steps, Path("out/freeform_fem"))

            stored = [*stored, run_thing(thing, bases, motion, steps)]
            save(stored)
    return stored


def run_meshes(
    folder: Path,
    stored: list[dict[str, Any]],
    save: Callable[[list[dict[str, Any]]], Any],
    *,
    references: References,
    networks: Path | None = None,
    quick: bool = False,
) -> list[dict[str, Any]]:
    """Run the meshes of a folder that are not stored yet; `save` is called after each.

    Args:
        folder: The meshes.
        stored: Records that there are.
        save: Takes all records.
        references: Where references are stored.
        networks: Simplicits' weights by name of the mesh, of `python -m benchmarks.freeform.simplicits`.
        quick: A few steps of the first mesh.
    """
    steps = 3 if quick else STEPS
    for thing in read_folder(folder)[: 1 if quick else None]:
        if any(record["name"] == thing.name for record in stored):
            continue
        bases = dict(EQUAL)
        if networks is not None and (found := simplicits.stored_body(networks, thing.name)) is not None:
            bases["Simplicits m = 16"] = found
        record = run_thing(thing, bases, lambda condition, _, t=thing: references.motion(t, condition, steps), steps)
        stored = [*stored, record]
        save(stored)
    return stored


def means(records: list[dict[str, Any]], several: bool) -> dict[tuple[str, str], dict[str, float]]:
    """Return the mean errors over objects by basis and condition."""
    found: dict[tuple[str, str], list[dict[str, float]]] = {}
    for record in records:
        if record["several"] == several:
            for row in record["rows"]:
                found.setdefault((row["basis"], row["condition"]), []).append(row)
    keys = ("mse", "worst_frame", "largest", "unknowns", "ms", "moved")
    return {pair: {key: float(np.mean([row[key] for row in rows])) for key in keys} for pair, rows in found.items()}


def wins(records: list[dict[str, Any]], basis: str, other: str) -> dict[str, str]:
    """Return by condition in how many objects, and of how many, the nMSE of a basis is not larger than another's."""
    found = {}
    for condition in CONDITIONS:
        mse = {
            (record["name"], row["basis"]): row["mse"]
            for record in records
            for row in record["rows"]
            if row["condition"] == condition
        }
        names = [name for name, label in mse if label == other]
        found[condition] = f"{sum(mse[name, basis] <= mse[name, other] for name in names)} of {len(names)}"
    return found
