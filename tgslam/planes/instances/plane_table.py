"""The planes of a run as arrays by id, for what goes through the map Gaussian by Gaussian or pixel by pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tgslam.planes.instances.instance import NO_ID, PlanarInstance


@dataclass(frozen=True)
class PlaneTable:
    """Row k is about id k, also where that PGI has been absorbed by another one or removed."""

    planes_w: NDArray[np.float64]  # [P, 4] unit normal and offset in m of n . x + d = 0; zeros = removed
    ids: NDArray[np.int32]  # [P] the id under which it lives on, -1 = removed

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def empty(cls) -> PlaneTable:
        """No planes."""
        return cls(np.zeros((0, 4)), np.zeros(0, np.int32))

    @classmethod
    def of(cls, instances: Mapping[int, PlanarInstance], ids: NDArray[np.int32]) -> PlaneTable:
        """Of the PGIs by id. ids: [P] the one under which each id lives on, -1 = removed."""
        planes_w = np.zeros((len(ids), 4))
        for row in np.flatnonzero(ids != NO_ID):
            instance = instances[int(ids[row])]
            planes_w[row] = *instance.normal_w, instance.offset_m
        return cls(planes_w, ids)

    def resolved(self, ids: ArrayLike) -> NDArray[np.int32]:
        """The ids under which those of any shape [...] live on; -1 for those removed, and for -1."""
        return np.append(self.ids, np.int32(NO_ID))[np.asarray(ids, np.intp)]  # -1 takes the last one
