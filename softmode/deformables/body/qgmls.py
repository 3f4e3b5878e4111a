"""Quadratic generalised moving least squares: PIE-NeRF's functions, which reproduce every quadratic field.

Each of the n kernels carries ten functions: its value, three first and six second derivatives (Martin et al. 2010,
doi:10.1145/1778765.1778776; Feng et al. 2024, equations 6 to 8). With p = (1, x, y, z, xx, xy, xz, yy, yz, zz) in the
coordinates xi = (X - c) / L, c the mean of the centres and L the median of the radii, and w_i = (1 - |X - X_i|^2 /
R_i^2)^3,

    G(X) = sum_i w_i [p p^T + sum_j p_,j p_,j^T + sum_jk p_,jk p_,jk^T](X_i),
    N_i^f = m_f w_i p_,f(X_i) . G^-1 p.

The sum over jk has nine terms for six functions: those with j != k count twice, m_f = 2, also in G. As printed, with
six plain terms beside a G of nine, a quadratic field comes back with an error of a percent. In the coordinates of the
world G adds terms of different dimension and loses four digits on a small object far from the origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.errors import BasisError

Array = NDArray[np.float64]

FUNCTIONS = 10
"""Functions of a kernel."""
REACH = 0.9
"""How far from a kernel's centre a point may lie, as a fraction of its radius, to be covered: w = 0.007. The points
that a body is built from have w >= 0.05, which is 0.79."""
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_COPIES = np.array([1, 1, 1, 1, 1, 2, 2, 1, 2, 1], dtype=np.float64)
"""How often each function stands in the sums."""


@dataclass(frozen=True, kw_only=True)
class BasisQGMLS:
    """Value and gradient of the ten functions of every kernel, float64."""

    centres: Array
    """Centres X_i [m], shape (n, 3)."""
    radii: Array
    """Radii R_i of their supports [m], shape (n,)."""

    def __post_init__(self) -> None:
        """Check shapes and finiteness."""
        if self.centres.ndim != 2 or self.centres.shape[1:] != (3,) or self.radii.shape != self.centres.shape[:1]:
            raise BasisError(f"centres (n, 3) and radii (n,): got shapes {self.centres.shape} and {self.radii.shape}")
        if not len(self.centres):
            raise BasisError("centres: at least one is needed")
        if not (np.isfinite(self.centres).all() and np.isfinite(self.radii).all() and (self.radii > 0.0).all()):
            raise BasisError("centres and radii must be finite, radii positive")

    @property
    def length(self) -> float:
        """Unit of length L [m]: with the degrees of freedom u, L u_,j and L^2 u_,jk all unknowns are in metres."""
        return float(np.median(self.radii))

    def reach(self, points: Array) -> tuple[Array, Array]:
        """Return distances of points (N, 3) from the centre that covers each best, over its reach, and that centre."""
        ratio = np.linalg.norm(points[:, None] - self.centres, axis=2) / (REACH * self.radii)
        best = ratio.argmin(axis=1)
        return ratio[np.arange(len(points)), best], self.centres[best]

    def evaluate(self, points: ArrayLike) -> tuple[Array, Array]:
        """Return the functions (N, 10 n) and their gradients [1/m] (N, 10 n, 3); those of a kernel stand together.

        Args:
            points: Rest positions [m], shape (N, 3).

        Raises:
            BasisError: If points are not finite, or no kernel covers one.
        """
        X = np.asarray(points, dtype=np.float64)
        if X.ndim != 2 or X.shape[1] != 3 or not np.isfinite(X).all():
            raise BasisError(f"points: expected finite positions of shape (N, 3), got shape {X.shape}")
        unit, functional, bracket = self.length, *self._functionals
        x, radius = (X - self.centres.mean(axis=0)) / unit, self.radii / unit
        away = x[:, None] - (self.centres - self.centres.mean(axis=0)) / unit
        rest = np.maximum(1.0 - (away**2).sum(axis=2) / radius**2, 0.0)
        w = rest**3
        if (lost := np.flatnonzero(~(w > 0.0).any(axis=1))).size:
            raise BasisError(
                f"points: {len(lost)} of {len(X)} are covered by no kernel (first: row {lost[0]})",
                hint="Use more or wider kernels, or evaluate only points within the object.",
            )
        # Solutions are homogeneous of degree zero in w: scaled, G is as good at the rim of a support as at its centre.
        scale = 1.0 / w.max(axis=1)
        w = w * scale[:, None]
        dw = (-6.0 * rest**2 / radius**2 * scale[:, None])[:, None] * away.transpose(0, 2, 1)  # (N, 3, n)
        size = (len(X), 3, FUNCTIONS, FUNCTIONS)
        inverse = np.linalg.inv((w @ bracket).reshape(-1, FUNCTIONS, FUNCTIONS))
        dG = (dw @ bracket).reshape(size)
        y = np.einsum("pab,pb->pa", inverse, _monomials(x))
        dy = np.einsum("pab,pdb->pda", inverse, _slopes(x) - np.einsum("pdab,pb->pda", dG, y))
        scaled = functional * _COPIES[:, None]
        fy, fdy = np.einsum("nfa,pa->pnf", scaled, y), np.einsum("nfa,pda->pnfd", scaled, dy)
        value = (w[:, :, None] * fy).reshape(len(X), -1)
        slope = w[:, :, None, None] * fdy + fy[..., None] * dw.transpose(0, 2, 1)[:, :, None]
        return value, slope.reshape(len(X), -1, 3) / unit

    @cached_property
    def _functionals(self) -> tuple[Array, Array]:
        """p_,f at the centres (n, 10, 10), and the bracket of G (n, 100)."""
        at = (self.centres - self.centres.mean(axis=0)) / self.length
        second = np.stack([_CURVED[a, b] for a, b in _PAIRS])
        found = np.concatenate(
            [_monomials(at)[:, None], _slopes(at), np.broadcast_to(second, (len(at), *second.shape))], axis=1
        )
        return found, np.einsum("nfa,f,nfb->nab", found, _COPIES, found).reshape(len(at), -1)


def _monomials(x: Array) -> Array:
    """Return p at points (N, 3), (N, 10)."""
    return np.concatenate([np.ones((len(x), 1)), x, *[x[:, a, None] * x[:, b, None] for a, b in _PAIRS]], axis=1)


def _slopes(x: Array) -> Array:
    """Return dp/dx at points (N, 3), (N, 3, 10)."""
    found = np.zeros((len(x), 3, FUNCTIONS))
    found[:, range(3), range(1, 4)] = 1.0
    for k, (a, b) in enumerate(_PAIRS):
        found[:, a, 4 + k] += x[:, b]
        found[:, b, 4 + k] += x[:, a]
    return found


def _second() -> Array:
    found = np.zeros((3, 3, FUNCTIONS))
    for k, (a, b) in enumerate(_PAIRS):
        found[a, b, 4 + k] += 1.0
        found[b, a, 4 + k] += 1.0
    return found


_CURVED = _second()
"""d2p/dx2, shape (3, 3, 10)."""
