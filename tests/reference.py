"""Readable float64 twins of the device code, in NumPy: what a kernel computes, without how it does it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.deformables.materials.material_kernels import MaterialModel

I3 = np.eye(3)
TRANSPOSE = np.einsum("il,jk->ijkl", I3, I3)
"""dF^T/dF."""


def lame(youngs_modulus: float, poissons_ratio: float) -> tuple[float, float]:
    """Return mu = E / (2 (1 + nu)) and lambda = E nu / ((1 + nu) (1 - 2 nu)) [Pa]."""
    e, nu = youngs_modulus, poissons_ratio
    return e / (2.0 * (1.0 + nu)), e * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


def hooke(mu: float, lam: float) -> np.ndarray:
    """Return dP/dF (3, 3, 3, 3) of Hooke's law: mu (dF + dF^T) + lambda tr(dF) I."""
    identity = np.einsum("ik,jl->ijkl", I3, I3)
    return mu * (identity + TRANSPOSE) + lam * np.einsum("ij,kl->ijkl", I3, I3)


def cofactor(F: np.ndarray) -> np.ndarray:
    """Return cof F = dJ/dF, row i the cross product of the other two rows."""
    return np.stack([np.cross(F[..., (i + 1) % 3, :], F[..., (i + 2) % 3, :]) for i in range(3)], axis=-2)


LEVI_CIVITA = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    LEVI_CIVITA[_i, _j, _k], LEVI_CIVITA[_i, _k, _j] = 1.0, -1.0


def cofactor_derivative(F: np.ndarray) -> np.ndarray:
    """Return d(cof F)_ij / dF_kl = eps_ikm eps_jln F_mn."""
    return np.einsum("ikm,jln,...mn->...ijkl", LEVI_CIVITA, LEVI_CIVITA, F)


def hooke_moduli(model: MaterialModel, mu: float, lam: float) -> tuple[float, float]:
    """Return the moduli of Hooke's law that a model obeys at small strain: ARAP has no lambda."""
    return mu, 0.0 if model == MaterialModel.ARAP else lam


def rotation(F: np.ndarray) -> np.ndarray:
    """Return the rotation nearest to F: the polar factor, with the smallest singular value negated if det F < 0."""
    U, _, Vt = np.linalg.svd(F)
    U[..., :, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[..., None]
    return U @ Vt


def rotation_derivative(F: np.ndarray) -> np.ndarray:
    """Return dR_ij / dF_kl. With F = R S and R^T dR = [w]x: (tr(S) I - S) w = the axial vector of R^T dF - dF^T R."""
    R = rotation(F)
    S = np.swapaxes(R, -1, -2) @ F
    S = 0.5 * (S + np.swapaxes(S, -1, -2))
    axial = -np.einsum("mil,...ki->...mkl", LEVI_CIVITA, R)
    system = np.trace(S, axis1=-2, axis2=-1)[..., None, None] * I3 - S
    w = np.linalg.solve(system, axial.reshape(*axial.shape[:-2], 9)).reshape(axial.shape)
    return -np.einsum("...in,njm,...mkl->...ijkl", R, LEVI_CIVITA, w)


WITH_ROTATION = MaterialModel.ARAP, MaterialModel.COROTATED
"""Models with the term mu |F - R|^2."""


def _invariant_slopes(model: MaterialModel, ic: np.ndarray, j: np.ndarray, mu: float, lam: float) -> tuple[Any, ...]:
    """Return Psi and its derivatives (Psi_I, Psi_II, Psi_J, Psi_JJ) of the part that depends on I_C and J."""
    if model == MaterialModel.STABLE_NEO_HOOKEAN:
        j0 = 1 + mu / (lam + mu)
        psi = mu / 2 * (ic - 3) + (lam + mu) / 2 * ((j - j0) ** 2 - (1 - j0) ** 2)
        return psi, mu / 2, 0.0, (lam + mu) * (j - j0), lam + mu
    if model == MaterialModel.STABLE_NEO_HOOKEAN_LOG:
        m, bulk = 4 / 3 * mu, lam + 5 / 6 * mu
        j0 = 1 + m / bulk - m / (4 * bulk)
        psi = m / 2 * (ic - 3 - np.log((ic + 1) / 4)) + bulk / 2 * ((j - j0) ** 2 - (1 - j0) ** 2)
        return psi, m / 2 * (1 - 1 / (ic + 1)), m / (2 * (ic + 1) ** 2), bulk * (j - j0), bulk
    if model == MaterialModel.NEO_HOOKEAN:  # beyond its domain: infinite energy, the slopes at J = 1e-9
        inside = np.maximum(j, 1e-9)
        log = np.log(inside)
        psi = np.where(j > 0, mu / 2 * (ic - 3) - mu * log + lam / 2 * log**2, np.inf)
        return psi, mu / 2, 0.0, (lam * log - mu) / inside, (lam + mu - lam * log) / inside**2
    if model == MaterialModel.COROTATED:
        return lam / 2 * (j - 1) ** 2, 0.0, 0.0, lam * (j - 1), lam
    return 0.0 * j, 0.0, 0.0, 0.0 * j, 0.0


def energy(model: MaterialModel, F: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """Return Psi(F) [J/m^3]."""
    psi = _invariant_slopes(model, (F * F).sum(axis=(-2, -1)), np.linalg.det(F), mu, lam)[0]
    if model in WITH_ROTATION:
        psi = psi + mu * ((F - rotation(F)) ** 2).sum(axis=(-2, -1))
    if model == MaterialModel.STVK:
        E = green_strain(F)
        psi = mu * (E**2).sum(axis=(-2, -1)) + lam / 2 * np.trace(E, axis1=-2, axis2=-1) ** 2
    return psi


def stress(model: MaterialModel, F: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """Return P = dPsi/dF [Pa]."""
    shape = (..., None, None)
    _, d_i, _, d_j, _ = _invariant_slopes(model, (F * F).sum(axis=(-2, -1))[shape], np.linalg.det(F)[shape], mu, lam)
    P = 2 * d_i * F + d_j * cofactor(F)
    if model in WITH_ROTATION:
        P = P + 2 * mu * (F - rotation(F))
    if model == MaterialModel.STVK:
        P = F @ hooke_stress(green_strain(F), mu, lam)
    return P


def hessian(model: MaterialModel, F: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """Return dP/dF (..., 3, 3, 3, 3) [Pa], not projected."""
    shape = (..., None, None, None, None)
    _, d_i, d_ii, d_j, d_jj = _invariant_slopes(
        model, (F * F).sum(axis=(-2, -1))[shape], np.linalg.det(F)[shape], mu, lam
    )
    g = cofactor(F)
    identity = np.einsum("ik,jl->ijkl", I3, I3)
    H = (
        2 * d_i * identity
        + 4 * d_ii * np.einsum("...ij,...kl->...ijkl", F, F)
        + d_jj * np.einsum("...ij,...kl->...ijkl", g, g)
        + d_j * cofactor_derivative(F)
    )
    if model in WITH_ROTATION:
        H = H + 2 * mu * (identity - rotation_derivative(F))
    if model == MaterialModel.STVK:
        turning = np.einsum("ik,...lj->...ijkl", I3, hooke_stress(green_strain(F), mu, lam))
        H = turning + hooke_hessian(F, mu, lam)
    return H


def projected(H: np.ndarray) -> np.ndarray:
    """Return the nearest positive semidefinite 9x9 matrices."""
    matrix = H.reshape(*H.shape[:-4], 9, 9)
    value, vector = np.linalg.eigh(0.5 * (matrix + np.swapaxes(matrix, -1, -2)))
    return (vector * np.maximum(value, 0.0)[..., None, :]) @ np.swapaxes(vector, -1, -2)


def green_strain(F: np.ndarray) -> np.ndarray:
    """Return (F^T F - I) / 2."""
    return 0.5 * (np.swapaxes(F, -1, -2) @ F - I3)


def hooke_stress(E: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """Return 2 mu E + lambda tr(E) I [Pa]."""
    return 2 * mu * E + lam * np.trace(E, axis1=-2, axis2=-1)[..., None, None] * I3


def hooke_hessian(F: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """Return the derivative of F (2 mu E + lambda tr(E) I) where the bracket vanishes, (..., 3, 3, 3, 3) [Pa]."""
    left = np.einsum("...im,...km,jl->...ijkl", F, F, I3) + np.einsum("...il,...kj->...ijkl", F, F)
    return mu * left + lam * np.einsum("...ij,...kl->...ijkl", F, F)


def viscous_energy(
    F: np.ndarray, F_start: np.ndarray, mu: float, lam: float, viscosity: float, dt: float
) -> np.ndarray:
    """Return the dissipation potential of a step, tau / dt (mu |D|^2 + lambda/2 tr(D)^2), D = E - E_n [J/m^3]."""
    D = green_strain(F) - green_strain(F_start)
    return viscosity / dt * (mu * (D**2).sum(axis=(-2, -1)) + lam / 2 * np.trace(D, axis1=-2, axis2=-1) ** 2)


def viscous_stress(
    F: np.ndarray, F_start: np.ndarray, mu: float, lam: float, viscosity: float, dt: float
) -> np.ndarray:
    """Return its derivative, tau / dt F (2 mu D + lambda tr(D) I) [Pa]."""
    return viscosity / dt * F @ hooke_stress(green_strain(F) - green_strain(F_start), mu, lam)


def viscous_hessian(F: np.ndarray, mu: float, lam: float, viscosity: float, dt: float) -> np.ndarray:
    """Return its Hessian at E = E_n, shape (..., 3, 3, 3, 3) [Pa]."""
    return viscosity / dt * hooke_hessian(F, mu, lam)


def penalty(p: np.ndarray, eps: float) -> np.ndarray:
    """Return the C2 penalty of contact per unit stiffness."""
    p = np.maximum(p, 0.0)
    return np.where(p < eps, p**3 / (6 * eps), p * p / 2 - eps * p / 2 + eps * eps / 6)


def dented_penalty(penetration: np.ndarray, eps: float, ratio: float) -> np.ndarray:
    """Return the mean over gaps x in [0, eps] of min_v (p - x - v)^2 / 2 + v^2 / (2 ratio), by Gauss's rule.

    Of two springs in series, v the dent; nothing where p < x.
    """
    x, weight = np.polynomial.legendre.leggauss(8)
    p = np.maximum(np.asarray(penetration), 0.0)
    reach = np.minimum(p, eps)  # gaps beyond p are open
    deep = p[..., None] - 0.5 * reach[..., None] * (x + 1.0)
    v = ratio / (1.0 + ratio) * deep
    energy = 0.5 * (deep - v) ** 2 + (v**2 / (2.0 * ratio) if ratio else 0.0)
    return reach / eps * (0.5 * weight * energy).sum(axis=-1)


def normal_potential(
    penetration: np.ndarray,
    eps: float,
    ratio: float = 0.0,
    depth: float = 0.0,
    ridge: float = 0.0,
    ridge_lead: float = 0.0,
) -> np.ndarray:
    """Return the contact potential per unit stiffness: a dented penalty, one nine times as stiff from ``depth`` on.

    Edges of a box are a penalty of their own stiffness, ``ridge_lead`` deeper in, until the face presses as much; from
    there on both together are as stiff as the face.
    """
    left = 1.0 - ridge * (1.0 + ratio)
    face = left * dented_penalty(penetration - ridge * (1.0 + ratio) / left * ridge_lead, eps, ratio)
    edges = ridge * penalty(penetration + ridge_lead, eps)
    return face + edges + 9.0 * penalty(penetration - depth, 2.0 * eps)


def ridge_in_cell(
    half: np.ndarray, x: np.ndarray, inward: np.ndarray, area: float, reach: float, front: float
) -> tuple[float, float]:
    """Return the length of the edges of a box in a cell and how deep they are on the mean [m].

    Edge by edge: 0 to 1 of its length beside the sample by how far that is, and on it the part between both ends of the
    cell that is there and deep, of 2,001 points; an eighth of half the cell at least.
    """
    facing, away = np.maximum(np.where(x < 0.0, -inward, inward), 0.0), np.abs(x) - half
    lengths, depths = [], []
    for k in range(3):
        slopes, gaps = np.delete(facing, k), np.delete(away, k)
        steep = np.clip((slopes.min() / max(slopes.max(), 1e-12) - 0.3) / 0.7, 0.0, None)
        if steep > 0.0:
            far = reach / slopes.max()
            beside = abs(slopes[1] * gaps[0] - slopes[0] * gaps[1]) / np.linalg.norm(slopes)
            end = min(far, -away[k])
            place = np.linspace(-far, end, 2001) if end > -far else np.full(1, -far)
            deep = facing[k] * place - slopes @ gaps
            first = -far if facing[k] == 0.0 else place[deep > 0.0].min() if (deep > 0.0).any() else end
            wet = max(np.clip(end - first, far / 8.0, end + far), 0.0)
            lengths.append(np.linalg.norm(slopes) ** 3 * steep * max(1.0 - beside / far, 0.0) * area * wet / far**2 / 2)
            depths.append(deep[-1] - 0.5 * facing[k] * wet)
    total = sum(lengths)
    depth = float(np.dot(lengths, depths)) / total if total else 0.0
    return float(total * np.clip((front - 0.3) / 0.25, 0.0, 1.0)), depth


def friction_potential(y: np.ndarray, eps: float) -> np.ndarray:
    """Return f0 of Li et al. 2020, eq. (13): its slope rises smoothly from 0 to 1 over the stick range eps."""
    return np.where(y < eps, y * y / eps - y**3 / (3 * eps**2) + eps / 3, y)


def stick_potential(y: np.ndarray, limit: float, stiffness: float, deep: float, depth: float) -> np.ndarray:
    """Return the energy [J] of a spring that slips at the force limit: the integral of min(force, limit).

    The force is k y up to 0.15 of the dent, and grows by ``deep`` from there on.
    """
    bend = 0.15 * depth
    most = limit / stiffness if limit <= stiffness * bend else bend + (limit - stiffness * bend) / deep
    x = np.minimum(y, most)
    return 0.5 * stiffness * x**2 + 0.5 * (deep - stiffness) * np.maximum(x - bend, 0.0) ** 2 + limit * (y - x)


def contact_stiffness(
    body: ReducedBody, material: Material, dt: float, partner_mass: float = np.inf, partner_area: float = np.inf
) -> float:
    """Return the automatic contact stiffness per area [Pa/m].

    The largest of 150 M / L (P-wave modulus over size), 100 m_eff / (A dt^2) with 1/m_eff = 1/m + 1/m_partner and A the
    smaller surface, and 1e8.
    """
    E, nu = material.youngs_modulus, material.poissons_ratio
    wave = E * (1 - nu) / ((1 + nu) * (1 - 2 * nu))
    size = float(np.linalg.norm(np.ptp(body.bounds, axis=0)))
    mass = 1.0 / (1.0 / (material.density * body.volume) + 1.0 / partner_mass)
    area = min(float(body.surface.areas.sum()), partner_area)
    return max(150.0 * wave / size, 100.0 * mass / (area * dt**2), 1.0e8)


def distance_plane(x: np.ndarray) -> np.ndarray:
    """Return the signed distance to z = 0."""
    return x[..., 2]


def distance_sphere(x: np.ndarray, radius: float) -> np.ndarray:
    """Return the signed distance to a sphere."""
    return np.linalg.norm(x, axis=-1) - radius


def distance_capsule(x: np.ndarray, radius: float, half_height: float) -> np.ndarray:
    """Return the signed distance to a capsule along Z."""
    core = np.zeros_like(x)
    core[..., 2] = np.clip(x[..., 2], -half_height, half_height)
    return np.linalg.norm(x - core, axis=-1) - radius


def _distance_to_extents(excess: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.maximum(excess, 0.0), axis=-1) + np.minimum(excess.max(axis=-1), 0.0)


def distance_box(x: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Return the signed distance to a box."""
    return _distance_to_extents(np.abs(x) - half)


def distance_cylinder(x: np.ndarray, radius: float, half_height: float) -> np.ndarray:
    """Return the signed distance to a cylinder along Z."""
    return _distance_to_extents(
        np.stack([np.hypot(x[..., 0], x[..., 1]) - radius, np.abs(x[..., 2]) - half_height], axis=-1)
    )


def distance_cone(x: np.ndarray, radius: float, half_height: float) -> np.ndarray:
    """Return the signed distance to a cone along Z, apex up, from its profile in the half plane (rho, z)."""
    p = np.stack([np.hypot(x[..., 0], x[..., 1]), x[..., 2]], axis=-1)
    rim, apex, foot = np.array([radius, -half_height]), np.array([0.0, half_height]), np.array([0.0, -half_height])
    away = [_distance_to_segment(p, rim, apex), _distance_to_segment(p, foot, rim)]
    inside = (p[..., 1] > -half_height) & (p[..., 0] / radius < (half_height - p[..., 1]) / (2.0 * half_height))
    return np.where(inside, -1.0, 1.0) * np.minimum(*away)


def _distance_to_segment(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    t = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.linalg.norm(p - a - t[..., None] * (b - a), axis=-1)


def distance_ellipsoid(x: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the signed distance to an ellipsoid: bisection for s in x_i = y_i (1 + s / e_i^2), y on the surface."""
    z = np.maximum(np.abs(x), 1e-14)
    low, high = np.full(x.shape[:-1], -(axes.min() ** 2)), (axes * np.linalg.norm(x, axis=-1)[..., None]).max(axis=-1)
    for _ in range(200):
        middle = 0.5 * (low + high)
        outside = ((axes * z / (middle[..., None] + axes**2)) ** 2).sum(axis=-1) > 1.0
        low, high = np.where(outside, middle, low), np.where(outside, high, middle)
    y = axes**2 * z / (high[..., None] + axes**2)
    return np.sign(high) * np.linalg.norm(z - y, axis=-1)


def distance_mesh(x: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the signed distance of points (N, 3) to closed, outward oriented triangles (M, 3, 3).

    The nearest of all triangles; inside where the winding number (sum of solid angles, van Oosterom and Strackee 1983)
    exceeds one half.
    """
    out = np.empty(len(x))
    a, b, c = (triangles[:, k] for k in range(3))
    sides = ((a, b), (b, c), (c, a))
    normal = np.cross(b - a, c - a)
    for i, point in enumerate(x):
        edges = [_distance_to_segments(point, p, q) for p, q in sides]
        above = ((point - a) * normal).sum(axis=-1) / np.linalg.norm(normal, axis=-1)
        over = np.all([(np.cross(q - p, point - p) * normal).sum(axis=-1) > 0 for p, q in sides], axis=0)
        nearest = np.min([*edges, np.where(over, np.abs(above), np.inf)])
        u, v, w = a - point, b - point, c - point
        lu, lv, lw = (np.linalg.norm(k, axis=-1) for k in (u, v, w))
        bottom = lu * lv * lw + (u * v).sum(-1) * lw + (v * w).sum(-1) * lu + (w * u).sum(-1) * lv
        angle = 2.0 * np.arctan2((u * np.cross(v, w)).sum(axis=-1), bottom).sum()
        out[i] = -nearest if angle > 2.0 * np.pi else nearest
    return out


def _distance_to_segments(point: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    t = np.clip(((point - a) * (b - a)).sum(axis=-1) / ((b - a) ** 2).sum(axis=-1), 0.0, 1.0)
    return np.linalg.norm(point - a - t[:, None] * (b - a), axis=-1)


@dataclass(frozen=True, kw_only=True)
class Surface:
    """The deformed surface of a soft body as other bodies' samples see it, through its own samples."""

    body: ReducedBody
    q: np.ndarray
    """Coordinates (n, 3) [m]."""

    @cached_property
    def points(self) -> np.ndarray:
        """Samples (S, 3) [m]."""
        return self.body.surface.points + self.body.surface.basis.astype(float) @ self.q

    @cached_property
    def deformation_gradient(self) -> np.ndarray:
        """F at the samples, (S, 3, 3)."""
        gradients = self.body.evaluate(self.body.surface.points)[1]
        return I3 + np.einsum("kc,skd->scd", self.q, gradients)

    @cached_property
    def area_vectors(self) -> np.ndarray:
        """Areas times outward normals, A cof(F) N, (S, 3) [m^2]."""
        n = np.einsum("scd,sd->sc", cofactor(self.deformation_gradient), self.body.surface.normals)
        return self.body.surface.areas[:, None] * n

    @cached_property
    def normals(self) -> np.ndarray:
        """Outward unit normals, (S, 3)."""
        return self.area_vectors / np.linalg.norm(self.area_vectors, axis=1, keepdims=True)

    @property
    def spacing(self) -> float:
        """Spacing of the samples [m]."""
        return float(np.sqrt(self.body.surface.areas.mean()))

    def patch(self, x: np.ndarray, n: np.ndarray, radius: float) -> tuple[float, np.ndarray, np.ndarray, int] | None:
        """Return gap [m], normal, weights (S,) and nearest sample of the surface about a sample x with normal n.

        gap = sum w_k n_k . (x - x_k), w_k ~ exp(-|x - x_k|^2 / h^2) max(-n . n_k - 0.3, 0)^2, h = 3/4 spacing. None
        where there is no surface: no sample within ``radius`` looks at x, or x lies beside all of them.
        """
        distance = np.linalg.norm(x - self.points, axis=1)
        facing = -(self.normals @ n)
        looking = (distance <= radius) & (facing > 0.3)
        blade = not looking.any()
        if blade:
            looking = (distance <= radius) & (facing > -0.3)
        if not looking.any():
            return None
        nearest = int(np.argmin(np.where(looking, distance, np.inf)))
        exponent = (distance**2 - distance[nearest] ** 2) / (0.75 * self.spacing) ** 2
        around = self._around(nearest)
        looking = around & (facing > (-0.3 if blade else 0.3))
        w = np.where(looking & (exponent <= 9.0), np.exp(-exponent), 0.0)
        w *= 1.0 if blade else np.maximum(facing - 0.3, 0.0) ** 2
        w /= w.sum()
        gap = float(w @ np.einsum("sc,sc->s", self.normals, x - self.points))
        mean = w @ self.normals
        normal = mean / np.linalg.norm(mean)
        offset = x - w @ self.points
        beside = np.linalg.norm(offset - (offset @ normal) * normal) > 1.2 * self.spacing
        if (
            beside
            or (blade and np.linalg.norm(mean) < 0.95)
            or self._beyond_edge(x, x - offset, normal, around & (distance < 2.0 * self.spacing))
            or (gap < -0.5 * self.spacing and self._is_elsewhere(x, around & (facing <= 0.3), -gap))
        ):
            return None
        return gap, normal, w, nearest

    def _around(self, sample: int) -> np.ndarray:
        """Return which samples are among the 32 nearest to one at rest, (S,)."""
        distance = np.linalg.norm(self.body.surface.points - self.body.surface.points[sample], axis=1)
        return distance <= np.sort(distance)[min(32, len(distance)) - 1]

    def _beyond_edge(self, x: np.ndarray, centre: np.ndarray, normal: np.ndarray, close: np.ndarray) -> bool:
        """Return whether a face across the normal lies between x, in front of it, and the surface, behind it."""

        def height(y: np.ndarray) -> np.ndarray:
            return np.einsum("sc,sc->s", self.normals, y - self.points)

        across = (np.abs(self.normals @ normal) < 0.5) & close
        below = (self.points - centre) @ normal < 0.0
        return bool((across & below & (height(x) > 0.0) & (height(centre) < 0.0)).any())

    def _is_elsewhere(self, x: np.ndarray, faces: np.ndarray, depth: float) -> bool:
        """Return whether one of some faces is nearer to x than half of a depth, or x is outside; of a thick body."""
        away = self.points - x
        height, square = np.einsum("sc,sc->s", self.normals, away), (away**2).sum(axis=1)
        aside = np.sqrt(np.maximum(square - height**2, 0.0))
        nearer = faces & (2.0 * np.abs(height) < depth) & (aside < 1.2 * self.spacing)
        areas = np.linalg.norm(self.area_vectors, axis=1)
        winding = (areas * height / (square + 0.1 * areas) ** 1.5).sum() / (4.0 * np.pi)
        return bool(nearer.any() or winding <= 0.4)

    def touched_row(self, x: np.ndarray, patch: tuple[float, np.ndarray, np.ndarray, int]) -> np.ndarray:
        """Return the functions (n,) of the material at x - max(gap, 0) normal, carried there from the samples."""
        gap, normal, w, nearest = patch
        away = x - max(gap, 0.0) * normal - w @ self.points
        gradient = self.body.evaluate(self.body.surface.points[[nearest]])[1][0]
        return w @ self.body.surface.basis + gradient @ np.linalg.solve(self.deformation_gradient[nearest], away)


@dataclass(frozen=True, kw_only=True)
class FreeBody:
    """A body without contact and the incremental potential of one implicit Euler step, dense.

    E(q) = m/(2 dt^2) |q - q_n - dt v_n|^2 + m alpha/(2 dt) |q - q_n|^2 + sum_p V_p Psi(F_p) - m sum_k bbar_k g . q_k
    + sum_e k_e/2 |x_e - target_e|^2 over the pins. With dt = inf inertia is gone and the minimum is the equilibrium.
    """

    body: ReducedBody
    material: Material
    dt: float
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pin_points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    """Rest points (K, 3) [m] that springs pull to where they rest."""
    pin_stiffness: float = 0.0
    """Stiffness of each spring [N/m]."""

    @cached_property
    def pin_basis(self) -> np.ndarray:
        """Functions at the pins, shape (K, n)."""
        if len(self.pin_points) == 0:
            return np.zeros((0, self.body.function_count))
        return self.body.evaluate(self.pin_points)[0]

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return self.material.density * self.body.volume

    @property
    def lame(self) -> tuple[float, float]:
        """Lame's parameters [Pa]."""
        return lame(self.material.youngs_modulus, self.material.poissons_ratio)

    @property
    def hooke_moduli(self) -> tuple[float, float]:
        """The moduli [Pa] at small strain."""
        return hooke_moduli(self.material.model, *self.lame)

    def deformation_gradient(self, q: np.ndarray) -> np.ndarray:
        """Return F = I + sum_k q_k grad b_k^T at the cubature points, shape (P, 3, 3)."""
        return I3 + np.einsum("kc,pkd->pcd", q, self.body.cubature.grad_basis.astype(float))

    def elastic_energy(self, q: np.ndarray) -> float:
        """Return sum_p V_p Psi(F_p) [J]."""
        return float(self.body.cubature.weights @ energy(self.material.model, self.deformation_gradient(q), *self.lame))

    def elastic_gradient(self, q: np.ndarray) -> np.ndarray:
        """Return sum_p V_p P_p grad b_k [N], shape (n, 3)."""
        P = stress(self.material.model, self.deformation_gradient(q), *self.lame)
        return np.einsum("p,pcd,pkd->kc", self.body.cubature.weights, P, self.body.cubature.grad_basis.astype(float))

    def residual(self, q: np.ndarray, q_start: np.ndarray, qd_start: np.ndarray) -> np.ndarray:
        """Return dE/dq [N], shape (n, 3)."""
        m, h, material = self.mass, self.dt, self.material
        inertia = m / h**2 * (q - q_start) - m / h * qd_start + m * material.mass_damping / h * (q - q_start)
        F, F_start = self.deformation_gradient(q), self.deformation_gradient(q_start)
        P = viscous_stress(F, F_start, *self.hooke_moduli, material.viscosity, h)
        viscous = np.einsum("p,pcd,pkd->kc", self.body.cubature.weights, P, self.body.cubature.grad_basis.astype(float))
        pins = self.pin_stiffness * self.pin_basis.T @ (self.pin_basis @ q)
        return inertia + self.elastic_gradient(q) + viscous + pins - m * np.outer(self.body.mean_basis, self.gravity)

    def tangent(self, q: np.ndarray, q_start: np.ndarray | None = None) -> np.ndarray:
        """Return d2E/dq2 [N/m], shape (3 n, 3 n), unknowns point-major; without q_n made positive definite."""
        F = self.deformation_gradient(q)
        C = hessian(self.material.model, F, *self.lame)
        if q_start is None:
            C = projected(C).reshape(-1, 3, 3, 3, 3)
        else:
            rate = (
                self.material.viscosity / self.dt * (green_strain(F) - green_strain(self.deformation_gradient(q_start)))
            )
            C = C + np.einsum("ik,pjl->pijkl", I3, hooke_stress(rate, *self.hooke_moduli))
        C = C + viscous_hessian(F, *self.hooke_moduli, self.material.viscosity, self.dt)
        grad = self.body.cubature.grad_basis.astype(float)
        n = grad.shape[1]
        C = (self.body.cubature.weights[:, None, None, None, None] * C).swapaxes(1, 2).reshape(-1, 3, 27)
        left = (grad @ C).reshape(-1, n, 3, 3, 3)
        K = np.tensordot(left, grad, axes=((0, 4), (0, 2))).swapaxes(2, 3).reshape(3 * n, 3 * n)
        K += np.kron(self.pin_stiffness * self.pin_basis.T @ self.pin_basis, I3)
        return K + self.mass * (1.0 / self.dt + self.material.mass_damping) / self.dt * np.eye(3 * n)

    def equilibrium(self) -> np.ndarray:
        """Return where the body rests: the minimum without inertia."""
        still = replace(self, dt=np.inf)
        return still.solve(np.zeros_like(self.body.linear_coordinates[:, :3]), np.zeros((self.body.function_count, 3)))

    def step(self, q_start: np.ndarray, qd_start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (q, qd) after one step of implicit Euler that follows the rotation, solved to rounding by Newton."""
        spin = Spin(self.body, q_start, qd_start, self.dt)
        q = self.solve(q_start, (spin.target - q_start) / self.dt)
        return q, spin.velocity(q)

    def solve(self, q_start: np.ndarray, qd_start: np.ndarray) -> np.ndarray:
        """Return the minimum of the potential, by full Newton steps from where the body rests or drifts to."""
        q = q_start + (self.dt * qd_start if np.isfinite(self.dt) else 0.0)
        for _ in range(100):
            r = self.residual(q, q_start, qd_start)
            H = self.tangent(q, q_start)
            if np.linalg.eigvalsh(H)[0] <= 0.0:
                H = self.tangent(q)
            dq = -np.linalg.solve(H, r.ravel()).reshape(q.shape)
            q = q + dq
            if np.linalg.norm(dq) < 1e-14 * np.linalg.norm(self.body.bounds):
                return q
        raise RuntimeError("the reference step did not converge")


def with_float32(material: Material) -> Material:
    """Return the material with its numbers rounded to float32, as a Newton model stores them."""
    names = ("youngs_modulus", "poissons_ratio", "density", "viscosity", "mass_damping", "friction")
    return replace(material, **{name: float(np.float32(getattr(material, name))) for name in names})


def contact_readings(entries, body, body_q, body_com):
    """Return force, friction, torque about the COM, centre of pressure and mean normal of a body at some contacts.

    Args:
        entries: Dict of arrays ``body`` (count,), ``point``, ``normal`` and ``force`` on the soft side (count, 3).
        body: Rigid body whose contacts are taken; torques about the origin where it is negative.
        body_q: Pose of the body at the start of the step, position and quaternion.
        body_com: Its centre of mass in its frame.
    """
    mine = entries["body"] == body
    x, n, f = (entries[name][mine] for name in ("point", "normal", "force"))
    centre = np.zeros(3)
    if body >= 0:
        w, v = body_q[6], body_q[3:6]
        centre = body_q[:3] + body_com + 2.0 * np.cross(v, np.cross(v, body_com) + w * body_com)
    pressing = np.einsum("ij,ij->i", n, f)
    weight = np.maximum(pressing, 0.0)
    if not weight.sum():
        return (np.zeros(3),) * 5
    mean = weight @ n
    return (
        -f.sum(axis=0),
        -(f - pressing[:, None] * n).sum(axis=0),
        -np.cross(x - centre, f).sum(axis=0),
        weight @ x / weight.sum(),
        mean / np.linalg.norm(mean),
    )


def exponential(turn: np.ndarray) -> np.ndarray:
    """Return the rotation exp([turn])."""
    angle = np.linalg.norm(turn)
    T = np.cross(turn, I3).T
    return I3 + np.sinc(angle / np.pi) * T + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * T @ T


class Spin:
    """Where a free body goes in a step without forces, and its velocity after it: see ``spin_kernels``.

    Args:
        body: The body.
        q: Coordinates at the start (n, 3) [m].
        qd: Velocities (n, 3) [m/s].
        dt: Step [s].
    """

    def __init__(self, body: ReducedBody, q: np.ndarray, qd: np.ndarray, dt: float) -> None:
        """Find the rotation of the step and the target."""
        self.body, self.dt = body, dt
        one = body.linear_coordinates[:, 3]
        r, X = self.about_centre(q)
        V = body.mean_basis @ qd
        u = qd - np.outer(one, V)
        inertia = self.inertia(r)
        self.momentum = np.cross(r, u).sum(axis=0)
        omega = mean = np.linalg.solve(inertia, self.momentum)
        for _ in range(200):  # L and L . omega are kept; Newton is not needed for bodies that are no needles
            mean = 0.5 * np.linalg.solve(inertia, self.momentum + exponential(-dt * mean) @ self.momentum)
        R = exponential(dt * mean)
        turned = r @ R.T
        omega_end = R @ (2.0 * mean - omega)
        b = (u - np.cross(omega, r)) @ R - dt * np.cross(omega_end, np.cross(omega_end, turned))
        b -= np.cross(np.linalg.solve(self.inertia(turned), np.cross(turned, b).sum(axis=0)), turned)
        self.outward = b
        self.turned = turned + np.outer(one, X) - body.linear_coordinates[:, :3]
        self.target = self.turned + dt * (np.outer(one, V) + b)

    def about_centre(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the coordinates of the place from the centre of mass (n, 3), and that centre (3,)."""
        y = q + self.body.linear_coordinates[:, :3]
        X = self.body.mean_basis @ y
        return y - np.outer(self.body.linear_coordinates[:, 3], X), X

    @staticmethod
    def inertia(r: np.ndarray) -> np.ndarray:
        """Return the tensor of inertia per unit mass."""
        return (r**2).sum() * I3 - r.T @ r

    def velocity(self, q: np.ndarray) -> np.ndarray:
        """Return the velocity at the end of the step, (n, 3)."""
        r, _X = self.about_centre(q)
        eta = np.linalg.solve(self.inertia(r), self.momentum - np.cross(r, self.outward).sum(axis=0))
        return (q - self.turned) / self.dt + np.cross(eta, r)
