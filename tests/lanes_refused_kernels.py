# ruff: noqa: D103 - the names say it
"""Device functions that cannot be read in lanes; the line at fault ends with a comment that says what to write."""

import math
from typing import Any

import warp as wp

vec8d: Any = wp.types.vector(length=8, dtype=wp.float64)


@wp.struct
class Table:
    """A struct with an array."""

    values: wp.array[wp.float64]
    count: wp.float64


@wp.func
def an_array(x: wp.array[wp.float64]):  # arrays are for the kernel
    return x[0]


@wp.func
def single_precision(
    x: float,  # pass float64
):
    return x


@wp.func
def a_field(table: Table):
    return table.values[0]  # pass what is needed of it


@wp.func
def a_break(x: wp.float64):
    while x > wp.float64(0.0):
        x = x - wp.float64(1.0)
        if x > wp.float64(5.0):
            break  # into the `while`
    return x


@wp.func
def a_return_in_a_loop(x: wp.float64):
    for k in range(3):  # return it behind
        if x > wp.float64(k):
            return x
    return -x


@wp.func
def an_open_loop(x: wp.float64, n: int):
    for _k in range(n):  # `while` with a condition
        x = x + x
    return x


@wp.func
def an_open_index(v: wp.vec3d, n: int):
    return v[n]  # variable of a `for`


@wp.func
def an_entry_too_many(v: wp.vec3d):
    return v[3]  # within its size


@wp.func
def a_power(x: wp.float64):
    return x**2.0  # + - * /


@wp.func
def integers_divided(x: wp.float64, n: int):
    return x * wp.float64(n / 2)  # or float64


@wp.func
def an_unknown_function(x: wp.float64):
    return wp.exp(x)  # write it with


@wp.func
def a_function_of_python(x: wp.float64):
    return math.sin(x)  # @wp.func


@wp.func
def an_argument_left_out(x: wp.float64):
    return uniform_rate()  # by position


@wp.func
def a_named_argument(x: wp.float64):
    return uniform_rate(rate=x)  # by position


@wp.func
def a_number_that_decides(x: wp.float64):
    n = wp.where(x > wp.float64(0.0), int(1), int(0))
    if n:  # compare it with a number
        x = -x
    return x


@wp.func
def a_chain(x: wp.float64):
    return wp.where(wp.float64(0.0) < x < wp.float64(1.0), x, -x)  # by `and`


@wp.func
def a_way_without_return(x: wp.float64):
    if x > wp.float64(0.0):  # as many values
        return x


@wp.func
def nothing_returned(x: wp.float64):  # end every way
    x = x + x


@wp.func
def a_value_of_one_side(x: wp.float64):
    if x > wp.float64(0.0):
        y = x
    return y  # on every way


@wp.func
def done_for_its_effect(x: wp.float64):
    print(x)  # for the kernel
    return x


@wp.func
def mixed_types(x: wp.float64, n: int):
    return x + n  # of one type


@wp.func
def what_differs_where_all_are_alike(x: wp.float64, rate: wp.float64):
    return uniform_rate(x)  # of one type


@wp.func
def uniform_rate(rate: wp.float64):
    return rate


@wp.func
def some_of_the_numbers(x: wp.float64):
    v = wp.vec3d(x, x)  # all of them
    return v[0]


@wp.func
def a_choice_of_python(x: wp.float64):
    return x if x > wp.float64(0.0) else -x  # `wp.where`
