"""Expressions of a device function as C++ in lanes."""

from __future__ import annotations

import ast
import builtins
import inspect
import math
import operator
import textwrap
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import warp as wp

from softmode.errors import LanesError
from softmode.lanes.native import IN_LANES, NUMERIC, Law, Value, entries, kind_of_shape, type_of

_OPERATORS: dict[type, tuple[str, Callable[[Any, Any], Any], str]] = {
    ast.Add: ("+", operator.add, "add"),
    ast.Sub: ("-", operator.sub, "sub"),
    ast.Mult: ("*", operator.mul, "mul"),
    ast.Div: ("/", operator.truediv, "div"),
    ast.Mod: ("%", operator.mod, ""),
}
_COMPARISONS: dict[type, tuple[str, Callable[[Any, Any], bool]]] = {
    ast.Lt: ("<", operator.lt),
    ast.Gt: (">", operator.gt),
    ast.LtE: ("<=", operator.le),
    ast.GtE: (">=", operator.ge),
    ast.Eq: ("==", operator.eq),
    ast.NotEq: ("!=", operator.ne),
}
NUMBER_BY_NUMBER = ("max", "min", "abs", "sqrt", "log")
"""Built-in functions of numbers, and of vectors and matrices number by number."""
_LENGTH = "lane_sqrt(wp::dot({0}, {0}))"
OF_SHAPES: dict[str, tuple[str, Callable[..., str]]] = {
    "dot": ("wp::dot({0}, {1})", lambda a, b: "lanes"),
    "length_sq": ("wp::dot({0}, {0})", lambda a: "lanes"),
    "length": (_LENGTH, lambda a: "lanes"),
    "normalize": (f"pick({_LENGTH} > 0.0, wp::div({{0}}, {_LENGTH}), {{type}}())", lambda a: a),
    "cross": ("wp::cross({0}, {1})", lambda a, b: a),
    "cw_mul": ("wp::cw_mul({0}, {1})", lambda a, b: a),
    "outer": ("wp::outer({0}, {1})", lambda a, b: f"mat{a[3:]}x{b[3:]}"),
    "diag": ("wp::diag({0})", lambda a: f"mat{a[3:]}x{a[3:]}"),
    "trace": ("wp::trace({0})", lambda a: "lanes"),
    "ddot": ("wp::ddot({0}, {1})", lambda a, b: "lanes"),
    "determinant": ("wp::determinant({0})", lambda a: "lanes"),
    "transpose": ("wp::transpose({0})", lambda a: "mat" + "x".join(reversed(a[3:].split("x")))),
}
"""Those of vectors and matrices: C++ over the arguments, and the kind of the result over theirs."""
_INSTEAD: dict[type, str] = {
    ast.Break: "put the condition into the `while`",
    ast.Continue: "put the rest of the loop into an `if`",
    ast.Return: "return what the function finds",
    ast.IfExp: "write `wp.where`",
    ast.Tuple: "assign a tuple to as many names",
}
_OTHERWISE = "write arithmetic, `if`, `while`, `for` over a constant range, and calls of device functions"


@dataclass
class Scope:
    """A stretch of code: what Python's variables are in it, lines of C++, and the variables of C++ that it made."""

    env: dict[str, Value]
    lines: list[str] = field(default_factory=list)
    own: set[str] = field(default_factory=set)


class Expressions(ast.NodeVisitor):
    """The expressions of one device function: each gives a value, and may add lines to the scope.

    Args:
        law: What the function belongs to.
        function: A ``wp.func``.
    """

    def __init__(self, law: Law, function: Any) -> None:
        """Read the source."""
        self.law, self.function, self.scope = law, function, Scope({})
        if function.native_snippet is not None:
            hint = "write it in Warp, or call it from the kernel and pass its result"
            raise LanesError(f"{function.key} is native code, which cannot be read", hint=hint)
        try:
            source = textwrap.dedent(inspect.getsource(function.func))
        except OSError as error:
            hint = "ship the .py files: a frozen application without them has no code for a CPU"
            raise LanesError(f"the source of {function.key} is not there", hint=hint) from error
        self.tree: Any = ast.parse(source).body[0]

    def refused(self, node: Any, what: str, instead: str) -> LanesError:
        """Return the error that a piece of source cannot be read: where, what of it, and what to write instead."""
        code = self.function.func.__code__
        place = f"{Path(code.co_filename).name}:{code.co_firstlineno + node.lineno - 1}, in {self.function.key}"
        return LanesError(f"{place}: `{ast.unparse(node).splitlines()[0]}` {what}", hint=instead)

    def generic_visit(self, node: ast.AST) -> Any:
        """Refuse what no other method reads."""
        raise self.refused(node, "cannot be read in lanes", _INSTEAD.get(type(node), _OTHERWISE))

    def let(self, value: Value, name: str = "v") -> Value:
        """Keep a value in a variable of C++."""
        made = self.law.fresh(name)
        self.scope.lines.append(f"{type_of(value.kind)} {made} = {value.code};")
        self.scope.own.add(made)
        return Value(made, value.kind)

    def to(self, kind: str, value: Value, node: Any) -> str:
        """Return a value as one of another kind: what is the same for all lanes may be given to each."""
        if value.kind == kind:
            return value.code
        if IN_LANES.get(value.kind) != kind:
            hint = "make both of one type; what differs between lanes cannot become what is the same for all"
            raise self.refused(node, f"has {value.kind} where {kind} is expected", hint)
        if kind == "mask":
            return f"({value.code} ? ~(words)0 : (words)0)"
        return f"({type_of(kind)}){'(long long)' if kind == 'integers' else ''}({value.code})"

    def common(self, a: Value, b: Value, node: Any) -> str:
        """Return the kind that holds both of two values."""
        kind = a.kind if a.kind == b.kind else IN_LANES.get(a.kind, a.kind)
        self.to(kind, b, node)
        return kind

    def known(self, found: Any, node: Any) -> Value:
        """Return a number of Python's or Warp's as a value."""
        number = getattr(found, "value", found)
        if isinstance(number, bool):
            return Value(str(number).lower(), "bool", number)
        if not isinstance(number, int | float) or math.isnan(number):
            hint = "give it a value on every way that leads here, or make it a number of the module"
            raise self.refused(node, "has no value here", hint)
        text = repr(abs(number + 0)) if math.isfinite(number) else "__builtin_inf()"
        kind = "int" if isinstance(number, int) else "double"
        return Value(text if number >= 0 else f"(-{text})", kind, number + 0)

    def resolve(self, node: ast.AST) -> Any:
        """Return what a name, or an attribute of one, is outside of the function; None where it is nothing."""
        if isinstance(node, ast.Name) and node.id not in self.scope.env:
            return self.function.func.__globals__.get(node.id, getattr(builtins, node.id, None))
        if isinstance(node, ast.Attribute) and (owner := self.resolve(node.value)) is not None:
            return getattr(owner, node.attr, None)
        return None

    def own_name(self, node: ast.Call) -> str:
        """Return the name of the function of Warp's that is called; empty where another one is."""
        return node.func.attr if isinstance(node.func, ast.Attribute) and self.resolve(node.func.value) is wp else ""

    def visit_Name(self, node: ast.Name) -> Value:
        """Return a variable, or a constant of the module."""
        return self.scope.env[node.id] if node.id in self.scope.env else self.known(self.resolve(node), node)

    def visit_Constant(self, node: ast.Constant) -> Value:
        """Return a number."""
        return self.known(node.value, node)

    def visit_Attribute(self, node: ast.Attribute) -> Value:
        """Return a field of a struct, or a constant of another module."""
        owner = self.scope.env.get(node.value.id) if isinstance(node.value, ast.Name) else None
        if owner is None:
            return self.known(self.resolve(node), node)
        kind = self.law.structs.get(owner.kind.removeprefix("struct "), {}).get(node.attr)
        if kind is None:
            raise self.refused(node, "is of a type that cannot be read in lanes", "pass what is needed of it")
        return Value(f"{owner.code}.{node.attr}", kind)

    def visit_BinOp(self, node: ast.BinOp) -> Value:
        """Return a sum, difference, product or quotient."""
        return self.operate(node.op, self.visit(node.left), self.visit(node.right), node)

    def operate(self, op: ast.operator, a: Value, b: Value, node: Any) -> Value:
        """Return what an operator makes of two values."""
        sign, compute, name = _OPERATORS.get(type(op), ("", operator.add, ""))
        if not sign or "mask" in (a.kind, b.kind) or "bool" in (a.kind, b.kind):
            raise self.refused(node, "is no arithmetic that is known in lanes", "write + - * / of numbers, vectors")
        if a.kind == b.kind == "int" and a.number is not None and b.number is not None and sign != "/":
            return self.known(compute(a.number, b.number), node)
        if sign == "%" or (sign == "/" and {a.kind, b.kind} <= {"int", "integers"}):
            raise self.refused(node, "divides integers", "use remainders of constants only, or float64")
        if a.kind in NUMERIC and b.kind in NUMERIC:
            kind = self.common(a, b, node)
            return Value(f"({self.to(kind, a, node)} {sign} {self.to(kind, b, node)})", kind)
        x, y = (Value(self.to("lanes", v, node), "lanes") if v.kind in NUMERIC else v for v in (a, b))
        kind = x.kind if sign != "*" or y.kind == "lanes" else y.kind
        if sign == "*" and "lanes" not in (x.kind, y.kind):  # rows of the left one, columns of the right one
            kept = [*x.kind[3:].split("x")[: x.kind[:3] == "mat"], *y.kind[3:].split("x")[1:]]
            kind = kind_of_shape([int(n) for n in kept])
        return Value(f"wp::{name}({x.code}, {y.code})", kind)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> Value:
        """Return the negative of a value, or the contrary of a decision."""
        value, decision = self.visit(node.operand), isinstance(node.op, ast.Not)
        if not isinstance(node.op, ast.Not | ast.USub) or decision != (value.kind in ("mask", "bool")):
            raise self.refused(node, "is not known in lanes", "negate numbers by - and comparisons by not")
        if value.number is not None:
            return self.known(not value.number if decision else -value.number, node)
        if value.kind not in NUMERIC:
            return Value(f"wp::neg({value.code})", value.kind)
        return Value(f"({ {'mask': '~', 'bool': '!'}.get(value.kind, '-') }{value.code})", value.kind)

    def visit_BoolOp(self, node: ast.BoolOp) -> Value:
        """Return decisions joined by ``and`` or ``or``."""
        values, conjunction = [self.visit(value) for value in node.values], isinstance(node.op, ast.And)
        if all(value.number is not None for value in values):
            return self.known((all if conjunction else any)(value.number for value in values), node)
        kind = "mask" if any(value.kind == "mask" for value in values) else "bool"
        sign = ("&" if conjunction else "|") * (1 if kind == "mask" else 2)
        return Value(f"({f' {sign} '.join(self.to(kind, value, node) for value in values)})", kind)

    def visit_Compare(self, node: ast.Compare) -> Value:
        """Return the decision whether two numbers compare as asked."""
        if len(node.ops) != 1 or type(node.ops[0]) not in _COMPARISONS:
            raise self.refused(node, "is no comparison of two numbers", "join comparisons of two numbers by `and`")
        a, b = self.visit(node.left), self.visit(node.comparators[0])
        sign, compute = _COMPARISONS[type(node.ops[0])]
        if a.number is not None and b.number is not None:
            return self.known(compute(a.number, b.number), node)
        kind = self.common(a, b, node)
        code = f"({self.to(kind, a, node)} {sign} {self.to(kind, b, node)})"
        return Value(code, "bool" if kind in IN_LANES else "mask")

    def visit_Subscript(self, node: ast.Subscript) -> Value:
        """Return an entry of a vector or a matrix."""
        return self.entry(self.visit(node.value), node)

    def entry(self, owner: Value, node: ast.Subscript) -> Value:
        """Return an entry at constant indices."""
        at = [self.visit(index) for index in (node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice])]
        if any(index.kind != "int" or index.number is None for index in at):
            hint = "use constants, or the variable of a `for` over a constant range"
            raise self.refused(node, "has an index that is not constant", hint)
        code = f".{'c' if len(at) == 1 else 'data'}" + "".join(f"[{index.number}]" for index in at)
        if owner.kind in NUMERIC or code not in entries(owner.kind):
            raise self.refused(node, f"is no entry of a {owner.kind}", "give an index for each axis, within its size")
        return Value(owner.code + code, "lanes")

    def visit_Call(self, node: ast.Call) -> Value:
        """Return what a function gives: a conversion, a built-in function, or another device function."""
        own, target = self.own_name(node), self.resolve(node.func)
        values = [self.visit(argument) for argument in node.args]
        if own == "identity":
            size = self.visit(node.keywords[0].value).number if node.keywords else values[0].number
            return Value(f"wp::identity<{size}, lanes>()", f"mat{size}x{size}")
        if node.keywords:
            raise self.refused(node, "names its arguments", "give all of them by position")
        if target in (int, wp.int32, float, wp.float32, wp.float64) and len(values) == 1:
            return self.converted(target in (int, wp.int32), values[0], node)
        if shape := getattr(target, "_shape_", None):
            kind = kind_of_shape(shape)
            if len(values) == 1 and values[0].kind == kind:
                return values[0]
            if len(values) not in (0, math.prod(shape)):
                raise self.refused(node, "gives some of the numbers", "give all of them, or none for zeros")
            return self.built(kind, [self.to("lanes", value, node) for value in values])
        if own:
            return self.built_in(own, values, node)
        if not isinstance(target, wp.Function):
            raise self.refused(node, "calls what is no device function", "make it one with @wp.func")
        parameters, results = self.law.signature(target)
        if len(values) != len(parameters):
            raise self.refused(node, "leaves arguments out", "give all of them by position")
        given = ", ".join(self.to(kind, value, node) for kind, value in zip(parameters, values, strict=True))
        if len(results) == 1:
            return Value(f"{target.key}({given})", results[0])
        name = self.law.fresh(target.key)
        self.scope.lines.append(f"const {target.key}_results {name} = {target.key}({given});")
        return Value(name, "tuple", parts=tuple(Value(f"{name}._{k}", kind) for k, kind in enumerate(results)))

    def converted(self, to_int: bool, value: Value, node: Any) -> Value:
        """Return a number as an int or a float64."""
        if value.number is not None:
            return self.known(int(value.number) if to_int else float(value.number), node)
        if value.kind not in (("int", "integers") if to_int else ("double", "lanes")):
            raise self.refused(node, f"makes another number of a {value.kind}", "use `wp.where`")
        return value

    def built(self, kind: str, numbers: list[str]) -> Value:
        """Return a vector or a matrix of given numbers; of zeros where there are none."""
        made = self.let(Value(f"{type_of(kind)}()", kind))
        self.scope.lines += [f"{made.code}{x} = {number};" for x, number in zip(entries(kind), numbers, strict=False)]
        return made

    def built_in(self, name: str, values: list[Value], node: ast.Call) -> Value:
        """Return what one of Warp's own functions gives."""
        if name == "where":
            test, a, b = values
            kind = self.common(a, b, node)
            if test.kind == "bool":
                return Value(f"({test.code} ? {self.to(kind, a, node)} : {self.to(kind, b, node)})", kind)
            kind, mask = IN_LANES.get(kind, kind), self.to("mask", test, node)
            return Value(self.law.pick(mask, self.to(kind, a, node), self.to(kind, b, node), kind), kind)
        if name in NUMBER_BY_NUMBER:
            kind = next((value.kind for value in values if value.kind not in NUMERIC), "lanes")
            given = [self.let(Value(self.to(kind, value, node), kind)).code for value in values]
            numbers = [f"lane_{name}({', '.join(code + x for code in given)})" for x in entries(kind)]
            return self.built(kind, numbers) if kind != "lanes" else Value(numbers[0], kind)
        if name not in OF_SHAPES or any(value.kind in NUMERIC for value in values):
            these = ", ".join(sorted(("where", "identity", *NUMBER_BY_NUMBER, *OF_SHAPES)))
            raise self.refused(node, f"calls wp.{name}, which is not known in lanes", f"write it with {these}")
        code, kind_of = OF_SHAPES[name]
        kind = kind_of(*(value.kind for value in values))
        if "pick" in code:
            self.law.pick("", "", "", kind)
        given = [value.code if value.code.isidentifier() else self.let(value).code for value in values]
        return Value(code.format(*given, type=type_of(kind)), kind)
