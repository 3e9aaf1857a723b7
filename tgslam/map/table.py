"""Named columns with the same rows, which come and go together: growing and compacting are written here, once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.device import runtime


@dataclass(frozen=True)
class Column:
    """What a column holds."""

    name: str
    width: int = 0  # values a row, 0 = a scalar
    dtype: type = np.float32
    on_host: bool = False  # no kernel uses it: it stays in NumPy memory, and may be of any dtype

    def zeros(self, rows: int) -> np.ndarray:
        """An array of so many rows, where the column lives."""
        shape = (rows, self.width) if self.width else (rows,)
        return np.zeros(shape, self.dtype) if self.on_host else runtime.zeros(shape, self.dtype)


class Table:
    """Rows [0, count) are in use; spare ones, of which `array` has `capacity` in all, make adding an append."""

    def __init__(self, columns: Iterable[Column], capacity: int) -> None:
        self.count, self.capacity = 0, capacity
        self._columns = {column.name: column for column in columns}
        self._arrays = {name: column.zeros(capacity) for name, column in self._columns.items()}

    def add_column(self, column: Column) -> None:
        """Another column, zero in all rows. Raises ValueError for a name that there is."""
        if column.name in self._columns:
            raise ValueError(f"there is a column {column.name!r} already")
        self._columns[column.name] = column
        self._arrays[column.name] = column.zeros(self.capacity)

    def array(self, name: str) -> np.ndarray:
        """A column with its spare rows, [capacity] or [capacity, width], where it lives."""
        return self._arrays[name]

    def host(self, name: str) -> np.ndarray:
        """The rows in use of a column on the host, to be read: a view in host memory, a copy of a CUDA device's."""
        return runtime.to_host(self._arrays[name])[: self.count]

    def write(self, name: str, rows: slice | NDArray[np.integer] | NDArray[np.bool_], values: np.ndarray) -> None:
        """Set rows in use of a column from host values."""
        host = runtime.to_host(self._arrays[name])
        host[: self.count][rows] = values
        self._put(name, host)

    def append(self, rows: int, values: Mapping[str, np.ndarray]) -> None:
        """Add rows at the end, doubling the capacity when it is used up; columns without values [rows] are zero."""
        start, self.count = self.count, self.count + rows
        if self.count > self.capacity:
            self.capacity = max(2 * self.capacity, self.count)
            for name in self._columns:
                self._resize(name, start)
        for name in self._columns:
            host = runtime.to_host(self._arrays[name])
            host[start : self.count] = values.get(name, 0)
            self._put(name, host)

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Remove the rows where the mask [count] is false; the others keep their order.

        Raises ValueError for a mask of another length.
        """
        if mask.shape != (self.count,):
            raise ValueError(f"the mask must have shape [{self.count}], but has {list(mask.shape)}")
        kept = np.flatnonzero(mask)
        for name in self._columns:
            host = runtime.to_host(self._arrays[name])
            host[: len(kept)] = host[kept]
            self._put(name, host)
        self.count = len(kept)

    def _resize(self, name: str, rows: int) -> None:
        """A new array of the capacity with the first rows of the old one."""
        larger, old = self._columns[name].zeros(self.capacity), runtime.to_host(self._arrays[name])
        host = runtime.to_host(larger)
        host[:rows] = old[:rows]
        self._arrays[name] = larger
        self._put(name, host)

    def _put(self, name: str, host: np.ndarray) -> None:
        """Host values of a whole column back to where it lives; on the CPU they are there already."""
        if runtime.device() is not runtime.Device.CPU and not self._columns[name].on_host:
            self._arrays[name] = runtime.to_device(host, self._columns[name].dtype)
