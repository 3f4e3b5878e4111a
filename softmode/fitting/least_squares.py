"""Least squares by SciPy over residuals that are evaluated in batches: a place and its Jacobian at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]
Names = Sequence[str]
Batch = Callable[[Array], Array]
"""From parameters (W, p) to residuals in units of their noise (W, M)."""
KEPT = 3
"""Jacobians for which lasting derivatives are kept."""
HUBER = 2.5
"""Residuals beyond this count by their size and not by its square."""

_FIELDS = ("mean", "prior", "step", "low", "high")


@dataclass(frozen=True, kw_only=True, eq=False)
class Space:
    """The parameters of a fit."""

    names: tuple[str, ...]
    """Their names (p)."""
    mean: Array
    """What is expected of each, (p,)."""
    prior: Array
    """Standard deviation of what is expected, infinite where nothing is, (p,)."""
    step: Array
    """Steps of the differences that make a Jacobian, (p,)."""
    low: Array
    """Least values (p,)."""
    high: Array
    """Largest values (p,)."""

    @classmethod
    def of(cls, rows: Mapping[str, Sequence[float]]) -> Space:
        """Return the space of rows: mean, prior, step, least and largest value of each parameter."""
        return cls(names=tuple(rows), **dict(zip(_FIELDS, np.array(list(rows.values())).T, strict=True)))

    def changed(self, values: Array, name: str, value: float) -> Array:
        """Return values (p,) with another one of a parameter."""
        return np.where(np.arange(len(self.names)) == self.names.index(name), value, values)

    def index(self, *names: str) -> NDArray[np.intp]:
        """Return where parameters are."""
        return np.array([self.names.index(name) for name in names])


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """Where least squares ended."""

    space: Space
    """The parameters."""
    x: Array
    """Their values (p,)."""
    free: NDArray[np.intp]
    """Which of them were free (k)."""
    converged: bool
    """Whether it ended because little changed, and not after the last round."""
    cost: float
    """Half the sum of what the residuals and the priors cost."""
    residuals: Array
    """Residuals (M,), without the priors."""
    jacobian: Array
    """Their derivatives by the free parameters (M, k)."""
    prior: Array
    """Standard deviations of the priors of the free parameters (k,)."""
    slope: Array
    """Derivatives of the cost by them, 0 where one has come to its least or largest value (k,)."""

    def deviations(self, blocks: Sequence[NDArray[np.intp]]) -> Array:
        """Return standard deviations of the free parameters, (k,).

        Of two the larger: that of Gauss and Newton with the priors, times chi where it is above one, and the jackknife
        over blocks of residuals that may err together (MacKinnon and White 1985, doi:10.1016/0304-4076(85)90158-7): a
        plain sandwich is too small where a few blocks, such as the first swing, tell most. The step that is left to
        the least cost counts as an error too.

        Args:
            blocks: Indices of residuals.
        """
        r, J = self.residuals, self.jacobian
        w = np.where(np.abs(r) < HUBER, 1.0, HUBER / np.maximum(np.abs(r), 1e-12))
        inverse = np.linalg.inv(J.T @ (w[:, None] * J) + np.diag(1.0 / self.prior**2))
        moved = np.abs(J).sum(axis=1)
        active = moved > 1e-3 * moved.max()
        chi = float((w * r * r)[active].sum() / max(int(active.sum()) - len(self.free), 1))
        without = [np.eye(len(inverse)) - J[b].T @ (w[b, None] * J[b]) @ inverse for b in blocks]
        scores = np.array([np.linalg.solve(a, J[b].T @ (w * r)[b]) for a, b in zip(without, blocks, strict=True)])
        sandwich = inverse @ (scores.T @ scores + np.diag(1.0 / self.prior**2)) @ inverse
        spread = np.sqrt(np.maximum(np.diag(inverse) * max(chi, 1.0), np.diag(sandwich)))
        return np.hypot(spread, inverse @ self.slope)


def minimise(
    residuals: Batch, space: Space, start: Array, free: Names, *, rounds: int, kept: Names = (), tolerance: float = 1e-3
) -> Solution:
    """Find the parameters of least residuals near a start.

    Args:
        residuals: Gives the residuals of a batch of parameters.
        space: The parameters.
        start: Where to begin (p,).
        free: Which of them may change.
        rounds: Jacobians at most.
        kept: Those whose derivatives hardly change: they are kept for `KEPT` Jacobians.
        tolerance: Relative change of the cost, and of the parameters' norm, at which it ends; 1e-3 is 1 % of E.
    """
    which = space.index(*free)
    prior, mean = space.prior[which], space.mean[which]
    known: dict[bytes, tuple[Array, Array]] = {}

    def batch(y: Array) -> tuple[Array, Array]:
        """Return residuals and Jacobian, priors included."""
        key = y.tobytes()
        if key not in known:
            renewed = np.ones(len(which), bool) if len(counted) % KEPT == 0 else ~lasts
            rows = np.flatnonzero(renewed)
            sets = np.repeat(start[None], len(rows) + 1, axis=0)
            sets[:, which] = y
            steps = np.where(y + space.step[which] > space.high[which], -1.0, 1.0) * space.step[which]
            sets[np.arange(len(rows)) + 1, which[rows]] += steps[rows]
            found = residuals(sets)
            slopes = ((found[1:] - found[0]) / steps[rows, None]).T
            if not renewed.all():
                fresh, slopes = slopes, latest[0].copy()
                slopes[:, rows] = fresh
            latest[:] = [slopes]
            known.clear()
            known[key] = np.append(found[0], (y - mean) / prior), np.vstack([slopes, np.diag(1.0 / prior)])
            counted.append(1)
        return known[key]

    counted: list[int] = []
    latest: list[Array] = []
    lasts = np.isin(np.array(free), kept)
    low, high, scale = space.low[which], space.high[which], np.where(np.isfinite(prior), prior, 1.0)
    how: dict[str, Any] = {"loss": "huber", "f_scale": HUBER, "ftol": tolerance, "xtol": tolerance, "max_nfev": rounds}
    begin = np.clip(start[which], low + 1e-9, high - 1e-9)
    found = least_squares(lambda y: batch(y)[0], begin, lambda y: batch(y)[1], (low, high), x_scale=scale, **how)  # type: ignore[arg-type]
    r, J = batch(found.x)
    x = start.copy()
    x[which] = found.x
    m = len(r) - len(which)
    told: dict[str, Any] = {"converged": found.status > 0, "cost": float(found.cost)}
    told["slope"] = np.where(found.active_mask, 0.0, found.grad)
    return Solution(space=space, x=x, free=which, residuals=r[:m], jacobian=J[:m], prior=prior, **told)


def cost_of(residuals: Array) -> Array:
    """Return what residuals (W, M) cost, (W,)."""
    a = np.abs(residuals)
    return 0.5 * np.where(a < HUBER, a * a, 2.0 * HUBER * a - HUBER**2).sum(axis=1)
