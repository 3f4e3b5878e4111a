"""Contact of soft bodies with each other and with themselves: buffers and launches, see ``pair_kernels``."""

from typing import Any

import numpy as np
import warp as wp
from scipy.spatial import KDTree

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.contact import pair_kernels as kernels
from softmode.deformables.model.lane_kernels import LANES, team_size, vec8
from softmode.deformables.model.layout import Layout
from softmode.deformables.model.struct_kernels import SLOTS


class SoftPairs:
    """Finds which soft bodies touch and writes their entries; does nothing in worlds where none are near.

    Args:
        model: Finalised model.
        layout: Its layout; rows of surface gradients and dynamic rows are added to the basis.
        pair_max: Pairs per instance at most.
        stick_ratio: Tangential over normal stiffness of a contact that sticks; 0 for friction without memory.
        spacing: Of the surface samples of each instance [m], shape (instance_count,).
    """

    def __init__(self, model: Any, layout: Layout, pair_max: int, stick_ratio: float, spacing: wp.array) -> None:
        """Allocate everything once."""
        self.model, self.layout, self.stick_ratio = model, layout, stick_ratio
        self.device, count, sample_max = model.device, layout.instance_count, layout.sample_max
        pairs: Any = kernels.Pairs()
        pairs.first_row = layout.basis.row.shape[0]
        pairs.spacing = spacing
        table = np.concatenate([neighbours(body) for body in layout.bodies])
        pairs.neighbour = wp.array(table, dtype=int, device=self.device)
        pairs.surface_normal = self._zeros((count, sample_max), wp.vec3)
        pairs.thickness = wp.array(
            np.concatenate([thickness(b) for b in layout.bodies]), dtype=float, device=self.device
        )
        self.team = team_size(self.device)
        pairs.tally = self._zeros((count, self.team, 2), int)
        shape = (count, sample_max, SLOTS)
        pairs.other, pairs.nearest, pairs.held = (self._zeros(shape, int) for _ in range(3))
        pairs.gap, pairs.normal = self._zeros(shape, wp.float64), self._zeros(shape, wp.vec3d)
        pairs.near, pairs.count = (self._zeros((count,), int) for _ in range(2))
        pairs.sample, pairs.entry, pairs.mirror = (self._zeros((count, pair_max), int) for _ in range(3))
        self.table = pairs
        self._extend_basis(count * pair_max)

    def _zeros(self, shape: tuple[int, ...], dtype: Any) -> Any:
        return wp.zeros(shape, dtype=dtype, device=self.device)

    def _extend_basis(self, dynamic_count: int) -> None:
        """Add normals and gradients at the samples, and room for the dynamic rows."""
        basis, bodies = self.layout.basis, self.layout.bodies
        blocks = basis.row.shape[1]
        gradients = np.zeros((sum(body.surface_count for body in bodies), blocks * LANES, 3), np.float32)
        start = 0
        for body in bodies:
            rows = slice(start, start + body.surface_count)
            gradients[rows, : body.function_count] = body.evaluate(body.surface_points)[1]
            start += body.surface_count
        gradients = gradients.reshape(start, blocks, LANES, 3).transpose(1, 0, 3, 2)
        basis.row_gradient = wp.array(np.ascontiguousarray(gradients), dtype=vec8, device=self.device)
        normals = np.concatenate([body.surface_normals for body in bodies]).astype(np.float32)
        basis.row_normal = wp.array(normals, dtype=wp.vec3, device=self.device)
        rows = self._zeros((basis.row.shape[0] + dynamic_count, blocks), vec8)
        wp.copy(rows, basis.row, count=basis.row.size)
        basis.row = rows

    def detect(
        self, motion: Any, samples: Any, progress: Any, memory: Any, entries: Any, *, entry_max: int, dt: float
    ) -> None:
        """Find the pairs of this step, ``samples`` being placed and bounded, and append them to the entries.

        ``memory`` are the attributes of the state, with what sticks.
        """
        layout, pairs = self.layout, self.table
        instances, basis = layout.instances, layout.basis
        every = samples.position.shape
        self._launch(kernels.mark_near, layout.instance_count, [instances, progress, samples], [pairs])
        self._launch(kernels.place_surface, every, [instances, basis, motion, samples], [pairs])
        self._launch(kernels.find_pairs, every, [instances, basis, progress, samples], [pairs])
        dim = (layout.instance_count, self.team)
        self._launch(kernels.compact_pairs, dim, [instances, self.team], [pairs, progress.status], self.team)
        self._launch(kernels.accept_pairs, layout.world_count, [progress, entry_max], [pairs, entries, progress.status])
        stick = [wp.float64(self.stick_ratio), memory.stick_partner, memory.stick_slip, dt]
        tables = [instances, basis, motion, samples, progress, *stick]
        self._launch(kernels.write_pairs, pairs.sample.shape, tables, [pairs, entries])

    def remember(self, motion: Any, progress: Any, entries: Any, memory: Any) -> None:
        """Write what sticks at the end of the step into the attributes of the state."""
        layout = self.layout
        tables = [layout.instances, layout.basis, motion, progress, self.table, entries]
        out = [memory.stick_partner, memory.stick_slip]
        self._launch(kernels.remember_pairs, self.table.surface_normal.shape, tables, out)

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any], outputs: list[Any], block_dim: int = 256) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, block_dim=block_dim, device=self.device)


def thickness(body: ReducedBody) -> np.ndarray:
    """Return how thick the body is at rest below each surface sample, shape (surface_count,) [m].

    The distance along the inner normal to the first samples that look the other way; the body's size where there are
    none.
    """
    x, normals = body.surface_points, body.surface_normals
    beside = (1.5**2) * body.surface_areas.mean()
    out = np.full(len(x), float(np.linalg.norm(np.ptp(body.bounds, axis=0))))
    for s, n in enumerate(normals):
        away = x[s] - x
        depth = away @ n
        opposite = (depth > 0.0) & (normals @ n < 0.0) & ((away**2).sum(axis=1) - depth**2 < beside)
        out[s] = depth[opposite].min(initial=out[s])
    return out


def neighbours(body: ReducedBody) -> np.ndarray:
    """Return the nearest surface samples of each at rest, itself first, shape (surface_count, NEIGHBOURS); -1 pads."""
    count = min(kernels.NEIGHBOURS, body.surface_count)
    out = np.full((body.surface_count, kernels.NEIGHBOURS), -1)
    out[:, :count] = KDTree(body.surface_points).query(body.surface_points, count)[1]
    return out
