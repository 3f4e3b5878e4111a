"""Draw the logo: a soft disc full of Gaussian splats, bent, and coloured by an eigenmode.

`python docs/logo.py` writes docs/images/logo.svg and docs/images/favicon.svg. Splats lie on a sunflower spiral in the
disc. The motion x(X) has a quadratic part; every splat is drawn at x with the covariance F Sigma F^T, and the outline
is the deformed circle. The colour is the eigenmode J_2(k r) cos(2 phi) of a disc.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import jv

IMAGES = Path(__file__).resolve().parent / "images"
BODY = "#1a2b4b"
"""Colour of the body."""
WARM, MIDDLE, COOL = np.array([255.0, 96, 72]), np.array([255.0, 214, 140]), np.array([46.0, 196, 220])
"""Colours of the mode: positive, zero, negative."""
GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
"""Angle between neighbours on a sunflower spiral [rad]."""
TILT = np.radians(-24.0)
"""Rotation of the whole [rad]."""


def bend(X: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the deformed places and the deformation gradients of points of the unit disc.

    Args:
        X: Rest positions, shape (N, 2).

    Returns:
        x of shape (N, 2), and F of shape (N, 2, 2).
    """
    u, v = X.T
    long, short, curl, fan = 1.12, 0.84, 0.30, 0.22
    x = np.stack([long * u + fan * u * v, short * v - curl * u**2], axis=1)
    F = np.empty((len(X), 2, 2))
    F[:, 0, 0], F[:, 0, 1] = long + fan * v, fan * u
    F[:, 1, 0], F[:, 1, 1] = -2.0 * curl * u, short
    turn = np.array([[np.cos(TILT), -np.sin(TILT)], [np.sin(TILT), np.cos(TILT)]])
    return x @ turn.T, turn @ F


def mode(X: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the eigenmode at points of the unit disc, between -1 and 1, shape (N,)."""
    r, phi = np.hypot(*X.T), np.arctan2(X[:, 1], X[:, 0])
    value = jv(2, 3.05 * r) * np.cos(2.0 * phi)  # 3.05: a disc with a free rim has J_2'(k) = 0
    return value / np.abs(value).max()


def colour(value: float) -> str:
    """Return the colour of a value of the mode as SVG writes it."""
    end = WARM if value > 0.0 else COOL
    t = abs(value) ** 0.7
    red, green, blue = (1.0 - t) * MIDDLE + t * end
    return f"#{round(red):02x}{round(green):02x}{round(blue):02x}"


def draw(count: int, size: float, *, rim: float, shades: int = 9) -> str:
    """Return the logo as SVG.

    Args:
        count: Number of splats.
        size: Radius of a splat over the spacing of its neighbours.
        rim: Radius of the body; the splats fill the unit disc.
        shades: Number of colours on either side of zero.
    """
    k = np.arange(count) + 0.5
    X = np.sqrt(k / count)[:, None] * np.stack([np.cos(GOLDEN * k), np.sin(GOLDEN * k)], axis=1)
    around = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
    x, F = bend(X)
    outline, _ = bend(rim * np.stack([np.cos(around), np.sin(around)], axis=1))
    shade = np.round(shades * mode(X)).astype(int)
    low, high = outline.min(axis=0), outline.max(axis=0)
    scale = 120.0 / (high - low).max()

    def place(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return 64.0 + scale * (points - 0.5 * (low + high)) * (1.0, -1.0)

    lines = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 128 128" role="img" aria-label="softmode">',
        "<defs>",
    ]
    for s in sorted(set(shade)):
        shown = colour(s / shades)
        lines.append(
            f'<radialGradient id="s{s + shades}"><stop stop-color="{shown}"/><stop offset=".5" stop-color="{shown}" '
            f'stop-opacity=".9"/><stop offset="1" stop-color="{shown}" stop-opacity="0"/></radialGradient>'
        )
    path = " ".join(f"{px:.1f},{py:.1f}" for px, py in place(outline))
    lines += ["</defs>", f'<polygon points="{path}" fill="{BODY}"/>']
    radius = size * scale * np.sqrt(np.pi / count)
    for i, (px, py) in enumerate(place(x)):
        axes, stretches, _ = np.linalg.svd(F[i])
        angle = -np.degrees(np.arctan2(axes[1, 0], axes[0, 0])) % 180.0  # an axis has no sign
        rx, ry = radius * stretches
        lines.append(
            f'<ellipse rx="{rx:.1f}" ry="{ry:.1f}" fill="url(#s{shade[i] + shades})" '
            f'transform="translate({px:.1f} {py:.1f}) rotate({angle:.0f})"/>'
        )
    return "\n".join([*lines, "</svg>", ""])


def main() -> None:
    """Write both files."""
    (IMAGES / "logo.svg").write_text(draw(130, 0.72, rim=1.13))
    (IMAGES / "favicon.svg").write_text(draw(28, 0.78, rim=1.2))


if __name__ == "__main__":
    main()
