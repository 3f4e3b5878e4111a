"""Checks of numbers: who passes, and what the message says to who does not."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from softmode.checks import require_fields, require_number
from softmode.errors import ConfigError, MaterialError


@pytest.mark.parametrize(
    ("value", "limits"),
    [(1.0, {"above": 0.0}), (0, {"at_least": 0}), (3, {"at_least": 1, "at_most": 3}), (-2.0, {}), (0.9, {"below": 1})],
)
def test_numbers_within_their_limits_pass(value: float, limits: dict[str, float]) -> None:
    """A bound of `at_least` and `at_most` belongs to the range, one of `above` and `below` does not."""
    require_number("x", value, **limits)


@pytest.mark.parametrize(
    ("value", "limits", "message"),
    [
        (0.0, {"above": 0.0}, "x must be a finite number > 0, got 0.0"),
        (float("nan"), {"at_least": 0.0}, "x must be a finite number >= 0, got nan"),
        (float("inf"), {}, "x must be a finite number, got inf"),
        (4, {"at_least": 1, "at_most": 3, "unit": "m"}, "x must lie in 1..3 m, got 4"),
        (0, {"at_least": 1}, "x must be at least 1, got 0"),
        (1.0, {"above": 0.0, "below": 1.0}, "x must be a finite number > 0 and < 1, got 1.0"),
        ("1", {"at_least": 0}, "x must be a finite number >= 0, got '1'"),
        (None, {}, "x must be a finite number, got None"),
    ],
)
def test_others_are_refused_with_what_was_given(value: object, limits: dict[str, float], message: str) -> None:
    """The message names the argument, the limits, the unit and the value; the hint follows it."""
    with pytest.raises(ConfigError) as caught:
        require_number("x", value, hint="give another", **limits)  # type: ignore[arg-type]
    assert str(caught.value) == f"{message}. Give another"


def test_fields_are_checked_by_name_and_errors_chosen() -> None:
    """The first field outside the limits is named, in the error that was asked for."""
    owner = SimpleNamespace(a=1.0, b=-1.0)
    require_fields(owner, ("a",), above=0.0)
    with pytest.raises(MaterialError, match="b must be a finite number > 0, got -1"):
        require_fields(owner, ("a", "b"), above=0.0, error=MaterialError)
