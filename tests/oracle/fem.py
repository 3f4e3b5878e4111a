"""Finite elements: 27-node hexahedra, total Lagrangian, implicit Euler or BDF2, Newton with line search.

Independent of softmode on purpose: own shape functions, own energies (written from the closed forms), own assembly and
its own direct solver. Quadratic elements, because linear ones lock at nu = 0.45. Everything is float64.

The tangent is exact; where it is not positive definite, that iteration uses the one whose 9 x 9 point blocks are
projected. Nodes are numbered along the longest axis, so that a banded Cholesky factorisation is short.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, sparse
from scipy.sparse import linalg as sparse_linalg
from scipy.spatial import KDTree

from tests.oracle.scenes import TOLERANCE, EnergyName, Lines, Scene

Array = NDArray[np.float64]
Mapping = Callable[[Array], Array]

BAND_LIMIT = 250_000_000
"""Largest banded matrix [entries] before the sparse LU takes over."""
ITERATION_MAX = 60
_EPSILON = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _EPSILON[_i, _j, _k], _EPSILON[_i, _k, _j] = 1.0, -1.0
_COFACTOR_DERIVATIVE = np.einsum("ijn,klm->ikjlnm", _EPSILON, _EPSILON).reshape(81, 9)
"""d cof(F)_ik / dF_jl = eps_ijn eps_klm F_nm."""


class ConvergenceError(RuntimeError):
    """Newton did not converge."""


# -- energies ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Energy:
    """Psi = m/2 (I_C - 3) + l/2 (J - a)^2 - l/2 (1 - a)^2 [- m/2 ln((I_C + 1) / 4)], per point; I_C = tr F^T F.

    `stable_neo_hookean`: m = mu, l = lambda + mu, a = 1 + m/l, without the logarithm (FreeForm eq. 16 with mu/2).
    `stable_neo_hookean_log`: m = 4/3 mu, l = lambda + 5/6 mu, a = 1 + 3/4 m/l (Smith, de Goes, Kim 2018).
    """

    m: Array
    """[Pa], shape (...,)."""
    l: Array
    """[Pa], shape (...,)."""
    a: Array
    """Rest value of J that the volume term alone would have, shape (...,)."""
    log: bool

    @classmethod
    def make(cls, name: EnergyName, youngs_modulus: ArrayLike, poissons_ratio: float) -> Energy:
        """Return the energy of a material, E [Pa] of any shape."""
        E, nu = np.asarray(youngs_modulus, float), poissons_ratio
        mu, lam = E / (2.0 * (1.0 + nu)), E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
        if name == "stable_neo_hookean":
            return cls(mu, lam + mu, 1.0 + mu / (lam + mu), False)
        if name == "stable_neo_hookean_log":
            m, l = 4.0 / 3.0 * mu, lam + 5.0 / 6.0 * mu
            return cls(m, l, 1.0 + 0.75 * m / l, True)
        raise ValueError(f"energy: unknown {name!r}")

    def value(self, F: Array) -> Array:
        """Return Psi [J/m^3] at F (..., 3, 3)."""
        trace, J = np.einsum("...ij,...ij->...", F, F), np.linalg.det(F)
        psi = 0.5 * self.m * (trace - 3.0) + 0.5 * self.l * ((J - self.a) ** 2 - (1.0 - self.a) ** 2)
        return psi - 0.5 * self.m * np.log((trace + 1.0) / 4.0) if self.log else psi

    def stress(self, F: Array) -> Array:
        """Return the first Piola-Kirchhoff stress [Pa] at F, (..., 3, 3)."""
        C = cofactor(F)
        J = np.einsum("...j,...j->...", F[..., 0, :], C[..., 0, :])
        return self._shear(F)[..., None, None] * F + (self.l * (J - self.a))[..., None, None] * C

    def hessian(self, F: Array) -> Array:
        """Return d^2 Psi / dF^2 [Pa], (..., 9, 9), rows of F one after another."""
        C = cofactor(F)
        J = np.einsum("...j,...j->...", F[..., 0, :], C[..., 0, :])
        flat, c = F.reshape(*F.shape[:-2], 9), C.reshape(*F.shape[:-2], 9)
        H = (flat @ _COFACTOR_DERIVATIVE.T).reshape(*F.shape[:-2], 9, 9)
        H *= (self.l * (J - self.a))[..., None, None]
        H += (self.l[..., None] * c)[..., :, None] * c[..., None, :]
        if self.log:
            trace = np.einsum("...i,...i->...", flat, flat)
            H += (2.0 * self.m / (trace + 1.0) ** 2)[..., None, None] * (flat[..., :, None] * flat[..., None, :])
        H[..., range(9), range(9)] += self._shear(F)[..., None]
        return H

    def _shear(self, F: Array) -> Array:
        if not self.log:
            return self.m
        return self.m * (1.0 - 1.0 / (np.einsum("...ij,...ij->...", F, F) + 1.0))


@dataclass(frozen=True)
class Damped:
    """An energy and what a solid of Kelvin and Voigt loses in a step: tau/h [mu D:D + l/2 tr(D)^2], D = E - E_before.

    E is Green's strain, so that the stress is tau C : dE/dt, with dE/dt = D / h and Hooke's C.
    """

    elastic: Energy
    mu: Array
    """tau/h mu [Pa], of the quadrature points."""
    lam: Array
    """tau/h lambda [Pa], likewise."""
    before: Array
    """E_before, shape (..., 3, 3)."""

    def _change(self, F: Array) -> tuple[Array, Array]:
        """Return D and the stress S = 2 mu D + lambda tr(D) I."""
        D = strain(F) - self.before
        S = 2.0 * self.mu[..., None, None] * D
        S[..., range(3), range(3)] += (self.lam * np.trace(D, axis1=-2, axis2=-1))[..., None]
        return D, S

    def value(self, F: Array) -> Array:
        """Return the density [J/m^3] at F (..., 3, 3)."""
        D, S = self._change(F)
        return self.elastic.value(F) + 0.5 * np.einsum("...ij,...ij->...", D, S)

    def stress(self, F: Array) -> Array:
        """Return its derivative [Pa], likewise."""
        return self.elastic.stress(F) + F @ self._change(F)[1]

    def hessian(self, F: Array) -> Array:
        """Return its second derivative [Pa], (..., 9, 9)."""
        eye, S = np.eye(3), self._change(F)[1]
        flat, left = F.reshape(*F.shape[:-2], 9), F @ F.swapaxes(-1, -2)
        H = np.einsum("ik,...jl->...ijkl", eye, S)
        H += self.mu[..., None, None, None, None] * (
            np.einsum("...ik,jl->...ijkl", left, eye) + np.einsum("...il,...kj->...ijkl", F, F)
        )
        found = H.reshape(*F.shape[:-2], 9, 9) + self.elastic.hessian(F)
        return found + (self.lam[..., None] * flat)[..., :, None] * flat[..., None, :]


def strain(F: Array) -> Array:
    """Return Green's strain (F^T F - I) / 2, (..., 3, 3)."""
    return 0.5 * (F.swapaxes(-1, -2) @ F - np.eye(3))


def cofactor(F: Array) -> Array:
    """Return J F^-T, (..., 3, 3)."""
    C = np.empty_like(F)
    for i in range(3):
        C[..., i, :] = np.cross(F[..., (i + 1) % 3, :], F[..., (i + 2) % 3, :])
    return C


# -- mesh --------------------------------------------------------------------------------------------------------------


def shape_functions(local: Array) -> tuple[Array, Array]:
    """Return the 27 triquadratic Lagrange functions and their local gradients at points of [-1, 1]^3.

    Args:
        local: Points (Q, 3).

    Returns:
        Values (Q, 27) and gradients (Q, 27, 3); node (i, j, k) of the 3 x 3 x 3 grid has index 9 i + 3 j + k.
    """
    t = local[:, :, None]
    value = np.concatenate([0.5 * t * (t - 1.0), 1.0 - t * t, 0.5 * t * (t + 1.0)], axis=2)  # (Q, 3 axes, 3 nodes)
    slope = np.concatenate([t - 0.5, -2.0 * t, t + 0.5], axis=2)
    factors = [[slope if d == e else value for e in range(3)] for d in range(3)]
    product = "qi,qj,qk->qijk"
    N = np.einsum(product, value[:, 0], value[:, 1], value[:, 2]).reshape(-1, 27)
    dN = [np.einsum(product, f[0][:, 0], f[1][:, 1], f[2][:, 2]).reshape(-1, 27) for f in factors]
    return N, np.stack(dN, axis=2)


class Mesh:
    """Hexahedra on the solid cells of a tensor grid, optionally mapped; 27 Gauss points each, or those of a subclass.

    Args:
        lines: Grid lines of the three axes in reference coordinates [m].
        solid: Which cells hold an element, (nx, ny, nz).
        to_rest: Maps reference coordinates (N, 3) to the rest shape; identity when None. Must be triquadratic at most
            within an element to be represented exactly.
        to_reference: Its inverse.
    """

    reach = 0.05
    """How far a point may lie outside of its element, over half of the largest edge."""

    def __init__(
        self,
        lines: Lines,
        solid: NDArray[np.bool_],
        to_rest: Mapping | None = None,
        to_reference: Mapping | None = None,
    ) -> None:
        """Number the nodes."""
        self.to_reference: Mapping = to_reference or (lambda x: x)
        fine = [_with_middles(line) for line in lines]
        cell = np.argwhere(solid)
        shape = tuple(len(f) for f in fine)
        offset = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), axis=-1).reshape(27, 3)
        grid = np.ravel_multi_index(tuple((2 * cell[:, None] + offset).transpose(2, 0, 1)), shape)
        used, elements = np.unique(grid, return_inverse=True)
        elements = elements.reshape(-1, 27)
        index = np.stack(np.unravel_index(used, shape), axis=1)
        # Along the axes, longest slowest, makes a short band; reverse Cuthill-McKee is a third shorter on an L, but its
        # order depends on the processor, and stored frames do not.
        order = np.lexsort(tuple(index[:, d] for d in np.argsort(np.ptp(index, axis=0), kind="stable")))
        rank = np.empty(len(order), int)
        rank[order] = np.arange(len(order))
        self.elements = rank[elements]
        """Nodes of every element, (E, 27)."""
        self.reference_nodes = np.stack([fine[d][index[order, d]] for d in range(3)], axis=1)
        self.nodes = to_rest(self.reference_nodes) if to_rest else self.reference_nodes
        """Rest positions [m], (N, 3)."""
        self.lower = np.stack([lines[d][cell[:, d]] for d in range(3)], axis=1)
        self.upper = np.stack([lines[d][cell[:, d] + 1] for d in range(3)], axis=1)
        point, weight = np.polynomial.legendre.leggauss(3)
        local = np.stack(np.meshgrid(point, point, point, indexing="ij"), axis=-1).reshape(27, 3)
        self.values, slope = shape_functions(local)
        jacobian = np.einsum("eai,qaj->eqij", self.nodes[self.elements], slope, optimize=True)
        self.weights = np.linalg.det(jacobian) * np.einsum("i,j,k->ijk", weight, weight, weight).ravel()
        """Quadrature weights [m^3], (E, 27)."""
        if not (self.weights > 0.0).all():
            raise ValueError("mesh: an element is inverted")
        self.gradients = np.ascontiguousarray(
            np.einsum("qaj,eqji->eqai", slope, np.linalg.inv(jacobian), optimize=True)
        )
        """Gradients of the shape functions at the quadrature points [1/m], (E, 27 points, 27 nodes, 3)."""
        self.points = np.einsum("qa,eai->eqi", self.values, self.nodes[self.elements], optimize=True)
        """Quadrature points [m], (E, 27, 3)."""

    @classmethod
    def of(cls, scene: Scene, cell: float | None = None) -> Mesh:
        """Mesh a scene's shape with elements of about `cell` [m] (the scene's own when None)."""
        breaks = tuple(c.region for c in scene.clamps) + tuple(i.region for i in scene.inclusions)
        lines, solid = scene.shape.cells(cell or scene.cell, breaks, scene.grading)
        return cls(lines, solid, scene.shape.to_rest, scene.shape.to_reference)

    def interpolation(self, points: ArrayLike) -> sparse.csr_matrix:
        """Return the matrix (P, N) that takes nodal values to rest points (P, 3) [m].

        A point outside takes the nearest element, whose functions go on beyond it: quadrature points of a cell that a
        sloping face cuts may lie a twentieth of half a cell outside.
        """
        x = self.to_reference(np.asarray(points, float))
        centre, half = 0.5 * (self.lower + self.upper), 0.5 * (self.upper - self.lower)
        near = KDTree(centre).query(x, k=min(12, len(centre)))[1].reshape(len(x), -1)
        excess = (np.abs(x[:, None] - centre[near]) - half[near]).max(axis=2)
        best = near[np.arange(len(x)), excess.argmin(axis=1)]
        if excess.min(axis=1).max() > self.reach * half.max():
            raise ValueError(f"points: row {int(excess.min(axis=1).argmax())} lies outside the mesh")
        values = shape_functions((x - centre[best]) / half[best])[0]
        rows = np.repeat(np.arange(len(x)), 27)
        return sparse.csr_matrix((values.ravel(), (rows, self.elements[best].ravel())), shape=(len(x), len(self.nodes)))


def _with_middles(line: Array) -> Array:
    out = np.empty(2 * len(line) - 1)
    out[::2], out[1::2] = line, 0.5 * (line[1:] + line[:-1])
    return out


# -- solid -------------------------------------------------------------------------------------------------------------


class Solid:
    """A mesh with a material: energy, forces, tangent, mass.

    Args:
        mesh: The mesh.
        energy: Name of the energy density.
        youngs_modulus: E [Pa], one number or one per quadrature point (E, 27).
        poissons_ratio: nu.
        density: rho [kg/m^3], one number or one per quadrature point (E, 27).
    """

    def __init__(
        self,
        mesh: Mesh,
        *,
        energy: EnergyName = "stable_neo_hookean",
        youngs_modulus: ArrayLike,
        poissons_ratio: float,
        density: ArrayLike = 1000.0,
    ) -> None:
        """Integrate what stays constant."""
        self.mesh = mesh
        points = mesh.weights.shape
        self.energy: Energy | Damped = Energy.make(energy, np.broadcast_to(youngs_modulus, points), poissons_ratio)
        modulus = np.broadcast_to(youngs_modulus, points) / (1.0 + poissons_ratio)
        self.hooke = 0.5 * modulus, modulus * poissons_ratio / (1.0 - 2.0 * poissons_ratio)
        """mu and lambda [Pa] of the quadrature points."""
        self.mass = self.gram(np.broadcast_to(density, mesh.weights.shape))
        """Mass matrix of one component [kg], (N, N)."""
        nodes = mesh.elements
        dof = (3 * nodes[:, :, None] + np.arange(3)).reshape(len(nodes), 81)
        row, column = np.repeat(dof, 81, axis=1).ravel(), np.tile(dof, (1, 81)).ravel()
        self._lower = np.flatnonzero(row >= column)
        self._row, self._column = row[self._lower], column[self._lower]
        self.size = 3 * len(mesh.nodes)
        self.band = int((self._row - self._column).max())
        self.banded = (self.band + 1) * self.size <= BAND_LIMIT

    @classmethod
    def of(cls, scene: Scene, cell: float | None = None) -> Solid:
        """Return the solid of a scene."""
        mesh = Mesh.of(scene, cell)
        centre = mesh.points[:, 13]  # the middle quadrature point decides, so that an interface stays sharp
        modulus = scene.youngs_modulus * scene.stiffness_scale(centre)[:, None]
        return cls(
            mesh,
            energy=scene.energy,
            youngs_modulus=modulus,
            poissons_ratio=scene.poissons_ratio,
            density=scene.density,
        )

    def gram(self, factor: ArrayLike) -> sparse.csr_matrix:
        """Return int factor N_a N_b dV as a sparse (N, N) matrix; factor per quadrature point (E, 27)."""
        mesh, count = self.mesh, len(self.mesh.nodes)
        weight = mesh.weights * factor
        at = "qa" if mesh.values.ndim == 2 else "eqa"
        block = np.einsum(f"eq,{at},{at[:-1]}b->eab", weight, mesh.values, mesh.values, optimize=True)
        row, column = np.repeat(mesh.elements, 27, axis=1), np.tile(mesh.elements, (1, 27))
        return sparse.csr_matrix((block.ravel(), (row.ravel(), column.ravel())), shape=(count, count))

    def inside(self, region: object) -> NDArray[np.bool_]:
        """Return which elements lie in a region (anything with `contains`, in reference coordinates)."""
        return region.contains(0.5 * (self.mesh.lower + self.mesh.upper))  # type: ignore[attr-defined]

    def deformation_gradient(self, x: Array) -> Array:
        """Return F at the quadrature points, (E, 27, 3, 3), of positions (N, 3)."""
        return np.matmul(x[self.mesh.elements].transpose(0, 2, 1)[:, None], self.mesh.gradients)

    def potential(self, x: Array) -> float:
        """Return the elastic energy [J]."""
        return float((self.mesh.weights * self.energy.value(self.deformation_gradient(x))).sum())

    def force(self, x: Array) -> Array:
        """Return the gradient of the elastic energy [N], (N, 3)."""
        mesh = self.mesh
        stress = self.energy.stress(self.deformation_gradient(x)) * mesh.weights[:, :, None, None]
        count = len(mesh.elements)
        G = mesh.gradients.transpose(0, 2, 1, 3).reshape(count, 27, -1)  # (e, a, q k)
        local = G @ stress.transpose(0, 1, 3, 2).reshape(count, -1, 3)
        out = np.empty_like(x)
        flat = mesh.elements.ravel()
        for c in range(3):
            out[:, c] = np.bincount(flat, weights=local[:, :, c].ravel(), minlength=len(x))
        return out

    def tangent(self, x: Array, *, project: bool = False) -> Array:
        """Return the second derivative of the elastic energy by elements [N/m], (E, 81, 81)."""
        mesh = self.mesh
        H = self.energy.hessian(self.deformation_gradient(x))
        if project:
            value, vector = np.linalg.eigh(H)
            H = (vector * np.maximum(value, 0.0)[..., None, :]) @ np.swapaxes(vector, -1, -2)
        H *= mesh.weights[:, :, None, None]
        count = len(mesh.elements)
        half = H.reshape(count, -1, 27, 3) @ mesh.gradients.transpose(0, 1, 3, 2)  # (e, q, [i k j], b)
        half = half.reshape(count, -1, 3, 3, 3, 27).transpose(0, 1, 3, 2, 4, 5).reshape(count, -1, 243)
        G = mesh.gradients.transpose(0, 2, 1, 3).reshape(count, 27, -1)
        K = (G @ half).reshape(count, 27, 3, 3, 27)  # (e, a, i, j, b)
        return K.transpose(0, 1, 2, 4, 3).reshape(count, 81, 81)

    def body_force(self, acceleration: ArrayLike) -> Array:
        """Return the nodal forces [N], (N, 3), of a uniform acceleration [m/s^2]."""
        return np.outer(self.mass @ np.ones(len(self.mesh.nodes)), np.asarray(acceleration, float))


# -- minimisation ------------------------------------------------------------------------------------------------------


class Minimiser:
    """Minimises U(x) + 1/2 tr x^T A x - b . x over the nodes that are not held.

    Args:
        solid: Gives U.
        quadratic: A, symmetric (N, N) [N/m], applied to each component: inertia and springs.
        held: Which nodes keep their positions, (N,).
    """

    def __init__(self, solid: Solid, quadratic: sparse.spmatrix, held: NDArray[np.bool_]) -> None:
        """Lay out the assembly."""
        self.solid, self.held = solid, held
        self.quadratic = sparse.csr_matrix(quadratic)
        free = np.repeat(~held, 3)
        keep = free[solid._row] & free[solid._column]
        self._entries = solid._lower[keep]
        row, column = solid._row[keep], solid._column[keep]
        pairs = sparse.tril(self.quadratic).tocoo()
        data, i, j = pairs.data, pairs.row, pairs.col
        rows = np.concatenate([3 * i + c for c in range(3)])
        columns = np.concatenate([3 * j + c for c in range(3)])
        keep = free[rows] & free[columns]
        self._fixed = np.flatnonzero(~free)
        self._shape = (solid.band + 1, solid.size)
        if solid.banded:
            self._slot = (row - column) * solid.size + column
            self._constant = np.zeros(self._shape)
            np.add.at(self._constant, (rows[keep] - columns[keep], columns[keep]), np.tile(data, 3)[keep])
            self._constant[0, self._fixed] = 1.0
        else:
            self._row, self._column = row, column
            lower = sparse.csc_matrix((np.tile(data, 3)[keep], (rows[keep], columns[keep])), shape=(solid.size,) * 2)
            lower += sparse.csc_matrix((np.ones(len(self._fixed)), (self._fixed,) * 2), shape=(solid.size,) * 2)
            self._constant = lower

    def direction(self, x: Array, gradient: Array) -> Array:
        """Return the Newton direction (N, 3)."""
        right = -gradient.ravel()
        right[self._fixed] = 0.0
        for project in (False, True):
            entries = self.solid.tangent(x, project=project).ravel()[self._entries]
            if self.solid.banded:
                band = np.bincount(self._slot, weights=entries, minlength=self._constant.size).reshape(self._shape)
                band += self._constant
                try:
                    factor = linalg.cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)
                except linalg.LinAlgError:
                    continue
                found = linalg.cho_solve_banded((factor, True), right, check_finite=False)
            else:
                lower = sparse.csc_matrix((entries, (self._row, self._column)), shape=(self.solid.size,) * 2)
                lower = lower + self._constant
                whole = lower + sparse.tril(lower, -1).T
                found = sparse_linalg.splu(whole, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(
                    right
                )
            if found @ right > 0.0:
                return found.reshape(-1, 3)
        raise ConvergenceError("no direction of descent")

    def __call__(self, x: Array, linear: Array, tolerance: float) -> tuple[Array, int]:
        """Minimise from x (N, 3) with b = `linear` (N, 3); stop once no node moves by more than `tolerance` [m].

        Newton converges quadratically, so the error left is far below the tolerance.

        Returns:
            Positions and the number of iterations.

        Raises:
            ConvergenceError: After too many iterations.
        """

        def potential(y: Array) -> float:
            Ay = self.quadratic @ y
            return self.solid.potential(y) + float(0.5 * (y * Ay).sum() - (y * linear).sum())

        for iteration in range(1, ITERATION_MAX + 1):
            gradient = self.solid.force(x) + self.quadratic @ x - linear
            step = self.direction(x, gradient)
            size = np.abs(step).max()
            if size < tolerance:
                return x + step, iteration
            start, slope, length = potential(x), float((gradient * step).sum()), 1.0
            # Near the solution the change of the potential drowns in rounding: steps of 1e4 tolerances are taken.
            while size * length > 1e4 * tolerance and potential(x + length * step) > start + 1e-4 * length * slope:
                length *= 0.5
            x = x + length * step
        raise ConvergenceError(f"Newton: step {size:.1e} m after {ITERATION_MAX} iterations")


# -- experiments -------------------------------------------------------------------------------------------------------


def simulate(
    scene: Scene,
    *,
    cell: float | None = None,
    substeps: int = 1,
    bdf2: bool = False,
    viscosity: float = 0.0,
    tolerance: float = 1e-6,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Solid, Array]:
    """Run a scene.

    Args:
        scene: The scene.
        cell: Mean edge of the elements [m]; the scene's own when None.
        substeps: Steps per step of the scene (for a reference converged in time).
        bdf2: Second-order backward differences instead of implicit Euler; the first step is implicit Euler.
        viscosity: tau [s] of the stress tau C : dE/dt, see `Damped`.
        tolerance: Newton's, relative to the largest edge of the bounding box. The last step is below it, so that the
            error left is that step squared: about 1e-12 of the edge.
        progress: Receives (step, iterations).

    Returns:
        The solid, and displacements [m] at the steps of the scene, (steps + 1, N, 3).
    """
    solid = Solid.of(scene, cell)
    mesh, dt = solid.mesh, scene.dt / substeps
    held = np.zeros(len(mesh.nodes), bool)
    springs = sparse.csr_matrix(solid.mass.shape)
    exact, soft = [], []
    for clamp in scene.clamps:
        if clamp.stiffness is None:
            mine = clamp.region.contains(mesh.reference_nodes)
            exact.append((mine, clamp.motion))
            held |= mine
        else:
            spring = solid.gram(clamp.stiffness * solid.inside(clamp.region)[:, None] * np.ones((1, 27)))
            soft.append((spring, clamp.motion))
            springs = springs + spring
    weight = solid.body_force(scene.gravity)
    first = 1.0 / dt**2
    later = 9.0 / 4.0 / dt**2
    euler = Minimiser(solid, first * solid.mass + springs, held)
    second = Minimiser(solid, later * solid.mass + springs, held) if bdf2 else euler
    x, v = scene.initial_position(mesh.nodes), scene.initial_velocity(mesh.nodes)
    x_old, v_old = x, v
    frames = [x - mesh.nodes]
    elastic, e_old, e = solid.energy, np.zeros(1), strain(solid.deformation_gradient(x))
    for n in range(1, scene.steps * substeps + 1):
        time = n * dt
        multistep = bdf2 and n > 1
        if multistep:
            inertial = (4.0 * x - x_old) / 3.0 + 2.0 / 9.0 * dt * (4.0 * v - v_old)
        else:
            inertial = x + dt * v
        linear = (later if multistep else first) * (solid.mass @ inertial) + weight
        for spring, motion in soft:
            linear = linear + spring @ motion.position(mesh.nodes, time)
        if viscosity:
            per_step = viscosity * (1.5 if multistep else 1.0) / dt
            before = (4.0 * e - e_old) / 3.0 if multistep else e
            solid.energy = Damped(elastic, *(per_step * value for value in solid.hooke), before)  # type: ignore[arg-type]
        guess = x + dt * v
        for mine, motion in exact:
            guess[mine] = motion.position(mesh.nodes[mine], time)
        found, iterations = (second if multistep else euler)(guess, linear, tolerance * scene.edge)
        speed = (3.0 * found - 4.0 * x + x_old) / (2.0 * dt) if multistep else (found - x) / dt
        x_old, v_old, x, v = x, v, found, speed
        e_old, e = e, strain(solid.deformation_gradient(x))
        if n % substeps == 0:
            frames.append(x - mesh.nodes)
            if progress:
                progress(n // substeps, iterations)
    solid.energy = elastic
    return solid, np.array(frames)


def static(
    solid: Solid,
    *,
    held: NDArray[np.bool_],
    target: Array,
    force: Array | None = None,
    springs: sparse.spmatrix | None = None,
    spring_target: Array | None = None,
    load_steps: int = 1,
    start: Array | None = None,
    tolerance: float = 1e-8,
) -> Array:
    """Find an equilibrium.

    Args:
        solid: The solid.
        held: Nodes whose position is prescribed, (N,).
        target: Their positions [m], (N, 3); rows of free nodes are not read.
        force: Dead nodal forces [N], (N, 3).
        springs: Matrix of soft supports [N/m], (N, N), see `Solid.gram`.
        spring_target: Where the springs pull to [m], (N, 3); the rest positions when None.
        load_steps: Number of equal parts in which displacement and force are applied.
        start: Positions to start from; rest when None.
        tolerance: Newton's, relative to the largest edge of the bounding box.

    Returns:
        Positions [m], (N, 3).
    """
    rest = solid.mesh.nodes
    matrix = sparse.csr_matrix(solid.mass.shape) if springs is None else sparse.csr_matrix(springs)
    if springs is None and not held.any():
        raise ValueError("static: nothing holds the solid")
    minimiser = Minimiser(solid, matrix, held)
    pull = rest if spring_target is None else spring_target
    load = np.zeros_like(rest) if force is None else force
    x = rest.copy() if start is None else start.copy()
    begin = x[held].copy()
    for k in range(1, load_steps + 1):
        part = k / load_steps
        x[held] = begin + part * (target[held] - begin)
        linear = matrix @ (rest + part * (pull - rest)) + part * load
        x, _ = minimiser(x, linear, tolerance * float(np.ptp(rest, axis=0).max()))
    return x


def node_mask(mesh: Mesh, region: object) -> NDArray[np.bool_]:
    """Return which nodes lie in a region (anything with `contains`, in reference coordinates)."""
    return region.contains(mesh.reference_nodes)  # type: ignore[attr-defined]


__all__ = ["TOLERANCE", "ConvergenceError", "Energy", "Mesh", "Minimiser", "Solid", "node_mask", "simulate", "static"]


def free_eigenvalues(
    mesh: Mesh,
    poissons_ratio: ArrayLike,
    count: int = 6,
    *,
    stiffness: ArrayLike | None = None,
    density: ArrayLike | None = None,
) -> Array:
    """Return the first elastic eigenvalues of a free solid, see `free_modes`."""
    return free_modes(mesh, poissons_ratio, count, stiffness=stiffness, density=density)[0]


def free_modes(
    mesh: Mesh,
    poissons_ratio: ArrayLike,
    count: int = 6,
    *,
    stiffness: ArrayLike | None = None,
    density: ArrayLike | None = None,
) -> tuple[Array, Array]:
    """Return the first elastic eigenvalues of a free solid, per E / rho [1/m^2], ascending, and its modes (node, 3, .).

    A frequency is sqrt(value E / rho) / (2 pi). Linear elasticity, consistent mass; the six rigid motions are left out.

    Args:
        mesh: Elements of the solid.
        poissons_ratio: nu, of all elements or of each at its points, shape (element_count, 27).
        count: How many.
        stiffness: Relative Young's modulus of every element, (element_count,) or likewise; ones when None.
        density: Relative density, likewise.
    """
    K, M = linear_matrices(mesh, poissons_ratio, stiffness, density)
    shift = 1e-3 / np.ptp(mesh.nodes, axis=0).max() ** 2
    shifted = sparse_linalg.splu((K + shift * M).tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    inverse = sparse_linalg.LinearOperator(K.shape, matvec=shifted.solve, dtype=np.float64)
    start = np.random.default_rng(0).normal(size=K.shape[0])
    value, mode = sparse_linalg.eigsh(K, k=count + 6, M=M, sigma=-shift, OPinv=inverse, v0=start)
    order = np.argsort(value)[6:]
    return value[order], mode[:, order].reshape(len(mesh.nodes), 3, -1)


def spring_work(mesh: Mesh, poissons_ratio: float, held: NDArray[np.bool_], stiffness: float, load: ArrayLike) -> float:
    """Return the work [m^5] of a body force (3,) per E on a solid that springs hold, in linear elasticity.

    Args:
        mesh: Elements of the solid.
        poissons_ratio: nu.
        held: Which elements the springs hold, shape (element_count,).
        stiffness: Of the springs per volume and E [1/m^2].
        load: Force per volume and E [1/m].
    """
    K = linear_matrices(mesh, poissons_ratio)[0]
    springs = _mass(mesh, stiffness * held[:, None] * mesh.weights)
    force = np.outer(_mass(mesh, mesh.weights) @ np.ones(len(mesh.nodes)), load).ravel()
    whole = (K + sparse.kron(springs, sparse.identity(3))).tocsc()
    solved = sparse_linalg.splu(whole, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(force)
    return float(force @ solved)


def linear_matrices(
    mesh: Mesh, poissons_ratio: ArrayLike, stiffness: ArrayLike | None = None, density: ArrayLike | None = None
) -> tuple[sparse.csc_matrix, sparse.csc_matrix]:
    """Return the stiffness [m] per E of linear elasticity, and the mass [m^3] per density, both (3 N, 3 N)."""
    nu, G, w = np.asarray(poissons_ratio, dtype=np.float64), mesh.gradients, mesh.weights

    def per_point(values: ArrayLike | None) -> Array:
        found = np.ones(1) if values is None else np.asarray(values, dtype=np.float64)
        return w * (found if found.ndim == 2 else found[:, None])

    def products(weights: Array) -> Array:
        return np.einsum("eq,eqai,eqbj->eaibj", weights, G, G, optimize=True)

    scale = per_point(stiffness)
    shear = products(scale / (2.0 * (1.0 + nu)))
    block = products(scale * nu / ((1 + nu) * (1 - 2 * nu))) + shear.transpose(0, 1, 4, 3, 2)
    trace = np.einsum("eaibi->eab", shear)
    for i in range(3):
        block[:, :, i, :, i] += trace
    dof = (3 * mesh.elements[:, :, None] + np.arange(3)).reshape(len(mesh.elements), 81)
    row, column = np.repeat(dof, 81, axis=1).ravel(), np.tile(dof, (1, 81)).ravel()
    size = 3 * len(mesh.nodes)
    K = sparse.csc_matrix((block.ravel(), (row, column)), shape=(size, size))
    return K, sparse.csc_matrix(sparse.kron(_mass(mesh, per_point(density)), sparse.identity(3)))


def _mass(mesh: Mesh, weights: Array) -> sparse.csr_matrix:
    """Return sum_q w_q N_a N_b, (N, N), of weights at the quadrature points (E, 27)."""
    gram = np.einsum("eq,qa,qb->eab", weights, mesh.values, mesh.values, optimize=True)
    row, column = np.repeat(mesh.elements, 27, axis=1).ravel(), np.tile(mesh.elements, (1, 27)).ravel()
    return sparse.csr_matrix((gram.ravel(), (row, column)), shape=(len(mesh.nodes),) * 2)
