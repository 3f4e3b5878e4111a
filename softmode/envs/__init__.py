"""Gymnasium environments and the scenes they are made of."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softmode.envs.check import VectorEnvReport, check_vector_env

__all__ = ["VectorEnvReport", "check_vector_env"]


def __getattr__(name: str) -> Any:
    """Import what the package offers when it is first asked for, so that importing it stays light."""
    if name in __all__:
        from softmode.envs import check

        return getattr(check, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
