"""Adam over named parameter arrays; what it remembers of their rows stays with the rows."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tgslam.device import runtime
from tgslam.device.arrays import require
from tgslam.kernels import adam as kernels

_MAX_CORRECTIONS = 1 << 15  # that are tabulated; for the usual betas they are 1 after 18,000 updates


class Adam:
    """Adam with a learning rate per group; all groups have the same rows.

    Only visible rows change. Each row has its own count of updates for the bias correction, so a row that is seen
    seldom, or was added late, takes the same first steps as any other. Moments and counts belong to the caller, who
    keeps them with the rows: a row of zeros has no history.
    """

    def __init__(
        self,
        channels: dict[str, int],
        learning_rates: dict[str, float],
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
        self._first_column, self.moment_width = _columns(channels)
        self._gains, self._epsilon = (1.0 - betas[0], 1.0 - betas[1]), epsilon
        self._correction = runtime.to_device(_corrections(*betas))

    def moments_of(self, group: str, moments: np.ndarray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """First and second moment of a group on the host, [N] or [N, C], out of those of all groups."""
        channels = self._channels[group]
        first, middle, end = (self._first_column[group] + k * max(channels, 1) for k in range(3))
        host = runtime.to_host(moments)
        m, v = host[:, first:middle], host[:, middle:end]
        return (m, v) if channels else (m[:, 0], v[:, 0])

    def step(
        self,
        rows: int,
        parameters: dict[str, np.ndarray],
        gradients: dict[str, np.ndarray],
        moments: np.ndarray,
        steps: np.ndarray,
        visible: np.ndarray,
        pace: float = 1.0,
    ) -> None:
        """Update the first `rows` rows of float32 [N] or [N, C] parameters in place, from gradients of that shape.

        moments: float32 [N, moment_width] and steps: int32 [N], changed too. visible: int32 [N], 0 = leave the row and
        its moments alone. pace: what all learning rates are multiplied by. Groups that are not in `parameters` rest.
        Raises ValueError for unknown groups, other shapes or dtypes.
        """
        for group in parameters:
            if group not in self._channels:
                raise ValueError(f"unknown group {group!r}: the optimiser has {sorted(self._channels)}")
            shape = self._shape(group, rows)
            require(f"parameter {group!r}", parameters[group], shape, at_least=True)
            require(f"gradient {group!r}", gradients[group], shape, at_least=True)
        require("moments", moments, (rows, self.moment_width), at_least=True)
        require("steps", steps, (rows,), np.int32, at_least=True)
        require("visible", visible, (rows,), np.int32, at_least=True)
        if not parameters:
            return
        arrays = [array for group in parameters for array in (gradients[group], parameters[group])]
        unused = kernels.GROUPS - len(parameters)
        kernels.adam_rows(
            rows, [pace * self.learning_rates[group] for group in parameters] + [0.0] * unused,
            *self._gains, self._epsilon, self._correction, visible, steps, moments,
            *arrays, *arrays[:2] * unused, tuple((self._first_column[g], self._channels[g]) for g in parameters),
        )  # fmt: skip

    def _shape(self, group: str, rows: int) -> tuple[int, ...]:
        channels = self._channels[group]
        return (rows, channels) if channels else (rows,)


def _columns(channels: dict[str, int]) -> tuple[dict[str, int], int]:
    """First column of each group's moments in a row, and the columns of a row: both moments of every value."""
    first, columns = {}, 0
    for group, values in channels.items():
        first[group] = columns
        columns += 2 * max(values, 1)
    return first, columns


def _corrections(beta1: float, beta2: float) -> NDArray[np.float32]:
    """Bias corrections 1 / (1 - beta^t), [T, 2], up to the t from which they are 1 in float32."""
    slowest = max(beta1, beta2)
    length = 2 if slowest <= 0.0 else min(_MAX_CORRECTIONS, math.ceil(math.log(1e-8) / math.log(slowest)) + 2)
    t = np.arange(length, dtype=np.float64)
    t[0] = 1.0  # no row is updated before its first count
    return np.stack([1.0 / (1.0 - beta1**t), 1.0 / (1.0 - beta2**t)], axis=1).astype(np.float32)
