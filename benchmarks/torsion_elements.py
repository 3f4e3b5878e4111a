"""References for torsion under fingers by finite elements: what presses a cube turns, with Coulomb's friction.

Run: ``python -m benchmarks.torsion_elements`` (a minute). Two rigid fingers press opposite faces of a cube and turn
against each other, each by the twist; friction 0.5, nu 0.3. A box finger is a third of the cube wide, the radius of a
ball a third of it. Prints torque over that of a rigid square of side 2 a on a half space, 8.3 G a^3 times the twist, or
of Lubkin's ball (`torsion`), and torque over mu F a.

An eighth of the cube is solved, which is alike under quarter turns about the axis and half turns across it. Elements
and material are those of `hertz_elements`; the penalty is a thousand times as stiff as the cube across the surface,
200 times along it. What is pressed is solved at finite strain; what turns is linear about that, condensed to the nodes
that may be touched.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy import sparse
from scipy.sparse import linalg

from benchmarks.edge_elements import CAP, face, grid, solid, symmetric
from benchmarks.hertz_elements import Array, Mask
from benchmarks.torsion import MU, NU, lubkin

HALF, RADIUS = 1.0 / 6.0, 1.0 / 3.0
"""Half width of the box, radius of the ball, over the edge of the cube."""
ACROSS, ALONG = 1.0e3, 2.0e2
"""Penalties per area."""
TURN, FLIP = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.diag([1.0, -1.0, -1.0])
GROUP = [np.linalg.matrix_power(TURN, k) @ flip for k in range(4) for flip in (np.eye(3), FLIP)]
TWISTS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
"""In radians."""


def main() -> None:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    print("depth, force [E edge^2], and at twists of", *TWISTS, "torque over the reference (over mu F a)")
    for kind, depth in (("box", 0.00247), ("box", 0.0198), ("ball", 0.0125), ("ball", 0.051)):
        force, torques = twisted(kind, depth)
        plain = [8.3 * 0.5 / (1.0 + NU) * HALF**3 * twist for twist in TWISTS]
        if kind == "ball":
            plain = [lubkin(force, twist, modulus=1.0, radius=RADIUS) for twist in TWISTS]
        a = HALF if kind == "box" else (0.75 * force * RADIUS * (1.0 - NU**2)) ** (1.0 / 3.0)
        row = [f"{t / p:.3f} ({t / (MU * force * a):.2f})" for t, p in zip(torques, plain, strict=True)]
        print(kind, depth, f"{force:.6f}", *row, flush=True)


class Finger:
    """What presses the top of the cube, and where its nodes stick.

    Args:
        kind: "box" or "ball".
        x: The nodes of the top at rest.
        area: Their areas.
    """

    def __init__(self, kind: str, x: Array, area: Array) -> None:
        """Touch nothing."""
        self.kind, self.area = kind, area
        self.below = np.abs(x[:, :2]).max(axis=1) < HALF + 1.0e-9
        self.anchor = np.full(x.shape, np.nan)

    def move(self, x: Array, depth: float, angle: float) -> None:
        """Go to a depth and an angle; what begins to stick does where it is now."""
        c, s = np.cos(angle), np.sin(angle)
        self.turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        self.centre = np.array([0.0, 0.0, 0.5 - depth + (RADIUS if self.kind == "ball" else 0.0)])
        self.anchor = np.where(np.isnan(self.anchor), (x - self.centre) @ self.turn, self.anchor)

    def gaps(self, y: Array) -> tuple[Array, Array]:
        """Return gaps and outward normals at places in the finger's frame."""
        if self.kind == "ball":
            r = np.linalg.norm(y, axis=1)
            return r - RADIUS, y / r[:, None]
        faces = np.stack([np.abs(y[:, 0]) - HALF, np.abs(y[:, 1]) - HALF, -y[:, 2]], axis=1)
        faces[self.below, :2] = -np.inf
        signs = np.stack([np.sign(y[:, 0]), np.sign(y[:, 1]), -np.ones(len(y))], axis=1)
        return faces.max(axis=1), signs * np.eye(3)[faces.argmax(axis=1)]

    def press(self, x: Array, exact: bool) -> tuple[Array, Array]:
        """Return forces on the nodes and what they fall by per motion; its slope with the pressure only if exact."""
        y = (x - self.centre) @ self.turn
        gap, n = self.gaps(y)
        n, k, k_t = n @ self.turn.T, ACROSS * self.area, ALONG * self.area
        self.touched = gap < 0.0
        slip = (y - self.anchor) @ self.turn.T
        slip -= n * (slip * n).sum(axis=1)[:, None]
        pressed = np.where(self.touched, -k * gap, 0.0)
        along = -k_t[:, None] * slip
        size = np.maximum(np.linalg.norm(along, axis=1), 1.0e-30)
        slides: Mask = MU * pressed < size
        share = np.where(slides, MU * pressed / size, 1.0)
        across, way = n[:, :, None] * n[:, None, :], along / size[:, None]
        slope = (k_t * share)[:, None, None] * (np.eye(3) - across)
        if exact:
            back = (MU * k)[:, None] * n - (k_t * share)[:, None] * way
            slope += np.where(slides[:, None, None], way[:, :, None] * back[:, None, :], 0.0)
        slope += k[:, None, None] * across
        along *= share[:, None]
        self.kept = y + along / k_t[:, None] @ self.turn
        return pressed[:, None] * n + along, np.where(self.touched[:, None, None], slope, 0.0)

    def keep(self) -> None:
        """Remember where the nodes stick that were touched last."""
        self.anchor = np.where(self.touched[:, None], self.kept, np.nan)


def towards(end: float, count: int, first: float) -> Array:
    """Return ``count`` growing steps from 0 to an end, the first about so long."""
    low, high, ratio = 1.0 + 1.0e-6, 4.0, 2.0
    for _ in range(60):
        ratio = 0.5 * (low + high)
        low, high = (ratio, high) if first * (ratio**count - 1.0) / (ratio - 1.0) < end else (low, ratio)
    steps = ratio ** np.arange(count)
    return np.concatenate([[0.0], np.cumsum(steps) * end / steps.sum()])


def lines(kind: str, depth: float) -> tuple[Array, Array, Array]:
    """Return the lines of the grid: finer at the rim of the box, or under the ball."""
    if kind == "box":
        fine = 0.01
        x = np.concatenate([HALF - towards(HALF, 7, fine)[::-1], HALF + towards(0.5 - HALF, 5, fine)[1:]])
    else:
        patch = 1.25 * np.sqrt(depth * RADIUS)
        fine = patch / 7
        x = np.concatenate([np.linspace(0.0, patch, 8), patch + towards(0.5 - patch, 4, fine)[1:]])
    return x, x, 0.5 - towards(0.5, 8, fine)[::-1]


def twisted(kind: str, depth: float) -> tuple[float, list[float]]:
    """Press a finger in by a depth and turn it; return its force and its torque at the twists."""
    parts = lines(kind, depth)
    x, index, corners = grid(parts)
    moves = symmetric(x, GROUP)
    nodes, area = face(index, parts, 2, -1)
    finger = Finger(kind, x[nodes], area)
    inside = solid(x, corners)
    at = 3 * nodes[:, None] + np.arange(3)
    u = np.zeros(x.size)

    def top() -> Array:
        return (x + u.reshape(x.shape))[nodes]

    count = 4 if kind == "box" else 8
    for k in range(count):
        finger.move(top(), depth * (k + 1) / count, 0.0)
        for turn in range(40):
            force, slope = finger.press(top(), exact=turn > 6)
            residual, H = inside(u)
            residual -= np.bincount(at.ravel(), force.ravel(), x.size)
            entries = (slope.ravel(), (np.repeat(at, 3, 1).ravel(), np.tile(at, (1, 3)).ravel()))
            H = (moves.T @ (H + sparse.csr_matrix(entries, H.shape)) @ moves).tocsc()
            step = -moves @ linalg.splu(H).solve(moves.T @ residual)
            most = np.abs(step).max()
            u += min(1.0, CAP / most) * step
            if most < 2.0e-6:
                break
        else:
            print(f"{kind}, depth {depth * (k + 1) / count:.4f}: not converged")
        finger.keep()
    start = top()
    finger.move(start, depth, 0.0)
    force, _slope = finger.press(start, exact=True)
    near = np.abs(start[:, :2]).max(axis=1) < 0.27
    own_moves = moves[at[near].ravel()]
    A = (moves.T @ inside(u)[1] @ moves).tocsc()
    touched = np.unique(own_moves.indices)
    rest = np.setdiff1d(np.arange(A.shape[0]), touched)
    cross = A[rest][:, touched].toarray()
    condensed = A[touched][:, touched].toarray() - cross.T @ linalg.splu(A[rest][:, rest]).solve(cross)
    part = own_moves[:, touched].toarray()
    w, torques = np.zeros(len(touched)), []
    pressed = force[near].ravel()
    for angle in TWISTS:
        finger.move(start, depth, angle)
        place, now = start, force
        for turn in range(400):
            place = start.copy()
            place[near] += (part @ w).reshape(-1, 3)
            now, slope = finger.press(place, exact=turn > 100)
            blocks = sparse.block_diag(slope[near]).toarray()
            residual = condensed @ w - part.T @ (now[near].ravel() - pressed)
            step = -np.linalg.solve(condensed + part.T @ blocks @ part, residual)
            w += min(1.0, CAP / np.abs(step).max()) * step
            if np.abs(step).max() < 1.0e-8:
                break
        else:
            print(f"{kind}, twist {angle:g}: not converged")
        finger.keep()
        torques.append(4.0 * float((place[:, 0] * now[:, 1] - place[:, 1] * now[:, 0]).sum()))
    return -4.0 * float(force[:, 2].sum()), torques


if __name__ == "__main__":
    main()
