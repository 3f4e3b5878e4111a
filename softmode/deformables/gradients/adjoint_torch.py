"""A trajectory of reduced bodies as a PyTorch function, differentiated by the adjoint. Needs the extra ``[rl]``."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import warp as wp

from softmode.deformables.gradients.adjoint import AdjointReduced
from softmode.deformables.model.namespaces import soft
from softmode.errors import ConfigError, MissingExtraError

if TYPE_CHECKING:
    from torch import Tensor

INSTANCE_PARAMETERS = (
    *("youngs_modulus", "poissons_ratio", "density", "viscosity"),
    *("mass_damping", "friction", "scale"),
)
INPUTS = (*INSTANCE_PARAMETERS, "q", "qd", "pin_target", "q_driven", "force")


def rollout(adjoint: AdjointReduced, step_count: int, dt: float, **inputs: Tensor) -> tuple[Tensor, Tensor]:
    """Simulate and return the trajectory, differentiable by every tensor given.

    Args:
        adjoint: Recorder of the solver that steps; a rollout may be differentiated until the next one begins.
        step_count: Steps T, at most ``adjoint.step_max``.
        dt: Step [s].
        **inputs: Any of ``youngs_modulus``, ``poissons_ratio``, ``density``, ``viscosity``, ``mass_damping``,
            ``friction``, ``scale``, shape (I,), written to the model, which keeps float32; ``q``, ``qd``: initial
            state, (N, 3); ``pin_target``: (T, pins, 3); ``q_driven``: (T, N, 3), read at the driven functions;
            ``force``: extra generalised force, (T, N, 3). What is not given comes from the model.

    Returns:
        q [m] and qd [m/s], float64, shape (T + 1, N, 3).

    Raises:
        ConfigError: If a name is unknown, or a rollout is differentiated after another has begun.
        MissingExtraError: If PyTorch is not installed.
    """
    unknown = set(inputs) - set(INPUTS)
    if unknown:
        raise ConfigError(f"unknown input {sorted(unknown)[0]!r}", hint=f"choose from {', '.join(INPUTS)}")
    return _function().apply(adjoint, step_count, dt, *(inputs.get(name) for name in INPUTS))


@functools.cache
def _function() -> Any:
    """Return the autograd function; made on first use, so that importing this module does not load PyTorch."""
    try:
        import torch
    except ImportError as error:
        raise MissingExtraError(
            "PyTorch is not installed", hint="install it with: pip install 'softmode[rl]'"
        ) from error

    def view(tensor: Tensor, adjoint: AdjointReduced, dtype: type = wp.vec3d) -> wp.array:
        """Return a tensor as a Warp array on the adjoint's device, sharing memory where it can."""
        scalar = torch.float32 if dtype is wp.float32 else torch.float64
        there = tensor.detach().to(device=wp.device_to_torch(adjoint.device), dtype=scalar).contiguous()
        return wp.from_torch(there, dtype=dtype)

    class Rollout(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, adjoint: AdjointReduced, step_count: int, dt: float, *values: Tensor | None) -> Any:
            given = {name: value for name, value in zip(INPUTS, values, strict=True) if value is not None}
            model = adjoint.solver.model
            for name in given.keys() & set(INSTANCE_PARAMETERS):
                wp.copy(getattr(soft(model), name), view(given[name], adjoint, wp.float32))
            adjoint.solver.notify_model_changed(0)
            state, after, control = model.state(), model.state(), model.control()
            for name in given.keys() & {"q", "qd"}:
                wp.copy(getattr(soft(state), name), view(given[name], adjoint))
            paths: dict[str, Any] = {
                name: view(given[name], adjoint) for name in given.keys() & {"pin_target", "q_driven", "force"}
            }
            for name, path in paths.items():
                if path.shape[0] != step_count:
                    raise ConfigError(f"{name}: expected {step_count} steps, got {path.shape[0]}")
            adjoint.start(state)
            for t in range(step_count):
                for name in paths.keys() & {"pin_target", "q_driven"}:
                    wp.copy(getattr(soft(control), name), paths[name][t])
                adjoint.step(state, after, control, dt, force=paths["force"][t] if "force" in paths else None)
                state, after = after, state
            ctx.adjoint, ctx.generation = adjoint, adjoint.generation
            ctx.kinds = [None if value is None else (value.dtype, value.device) for value in values]
            return tuple(wp.to_torch(values).clone() for values in (adjoint.q, adjoint.qd))

        @staticmethod
        def backward(ctx: Any, *losses: Tensor) -> Any:
            adjoint = ctx.adjoint
            if adjoint.generation != ctx.generation:
                raise ConfigError(
                    "another rollout has begun since this one", hint="call backward before the next rollout"
                )
            loss_q, loss_qd = (view(loss, adjoint) for loss in losses)
            gradients = adjoint.backward(loss_q=loss_q, loss_qd=loss_qd)
            out: list[Any] = [None, None, None]
            for name, kind in zip(INPUTS, ctx.kinds, strict=True):
                value = None if kind is None else wp.to_torch(getattr(gradients, name))
                out.append(value if kind is None or value is None else value.to(dtype=kind[0], device=kind[1]))
            return tuple(out)

    return Rollout
