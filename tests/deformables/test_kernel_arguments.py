"""How functions of kernels take their arguments: by source, since it costs time only on a device."""

import ast
from collections.abc import Iterator
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[2] / "softmode"


def handed_on(source: str) -> Iterator[str]:
    """Yield the calls in functions of kernels that hand on a whole ``NewtonStep``."""
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef):
            continue
        if not any(ast.unparse(decorator).startswith("wp.func") for decorator in function.decorator_list):
            continue
        named = [one for one in function.args.args if one.annotation]
        steps = {one.arg for one in named if ast.unparse(one.annotation) == "NewtonStep"}
        for call in ast.walk(function):
            if isinstance(call, ast.Call) and any(isinstance(one, ast.Name) and one.id in steps for one in call.args):
                yield f"{function.name}: {ast.unparse(call)}"


def test_no_function_hands_on_the_step() -> None:
    """The CUDA compiler copies a struct of more than 8 kB for every thread where such a function hands it on."""
    found = [f"{path.name} {call}" for path in SOURCE.rglob("*_kernels.py") for call in handed_on(path.read_text())]
    assert not found, "hand on the members that are needed: " + "; ".join(found)


def test_what_counts_as_handing_on() -> None:
    """A function that hands on the step is found; one that hands on its members, and a kernel, are not."""
    text = "@wp.func\ndef f(step: NewtonStep, i: int):\n    return g({0})\n"
    assert list(handed_on(text.format("step, i"))) == ["f: g(step, i)"]
    assert not list(handed_on(text.format("step.instances, i")))
    assert not list(handed_on(text.replace("wp.func", "wp.kernel").format("step, i")))
