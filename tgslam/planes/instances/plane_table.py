"""The planes of a run as arrays by id, for what goes through the map Gaussian by Gaussian or pixel by pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tgslam.planes.instances.instance import NO_ID

if TYPE_CHECKING:
    from tgslam.planes.instances.registry import PlaneRegistry


@dataclass(frozen=True)
class PlaneTable:
    """Row k is about id k, also where that PGI has been absorbed by another one or removed."""

    planes_w: NDArray[np.float64]  # [P, 4] unit normal and offset in m of n . x + d = 0; zeros = removed
    ids: NDArray[np.int32]  # [P] the id under which it lives on, -1 = removed

    def __len__(self) -> int:
        return len(self.ids)

    def resolved(self, ids: NDArray[np.int32]) -> NDArray[np.int32]:
        """The ids [...] under which they live on; -1 stays -1."""
        return np.append(self.ids, np.int32(NO_ID))[ids]

    @classmethod
    def empty(cls) -> PlaneTable:
        """No planes."""
        return cls(np.zeros((0, 4)), np.zeros(0, np.int32))

    @classmethod
    def of(cls, registry: PlaneRegistry, count: int) -> PlaneTable:
        """The planes as the registry knows them now. count: the least id that nothing in the map or keyframes has."""
        ids = np.array([registry.resolve(plane_id) for plane_id in range(count)], np.int32)
        instances = registry.instances
        planes_w = np.zeros((count, 4))
        for row in np.flatnonzero(ids != NO_ID):
            instance = instances[int(ids[row])]
            planes_w[row] = *instance.normal_w, instance.offset_m
        return cls(planes_w, ids)
