"""How the episodes of all worlds go on and end, and what the last ones came to."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.deformables.model import status as bits
from softmode.deformables.model.declare import launch
from softmode.deformables.model.structs import filled
from softmode.envs import task_kernels as kernels

FALL = 0.05
"""How far under its resting height on the table object 0 counts as dropped [m]."""
NOT_FINITE = bits.WORLD_NOT_FINITE | bits.WORLD_RIGID_NOT_FINITE


class Episodes:
    """What a step came to in every world, and when its episode ends.

    Args:
        world_count: Number of worlds.
        terms: Number of the reward's terms.
        metrics: Number of the task's figures.
        limit: Control steps per episode, 0 for no limit.
        sparse: Whether success is paid in place of the terms.
        device: Warp device.

    Attributes:
        elapsed: Control steps of the episode, shape (world_count,), as all others but terms and metrics.
        reward: Sum of the terms, or as `TaskConfig.reward_mode` says.
        terms: Terms of the reward, shape (world_count, T).
        metrics: Figures of the task, shape (world_count, M).
        success: Whether the task counts as solved now.
        failure: An `EndReason` that the task found.
        held: Control steps in a row in which the goal was met.
        terminated: Whether the episode ended by a failure.
        truncated: Whether it ended by its limit.
        end: `EndReason` of the step.
        done: terminated or truncated.
        any_done: Whether any world is done, shape (1,).
        never: A mask of no world.
        fresh: Worlds whose step is a reset.
    """

    def __init__(
        self, world_count: int, *, terms: int, metrics: int, limit: int, sparse: bool, device: wp.Device
    ) -> None:
        """Make the arrays that a step writes."""

        def zeros(*shape: int, dtype: type = float) -> wp.array:
            return wp.zeros((world_count, *shape), dtype=dtype, device=device)

        self.elapsed, self.end, self.failure, self.held = (zeros(dtype=int) for _ in range(4))
        self.terminated, self.truncated, self.success, self.done = (zeros(dtype=wp.bool) for _ in range(4))
        self.never, self.fresh = (zeros(dtype=wp.bool) for _ in range(2))
        self.reward, self.terms, self.metrics = zeros(), zeros(max(terms, 1)), zeros(max(metrics, 1))
        self.any_done = wp.zeros(1, dtype=int, device=device)
        self._limit, self._sparse, self._device, self._world_count = limit, int(sparse), device, world_count
        self._struct = filled(kernels.Episode, self)

    def begin(self, mask: NDArray[np.bool_] | None = None) -> None:
        """Let episodes begin in the masked worlds, all if None, from where they are: time counts from zero."""
        ends = (self.elapsed, self.terminated, self.truncated, self.done)
        self._zero(slice(None) if mask is None else mask, *ends, self.end, self.terms)

    def forget(self, mask: NDArray[np.bool_]) -> None:
        """Set what the last step of the masked worlds earned and why it ended to zero."""
        self._zero(mask, self.end, self.terms)

    def _zero(self, mask: Any, *arrays: wp.array) -> None:
        """Set the rows of the masked worlds to zero."""
        for array in arrays:
            values = array.numpy().copy()
            values[mask] = 0
            array.assign(values)

    def clear(self, world_mask: wp.array, result: Any) -> None:
        """Start the episodes of the masked worlds; capturable."""
        launch(self._device, kernels.clear_worlds, self._world_count, world_mask, self._struct, result)

    def finish(
        self, fresh: wp.array, state: Any, result: Any, *, status: wp.array, finite: wp.array, lowest: wp.array
    ) -> None:
        """Sum the reward, count the step and decide whether episodes end; capturable.

        Args:
            fresh: Worlds that only started.
            state: A `WorldState`.
            result: A `StepResult`, of these arrays.
            status: Status of the solver.
            finite: Whether a world's observation was finite.
            lowest: Height under which object 0 is lost [m].
        """
        given = (fresh, self._limit, self._sparse, NOT_FINITE, status, finite, state, lowest)
        launch(self._device, kernels.finish_step, self._world_count, *given, result, self._struct)
