"""`FitWorlds`: one body in many worlds, two steps a launch; `HeldWorlds`: a held one, a world per set of numbers."""

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
PHYSICS = ("youngs_modulus", "viscosity", "tilt_x", "tilt_y", "poissons_ratio", "mass_damping")
"""What sets of numbers hold: logarithms of Young's modulus [Pa] and viscosity [s], turns of gravity [rad], Poisson's
ratio, and mass damping [1/s]."""
FREE = PHYSICS[4:]
"""Those that a fit keeps where it is not asked for them."""


def physics_rows(material: Material) -> dict[str, tuple[float, ...]]:
    """Return the rows of `PHYSICS` for `Space.of`, about a material's density, Poisson's ratio and mass damping."""
    rho, inf = material.density, np.inf
    return {
        "youngs_modulus": (np.log(200.0 * rho), 3.0, 0.03, np.log(3.0 * rho), np.log(3.0e4 * rho)),
        "viscosity": (np.log(3.0e-3), 1.5, 0.1, np.log(1.0e-4), np.log(0.1)),
        "tilt_x": (0.0, 0.035, 0.01, -inf, inf),
        "tilt_y": (0.0, 0.035, 0.01, -inf, inf),
        "poissons_ratio": (material.poissons_ratio, 0.1, 0.02, -0.2, 0.49),
        "mass_damping": (material.mass_damping, 1.0, 0.1, 0.0, 20.0),
    }


class FitWorlds:
    """Worlds of one body that are stepped together, two steps a launch.

    Args:
        model: The worlds.
        body: The body.
        dt: Step [s].
        options: Of the solver.
    """

    def __init__(
        self, model: newton.Model, body: ReducedBody, *, dt: float, options: SolverReducedOptions | None = None
    ) -> None:
        """Allocate the states."""
        self.model, self.body, self.count, self.dt = model, body, model.world_count, dt
        self.solver = SolverReduced(model, [body], options=options)
        self.pair, self._control = (model.state(), model.state()), model.control()
        self._launch: Callable[[], None] = self._two_steps

    def reset(self) -> None:
        """Put all worlds at rest, and capture the steps if they are not yet."""
        if self._launch == self._two_steps:
            self._launch = capture_graph(self._two_steps, self.model.device).launch
        self.solver.status.zero_()
        for state in self.pair:
            self.solver.reset(state)
            set_states(self.solver, state)

    def step_twice(self) -> None:
        """Launch two steps, which end where they began."""
        self._launch()

    def _two_steps(self) -> None:
        """Step from one state to the other and back."""
        for a, b in (self.pair, self.pair[::-1]):
            self.solver.step(a, b, self._control, None, self.dt)


class HeldWorlds(FitWorlds):
    """Worlds of one body that regions of its own hold; a run is all starts, or a whole Jacobian, at once.

    Args:
        body: The body, placed where its file has it: the origin of the body frame lies at minus the translation of
            `softmode.objects.file_frame`.
        material: What is the same in all worlds.
        count: Number of worlds.
        dt: Step [s].
        device: Warp device.
    """

    def __init__(
        self, body: ReducedBody, material: Material, count: int, *, dt: float, device: wp.DeviceLike = None
    ) -> None:
        """Allocate the worlds."""
        world, builder = newton.ModelBuilder(), newton.ModelBuilder()
        add_reduced_body(world, body, material=material)
        builder.replicate(world, count)
        model = builder.finalize(device=device)
        super().__init__(model, body, dt=dt, options=SolverReducedOptions(integrator="bdf2"))
        self.steps = 0
        """Steps of worlds so far."""

    def hang(self, load: Array) -> None:
        """Let forces pull at the surface samples [N], shape (surface_count, 3)."""
        for state in self.pair:
            present(state.particle_f).assign(np.tile(load, (self.count, 1)).astype(np.float32))

    def run(
        self, parameters: Mapping[str, ArrayLike], seconds: float, *, tilt: ArrayLike = (0.0, 0.0), every: int = 2
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
            getattr(soft(self.model), name).assign(values[whole].astype(np.float32))
        turn = np.broadcast_to(np.atleast_2d(tilt), (worlds, 2))[whole]
        down = np.stack([-np.sin(turn[:, 1]), np.sin(turn[:, 0]) * np.cos(turn[:, 1])], axis=1)
        gravity = GRAVITY * np.column_stack([down, -np.sqrt(1.0 - (down**2).sum(axis=1))])
        present(self.model.gravity)[: self.count].assign(gravity.astype(np.float32))
        self.reset()
        count, size = round(seconds / (self.dt * every)), (self.count, self.body.function_count, 3)
        found = np.empty((count + 1, worlds, *size[1:]))
        for k in range(count + 1):
            found[k] = soft(self.pair[0]).q.numpy().reshape(size)[:worlds]
            if k < count:
                for _ in range(every // 2):
                    self.step_twice()
        self.steps += count * every * worlds
        if (self.solver.status.numpy()[:worlds] & WORLD_NOT_FINITE).any():  # such a world is put at rest, finite
            raise SolverDiverged("a world of the fit is no longer finite", hint="check --size, the mass and --held")
        return self.dt * every * np.arange(count + 1, dtype=np.float64), found

    def states(self, sets: Array, starts: Array, times: Array) -> Array:
        """Return coordinates at times [s], shape (W, F, n, 3), of any number of sets of parameters.

        Args:
            sets: Numbers as `PHYSICS` has them, shape (W, 6).
            starts: When each is let go [s], shape (W,).
            times: Times (F,) [s].
        """
        some, which = np.unique(sets, axis=0, return_inverse=True)
        seconds, at, found = max(float(times.max() - starts.min()), 0.0) + 4.0 * self.dt, np.zeros(0), []
        for first in range(0, len(some), self.count):
            part = some[first : first + self.count]
            given = dict(zip(PHYSICS, part.T, strict=True))
            logs = {name: np.exp(given[name]) for name in PHYSICS[:2]}
            at, q = self.run({**logs, **{name: given[name] for name in FREE}}, seconds, tilt=part[:, 2:4])
            found.append(q)
        whole = np.concatenate(found, axis=1)
        return np.array([at_times(at, whole[:, k], times - t) for k, t in zip(which.ravel(), starts, strict=True)])


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
