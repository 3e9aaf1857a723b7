"""Kernels executed as plain Python on numbers that count what is done to them.

Taichi keeps the Python function that it compiles. Called with its globals replaced (a `ti` of a few lines, and `Lanes`
that count), the very source of a kernel says how much arithmetic it does on each lane.
"""

from __future__ import annotations

import inspect
import types
from collections import Counter
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

ARITHMETIC = ("+", "-", "*", "/")


class Lanes:
    """16 numbers; every operation on all of them is counted once, in `Lanes.counts`."""

    __array_ufunc__ = None  # a NumPy scalar on the left leaves the operation to us
    counts: ClassVar[Counter[str]] = Counter()

    def __init__(self, value: Any) -> None:
        self.v = np.broadcast_to(np.asarray(value, np.float64), (16,)).copy()

    def __getitem__(self, lane: int) -> float:
        return float(self.v[lane])

    def __setitem__(self, lane: int, value: float) -> None:
        self.v[lane] = value


def _values(x: Any) -> Any:
    return x.v if isinstance(x, Lanes) else x


def _counted(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    def operate(*operands: Any) -> Any:
        if not any(isinstance(x, Lanes) for x in operands):
            return function(*operands)
        Lanes.counts[name] += 1
        return Lanes(function(*(_values(x) for x in operands)))

    return operate


_add, _subtract = _counted("+", lambda a, b: a + b), _counted("-", lambda a, b: a - b)
_multiply, _divide = _counted("*", lambda a, b: a * b), _counted("/", lambda a, b: a / b)
Lanes.__add__ = Lanes.__radd__ = _add  # type: ignore[attr-defined]
Lanes.__mul__ = Lanes.__rmul__ = _multiply  # type: ignore[attr-defined]
Lanes.__sub__, Lanes.__truediv__ = _subtract, _divide  # type: ignore[attr-defined]
Lanes.__rsub__ = lambda a, b: _subtract(b, a)  # type: ignore[attr-defined]
Lanes.__rtruediv__ = lambda a, b: _divide(b, a)  # type: ignore[attr-defined]
Lanes.__lt__ = _counted("compare", lambda a, b: a < b)  # type: ignore[method-assign]
Lanes.__le__ = _counted("compare", lambda a, b: a <= b)  # type: ignore[method-assign]
Lanes.__gt__ = _counted("compare", lambda a, b: a > b)  # type: ignore[method-assign]


def _clz(bits: int) -> int:
    return 32 - int(bits).bit_length()


def _select(condition: Any, yes: Any, no: Any) -> Any:
    return np.where(condition, yes, no) if np.ndim(condition) else yes if condition else no


_TAICHI = types.SimpleNamespace(
    min=_counted("min", np.minimum),
    max=_counted("max", np.maximum),
    sqrt=_counted("sqrt", np.sqrt),
    select=_counted("select", _select),
    static=lambda x: x,
    cast=lambda x, dtype: dtype(x),
    math=types.SimpleNamespace(clz=_clz),
    f32=float,
    i32=int,
)


def source_of(function: Callable[..., Any]) -> types.FunctionType:
    """The Python function below Taichi's decorators and ours."""
    while hasattr(function, "__wrapped__"):
        function = function.__wrapped__
    assert isinstance(function, types.FunctionType)
    return function


def in_python(function: Callable[..., Any]) -> Callable[..., Any]:
    """The source of a `lanes_kernel` or `ti.func` as a Python function; what it calls is translated too."""
    source = source_of(function)
    names: dict[str, Any] = dict(source.__globals__)
    for name in source.__code__.co_names:
        if getattr(names.get(name), "_is_taichi_function", False):
            names[name] = in_python(names[name])
    return types.FunctionType(source.__code__, {**names, "ti": _TAICHI, "Lanes": Lanes})


class LaneArray:
    """An array of `Lanes` as a kernel argument: element [i, ...] is read and written whole."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.values = np.zeros((*shape, 16))

    def __getitem__(self, index: Any) -> Lanes:
        return Lanes(self.values[index])

    def __setitem__(self, index: Any, value: Lanes) -> None:
        self.values[index] = value.v


def arithmetic_of(kernel: Callable[..., Any], known: dict[str, Any]) -> int:
    """Additions, subtractions, multiplications and divisions that a call of the kernel does on each lane.

    known: the kernel's arguments by name, and maybe others.
    """
    arguments = {name: known[name] for name in inspect.signature(source_of(kernel)).parameters}
    Lanes.counts.clear()
    in_python(kernel)(**arguments)
    return sum(Lanes.counts[name] for name in ARITHMETIC)
