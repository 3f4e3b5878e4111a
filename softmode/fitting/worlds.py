"""`FitWorlds`: one held body in many worlds, one world for each set of parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import newton
import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.model.namespaces import soft
from softmode.deformables.model.status import WORLD_NOT_FINITE
from softmode.deformables.model.tables import present
from softmode.deformables.solver.solver_reduced import SolverReduced, SolverReducedOptions
from softmode.deformables.tools.start import set_states
from softmode.errors import SolverDiverged
from softmode.scenes.capture import capture_graph

Array = NDArray[np.float64]
GRAVITY = 9.81
"""[m/s^2]."""


class FitWorlds:
    """Worlds of one body that regions of its own hold; a run is all starts, or a whole Jacobian, at once.

    Args:
        body: The body, placed where its file has it: the origin of the body frame lies at minus the translation of
            `softmode.objects.file_frame`.
        material: What is the same in all worlds.
        count: Number of worlds.
        dt: Step [s].
        load: Force on each surface sample [N], shape (surface_count, 3); None for none.
        device: Warp device.
    """

    def __init__(
        self,
        body: ReducedBody,
        material: Material,
        count: int,
        *,
        dt: float,
        load: Array | None = None,
        device: wp.DeviceLike = None,
    ) -> None:
        """Allocate the worlds."""
        world, builder = newton.ModelBuilder(), newton.ModelBuilder()
        add_reduced_body(world, body, material=material)
        builder.replicate(world, count)
        self.body, self.count, self.dt = body, count, dt
        self.steps = 0
        """Steps of worlds so far."""
        model = builder.finalize(device=device)
        options = SolverReducedOptions(integrator="bdf2")
        self._model, self._solver = model, SolverReduced(model, [body], options=options)
        self._states, self._control = (model.state(), model.state()), model.control()
        self._graph: Callable[[], None] | None = None
        if load is not None:
            for state in self._states:
                present(state.particle_f).assign(np.tile(load, (count, 1)).astype(np.float32))

    def run(
        self,
        parameters: Mapping[str, ArrayLike],
        seconds: float,
        *,
        tilt: ArrayLike = (0.0, 0.0),
        every: int = 2,
    ) -> tuple[Array, Array]:
        """Let the body go from its rest shape, without speed.

        Args:
            parameters: Of up to `count` worlds, by the names of `Material`'s numbers, each a number or of shape (W,).
            seconds: How long [s].
            tilt: Turns of gravity about x and y [rad], shape (2,) or (W, 2).
            every: Steps between two times that are kept; even.

        Returns:
            Times (T,) [s] and coordinates (T, W, n, 3) [m].

        Raises:
            SolverDiverged: If a step of a world has no finite end.
        """
        sets = np.broadcast_arrays(*[np.atleast_1d(value) for value in parameters.values()], np.atleast_2d(tilt)[:, 0])
        worlds, whole = len(sets[0]), np.minimum(np.arange(self.count), len(sets[0]) - 1)
        for name, values in zip(parameters, sets, strict=False):
            getattr(soft(self._model), name).assign(values[whole].astype(np.float32))
        turn = np.broadcast_to(np.atleast_2d(tilt), (worlds, 2))[whole]
        down = np.stack([-np.sin(turn[:, 1]), np.sin(turn[:, 0]) * np.cos(turn[:, 1])], axis=1)
        gravity = GRAVITY * np.column_stack([down, -np.sqrt(1.0 - (down**2).sum(axis=1))])
        present(self._model.gravity)[: self.count].assign(gravity.astype(np.float32))
        if self._graph is None:
            self._graph = capture_graph(self._two_steps, self._model.device).launch
        self._solver.status.zero_()
        for state in self._states:
            self._solver.reset(state)
            set_states(self._solver, state)
        count, size = round(seconds / (self.dt * every)), (self.count, self.body.function_count, 3)
        found = np.empty((count + 1, worlds, *size[1:]))
        for k in range(count + 1):
            found[k] = soft(self._states[0]).q.numpy().reshape(size)[:worlds]
            if k < count:
                for _ in range(every // 2):
                    self._graph()
        self.steps += count * every * worlds
        if (self._solver.status.numpy()[:worlds] & WORLD_NOT_FINITE).any():  # such a world is put at rest, finite
            raise SolverDiverged("a world of the fit is no longer finite", hint="check --size, the mass and --held")
        return self.dt * every * np.arange(count + 1, dtype=np.float64), found

    def states(self, sets: Array, starts: Array, times: Array) -> Array:
        """Return coordinates at times [s], shape (W, F, n, 3), of any number of sets of parameters.

        Args:
            sets: Logarithms of Young's modulus [Pa] and viscosity [s], and the tilt [rad], shape (W, 4).
            starts: When each is let go [s], shape (W,).
            times: Times (F,) [s].
        """
        some, which = np.unique(sets, axis=0, return_inverse=True)
        seconds, at, found = max(float(times.max() - starts.min()), 0.0) + 4.0 * self.dt, np.zeros(0), []
        for first in range(0, len(some), self.count):
            part = some[first : first + self.count]
            given = {"youngs_modulus": np.exp(part[:, 0]), "viscosity": np.exp(part[:, 1])}
            at, q = self.run(given, seconds, tilt=part[:, 2:])
            found.append(q)
        whole = np.concatenate(found, axis=1)
        return np.array([at_times(at, whole[:, k], times - t) for k, t in zip(which.ravel(), starts, strict=True)])

    def _two_steps(self) -> None:
        """Launch two steps, which end where they began."""
        for a, b in (self._states, self._states[::-1]):
            self._solver.step(a, b, self._control, None, self.dt)


def at_times(times: Array, values: Array, wanted: Array) -> Array:
    """Return values (T, ...) at equally spaced times, by cubics through four of them, at wanted times (F,).

    Before the first time the values are those of the start.
    """
    step = times[1] - times[0]
    place = np.clip(wanted / step, 0.0, len(times) - 1.0)
    k = np.clip(np.floor(place).astype(int), 0, len(times) - 2)
    a = (place - k).reshape(-1, *[1] * (values.ndim - 1))
    before, after = values[np.maximum(k - 1, 0)], values[np.minimum(k + 2, len(times) - 1)]
    low, high = values[k], values[k + 1]
    # Catmull-Rom; at rest before the start
    return low + 0.5 * a * (
        (high - before)
        + a * (2.0 * before - 5.0 * low + 4.0 * high - after + a * (3.0 * (low - high) + after - before))
    )
