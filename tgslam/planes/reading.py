"""Which plane a rendering of the map shows at each pixel: read off the rendered embedding, and checked by its depth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tgslam import runtime
from tgslam.config.schema import StructureConfig
from tgslam.planes import codes
from tgslam.planes.instance import NO_ID
from tgslam.splatting.images import RenderImages
from tgslam.types import Camera, FloatImage, Matrix4, Plane


class PlaneReader:
    """Reads ids off renderings for one camera.

    Where two surfaces blend, the mixture may look like a third one. It is nowhere near, though, so an id holds only
    where the rendered surface lies on its plane.
    """

    def __init__(
        self, camera: Camera, planes: Sequence[Plane], config: StructureConfig, depth_sigma_per_m2: float
    ) -> None:
        """depth_sigma_per_m2: the sensor's noise, sigma_z = this * z^2, m."""
        self.config, self.sigma_per_m2 = config, depth_sigma_per_m2
        self.planes = sorted(planes, key=lambda plane: plane.id)
        self._rays = camera.rays()

    def read(self, images: RenderImages, T_cw: Matrix4) -> NDArray[np.int32]:
        """The plane [H, W] that each pixel shows, -1 = none. images: a rendering from T_cw with its embedding."""
        ids = codes.read_ids(images.embedding, images.opacity, [plane.id for plane in self.planes], self.config)
        opacity = np.maximum(runtime.to_host(images.opacity), np.float32(1e-3))
        return self.on_planes(ids, runtime.to_host(images.depth) / opacity, T_cw)

    def on_planes(self, ids: NDArray[np.int32], depth_m: FloatImage, T_cw: Matrix4) -> NDArray[np.int32]:
        """The ids [H, W] but for those pixels whose surface, at depth_m [H, W] m, is not on their plane: -1."""
        result = np.full_like(ids, NO_ID)
        for plane in self.planes:
            at = np.nonzero(ids == plane.id)
            normal = T_cw[:3, :3] @ plane.normal_w
            z = depth_m[at].astype(np.float64)
            distance = np.abs(z * (self._rays[at] @ normal) + plane.offset_m - normal @ T_cw[:3, 3])
            near = distance <= self.config.read_distance_m + self.config.read_sigmas * self.sigma_per_m2 * z**2
            result[at[0][near], at[1][near]] = plane.id
        return result
