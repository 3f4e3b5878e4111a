"""The C++ that code in lanes is made of: types, functions of numbers, choices, structs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

from softmode.errors import LanesError

LANES = 8
"""Points that are evaluated at a time."""

TYPES = f"""
    typedef double lanes __attribute__((ext_vector_type({LANES})));
    typedef __typeof__((lanes)0.0 < (lanes)0.0) words;  // 64-bit integers; a decision has all bits set, or none
"""
# The logarithm: u = 2^k m with m in [sqrt(1/2), sqrt(2)), and ln m = ln(1 + f) as in FreeBSD's e_log.c (Sun, 1993), to
# less than a unit in the last place.
NUMBERS = """
        static bool any(words mask) { return __builtin_reduce_or(mask) != 0; }
        static lanes lane_max(lanes a, lanes b) { return a < b ? b : a; }
        static lanes lane_min(lanes a, lanes b) { return b < a ? b : a; }
        static lanes lane_abs(lanes a) { return __builtin_elementwise_abs(a); }
        static lanes lane_sqrt(lanes a) { return __builtin_elementwise_sqrt(a); }
        static lanes lane_log(lanes u) {  // subnormal numbers count as 0
            #pragma clang fp contract(fast)
            const words bits = (words)u, k = (bits - (words)0x3fe6a09e667f3bcd) >> 52;
            const lanes n = __builtin_convertvector(k, lanes), f = (lanes)(bits - (k << 52)) - 1.0;
            const lanes s = f / (2.0 + f), z = s * s;
            lanes R = 1.479819860511658591e-1 * z + 1.531383769920937332e-1;
            R = R * z + 1.818357216161805012e-1;
            R = R * z + 2.222219843214978396e-1;
            R = R * z + 2.857142874366239149e-1;
            R = R * z + 3.999999999940941908e-1;
            R = (R * z + 6.666666666666735130e-1) * z;
            const lanes half_square = 0.5 * f * f, low = s * (half_square + R) + n * 1.90821492927058770002e-10;
            const lanes found = n * 6.93147180369123816490e-1 - ((half_square - low) - f);
            const words sound = (u >= 2.2250738585072014e-308) & (u < (lanes)__builtin_inf());
            const lanes edge = u < 1.0 ? -(lanes)__builtin_inf() : u;
            return sound ? found : u < 0.0 ? (lanes)__builtin_nan("") : edge;
        }
"""
IN_LANES = {"int": "integers", "double": "lanes", "bool": "mask"}
"""Kinds of numbers that are the same for all lanes, and the kinds of such numbers in each lane."""
NUMERIC = {*IN_LANES, *IN_LANES.values()}
"""Kinds of numbers; the others are "vec3", "mat3x3" and the like, "struct" with a name, and "tuple"."""


@dataclass(frozen=True)
class Value:
    """What an expression gives: C++, its kind, its number where that is known here, its parts where it has several."""

    code: str
    kind: str
    number: float | None = None
    parts: tuple[Value, ...] = ()


Signature = tuple[list[str], list[str]]
"""The kinds of a function's parameters and of its results."""


def type_of(kind: str) -> str:
    """Return the type in C++ of a kind."""
    if kind.startswith(("vec", "mat")):
        return f"wp::{kind[:3]}_t<{kind[3:].replace('x', ', ')}, lanes>"
    return {"integers": "words", "mask": "words"}.get(kind, kind.removeprefix("struct "))


def entries(kind: str) -> list[str]:
    """Return how C++ reads each number of a vector, or of a matrix row by row; of a number, itself."""
    if kind in NUMERIC:
        return [""]
    size = [int(n) for n in kind[3:].split("x")]
    if len(size) == 1:
        return [f".c[{k}]" for k in range(size[0])]
    return [f".data[{row}][{column}]" for row in range(size[0]) for column in range(size[1])]


def kind_of_shape(shape: Sequence[int]) -> str:
    """Return the kind of vectors or matrices of a shape."""
    return ("vec", "mat")[len(shape) - 1] + "x".join(map(str, shape))


class Law:
    """What was written so far: helpers, and functions, those that are called before those that call.

    Args:
        uniform: Parameters and fields, by name, that are the same for all lanes.
        apart: Functions, by name, that are compiled out of line.
        write: Translates a function, adds it to the members, and returns its signature.
    """

    def __init__(self, uniform: Sequence[str], apart: Sequence[str], write: Callable[[Law, Any], Signature]) -> None:
        """Nothing is written yet."""
        self.uniform, self.apart = uniform, apart
        self.helpers: dict[str, str] = {}
        self.members: list[str] = []
        self.structs: dict[str, dict[str, str]] = {}
        self._write = write
        self._signatures: dict[str, tuple[Any, Signature]] = {}
        self._count = 0

    def code(self) -> str:
        """Return all of it."""
        return f"{TYPES}    struct Law {{{NUMBERS}{''.join(self.helpers.values())}{''.join(self.members)}    }};\n"

    def signature(self, function: Any) -> Signature:
        """Return the kinds of a function's parameters and results; writes it if it was not."""
        if function.key not in self._signatures:
            self._signatures[function.key] = function, self._write(self, function)
        written, signature = self._signatures[function.key]
        if written is not function:
            raise LanesError(f"two device functions are called {function.key}", hint="give one of them another name")
        return signature

    def fresh(self, name: str) -> str:
        """Return a name for a variable that no other has."""
        self._count += 1
        return f"{name}_{self._count}"

    def kind(self, name: str, declared: Any) -> str | None:
        """Return the kind of a parameter or field; None where its type cannot be read."""
        number = {wp.float64: "double", int: "int", wp.int32: "int", bool: "bool", wp.bool: "bool"}.get(declared)
        if number is not None:
            return number if number == "int" or name in self.uniform else IN_LANES[number]
        if shape := getattr(declared, "_shape_", None):
            return kind_of_shape(shape)
        struct = getattr(declared, "key", None)
        if struct is None:
            return None
        if struct not in self.structs:
            kinds = {field: self.kind(field, variable.type) for field, variable in declared.vars.items()}
            self.structs[struct] = {field: kind for field, kind in kinds.items() if kind}
            members = " ".join(f"{type_of(kind)} {field};" for field, kind in self.structs[struct].items())
            self.helpers[struct] = f"        struct {struct} {{ {members} }};\n"
        return f"struct {struct}"

    def pick(self, mask: str, a: str, b: str, kind: str) -> str:
        """Return the choice between two values per lane."""
        each = " ".join(f"b{x} = m ? a{x} : b{x};" for x in entries(kind))
        given = f"words m, const {type_of(kind)}& a, {type_of(kind)} b"
        self.helpers[kind] = f"        static {type_of(kind)} pick({given}) {{ {each} return b; }}\n"
        return f"pick({mask}, {a}, {b})"
