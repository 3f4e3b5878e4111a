"""`train_field`: a radiance field with opaque walls out of pictures with poses before a plain wall; torch, one core.

The field is a signed distance s [voxels] at the nodes of a sparse grid. Between two places of a ray passes the share
Phi(s / beta) has there over here, at most all, where Phi is the logistic function and beta shrinks (NeuS, Wang et al.
2021): half the light is lost at s = 0, seen from the front and along a rim alike. (A density has its rim further out,
and its walls elsewhere.) On a coarse grid it begins as fog, of density Psi(-s / beta) / beta, where Psi is the
distribution function of Laplace (VolSDF, Yariv et al. 2021): thin in the hull of the silhouettes, less what their
colours contradict, it becomes dense where pictures ask for it. Then what light reaches is empty, and what none reaches
is inside. (Fog in all of the hull puts a lid on every cavity.) A hull whose lid was carved away begins with a dense
skin: else fog forms in front of a wall of one colour, and the floor of a cup stays thin. Silhouettes take a plain wall.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from softmode.checks import require_number
from softmode.errors import AssetError, ConfigError, needs_extra
from softmode.learning.space_carving import contradicted
from softmode.radiance.grid import RadianceGrid
from softmode.splats.raster.posed_pictures import PosedPicture
from softmode.splats.splats import SH_DC

with needs_extra("rl", "training a field needs torch"):
    import torch

Array = NDArray[np.float64]

COARSE, FINE, SWITCH, FIRST, MARGIN = 48, 96, 0.35, 200, 4
"""Nodes of an edge at first and at last; the part of the steps after which the grid is refined, and how many that are
at least if the coarse grid begins as fog, which needs them to become dense: of fewer steps it begins as the hull. Nodes
around the hull on every side."""
RAYS, REGULAR = 4096, 6000
"""Rays of a step on the fine grid, half as many on the coarse one; nodes with neighbours of a step."""
WIDEST, SHARPEST, STRIDE = 1.0, 0.4, 0.6
"""beta of a grid at first, and at its end [voxels]; between samples of a ray of the fine grid [voxels]."""
AT_ONCE = 1 << 16
"""Rays of a picture whose light is followed at a time."""
FOG, DENSE, LIT = 3.0, 0.7, 0.5
"""What nodes of the hull begin with [voxels]: a fortieth of the light is lost in a voxel; below which fog is solid, a
quarter lost; a node is lit where so much of the light of two pictures comes to it."""
CAVITY, SKIN, DEEP, FIRM, LEAN = 0.95, -1.0, 2.5, 0.3, 5.0e-8
"""What is left of a hull with a cavity when its lid was carved away, at most. Then fog begins at a distance below 0 in
a skin so many nodes deep and is solid below another one, and what is inside has a price on the fine grid, so that walls
recede that pictures do not hold."""
RATES = (0.1, 0.1, 3.0e-3)
"""Steps of distances [voxels], colours, and logarithms of exposures."""
EIKONAL, SMOOTH, EVEN = 1.0e-2, 1.0e-3, 1.0e-3
"""Weights of (|grad s| - 1)^2, on the fine grid, of the curvature of s and of the differences of colours."""
BAND, AGAIN = 4.0, 150
"""Distance from the surface up to which nodes are learned [voxels], and steps after which it is found anew."""
EMPTY = 6.0e-8
"""Weight of the light that nodes take as fog, so that there is none where no picture asks for it."""
THINNER, CRISP, BEFORE = 0.5, 0.1, 0.5
"""On the grid of the field, finer by two: how much its surface lies below s = 0, as its density takes light before its
half is reached, and its beta [its voxels; nodes]; where its colours are taken [nodes before s = 0]."""
ENOUGH = 0.015
"""Share of a hull's surface in a patch that pictures contradict from which on it is carved away."""
SLACK, VOTES, CONTRAST = 2, 2, 0.06
"""Silhouettes are widened by so many pixels; a node that so many see beside one is carved; what differs so much from
the backdrop stands before it."""


def train_field(
    pictures: Sequence[PosedPicture],
    *,
    wall: Sequence[float] | None = (1.0, 1.0, 1.0),
    steps: int = 1000,
    seed: int = 0,
    metres: float | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> RadianceGrid:
    """Train a field on pictures of an object before a plain wall.

    The exposure of each picture is found too. Colours do not depend on the direction. What no picture shows is filled.
    A cavity is empty as far as two pictures look into it.

    Args:
        pictures: The pictures; the border of each is the wall. The object is where their axes meet.
        wall: Colour of the wall, sRGB 0..1. None takes that of the border of most pictures, and the exposures are over
            theirs. Where the object has it too, no picture says where its surface is.
        steps: Steps; 1,000 take two minutes on one core.
        seed: Seed of rays.
        metres: Metres of a unit of the poses, None if not known.
        progress: Called with the step and the mean squared error after every step.

    Returns:
        The field, in the frame and unit of the poses, 192 nodes an edge less what is empty, of degree 0.

    Raises:
        AssetError: If the pictures are of several sizes, their border is not the wall, or their silhouettes have
            nothing in common, or they contradict all of what is in them.
        ConfigError: If the number of steps is not positive, or the wall is no colour, or black.
    """
    require_number("steps", steps, at_least=1)
    if wall is not None and (len(wall) != 3 or not (min(wall) >= 0.0 and 0.0 < max(wall) <= 1.0)):
        raise ConfigError(f"wall is {wall}", hint="give the colour of the wall, three numbers 0..1, not black")
    if len({(p.camera.width, p.camera.height) for p in pictures}) != 1:
        raise AssetError("pictures of several sizes, or none", hint="give pictures of one size")
    torch.manual_seed(seed)
    images = np.stack([picture.pixels()[..., :3] for picture in pictures])
    border = np.concatenate([images[:, :3].reshape(len(images), -1, 3), images[:, -3:].reshape(len(images), -1, 3)], 1)
    back = np.median(border, axis=1).astype(np.float64)
    color = np.median(back, axis=0)
    known = color.clip(1e-3) if wall is None else np.array(wall, dtype=np.float64)
    exposures = back.sum(axis=1) / known.sum()
    if np.median(np.abs(border - (exposures[:, None] * known)[:, None]).max(axis=2)) > 0.1:
        raise AssetError(
            f"the border of the pictures is {color.round(2).tolist()}, not the wall, or not of one colour",
            hint="take pictures before a plain wall, and give its colour as wall",
        )
    middle, half = _cube(pictures)
    carved = _hull(pictures, images, back, middle, half)
    if not carved.any():
        raise AssetError("the silhouettes have nothing in common", hint="check poses, lens and that the wall is plain")
    low, high = np.argwhere(carved).min(axis=0) - 0.5, np.argwhere(carved).max(axis=0) + 0.5
    middle = middle - half + (low + high) * half / (COARSE - 1)
    half *= float((high - low).max()) / (COARSE - 1 - 2 * MARGIN)
    carved = _hull(pictures, images, back, middle, half)
    skin, hull = _distance(carved) > -DEEP, carved.sum()
    even = images / exposures[:, None, None, None]
    while (wrong := contradicted(pictures, even, carved, middle, half))[1] > ENOUGH:
        carved &= ~wrong[0]
    if not carved.any():
        raise AssetError("the pictures contradict all of the hull", hint="check poses, lens and exposures")
    switch, fresh = int(SWITCH * steps), 0
    foggy, cavity = switch >= FIRST, bool(carved.sum() < CAVITY * hull)
    dense, lean = (FIRM, LEAN) if cavity else (DENSE, 0.0)
    walls = Walls(_distance(carved), np.zeros((*carved.shape, 3)), fog=skin & cavity if foggy else None)
    plain = torch.tensor(known, dtype=torch.float32)
    gain = torch.tensor(np.log(exposures), dtype=torch.float32, requires_grad=True)
    gains = torch.optim.Adam([gain], lr=RATES[2])
    eyes = torch.tensor(np.array([p.camera.position for p in pictures]) - middle + half, dtype=torch.float32)
    ways = torch.tensor(np.stack([p.rays() for p in pictures]).reshape(-1, 3), dtype=torch.float32)
    target, each = torch.tensor(images.reshape(-1, 3)), images[0, ..., 0].size
    first, last = _reach(walls, eyes.repeat_interleave(each, 0), ways, 2.0 * half)
    hit = (last > first).nonzero()[:, 0]
    parts = hit.split(torch.bincount(hit // each, minlength=len(images)).tolist())

    def lit(walls: Walls) -> np.ndarray:
        """Return which nodes light of two pictures comes to."""
        voxel = 2.0 * half / (walls.n - 1)
        found = [
            walls.lit(eye / voxel, ways[ray], first[ray] / voxel, last[ray] / voxel)
            for eye, ray in zip(eyes, parts, strict=True)
        ]
        return torch.stack(found).sum(0).numpy() > 1

    for step in range(steps):
        size = FINE if step >= switch else COARSE
        if size != walls.n or (step - fresh >= AGAIN and not foggy and step < 0.9 * steps):
            walls, fresh, foggy = walls.anew(size, lit(walls) if foggy else None, dense), step, False
        part = (step - switch) / (steps - switch) if step >= switch else step / switch
        beta = WIDEST if foggy else WIDEST * (SHARPEST / WIDEST) ** min(part / 0.7, 1.0)
        for group, rate in zip(walls.optimiser.param_groups, RATES, strict=False):
            group["lr"] = rate * 0.1 ** ((step / steps) ** 2)
        ray = hit[torch.randint(len(hit), (RAYS // 2 if foggy else RAYS,))]
        voxel, of = 2.0 * half / (walls.n - 1), ray // each
        near, far = first[ray] / voxel, last[ray] / voxel
        color, left = walls.march(eyes[of] / voxel, ways[ray], near, far, STRIDE, beta)
        seen = torch.exp(gain)[of, None] * (color + left[:, None] * plain)
        error = ((torch.minimum(seen, 1.0 + 0.01 * (seen - 1.0)) - target[ray]) ** 2).mean()  # cut at white
        for optimiser in (walls.optimiser, gains):
            optimiser.zero_grad()
        price = EMPTY if foggy else lean * max(1.0 - part / 0.7, 0.0)
        (error + walls.roughness(0.0 if foggy else EIKONAL) + price * walls.matter()).backward()
        for optimiser in (walls.optimiser, gains):
            optimiser.step()
        if progress is not None:
            progress(step + 1, error.item())
    s, c = walls.dense()
    s, c = 2.0 * _zoomed(s, 2.0), _zoomed(_in_front(s, c), 2.0)
    beta, s = 2.0 * CRISP, s + THINNER
    tail = 0.5 * np.exp(-np.abs(s) / beta)
    density = np.where(s > 0.0, tail, 1.0 - tail) * (len(s) - 1) / (2.0 * half * beta)
    box = np.stack([middle - half, middle + half])
    field = RadianceGrid.from_bounds(density, c[..., None, :], box, name="trained field", metres=metres)
    full = _zoomed(s, COARSE / len(s)) < 0.0
    share: Any = contradicted(pictures, even, full, middle, half)[1]
    spare: Any = ndimage.binary_opening(carved & ~full)  # a hull is a node or two too large everywhere
    allowed = 1.0 + float(spare.sum() / full.sum())
    return replace(field.cropped(*field.surroundings), contradicted=share, allowed=allowed)


def _cube(pictures: Sequence[PosedPicture]) -> tuple[Array, float]:
    """Return the point nearest to all axes, and half the edge of a cube around it that pictures see across."""
    eyes = np.array([p.camera.position for p in pictures])
    axes = np.array([p.camera.world_to_camera[2, :3] for p in pictures])
    flat = np.eye(3) - axes[:, :, None] * axes[:, None]
    middle = np.linalg.solve(flat.sum(axis=0), (flat @ eyes[..., None]).sum(axis=0))[:, 0]
    c = pictures[0].camera
    wide = 0.5 * min(c.width / c.fx, c.height / c.fy)
    return middle, float(np.linalg.norm(eyes - middle, axis=1).mean()) * wide / np.hypot(1.0, wide)


def _hull(
    pictures: Sequence[PosedPicture], images: NDArray[np.float32], walls: Array, middle: Array, half: float
) -> NDArray[np.bool_]:
    """Return the nodes of the coarse grid that half of the pictures see, and that lie in the silhouettes."""
    line = np.linspace(-half, half, COARSE)
    nodes = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1) + middle
    beside, seen = np.zeros((COARSE,) * 3, int), np.zeros((COARSE,) * 3, int)
    for picture, image, back in zip(pictures, images, walls, strict=True):
        apart: Any = np.abs(ndimage.gaussian_filter(image, (0.7, 0.7, 0.0)) - back).max(axis=-1) > CONTRAST
        front: Any = ndimage.binary_dilation(ndimage.binary_opening(ndimage.binary_fill_holes(apart)), iterations=SLACK)
        j, i = np.moveaxis(np.floor(picture.project(nodes)).astype(int), -1, 0)
        inside = (i >= 0) & (i < front.shape[0]) & (j >= 0) & (j < front.shape[1])
        seen += inside
        beside += inside & ~front[i.clip(0, front.shape[0] - 1), j.clip(0, front.shape[1] - 1)]
    hull: Any = ndimage.binary_erosion((beside < VOTES) & (2 * seen >= len(images)))
    return hull


def _distance(full: NDArray[np.bool_]) -> Array:
    """Return the signed distance of nodes from the faces between full ones and others [voxels]."""
    far: Any = ndimage.distance_transform_edt(~full)
    far -= ndimage.distance_transform_edt(full)
    return far - 0.5 * np.sign(far)


def _zoomed(values: Array, zoom: float) -> Array:
    """Return values (n, n, n, ...) at as many times more nodes an edge."""
    found: Any = ndimage.zoom(values, (zoom,) * 3 + (1.0,) * (values.ndim - 3), order=1)
    return found


def _in_front(s: Array, c: Array) -> Array:
    """Return colours (n, n, n, 3) of nodes near a surface where light is lost on its way to them: before s = 0."""
    near = np.abs(s) < 3.0
    slopes: Any = np.gradient(ndimage.gaussian_filter(s, 0.5))
    out = np.stack([slope[near] for slope in slopes])
    out *= (BEFORE - s[near]) / np.maximum((out**2).sum(axis=0), 0.25)
    at, moved = np.argwhere(near).T + out, c.copy()
    for k in range(3):
        moved[near, k] = ndimage.map_coordinates(c[..., k], at, order=1, mode="nearest")
    return moved


def _reach(walls: Walls, eye: torch.Tensor, way: torch.Tensor, edge: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return where rays come to the nodes that are learned, and where they leave them; last < first where nowhere."""
    voxel = edge / (walls.n - 1)
    near = torch.tensor(ndimage.maximum_filter(walls.near, 3).ravel())
    first, last = torch.full((len(eye),), torch.inf), torch.full((len(eye),), -torch.inf)
    for part in torch.arange(len(eye)).split(40_000):
        middle = ((0.5 * edge - eye[part]) * way[part]).sum(1)
        t = middle[:, None] + torch.arange(-0.87 * edge, 0.87 * edge, voxel)
        node = ((eye[part, None] + t[..., None] * way[part, None]) / voxel).round().long()
        ok = ((node >= 0) & (node < walls.n)).all(-1)
        node = node.clamp(0, walls.n - 1)
        ok &= near[(node[..., 0] * walls.n + node[..., 1]) * walls.n + node[..., 2]]
        first[part] = torch.where(ok, t, torch.inf).amin(1) - 0.5 * voxel
        last[part] = torch.where(ok, t, -torch.inf).amax(1) + 0.5 * voxel
    return first, last


class Walls:
    """Signed distances [voxels] and colours at the nodes of a cube near a surface; the others are out (0) or in (1)."""

    def __init__(self, distance: np.ndarray, shades: np.ndarray, *, fog: np.ndarray | None = None) -> None:
        """Take dense arrays (n, n, n) and (n, n, n, 3), learned near the surface; or begin as fog, dense in a skin."""
        n, near = len(distance), np.abs(distance) < BAND if fog is None else distance < 2.0
        kept = np.flatnonzero(near)
        rows = np.where(distance.ravel() > 0.0, 0, 1)
        rows[kept] = np.arange(2, len(kept) + 2)
        start = distance if fog is None else np.where(fog, SKIN, FOG) + np.maximum(distance, 0.0)
        table = np.column_stack([start.ravel(), shades.reshape(-1, 3)])[kept]
        table = np.concatenate([[[30.0, 0.0, 0.0, 0.0], [-30.0, 0.0, 0.0, 0.0]], table])
        self.n, self.near, self.rows, self.fog = n, near, torch.tensor(rows), fog is not None
        self.s = torch.tensor(table[:, :1], dtype=torch.float32, requires_grad=True)
        self.c = torch.tensor(table[:, 1:], dtype=torch.float32, requires_grad=True)
        self.cells = torch.tensor(ndimage.maximum_filter(near, 2, origin=-1).ravel())
        core = np.flatnonzero(near & (np.pad(np.ones((n - 2,) * 3), 1) > 0))
        around = self.rows[torch.tensor(core[:, None] + np.array([0, -n * n, n * n, -n, n, -1, 1]))]
        self.around = around[(around > 1).all(1)]
        self.optimiser = torch.optim.Adam([{"params": [x]} for x in (self.s, self.c)], betas=(0.9, 0.95), eps=1e-10)

    def dense(self) -> tuple[np.ndarray, np.ndarray]:
        """Return distances and colours at all nodes; far ones have the colour of the nearest."""
        s, c = (x.detach()[self.rows].reshape(self.n, self.n, self.n, -1).numpy() for x in (self.s, self.c))
        nearest: Any = ndimage.distance_transform_edt(~self.near, return_distances=False, return_indices=True)
        return s[..., 0], c[tuple(nearest)]

    def anew(self, n: int, lit: np.ndarray | None = None, dense: float = DENSE) -> Walls:
        """Return them with true distances from the surface of the largest part, perhaps on a finer grid.

        What was fog is full below s = `dense`, where it is not `lit` (n^3,), or enclosed but for holes of some nodes.
        """
        s, c = self.dense()
        zoom = n / self.n
        if lit is not None:
            s = s - dense
            within: Any = ndimage.binary_erosion(self.near, iterations=2)
            solid: Any = (s < 0.0) | (within & ~lit.reshape(s.shape))
            whole: Any = ndimage.binary_fill_holes(ndimage.binary_closing(solid, iterations=2))
            s = np.where(solid | ndimage.binary_erosion(whole), -np.abs(s), np.abs(s))
        s = _zoomed(np.clip(s, -3.0, 3.0), zoom) * zoom
        found: Any = ndimage.label(s < 0.0)
        parts, count = found
        if not count:
            raise AssetError("nothing is left of the object", hint="check exposure, poses, and the colour of the wall")
        full = parts == 1 + np.argmax(np.bincount(parts.ravel())[1:])
        far = _distance(full)
        s = np.where((np.abs(s) < 1.5 * zoom) & (np.abs(far) < 2.5), np.sign(far) * np.abs(s), far)
        return Walls(s, _zoomed(c, zoom) if zoom != 1.0 else c)

    def matter(self) -> torch.Tensor:
        """Return the sum of the light that nodes of fog take within a voxel, or how many nodes are inside."""
        if not self.fog:
            return torch.sigmoid(-self.s[2:] / WIDEST).sum()
        half = 0.5 * torch.exp(-self.s[2:].abs() / WIDEST)
        return (1.0 - torch.exp(-torch.where(self.s[2:] > 0.0, half, 1.0 - half) / WIDEST)).sum()

    def roughness(self, eikonal: float) -> torch.Tensor:
        """Return what a step lowers beside the error: no distance, curved, colours that change from node to node."""
        rows = self.around[torch.randint(len(self.around), (REGULAR,))]
        s, c = self.s[:, 0][rows], self.c[rows[:, :4]]
        slope = 0.5 * (s[:, 2::2] - s[:, 1::2]).norm(dim=1)
        curve = s[:, 1:].sum(1) - 6.0 * s[:, 0]
        change = ((c[:, :1] - c[:, 1:]) ** 2).sum(-1)
        return eikonal * ((slope - 1.0) ** 2).mean() + SMOOTH * (curve**2).mean() + EVEN * change.mean()

    def _samples(
        self, eye: torch.Tensor, way: torch.Tensor, first: torch.Tensor, last: torch.Tensor, step: float
    ) -> tuple[torch.Size, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the shape (R, S) of samples, which of them lie in cells, and the rows and weights of their nodes."""
        ticks = torch.arange(float(((last - first) / step).max()))[None] + torch.rand(len(way), 1)
        t = first[:, None] + ticks * step
        at = eye[..., None, :] + t[..., None] * way[:, None]
        corner = at.floor().long().clamp(0, self.n - 2)
        flat = (corner[..., 0] * self.n + corner[..., 1]) * self.n + corner[..., 2]
        use = (self.cells[flat] & (t < last[:, None])).reshape(-1).nonzero()[:, 0]
        f = (at - corner).reshape(-1, 3)[use].clamp(0.0, 1.0)
        bits = torch.tensor(list(np.ndindex(2, 2, 2)))
        rows = self.rows[flat.reshape(-1)[use][:, None] + bits @ torch.tensor([self.n**2, self.n, 1])]
        return t.shape, use, rows, torch.where(bits > 0, f[:, None], 1.0 - f[:, None]).prod(-1)

    def _depths(
        self, shape: torch.Size, use: torch.Tensor, rows: torch.Tensor, weight: torch.Tensor, step: float, beta: float
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return optical depths of samples (R, S), the light that comes to each, and where the first is not 0."""
        s = (self.s.index_select(0, rows.reshape(-1)).reshape(-1, 8) * weight).sum(1)
        if self.fog:
            half = 0.5 * torch.exp(-s.abs() / beta)
            tau = torch.where(s > 0.0, half, 1.0 - half) * (step / beta)
            there = full = torch.zeros(shape.numel()).index_put((use,), tau).reshape(shape)
        else:
            far = torch.full((shape.numel(),), 30.0).index_put((use,), s).reshape(shape)
            there = torch.nn.functional.softplus(-far / beta)
            full = torch.relu(there.diff(dim=1, append=there[:, -1:]))
        return full, torch.exp(full - full.cumsum(1)), there

    @torch.no_grad()
    def lit(self, eye: torch.Tensor, way: torch.Tensor, first: torch.Tensor, last: torch.Tensor) -> torch.Tensor:
        """Return which nodes (n^3,) light of rays comes to."""
        found = torch.zeros(len(self.s))
        for some in torch.arange(len(way)).split(AT_ONCE) if len(way) else ():
            shape, use, rows, weight = self._samples(
                eye.expand(way.shape)[some], way[some], first[some], last[some], 0.7
            )
            light = self._depths(shape, use, rows, weight, 0.7, SHARPEST)[1].reshape(-1)[use]
            found.scatter_reduce_(0, rows.gather(1, weight.argmax(1, True))[:, 0], light, "amax")
        return found[self.rows] > LIT

    def march(
        self, eye: torch.Tensor, way: torch.Tensor, first: torch.Tensor, last: torch.Tensor, step: float, beta: float
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return colour times coverage (R, 3) and light left (R,) of rays [voxels] between two places each."""
        shape, use, rows, weight = self._samples(eye, way, first, last, step)
        with torch.no_grad():
            _, light, there = (x.reshape(-1)[use] for x in self._depths(shape, use, rows, weight, step, beta))
            seen = (there > 1e-4) & (light > 1e-3)
        rows, weight, use = rows[seen], weight[seen], use[seen]
        tau, light, _ = self._depths(shape, use, rows, weight, step, beta)
        share = (light * (1.0 - torch.exp(-tau))).reshape(-1)[use]
        color = 0.5 + SH_DC * (self.c.index_select(0, rows.reshape(-1)).reshape(-1, 8, 3) * weight[..., None]).sum(1)
        color = torch.zeros(len(way), 3).index_add(0, use // shape[1], share[:, None] * color)
        return color, torch.exp(-tau.sum(1))
