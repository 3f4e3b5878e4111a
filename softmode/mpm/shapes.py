"""GridShapes: the rigid shapes of a Newton model, which act on the grid and get back a wrench."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import newton
import numpy as np
import warp as wp

from softmode.checks import require_choice
from softmode.deformables.contact.shape_query_kernels import HEIGHTFIELD, PLANE
from softmode.deformables.contact.shape_tables import shape_table, solid_shapes
from softmode.deformables.model.tables import host
from softmode.errors import ConfigError
from softmode.mpm.shape_kernels import Obstacles

Boundary = Literal["stick", "slip", "separate"]


class GridShapes:
    """The shapes of a Newton model that collide with particles (``ShapeFlags.COLLIDE_PARTICLES``).

    A shape acts on the grid nodes that lie inside of it or within its margin (``ShapeConfig.margin``):

    - "stick": they move with the shape;
    - "slip": they slide along it without friction, and do not leave it;
    - "separate": they slide with the shape's Coulomb friction (``ShapeConfig.mu``), and leave it freely.

    The body of a shape moves on with the velocity that it has at the start of a run. Derivatives of a run hold with
    shapes, except by where they are; they are one-sided where a node begins to slide or to separate.
    """

    def __init__(
        self,
        model: newton.Model,
        *,
        boundary: Boundary | Sequence[Boundary] = "separate",
        state: newton.State | None = None,
    ) -> None:
        """Read the shapes of a model.

        Args:
            model: The model; closed meshes, heightfields and primitives.
            boundary: What shapes do to nodes, one word for all or one for each shape of the model.
            state: Where bodies are and how they move; the model's initial state when None.

        Raises:
            ConfigError: If no shape collides with particles, or one has a form whose distance cannot be queried.
        """
        words = [boundary] * model.shape_count if isinstance(boundary, str) else list(boundary)
        if len(words) != model.shape_count:
            raise ConfigError(f"boundary: expected one word for each of {model.shape_count} shapes, got {len(words)}")
        for word in words:
            require_choice("boundary", word, get_args(Boundary))
        found = np.flatnonzero(solid_shapes(model)) if model.shape_count else np.zeros(0, dtype=int)
        if not len(found):
            raise ConfigError(
                "model: no shape collides with particles",
                hint="add one, or leave has_particle_collision of its ShapeConfig as it is",
            )
        self.model = model
        table, self._alive = shape_table(model)
        codes = np.array([get_args(Boundary).index(word) for word in words], dtype=np.int32)
        self.worlds = host(model.shape_world)[found]
        """World of each shape that acts, -1 for all of them."""
        self._found = found
        self.obstacles = Obstacles()
        with wp.ScopedDevice(model.device):
            self.obstacles.index = wp.array(found.astype(np.int32), dtype=int)
            self.obstacles.world = wp.array(self.worlds.astype(np.int32), dtype=int)
            self.obstacles.boundary = wp.array(codes[found], dtype=int)
        self._table = table
        self.place(state or model.state())

    def place(self, state: newton.State) -> None:
        """Take poses and velocities of the bodies from a state; its arrays are read when a run is stepped."""
        self._table.body_q, self._table.body_qd = state.body_q, state.body_qd
        self.obstacles.shapes = self._table

    def require_wide(self, spacing: float) -> None:
        """Raise if a shape is so thin that no node may lie in it.

        Args:
            spacing: Distance between nodes [m].

        Raises:
            ConfigError: If the bounds of a shape with its margin are thinner than a cell.
        """
        model = self.model
        edges = host(model.shape_collision_aabb_upper) - host(model.shape_collision_aabb_lower)
        thin = edges.min(axis=1) + 2.0 * host(model.shape_margin)
        solid = np.isin(host(model.shape_type), (PLANE, HEIGHTFIELD), invert=True)
        for shape in self._found[(solid & (thin < spacing))[self._found]]:
            raise ConfigError(
                f"shape {shape} ({model.shape_label[shape]!r}) is {thin[shape]:.3g} m thin, less than a cell of "
                f"{spacing:g} m, so that nodes may miss it",
                hint="give it a margin (ShapeConfig.margin) or thickness, take smaller cells, or clear its "
                "COLLIDE_PARTICLES flag (ShapeConfig.has_particle_collision)",
            )
