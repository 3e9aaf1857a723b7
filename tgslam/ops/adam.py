"""Adam over named parameter arrays whose rows come and go with the map."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tgslam.device import runtime
from tgslam.device.arrays import require
from tgslam.kernels import adam as kernels

_MAX_CORRECTIONS = 1 << 15  # that are tabulated; for the usual betas they are 1 after 18,000 updates
_MIN_CAPACITY = 64  # rows, so that small maps do not take new memory at every keyframe


class Adam:
    """Adam with a learning rate per group; all groups have the same rows.

    Only visible rows change. Each row has its own count of updates for the bias correction, so a row that is seen
    seldom, or was added late, takes the same first steps as any other. Moments live on the device with spare capacity
    that doubles when rows are appended.
    """

    def __init__(
        self,
        channels: dict[str, int],
        learning_rates: dict[str, float],
        rows: int = 0,
        betas: tuple[float, float] = (0.9, 0.999),
        epsilon: float = 1e-15,
    ) -> None:
        """channels: values per row of each group, 0 for a one-dimensional array [N].

        learning_rates: per group, in the parameter's unit; may be changed between steps. betas, epsilon: as usual in
        Adam. Raises ValueError if the two dicts name different groups, or more than five.
        """
        if channels.keys() != learning_rates.keys():
            raise ValueError(f"groups {sorted(channels)} need learning rates, but got {sorted(learning_rates)}")
        if len(channels) > kernels.GROUPS:
            raise ValueError(f"at most {kernels.GROUPS} groups, but got {sorted(channels)}")
        self.learning_rates = dict(learning_rates)
        self._channels = dict(channels)
        self._first_column, self._columns = _columns(channels)
        self._gains, self._epsilon = (1.0 - betas[0], 1.0 - betas[1]), epsilon
        self._rows = rows
        self._correction = runtime.to_device(_corrections(*betas))
        self._allocate(max(rows, _MIN_CAPACITY))

    @property
    def rows(self) -> int:
        """Rows in use."""
        return self._rows

    def moments(self, group: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Host views or copies of the first and second moment of a group, [rows] or [rows, C]."""
        channels = self._channels[group]
        first, middle, end = (self._first_column[group] + k * max(channels, 1) for k in range(3))
        host = runtime.to_host(self._moments)[: self._rows]
        m, v = host[:, first:middle], host[:, middle:end]
        return (m, v) if channels else (m[:, 0], v[:, 0])

    def step_counts(self) -> NDArray[np.int32]:
        """Updates that each row has had, [rows]."""
        return runtime.to_host(self._steps)[: self._rows]

    def step(
        self,
        parameters: dict[str, np.ndarray],
        gradients: dict[str, np.ndarray],
        visible: np.ndarray | None = None,
        pace: float = 1.0,
    ) -> None:
        """Update float32 [N] or [N, C] parameters in place from gradients of that shape; N may exceed `rows`.

        visible: int32 [N], 0 = leave the row and its moments alone; by default every row is updated. pace:
        what all learning rates are multiplied by. Groups that are not in `parameters` rest. Raises ValueError for
        unknown groups, other shapes or dtypes.
        """
        for group in parameters:
            if group not in self._channels:
                raise ValueError(f"unknown group {group!r}: the optimiser has {sorted(self._channels)}")
            shape = self._shape(group, self._rows)
            require(f"parameter {group!r}", parameters[group], shape, at_least=True)
            require(f"gradient {group!r}", gradients[group], shape, at_least=True)
        if visible is None:
            visible = self._all_visible
        require("visible", visible, (self._rows,), np.int32, at_least=True)
        if not parameters:
            return
        arrays = [array for group in parameters for array in (gradients[group], parameters[group])]
        unused = kernels.GROUPS - len(parameters)
        kernels.adam_rows(
            self._rows, [pace * self.learning_rates[group] for group in parameters] + [0.0] * unused,
            *self._gains, self._epsilon, self._correction, visible, self._steps, self._moments,
            *arrays, *arrays[:2] * unused, tuple((self._first_column[g], self._channels[g]) for g in parameters),
        )  # fmt: skip

    def append(self, rows: int) -> None:
        """Add rows with no history at the end."""
        start, self._rows = self._rows, self._rows + rows
        capacity = self._steps.shape[0]
        if self._rows > capacity:
            self._reallocate(np.arange(start), max(self._rows, 2 * capacity))

    def keep(self, kept: NDArray[np.bool_] | NDArray[np.integer]) -> None:
        """Keep these rows, as a mask [rows] or as indices in the new order, with their moments and step counts.

        Raises ValueError if a mask has another length, IndexError if an index is out of range.
        """
        if kept.dtype == np.bool_:
            rows = np.flatnonzero(require("kept", kept, (self._rows,), np.bool_))
        else:
            rows = kept.astype(np.int64)
            if len(rows) and not (rows.min() >= 0 and rows.max() < self._rows):
                raise IndexError(f"rows to keep must be in 0..{self._rows - 1}")
        self._rows = len(rows)
        self._reallocate(rows, self._steps.shape[0])

    def _shape(self, group: str, rows: int) -> tuple[int, ...]:
        channels = self._channels[group]
        return (rows, channels) if channels else (rows,)

    def _allocate(self, capacity: int) -> None:
        self._moments = runtime.zeros((capacity, self._columns))
        self._steps = runtime.zeros((capacity,), np.int32)
        self._all_visible = runtime.empty((capacity,), np.int32)
        self._all_visible.fill(1)

    def _reallocate(self, kept: NDArray[np.integer], capacity: int) -> None:
        """New arrays that start with the rows `kept` of the old ones, the rest zero."""
        old_moments, old_steps = self._moments, self._steps
        self._allocate(capacity)
        self._moments = _moved(old_moments, kept, self._moments)
        self._steps = _moved(old_steps, kept, self._steps)


def _columns(channels: dict[str, int]) -> tuple[dict[str, int], int]:
    """First column of each group's moments in a row, and the columns of a row: both moments of every value."""
    first, columns = {}, 0
    for group, values in channels.items():
        first[group] = columns
        columns += 2 * max(values, 1)
    return first, columns


def _moved(old: np.ndarray, kept: NDArray[np.integer], new: np.ndarray) -> np.ndarray:
    host = runtime.to_host(new)
    host[: len(kept)] = runtime.to_host(old)[kept]
    return runtime.to_device(host, host.dtype.type)


def _corrections(beta1: float, beta2: float) -> NDArray[np.float32]:
    """Bias corrections 1 / (1 - beta^t), [T, 2], up to the t from which they are 1 in float32."""
    slowest = max(beta1, beta2)
    length = 2 if slowest <= 0.0 else min(_MAX_CORRECTIONS, math.ceil(math.log(1e-8) / math.log(slowest)) + 2)
    t = np.arange(length, dtype=np.float64)
    t[0] = 1.0  # no row is updated before its first count
    return np.stack([1.0 / (1.0 - beta1**t), 1.0 / (1.0 - beta2**t)], axis=1).astype(np.float32)
