"""How device code is declared and launched: structs that type checkers read, kernels over functions, launches."""

from collections.abc import Callable, Sequence
from typing import Any

import warp as wp

from softmode.quiet import quieten_warp

quieten_warp()

Kernel = Callable[..., object]
"""A ``wp.kernel``, which a type checker takes for the function that it was made of."""

WRENCH: Any = wp.spatial_vector
"""Type of a force with a torque, which Warp's stubs take for a function."""


class Struct:
    """A struct to a type checker, which knows no array of two axes: it has attributes, of whatever type."""

    def __getattr__(self, name: str) -> Any:
        """Return an array or a number."""

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an array or a number."""


def struct(declared: type) -> type[Struct]:
    """Make a class a struct that kernels take."""
    made: Any = wp.struct(declared)
    return made


def kernel_over(function: Any, name: str, *indices: str) -> Any:
    """Return the kernel that calls a device function at every point of its launch.

    Such kernels are compiled apart from the others of their Python module, so that nobody compiles them who takes the
    one launch.

    Args:
        function: A ``wp.func``. A launch per phase and the launch that takes a world through all of its iterations
            then run the same code.
        name: What the kernel is called.
        indices: Parameters of the function that are the thread's indices, in the order of the launch dimensions; the
            other parameters are the kernel's.
    """
    types = {p: kind for p, kind in function.func.__annotations__.items() if p != "return"}
    given = [p for p in types if p not in indices]
    call = f"{function.key}({', '.join(types)})"
    source = f"def {name}({', '.join(given)}):\n    {', '.join(indices)} = wp.tid()\n    {call}\n"
    scope: dict[str, Any] = {"wp": wp, function.key: function}
    exec(source, scope)  # Warp compiles from source, and reads the types from the annotations
    made = scope[name]
    made.__module__, made.__doc__ = function.func.__module__, function.func.__doc__
    made.__annotations__ = {p: types[p] for p in given}
    apart = wp.get_module(f"{made.__module__}.phases")
    return wp.Kernel(made, key=name, source=source, module=apart, options={"enable_backward": False})


def launch(
    device: wp.Device, kernel: Kernel, dim: int | Sequence[int], *arguments: object, block_dim: int = 256
) -> None:
    """Launch a kernel.

    Args:
        device: Where.
        kernel: A ``wp.kernel``.
        dim: Number of threads, an integer or one per dimension.
        arguments: What it takes, inputs and outputs.
        block_dim: Threads of a block on CUDA.
    """
    threads = dim if isinstance(dim, int) else tuple(dim)
    wp.launch(kernel, dim=threads, inputs=arguments, device=device, block_dim=block_dim)


def launch_teams(device: wp.Device, kernel: Kernel, count: int, team: int, *arguments: object) -> None:
    """Launch ``count`` teams of threads, each in a block of its own; arguments as for :func:`launch`."""
    launch(device, kernel, (count, team), *arguments, block_dim=team)
