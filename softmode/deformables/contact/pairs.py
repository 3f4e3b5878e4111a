"""Contact of soft bodies with each other and with themselves: tables and launches, see ``pair_kernels``."""

from __future__ import annotations

from functools import partial

import numpy as np
import warp as wp
from scipy.spatial import KDTree

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.contact import dent_kernels
from softmode.deformables.contact import pair_kernels as kernels
from softmode.deformables.contact.cell_kernels import Surface
from softmode.deformables.model.declare import Kernel, launch, launch_teams
from softmode.deformables.model.lane_kernels import team_size
from softmode.deformables.model.layout import Layout
from softmode.deformables.model.namespaces import SoftState
from softmode.deformables.model.struct_kernels import (
    SLOTS,
    Basis,
    Instances,
    Motion,
    NewtonState,
    PointConstraints,
    Samples,
)
from softmode.deformables.model.tables import allocate

_AXES = {
    "": "instance sample slot",
    "near count": "instance",
    "surface_normal surface_area": "instance sample",
    "sample constraint mirror": "instance pair",
    "tally": "instance team 2",
}


class SoftPairs:
    """Finds which soft bodies touch and writes their point constraints; does nothing in worlds where none are near.

    Args:
        layout: Layout of the model, which says how many contacts there may be.
        instances: Its instances.
        basis: Their bases, with the rows that contact between soft bodies writes.
        stick_ratio: Tangential over normal stiffness of a contact that sticks; 0 for friction without memory.
        spacing: Of the surface samples of each instance [m], shape (instance_count,).
        surface: What contact knows of the surface samples of all bodies.
        device: Where the tables lie.
    """

    def __init__(
        self,
        layout: Layout,
        instances: Instances,
        basis: Basis,
        stick_ratio: float,
        spacing: wp.array,
        surface: Surface,
        device: wp.Device,
    ) -> None:
        """Allocate the tables."""
        self.layout, self.instances, self.basis, self.device = layout, instances, basis, device
        self.stick_ratio, self.team = stick_ratio, team_size(device)
        self.surface = surface
        sizes = {
            "instance": layout.instance_count,
            "sample": layout.sample_max,
            "slot": SLOTS,
            "pair": layout.pair_max,
            "team": self.team,
        }
        given = {
            "first_row": basis.row.shape[0] - layout.instance_count * layout.pair_max,
            "spacing": spacing,
            "neighbour": np.concatenate([neighbours(body) for body in layout.bodies]),
            "thickness": np.concatenate([thickness(body) for body in layout.bodies]),
        }
        self.table = allocate(kernels.Pairs, _AXES, sizes, device, given=given)
        self.any_near = wp.zeros(1, dtype=int, device=device)
        """Whether any instance may touch another one, or itself, in this step."""

    def detect(
        self,
        motion: Motion,
        samples: Samples,
        state: NewtonState,
        memory: SoftState,
        constraints: PointConstraints,
        *,
        dt: float,
    ) -> None:
        """Find the pairs of this step and append them to the constraints.

        Args:
            motion: Motion of the step.
            samples: Surface samples, placed and bounded.
            state: Where Newton's iteration stands.
            memory: What sticks, as the state of the step says.
            constraints: Point constraints of the step.
            dt: Step [s].
        """
        self.any_near.zero_()
        near = (self.instances, state, samples, self.table, self.any_near)
        self._launch(kernels.mark_near, self.layout.instance_count, *near)
        given = {"motion": motion, "samples": samples, "state": state, "memory": memory, "constraints": constraints}
        found, none = partial(self._find, **given, dt=dt), partial(self._none, constraints)
        wp.capture_if(self.any_near, on_true=found, on_false=none)

    def _none(self, constraints: PointConstraints) -> None:
        """Write that nothing touches."""
        self.table.count.zero_()
        constraints.pair_count.zero_()

    def _find(
        self,
        motion: Motion,
        samples: Samples,
        state: NewtonState,
        memory: SoftState,
        constraints: PointConstraints,
        dt: float,
    ) -> None:
        """Find the pairs, where some bodies are near."""
        pairs, instances, basis = self.table, self.instances, self.basis
        every, count, constraint_max = samples.position.shape, self.layout.instance_count, constraints.row.shape[1]
        self._launch(kernels.place_surface, every, instances, basis, motion, samples, pairs)
        self._launch(kernels.find_pairs, every, instances, basis, state, samples, self.surface.curvature, pairs)
        launch_teams(self.device, kernels.compact_pairs, count, self.team, instances, self.team, pairs, state.status)
        found = (pairs, constraints, state.status)
        self._launch(kernels.accept_pairs, self.layout.world_count, state, constraint_max, *found)
        stick = (wp.float64(self.stick_ratio), memory.stick_partner, memory.stick_slip, dt)
        tables = (instances, basis, motion, samples, state, self.surface, *stick)
        self._launch(kernels.write_pairs, pairs.sample.shape, *tables, pairs, constraints)

    def remember(self, motion: Motion, state: NewtonState, constraints: PointConstraints, memory: SoftState) -> None:
        """Write what sticks at the end of the step into the state ``memory``; arguments as for :meth:`detect`."""
        tables = (self.instances, self.basis, motion, state, self.table, constraints)
        out, every = (memory.stick_partner, memory.stick_slip), self.table.surface_normal.shape

        def none() -> None:
            memory.stick_partner.fill_(wp.vec2i(-1, -1))
            memory.stick_slip.zero_()

        wp.capture_if(
            self.any_near, on_true=lambda: self._launch(kernels.remember_pairs, every, *tables, *out), on_false=none
        )

    def leave_dents(self, constraints: PointConstraints, memory: SoftState) -> None:
        """Add the dents that these contacts leave to those in the state ``memory``."""
        tables = (self.instances, self.table, constraints, memory.dent)
        self._launch(dent_kernels.leave_pair_dents, self.table.surface_normal.shape, *tables)

    def _launch(self, kernel: Kernel, dim: int | tuple[int, ...], *arguments: object) -> None:
        launch(self.device, kernel, dim, *arguments)


def thickness(body: ReducedBody) -> np.ndarray:
    """Return how thick the body is at rest below each surface sample, shape (surface_count,) [m].

    The distance along the inner normal to the first samples that look the other way; the body's size where there are
    none.
    """
    x, normals = body.surface.points, body.surface.normals
    beside = (1.5**2) * body.surface.areas.mean()
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
    out[:, :count] = KDTree(body.surface.points).query(body.surface.points, count)[1]
    return out
