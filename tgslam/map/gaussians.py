"""The map: Gaussians as a structure of device arrays with spare capacity, so that adding is an append."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.device import runtime
from tgslam.ops import rigid
from tgslam.types import Gaussians

_FLOAT_FIELDS = {"mean": 3, "log_scale": 3, "quat_wxyz": 4, "opacity_logit": 0, "colour": 3, "embedding": 3}
_INT_FIELDS = ("plane_id", "birth_keyframe")
PARAMETERS = tuple(_FLOAT_FIELDS)


def _shape(rows: int, columns: int) -> tuple[int, ...]:
    return (rows, columns) if columns else (rows,)


def grown(array: np.ndarray, count: int, capacity: int) -> np.ndarray:
    """A device array with `capacity` zeroed rows that holds the first `count` rows of `array`."""
    host = runtime.to_host(array)
    larger = np.zeros((capacity, *host.shape[1:]), host.dtype)
    larger[:count] = host[:count]
    return runtime.to_device(larger, host.dtype.type)


class GaussianMap:
    """Parameters of all Gaussians, as in `types.Gaussians`; rows [0, count) are in use."""

    def __init__(self, capacity: int = 4096) -> None:
        self.count = 0
        self.capacity = capacity
        self.mean = runtime.zeros((capacity, 3))
        self.log_scale = runtime.zeros((capacity, 3))
        self.quat_wxyz = runtime.zeros((capacity, 4))
        self.opacity_logit = runtime.zeros((capacity,))
        self.colour = runtime.zeros((capacity, 3))
        self.embedding = runtime.zeros((capacity, 3))
        self.plane_id = runtime.zeros((capacity,), np.int32)
        self.birth_keyframe = runtime.zeros((capacity,), np.int32)

    @classmethod
    def from_gaussians(cls, gaussians: Gaussians) -> GaussianMap:
        """A map that holds these Gaussians."""
        result = cls(max(len(gaussians), 1))
        result.append(gaussians)
        return result

    def append(self, gaussians: Gaussians) -> None:
        """Add rows at the end, doubling the capacity when it is used up."""
        count = self.count + len(gaussians)
        if count > self.capacity:
            capacity = max(2 * self.capacity, count)
            for name in (*PARAMETERS, *_INT_FIELDS):
                setattr(self, name, grown(getattr(self, name), self.count, capacity))
            self.capacity = capacity
        for name in (*PARAMETERS, *_INT_FIELDS):
            self.write(name, slice(self.count, count), getattr(gaussians, name))
        self.count = count

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Remove the rows where `mask` [count] is false; the order of the rest stays."""
        kept = int(mask.sum())
        for name in (*PARAMETERS, *_INT_FIELDS):
            rows = runtime.to_host(getattr(self, name))[: self.count][mask]
            self.write(name, slice(0, kept), rows)
        self.count = kept

    def move(self, motions: NDArray[np.float64], carriers: NDArray[np.int32]) -> None:
        """Move each row by the mean of some motions: p_w <- mean of motions[carriers] p_w.

        motions: rigid, [K, 4, 4]. carriers: [count, S] which of them.
        """
        rigid.move_rows(motions, runtime.to_device(carriers, np.int32), self.mean, self.quat_wxyz, self.count)

    def gaussians(self) -> Gaussians:
        """A copy on the host."""
        return self.rows(np.arange(self.count))

    def rows(self, numbers: NDArray[np.integer]) -> Gaussians:
        """A copy of some rows on the host."""
        return Gaussians(**{name: self.host(name)[numbers] for name in (*PARAMETERS, *_INT_FIELDS)})

    def host(self, name: str) -> np.ndarray:
        """The rows in use of one parameter on the host: a view on the CPU, a copy under CUDA."""
        return runtime.to_host(getattr(self, name))[: self.count]

    def write(self, name: str, rows: slice | NDArray[np.integer], values: np.ndarray) -> None:
        """Set rows of one parameter from host values."""
        host = runtime.to_host(getattr(self, name))
        host[rows] = values
        if runtime.device() is not runtime.Device.CPU:
            setattr(self, name, runtime.to_device(host, host.dtype.type))
