"""Quicker imports and translation of kernels: errors still name the place, and functions do what they did."""

import inspect
from pathlib import Path

import pytest
import taichi as ti

from tgslam.device import runtime
from tgslam.device.quick_import import quick_import


@ti.kernel
def broken():
    for i in range(3):
        print(i + no_such_name)  # noqa: F821


def test_an_error_in_a_kernel_names_file_line_and_text() -> None:
    runtime.start()
    with pytest.raises(ti.TaichiNameError) as error:
        broken()
    message = str(error.value)
    assert __file__ in message
    lines = Path(__file__).read_text(encoding="utf-8").splitlines()
    line = next(i for i, text in enumerate(lines, 1) if "print(i + no_such" in text)
    assert f"line {line}, in broken" in message
    assert "print(i + no_such_name)" in message
    assert "^^^" not in message  # the layout that costs half of the start-up is gone


@ti.func
def binomial(n: ti.template(), k: ti.template()):
    result = 1.0
    if ti.static(0 < k < n):
        result = binomial(n - 1, k - 1) + binomial(n - 1, k)
    return result


@ti.kernel
def pascal(row: ti.types.ndarray(dtype=ti.f32, ndim=1)):
    for _ in range(1):
        for k in ti.static(range(7)):
            row[k] = binomial(6, k)


def test_a_function_may_come_up_within_its_own_call() -> None:
    runtime.start()
    row = runtime.empty((7,))
    pascal(row)
    assert row.tolist() == [1.0, 6.0, 15.0, 20.0, 15.0, 6.0, 1.0]


@ti.data_oriented
class Table:
    @ti.func
    def max(self):
        return 7.0


TABLE = Table()


@ti.func
def largest(of: ti.template()):
    return of.max()


@ti.kernel
def largest_of_each(out: ti.types.ndarray(dtype=ti.f32, ndim=1)):
    for _ in range(1):
        vector = ti.Vector([1.0, 3.0, 2.0])
        out[0] = largest(TABLE)
        out[1] = largest(vector)
        out[2] = largest(TABLE)


def test_a_tree_that_is_used_again_forgets_what_it_was_called_on() -> None:
    runtime.start()
    out = runtime.empty((3,))
    largest_of_each(out)
    assert out.tolist() == [7.0, 3.0, 7.0]


@ti.func
def halved(x):
    return x / missing  # noqa: F821


@ti.kernel
def broken_inside(out: ti.types.ndarray(dtype=ti.f32, ndim=1)):
    for i in range(3):
        out[i] = ti.sqrt(
            halved(2.0),
        )


def test_an_error_in_a_function_names_its_statement_and_the_one_that_calls() -> None:
    runtime.start()
    with pytest.raises(ti.TaichiCompilationError) as error:
        broken_inside(runtime.empty((3,)))
    message = str(error.value)
    assert "in halved" in message and "return x / missing" in message
    assert "in broken_inside" in message and "out[i] = ti.sqrt(" in message


def test_a_method_of_a_class_is_still_told_from_a_function() -> None:
    with quick_import():

        @ti.data_oriented
        class Counter:
            @ti.kernel
            def three(self) -> ti.i32:
                return 3

    runtime.start()
    assert Counter().three() == 3
    assert inspect.getframeinfo.__module__ == "inspect"
