"""Device functions read in lanes: every construct against the function of one point, every refusal with its line."""

from __future__ import annotations

import linecache
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

from softmode.errors import LanesError
from softmode.lanes import LANES, lanes_code
from tests import lanes_refused_kernels as refused
from tests.lanes_kernels import FUNCTIONS, eight_at_a_time, one_at_a_time, vec8d
from tests.modules import load

WRITTEN: Any = FUNCTIONS  # device functions, which a type checker takes for Python's
NAMES = [*(function.key for function in WRITTEN), "of_struct", "log"]
REFUSED = [f for f in vars(refused).values() if isinstance(f, wp.Function) and f.key != "uniform_rate"]


def both(which: int, x: np.ndarray, y: np.ndarray, n: int, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what a function gives at points, eight at a time and one at a time."""
    found = []
    for kernel, kind, width in ((eight_at_a_time, vec8d, LANES), (one_at_a_time, wp.float64, 1)):
        arrays = [wp.array(values.reshape(-1, width).squeeze(), dtype=kind, device="cpu") for values in (x, y)]
        out = wp.zeros_like(arrays[0])
        wp.launch(kernel, len(x) // width, [which, n, wp.float64(rate), *arrays, out], device="cpu")
        found.append(out.numpy().ravel())
    return found[0], found[1]


@pytest.mark.parametrize("name", NAMES[:-1])
def test_constructs(name: str) -> None:
    """Lanes equal points up to rounding of numbers of size 1 to 1e3, whatever each lane decides, for every option."""
    x, y = np.random.default_rng(0).uniform(-3.0, 3.0, (2, 20 * LANES))
    x[:3], y[:3] = y[:3], 0.0  # equal numbers and zeros too
    x[0] = y[0]
    for n in (0, 1, 2):
        for rate in (0.05, 0.3, 1.7):
            eight, one = both(NAMES.index(name), x, y, n, rate)
            assert np.isfinite(one).all()
            np.testing.assert_allclose(eight, one, rtol=1e-13, atol=1e-12)
            assert len(np.unique(one)) > LANES


def test_logarithm() -> None:
    """To two units in the last place from 1e-307 to 1e308, and what it gives of 0, negative numbers and infinity."""
    x = np.concatenate([np.logspace(-307, 308, 100), 1.0 + np.linspace(-1e-3, 1e-3, 100)])
    eight, one = both(NAMES.index("log"), x, x, 0, 0.0)
    np.testing.assert_allclose(eight, one, rtol=2.0 * np.finfo(float).eps)
    eight, one = both(NAMES.index("log"), np.array([0.0, -1.0, np.inf, 1.0, -np.inf, np.nan, 2.0, -0.0]), x[:8], 0, 0.0)
    np.testing.assert_array_equal(eight[[0, 1, 2, 3, 4, 7]], one[[0, 1, 2, 3, 4, 7]])
    assert np.isnan(eight[5])


@pytest.mark.parametrize("function", REFUSED, ids=lambda function: function.key)
def test_refusals_name_the_line(function: wp.Function) -> None:
    """What cannot be read is refused, with its line and what to write instead, as the remark in that line says."""
    with pytest.raises(LanesError) as error:
        lanes_code(function, uniform=("rate",))
    place = re.match(r"lanes_refused_kernels\.py:(\d+), in (\w+): `", error.value.message)
    assert place
    line = Path(str(refused.__file__)).read_text().splitlines()[int(place[1]) - 1]
    assert place[2] == function.key
    assert line.split("# ")[1] in error.value.hint


def test_native_code_is_refused() -> None:
    """A function whose body is C++ has no source that could be read."""

    @wp.func_native(snippet="return x;")
    def same(x: wp.float64) -> wp.float64: ...

    with pytest.raises(LanesError, match=r"same is native code.*Write it in Warp"):
        lanes_code(same)


def test_two_functions_of_one_name_are_refused(tmp_path: Path) -> None:
    """A law that calls two functions of one name would have one of them called for both."""
    modules = [written(tmp_path / f"{name}.py", SOURCE) for name in ("first", "second")]
    with pytest.raises(LanesError, match="two device functions are called twice"):
        lanes_code(*(module.twice for module in modules))


SOURCE = """import warp as wp

@wp.func
def twice(x: wp.float64):
    return x + x
"""


def written(path: Path, source: str):
    """Return a module of a file that is written here."""
    path.write_text(source)
    return load(path)


def test_without_its_source_a_function_is_refused(tmp_path: Path) -> None:
    """As in a frozen application that ships no .py files."""
    module = written(tmp_path / "frozen.py", SOURCE)
    assert "twice" in lanes_code(module.twice)
    (tmp_path / "frozen.py").unlink()
    linecache.clearcache()
    with pytest.raises(LanesError, match=r"source of twice is not there.*Ship the \.py files"):
        lanes_code(module.twice)
