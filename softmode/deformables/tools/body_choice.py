"""Another body in the place of an instance, per world and inside a captured graph, as at a reset."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import body_key
from softmode.deformables.model.declare import launch
from softmode.deformables.model.newton_step_kernels import NewtonArrays
from softmode.deformables.model.struct_kernels import Motion, PointConstraints, Points, Samples
from softmode.deformables.model.tables import allocate, starts_of
from softmode.deformables.solver.solver_base import ReducedSolver, require_reduced
from softmode.deformables.solver.solver_reduced import require_materials
from softmode.deformables.solver.step_tables import FILLED
from softmode.deformables.tools import body_choice_kernels as kernels
from softmode.errors import ConfigError

_KEPT = (*FILLED, "shape", "direction", "system_start", "rigid_tolerance")
"""Arrays of a step that do not begin with zeros, that every step writes whole, or that have a row per world."""


class BodyChoice:
    """Bodies of which every soft body of a world may be any, or none; all are resident, instances point to theirs.

    A soft body that is none is inert: it touches nothing, nothing moves it, and it takes no part in the solve. An
    instance must have room for the largest, see
    :func:`softmode.deformables.model.authoring.reserve_room`: the memory of a world is that of the largest body, and
    the bases of all bodies are stored once.

    Args:
        solver: A solver of soft bodies.
        bodies: The bodies, all of them among those of the solver.
        materials: What each is made of; only what :func:`set_parameters` does not set is taken from it.

    Raises:
        ConfigError: If a body is not among the solver's or has pins; for exact regions see `require_materials`.
    """

    def __init__(self, solver: ReducedSolver, bodies: Sequence[ReducedBody], materials: Sequence[Material]) -> None:
        """Upload a row per body."""
        self._solver = require_reduced(solver)
        tables = self._solver.tables
        layout, options, device = tables.layout, tables.options, tables.model.device
        if layout.pin_max:
            raise ConfigError("bodies can be chosen in worlds without pins only", hint="leave the pins out")
        known = {body_key(body): a for a, body in enumerate(layout.bodies)}
        missing = [body.name for body in bodies if body_key(body) not in known]
        if missing:
            what = f"bodies to choose from: {missing[0]!r} is not among the solver's"
            raise ConfigError(what, hint="give the solver all bodies")
        require_materials([body.driven_count for body in bodies], [int(one.model) for one in materials])
        asset = np.array([known[body_key(body)] for body in bodies])
        points, samples = (
            np.array([getattr(body, name) for body in layout.bodies]) for name in ("point_count", "surface_count")
        )
        size = np.array([float(np.linalg.norm(np.ptp(body.bounds, axis=0))) for body in bodies])
        rows: dict[str, Any] = {
            "asset": asset,
            "key": np.array([body_key(body) for body in bodies]),
            "function_count": [body.function_count for body in bodies],
            "driven_count": [body.driven_count for body in bodies],
            "point_start": starts_of(points)[asset],
            "point_count": points[asset],
            "row_start": starts_of(samples)[asset],
            "sample_count": samples[asset],
            "volume": [body.volume for body in bodies],
            "area": [body.surface.areas.sum() for body in bodies],
            "size": size,
            "tolerance": options.tolerance * size,
            "margin": options.contact_margin * size,
            "smoothing": options.contact_smoothing * size,
            "spacing": [np.sqrt(body.surface.areas.mean()) for body in bodies],
            "material_model": [int(one.model) for one in materials],
            "viscosity": [one.viscosity for one in materials],
            "mass_damping": [one.mass_damping for one in materials],
        }
        self._rows = allocate(kernels.BodyRows, "", {}, device, given=rows)
        self._history = _histories(tables)

    def set(self, choice: wp.array, world_mask: wp.array) -> None:
        """Put the chosen bodies into the masked worlds; reads nothing back and may be captured.

        Parameters, places and the state come after it: call ``set_parameters`` and ``solver.reset`` for the same
        worlds.

        Args:
            choice: Which body each instance is, -1 for none, int32, shape (instance_count,).
            world_mask: Which worlds, shape (world_count,) bool.
        """
        tables = self._solver.tables
        out = (tables.scaled.rest, tables.instances, tables.parameters.body_key)
        tables.launch(kernels.choose_bodies, tables.layout.instance_count, self._rows, choice, world_mask, *out)
        for words in self._history:
            tables.launch(kernels.clear_rows, words.shape, tables.instances.world, world_mask, words)


def copy_slots(
    table: wp.array, out: wp.array, choice: wp.array, world_mask: wp.array, *, parts: Sequence[int] | None = None
) -> None:
    """Copy from a table with a row per choice to a row per world, in the masked worlds; capturable.

    Args:
        table: A row per choice, of a multiple of 32 bits.
        out: A row per world, shape (world_count, ...).
        choice: Which row each slot of a world has, int32, shape (world_count * slots,), -1 for none, which means zeros.
        world_mask: Which worlds, shape (world_count,) bool.
        parts: How many entries of the second axis follow each slot; those behind them follow the first, as all do where
            there are none.
    """
    device: Any = out.device
    worlds = out.shape[0]
    slots = choice.shape[0] // worlds
    rows, words = words_of(table, table.shape[0]), words_of(out, worlds)
    each = words.shape[1] // out.shape[1] if out.ndim > 1 else 1
    begin = 0
    followed = [] if parts is None else [each * part for part in parts]
    for slot, width in [*enumerate(followed), (0, words.shape[1] - sum(followed))]:
        if width:
            launch(device, kernels.copy_rows, (worlds, width), rows, choice, slots, slot, begin, world_mask, words)
        begin += width


def words_of(array: wp.array, rows: int) -> wp.array:
    """Return an array that has so many rows one after another as words of 32 bits, shape (rows, words); no copy."""
    words = array.size * wp.types.type_size_in_bytes(array.dtype) // 4
    return wp.array(ptr=array.ptr, dtype=wp.uint32, shape=(rows, words // rows), device=array.device, copy=False)


def _histories(tables: Any) -> list[wp.array]:
    """Return all that a step may leave behind in the row of an instance beyond the functions of a smaller body."""
    count = tables.layout.instance_count
    found = []
    owned: list[tuple[Any, Any]] = [
        (Motion, tables.motion),
        (Points, tables.points),
        (NewtonArrays, tables.arrays),
        (Samples, tables.samples),
        (PointConstraints, tables.constraints),
    ]
    for struct, table in owned:
        for name in struct.vars:
            value = getattr(table, name)
            if name in _KEPT or not isinstance(value, wp.array) or not value.is_contiguous:
                continue
            if value.size and value.shape[0] == count:
                found.append(words_of(value, count))
    return found
