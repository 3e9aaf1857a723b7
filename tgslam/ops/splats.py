"""What the rasterizer takes and gives back: the Gaussians' parameters and the gradients by them, on the device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tgslam.device import runtime
from tgslam.kernels import projection
from tgslam.kernels import rows as kernels
from tgslam.types import Gaussians

IMAGE_EDGE = projection.EDGE  # splats are projected as if they were at most so many half-images off the axis
WIDTHS = {"mean": 3, "log_scale": 3, "quat_wxyz": 4, "opacity_logit": 0, "colour": 3, "embedding": 3}  # 0: a scalar


class Splats(Protocol):
    """Gaussians as float32 device arrays, whose first `count` rows are in use; see `types.Gaussians`."""

    @property
    def count(self) -> int:
        """Gaussians."""

    @property
    def capacity(self) -> int:
        """Rows of each array."""

    @property
    def mean(self) -> np.ndarray:
        """[capacity, 3] m, world."""

    @property
    def log_scale(self) -> np.ndarray:
        """[capacity, 3] log of the standard deviations, m."""

    @property
    def quat_wxyz(self) -> np.ndarray:
        """[capacity, 4] local to world, of any length but zero."""

    @property
    def opacity_logit(self) -> np.ndarray:
        """[capacity]."""

    @property
    def colour(self) -> np.ndarray:
        """[capacity, 3] RGB."""

    @property
    def embedding(self) -> np.ndarray:
        """[capacity, 3] theta of Eq. 1."""


class PlanarSplats(Splats, Protocol):
    """Gaussians that know which plane they are on."""

    @property
    def plane_id(self) -> np.ndarray:
        """[capacity] int32, -1 = on none."""


@dataclass(frozen=True)
class FixedSplats:
    """Gaussians that are rendered and stay as they are."""

    count: int
    mean: np.ndarray
    log_scale: np.ndarray
    quat_wxyz: np.ndarray
    opacity_logit: np.ndarray
    colour: np.ndarray
    embedding: np.ndarray

    @classmethod
    def of(cls, gaussians: Gaussians) -> FixedSplats:
        """Copies of a map's on the device; one that is empty gets a row that is not in use."""
        rows = max(len(gaussians), 1)
        arrays = {}
        for name in WIDTHS:
            host = np.zeros(shape_of(name, rows), np.float32)
            host[: len(gaussians)] = getattr(gaussians, name)
            arrays[name] = runtime.to_device(host)
        return cls(len(gaussians), **arrays)

    @property
    def capacity(self) -> int:
        """Rows of each array."""
        return max(self.count, 1)


def shape_of(name: str, rows: int) -> tuple[int, ...]:
    """Of that parameter's array."""
    return (rows, WIDTHS[name]) if WIDTHS[name] else (rows,)


@dataclass
class MapGradient:
    """Gradients by parameter (capacity rows, of which [0, count) are in use) and the summed residual weights."""

    mean: np.ndarray  # [capacity, 3]
    log_scale: np.ndarray  # [capacity, 3]
    quat_wxyz: np.ndarray  # [capacity, 4]
    opacity_logit: np.ndarray  # [capacity]
    colour: np.ndarray  # [capacity, 3]
    embedding: np.ndarray  # [capacity, 3]
    # [capacity, 2] sum over pixels of blend weight times the loss's second derivative: by colour, by depth
    curvature: np.ndarray

    @classmethod
    def zeros(cls, capacity: int) -> MapGradient:
        """All zero, for a map of that capacity."""
        arrays = {name: runtime.zeros(shape_of(name, capacity)) for name in WIDTHS}
        return cls(**arrays, curvature=runtime.zeros((capacity, 2)))

    def clear(self) -> None:
        """Set every gradient to zero."""
        kernels.clear_gradient(
            self.curvature.shape[0], self.mean, self.log_scale, self.quat_wxyz, self.opacity_logit, self.colour,
            self.embedding, self.curvature,
        )  # fmt: skip
