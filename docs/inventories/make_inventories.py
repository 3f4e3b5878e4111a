"""Write the inventories with which the reference links to the documentation of other projects, without a network.

`python docs/inventories/make_inventories.py` writes one `.inv` for each entry of `PROJECTS`, in the format of Sphinx's
extension intersphinx. They hold only the names that softmode's docstrings and signatures use. To add a name, find its
page in the other project's documentation, add it below and run the script again.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import NamedTuple

FOLDER = Path(__file__).resolve().parent


class Name(NamedTuple):
    """A name of another project."""

    name: str
    """Where users import it from."""
    role: str
    """What it is: class, function, method, attribute, exception, data or module."""
    page: str
    """Path of its page below the project's URL."""
    aliases: tuple[str, ...] = ()
    """Other names under which annotations show it: where it is defined, or how it is written in short."""


class Project(NamedTuple):
    """A project whose documentation is linked to."""

    url: str
    """Where its documentation lies."""
    names: tuple[Name, ...]
    """The names that are linked."""


def _python(role: str, page: str, *names: str) -> tuple[Name, ...]:
    """Return names of the standard library that share a page."""
    return tuple(Name(name, role, f"library/{page}.html#{name}") for name in names)


def _scalars(*names: str) -> tuple[Name, ...]:
    """Return NumPy's scalar types, which annotations write without the module."""
    return tuple(Name(f"numpy.{n}", "class", f"reference/arrays.scalars.html#numpy.{n}", (n,)) for n in names)


def _generated(folder: str, role: str, names: dict[str, str]) -> tuple[Name, ...]:
    """Return names with a page of their own each, given with the module that defines them."""
    found = []
    for name, module in names.items():
        alias = f"{module}.{name.rpartition('.')[2]}" if module else ""
        found.append(Name(name, role, f"{folder}/{name}.html#{name}", (alias,) if alias else ()))
    return tuple(found)


PYTHON = Project(
    "https://docs.python.org/3/",
    (
        *_python("class", "functions", "bool", "int", "float", "object", "type"),
        *_python("class", "stdtypes", "str", "bytes", "list", "tuple", "dict", "set", "frozenset", "slice"),
        *_python("class", "pathlib", "pathlib.Path"),
        Name("os.PathLike", "class", "library/os.html#os.PathLike"),
        *_python("data", "constants", "None"),
        *_python("data", "typing", "typing.Any", "typing.Literal"),
        *_python("class", "typing", "typing.NamedTuple", "typing.Protocol"),
        *_python("class", "enum", "enum.Enum", "enum.IntEnum", "enum.IntFlag"),
        *_python(
            "class",
            "collections.abc",
            *(
                f"collections.abc.{name}"
                for name in ("Callable", "Collection", "Iterable", "Iterator", "Mapping", "Sequence")
            ),
        ),
        *_python(
            "exception",
            "exceptions",
            *("Exception", "AssertionError", "FileNotFoundError", "ImportError", "KeyError", "OSError"),
            *("RuntimeError", "TypeError", "UserWarning", "ValueError"),
        ),
    ),
)

NUMPY = Project(
    "https://numpy.org/doc/stable/",
    (
        Name("numpy.ndarray", "class", "reference/generated/numpy.ndarray.html#numpy.ndarray"),
        Name("numpy.typing.NDArray", "class", "reference/typing.html#numpy.typing.NDArray", ("NDArray",)),
        Name("numpy.typing.ArrayLike", "class", "reference/typing.html#numpy.typing.ArrayLike", ("ArrayLike",)),
        Name(
            "numpy.random.Generator",
            "class",
            "reference/random/generator.html#numpy.random.Generator",
            ("numpy.random._generator.Generator",),
        ),
        *_scalars("bool", "floating", "float32", "float64", "integer", "int32", "int64", "uint8", "uint32"),
    ),
)

SCIPY = Project(
    "https://docs.scipy.org/doc/scipy/",
    _generated(
        "reference/generated",
        "class",
        {
            "scipy.sparse.csr_matrix": "scipy.sparse._csr",
            "scipy.sparse.csr_array": "scipy.sparse._csr",
            "scipy.spatial.transform.Rotation": "scipy.spatial.transform._rotation",
        },
    ),
)

GYMNASIUM = Project(
    "https://gymnasium.farama.org/",
    (
        Name("gymnasium.Env", "class", "api/env/#gymnasium.Env", ("gymnasium.core.Env",)),
        Name("gymnasium.Wrapper", "class", "api/wrappers/#gymnasium.Wrapper", ("gymnasium.core.Wrapper",)),
        Name("gymnasium.make", "function", "api/registry/#gymnasium.make"),
        Name("gymnasium.make_vec", "function", "api/registry/#gymnasium.make_vec"),
        Name("gymnasium.register", "function", "api/registry/#gymnasium.register"),
        Name(
            "gymnasium.spaces.Space", "class", "api/spaces/#gymnasium.spaces.Space", ("gymnasium.spaces.space.Space",)
        ),
        *(
            Name(
                f"gymnasium.spaces.{name}",
                "class",
                f"api/spaces/{page}/#gymnasium.spaces.{name}",
                (f"gymnasium.spaces.{name.lower()}.{name}",),
            )
            for name, page in (("Box", "fundamental"), ("Dict", "composite"))
        ),
        Name(
            "gymnasium.vector.VectorEnv",
            "class",
            "api/vector/#gymnasium.vector.VectorEnv",
            ("gymnasium.vector.vector_env.VectorEnv",),
        ),
        # It has no entry of its own there; the page of the vector environments describes it.
        Name("gymnasium.vector.AutoresetMode", "class", "api/vector/", ("gymnasium.vector.vector_env.AutoresetMode",)),
        Name("gymnasium.utils.env_checker.check_env", "function", "api/utils/#gymnasium.utils.env_checker.check_env"),
    ),
)

WARP = Project(
    "https://nvidia.github.io/warp/stable/",
    (
        Name(
            "warp.array",
            "class",
            "api_reference/_generated/warp.array.html#warp.array",
            ("wp.array", "warp._src.types.array"),
        ),
        *_generated(
            "api_reference/_generated",
            "class",
            {
                "warp.vec2f": "warp._src.types",
                "warp.vec3f": "warp._src.types",
                "warp.quatf": "warp._src.types",
                "warp.transformf": "warp._src.types",
                "warp.Mesh": "warp._src.types",
                "warp.Device": "warp._src.context",
                "warp.Tape": "warp._src.tape",
            },
        ),
    ),
)

NEWTON = Project(
    "https://newton-physics.github.io/newton/stable/",
    (
        *_generated(
            "api/_generated",
            "class",
            {
                "newton.Model": "newton._src.sim.model",
                "newton.ModelBuilder": "newton._src.sim.builder",
                "newton.State": "newton._src.sim.state",
                "newton.Control": "newton._src.sim.control",
                "newton.Contacts": "newton._src.sim.contacts",
                "newton.Mesh": "newton._src.geometry.types",
                "newton.solvers.SolverBase": "newton._src.solvers.solver",
                "newton.solvers.SolverMuJoCo": "newton._src.solvers.mujoco.solver_mujoco",
                "newton.sensors.SensorContact": "newton._src.sensors.sensor_contact",
                "newton.sensors.SensorTiledCamera": "newton._src.sensors.sensor_tiled_camera",
            },
        ),
        *_generated("api/_generated", "function", {"newton.eval_fk": "", "newton.eval_jacobian": ""}),
        Name(
            "newton.ModelBuilder.ShapeConfig",
            "class",
            "api/_generated/newton.ModelBuilder.html#newton.ModelBuilder.ShapeConfig",
            ("newton._src.sim.builder.ModelBuilder.ShapeConfig",),
        ),
        Name(
            "newton.ModelBuilder.add_usd",
            "method",
            "api/_generated/newton.ModelBuilder.html#newton.ModelBuilder.add_usd",
        ),
        Name(
            "newton.solvers.experimental.coupled.SolverCoupledProxy",
            "class",
            "api/newton_solvers_experimental_coupled.html#newton.solvers.experimental.coupled.SolverCoupledProxy",
            ("newton._src.solvers.coupled.solver_coupled_proxy.SolverCoupledProxy",),
        ),
    ),
)

TORCH = Project(
    "https://docs.pytorch.org/docs/stable/",
    (
        Name("torch.Tensor", "class", "tensors.html#torch.Tensor", ("torch._tensor.Tensor",)),
        Name("torch.device", "class", "tensor_attributes.html#torch.device"),
        Name("torch.Generator", "class", "generated/torch.Generator.html#torch.Generator", ("torch._C.Generator",)),
    ),
)

PROJECTS = {
    "python": PYTHON,
    "numpy": NUMPY,
    "scipy": SCIPY,
    "gymnasium": GYMNASIUM,
    "warp": WARP,
    "newton": NEWTON,
    "torch": TORCH,
}
"""The projects by the names of their inventories."""


def entries(project: Project) -> list[str]:
    """Return the lines of an inventory: name, domain and role, priority, place, displayed name."""
    return [
        f"{name} py:{entry.role} 1 {entry.page} -" for entry in project.names for name in (entry.name, *entry.aliases)
    ]


def content(title: str, project: Project) -> bytes:
    """Return an inventory: four lines of header, then the entries, compressed."""
    header = (
        f"# Sphinx inventory version 2\n# Project: {title}\n# Version: \n"
        "# The remainder of this file is compressed using zlib.\n"
    )
    return header.encode() + zlib.compress("".join(f"{line}\n" for line in entries(project)).encode(), 9)


def main() -> None:
    """Write all inventories."""
    for title, project in PROJECTS.items():
        (FOLDER / f"{title}.inv").write_bytes(content(title, project))


if __name__ == "__main__":
    main()
