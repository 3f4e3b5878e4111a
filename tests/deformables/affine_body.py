"""A cube that can only move affinely: its four functions admit exact closed forms of statics and vibration."""

from __future__ import annotations

import functools

import numpy as np

from softmode.deformables.body.reduced_body import ReducedBody
from tests.bodies import changed, two_modes


@functools.cache
def affine_cube(edge: float = 1.0) -> ReducedBody:
    """Return a cube reduced to the functions 1, X, Y, Z: every deformation is homogeneous.

    The kinetic energy of x = F X is rho V edge^2 / 24 |dF/dt|^2 up to the error of the quadrature.
    """
    body = two_modes(edge)
    names = ("mean_basis", "linear_coordinates")
    changes = {name: np.ascontiguousarray(body.flat()[name][:4]) for name in names}
    names = ("grad_basis", "surface_basis", "transform")
    changes |= {name: np.ascontiguousarray(body.flat()[name][:, :4]) for name in names}
    return changed(body, **changes, fingerprint=f"{body.fingerprint}, affine")


def mean_gradient(body: ReducedBody, q: np.ndarray) -> np.ndarray:
    """Return the deformation gradient F (3, 3) that an affine body has at coordinates q (4, 3)."""
    return np.eye(3) + np.einsum("kc,kd->cd", q, body.cubature.grad_basis.astype(float).mean(axis=0))
