"""Device functions as C++ in lanes: their statements."""

from __future__ import annotations

import ast
from collections.abc import Sequence
from typing import Any

import warp as wp

from softmode.lanes.expressions import Expressions, Scope
from softmode.lanes.native import IN_LANES, Law, Signature, Value, type_of


def lanes_code(*functions: Any, uniform: Sequence[str] = (), apart: Sequence[str] = ()) -> str:
    """Return C++ for the body of a native function: the types ``lanes`` and ``words``, and a struct ``Law``.

    Its static members are the device functions and all that they call. One with several results returns a struct with
    the members ``_0``, ``_1`` and so on.

    Args:
        functions: Functions of a point, made by ``wp.func``.
        uniform: Parameters and fields of structs, by name, of type float64 or bool that are the same for all lanes.
        apart: Functions, by name, that are not compiled into those that call them, like those of
            ``wp.func(inline=False)``: large ones that are seldom called compile in half of the time.

    Raises:
        LanesError: If a function uses what cannot be read, or its source is not there.
    """
    law = Law(uniform, apart, lambda law, function: Translation(law, function).write())
    for function in functions:
        law.signature(function)
    return law.code()


class Translation(Expressions):
    """The translation of one device function: statements add lines to the scope."""

    def write(self) -> Signature:
        """Add the function to the law."""
        for parameter in self.tree.args.args:
            kind = self.law.kind(parameter.arg, self.function.input_types[parameter.arg])
            if kind is None:
                hint = "pass float64, int, bool, vectors, matrices or structs of them; arrays are for the kernel"
                raise self.refused(parameter, "is of a type that cannot be read in lanes", hint)
            self.scope.env[parameter.arg] = Value(self.law.fresh(parameter.arg), kind)
        parameters = list(self.scope.env.values())
        results = self.block(self.tree.body)
        if results is None:
            raise self.refused(self.tree, "may end without a return", "end every way through it with a return")
        name, kinds = self.function.key, [value.kind for value in results]
        given = ", ".join(f"const {type_of(value.kind)}& {value.code}" for value in parameters)
        out = type_of(kinds[0]) if len(kinds) == 1 else f"{name}_results"
        if len(kinds) > 1:
            members = " ".join(f"{type_of(kind)} _{k};" for k, kind in enumerate(kinds))
            self.law.members.append(f"        struct {out} {{ {members} }};\n")
        apart = name in self.law.apart or getattr(self.function, "inline_hint", None) == "noinline"
        codes = ", ".join(value.code for value in results)
        body = [*self.scope.lines, f"return {codes};" if len(kinds) == 1 else f"return {{{codes}}};"]
        text = "".join(f"            {line}\n" for line in ("#pragma clang fp contract(fast)", *body))
        head = f"        __attribute__(({'noinline' if apart else 'always_inline'})) static {out} {name}({given})"
        self.law.members.append(f"{head} {{\n{text}        }}\n")
        return [value.kind for value in parameters], kinds

    def block(self, statements: list[ast.stmt]) -> list[Value] | None:
        """Write statements; return what they return, None where they go on."""
        for k, statement in enumerate(statements):
            rest = statements[k + 1 :]
            if isinstance(statement, ast.Return) and statement.value is not None:
                given = statement.value.elts if isinstance(statement.value, ast.Tuple) else [statement.value]
                values = [self.visit(value) for value in given]
                return list(values[0].parts) or values
            if not isinstance(statement, ast.If):
                self.visit(statement)
                continue
            test, sides = self.visit(statement.test), [statement.body, statement.orelse]
            if test.number is not None:
                return self.block(sides[not test.number] + rest)
            if any(isinstance(node, ast.Return) for node in ast.walk(statement)):
                sides = [side if side and isinstance(side[-1], ast.Return) else side + rest for side in sides]
                return self.branch(test, sides, statement)
            self.branch(test, sides, statement)
        return None

    def inside(self, statements: list[ast.stmt]) -> tuple[Scope, list[Value] | None]:
        """Write statements apart from the lines so far; return their scope and what they return."""
        outer, self.scope = self.scope, Scope(dict(self.scope.env))
        results = self.block(statements)
        inner, self.scope = self.scope, outer
        return inner, results

    def branch(self, test: Value, given: list[list[ast.stmt]], node: ast.If) -> list[Value] | None:
        """Write both sides of a branch, and what of each becomes of the variables, or of the results."""
        if test.kind not in ("mask", "bool"):
            raise self.refused(node, "decides by what is no bool", "compare it with a number")
        per_lane, condition = test.kind == "mask", self.let(test).code
        yes, no = given
        (first, one), (second, other) = self.inside(yes), self.inside(no)
        a, b = first.env, second.env
        if one is not None or other is not None:
            if one is None or other is None or len(one) != len(other):
                raise self.refused(node, "returns on one side", "end every way with a return of as many values")
            a, b = ({f"result{k}": value for k, value in enumerate(values)} for values in (one, other))
        changed = {name: (a[name], b[name]) for name in a if name in b and a[name] != b[name]}
        merged: dict[str, Value] = {}
        for name, pair in changed.items():
            kind = self.common(*pair, node)
            merged[name] = Value(self.law.fresh(name), IN_LANES.get(kind, kind) if per_lane else kind)
        sides = [(f"{'~' if per_lane else '!'}{condition}", second, no, 1), (condition, first, yes, 0)]
        sides.sort(key=lambda side: not per_lane or self.is_dear(side[2]))
        whole = per_lane and not self.is_dear(sides[0][2])  # what is cheap is evaluated for all lanes, without a choice
        if not whole:
            self.scope.lines += [f"{type_of(value.kind)} {value.code} = {{}};" for value in merged.values()]
        for mask, side, statements, which in sides:
            guarded = not per_lane or self.is_dear(statements)
            self.scope.lines += [f"if ({f'any({mask})' if per_lane else mask}) {{"] if guarded else []
            self.scope.lines += side.lines
            for name, value in merged.items():
                new = self.to(value.kind, changed[name][which], node)
                if per_lane and not whole:
                    new = self.law.pick(mask, new, value.code, value.kind)
                self.scope.lines.append(f"{type_of(value.kind) if whole else ''} {value.code} = {new};")
            self.scope.lines += ["}"] if guarded else []
            whole = False
        if one is not None:
            return [merged.get(name, a[name]) for name in a]
        self.scope.env |= merged
        self.scope.own |= {value.code for value in merged.values()}
        return None

    def is_dear(self, statements: list[ast.stmt]) -> bool:
        """Return whether statements call device functions, take logarithms or loop: not to be done for no lane."""

        def dear(node: ast.AST) -> bool:
            if not isinstance(node, ast.Call):
                return isinstance(node, ast.While)
            own = self.own_name(node)
            return own == "log" or (not own and isinstance(self.resolve(node.func), wp.Function))

        return any(dear(node) for statement in statements for node in ast.walk(statement))

    def loop_body(self, node: ast.For | ast.While) -> list[ast.stmt]:
        """Return the statements of a loop, which has neither a return nor an ``else``."""
        if node.orelse or any(isinstance(inner, ast.Return) for inner in ast.walk(node)):
            raise self.refused(node, "returns or has an else", "set a variable in the loop and return it behind")
        return node.body

    def visit_For(self, node: ast.For) -> None:
        """Write a loop over a constant range again and again."""
        call, body = node.iter, self.loop_body(node)
        over_range = isinstance(call, ast.Call) and self.resolve(call.func) is range
        bounds = [self.visit(bound) for bound in call.args] if isinstance(call, ast.Call) and over_range else []
        if not bounds or any(bound.kind != "int" or bound.number is None for bound in bounds):
            hint = "loop over a range of constants, or `while` with a condition"
            raise self.refused(node, "loops over what is not constant", hint)
        for k in range(*(int(bound.number or 0) for bound in bounds)):
            self.assign(node.target, self.known(k, node))
            self.block(body)

    def visit_While(self, node: ast.While) -> None:
        """Write a loop that goes on until every lane has ended; a lane that has ended is left alone."""
        body = self.loop_body(node)
        stored = [inner for inner in ast.walk(node) if isinstance(getattr(inner, "ctx", None), ast.Store)]
        names = {getattr(target, "id", None) or ast.unparse(getattr(target, "value", target)) for target in stored}
        kept: dict[str, Value] = {}
        for name in sorted(names & self.scope.env.keys()):
            value = self.scope.env[name]
            kind = IN_LANES.get(value.kind, value.kind)
            kept[name] = self.scope.env[name] = self.let(Value(self.to(kind, value, node), kind), name)
        outer, self.scope = self.scope, Scope(dict(self.scope.env))
        going = self.let(Value(self.to("mask", self.visit(node.test), node), "mask"), "going").code
        self.scope.lines.append(f"if (!any({going})) break;")
        self.block(body)
        inner, self.scope = self.scope, outer
        for name, value in kept.items():
            new = self.to(value.kind, inner.env[name], node)
            inner.lines.append(f"{value.code} = {self.law.pick(going, new, value.code, value.kind)};")
        self.scope.lines += ["while (true) {", *inner.lines, "}"]

    def visit_Assign(self, node: ast.Assign) -> None:
        """Give a value to a name, to several, or to an entry."""
        if isinstance(node.value, ast.Tuple):
            value = Value("", "tuple", parts=tuple(self.let(self.visit(part)) for part in node.value.elts))
        else:
            value = self.visit(node.value)
        for target in node.targets:
            self.assign(target, value)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        """Change the value of a name or an entry."""
        self.assign(node.target, self.operate(node.op, self.visit(node.target), self.visit(node.value), node))

    def visit_Expr(self, node: ast.Expr) -> None:
        """Read over a docstring."""
        if not isinstance(node.value, ast.Constant):
            raise self.refused(node, "is done for its effect", "return what it finds; writing is for the kernel")

    def assign(self, target: ast.expr, value: Value) -> None:
        """Give a value to a name, to several, or to an entry of a vector or a matrix."""
        if isinstance(target, ast.Tuple) and len(target.elts) == len(value.parts):
            for name, part in zip(target.elts, value.parts, strict=True):
                self.assign(name, part)
        elif isinstance(target, ast.Name) and not value.parts:
            self.scope.env[target.id] = value if value.number is not None else self.let(value, target.id)
        elif isinstance(target, ast.Subscript) and isinstance(target.value, ast.Name):
            held = self.visit(target.value)
            if held.code not in self.scope.own:
                held = self.scope.env[target.value.id] = self.let(held, target.value.id)
            self.scope.lines.append(f"{self.entry(held, target).code} = {self.to('lanes', value, target)};")
        else:
            hint = "assign to a name, an entry of a vector or matrix, or as many names as a function returns"
            raise self.refused(target, "cannot be assigned to", hint)
