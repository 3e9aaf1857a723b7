"""Which plane a rendering of the map shows at each pixel: read off the rendered embedding, and checked by its depth."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.config.plane_settings import StructureConfig
from tgslam.device import runtime
from tgslam.geometry import inverse, transform_points
from tgslam.ops.render_images import RenderImages
from tgslam.planes.identity import codes
from tgslam.planes.identity.outline import Outline
from tgslam.planes.instances.instance import NO_ID
from tgslam.types import FloatImage, Matrix4, Plane

_AROUND = tuple((dy, dx) for dy in (-2, 0, 2) for dx in (-2, 0, 2) if dy or dx)  # px: beyond a blurred edge


class PlaneReader:
    """Reads ids off renderings for one camera.

    Where two surfaces blend, the mixture may look like a third one. It is nowhere near, though, so an id holds only
    where the rendered surface lies on its plane, and adjoins where that has been seen; and what remains undecided is
    held against mixtures of what the pixels around show.
    """

    def __init__(self, camera: Camera, planes: Sequence[Plane], config: StructureConfig, noise: SensorNoise) -> None:
        """noise: the depth sensor's."""
        self.config, self.noise = config, noise
        self.planes = sorted(planes, key=lambda plane: plane.id)
        self._outlines = [Outline(plane, config.expert.reading.read_margin_m) for plane in self.planes]
        self._rays = camera.rays()

    def read(self, images: RenderImages, T_cw: Matrix4) -> NDArray[np.int32]:
        """The plane [H, W] that each pixel shows, -1 = none. images: a rendering from T_cw with its embedding."""
        ids = codes.read_ids(images.embedding, images.opacity, [plane.id for plane in self.planes], self.config)
        opacity = np.maximum(runtime.to_host(images.opacity), np.float32(1e-3))
        depth_m = runtime.to_host(images.depth) / opacity
        ids = self.on_planes(ids, depth_m, T_cw)
        colours = runtime.to_host(images.embedding) / opacity[..., None]
        mixed = self._unmixed(ids, colours, opacity >= self.config.expert.reading.read_opacity)
        return self.on_planes(mixed, depth_m, T_cw)

    def _unmixed(self, ids: NDArray[np.int32], colours: FloatImage, covered: NDArray[np.bool_]) -> NDArray[np.int32]:
        """The ids [H, W], where those that are -1 but covered have what most of a mixture is that explains the colour.

        A pixel at an edge shows two surfaces, or one and what is no plane: one of the pixels around shows each of them
        by itself. colours: [H, W, 3] embeddings over opacity.
        """
        rows, columns = np.nonzero((ids == NO_ID) & covered)
        height, width = ids.shape
        around = [ids[np.clip(rows + dy, 0, height - 1), np.clip(columns + dx, 0, width - 1)] for dy, dx in _AROUND]
        nearby = np.sort(np.stack([*around, np.full(len(rows), NO_ID, np.int32)], axis=1), axis=1)
        beside = nearby[:, -1] != NO_ID
        rows, columns, nearby = rows[beside], columns[beside], nearby[beside]
        result = ids.copy()
        result[rows, columns] = codes.unmixed(colours[rows, columns], nearby, self.config)
        return result

    def on_planes(self, ids: NDArray[np.int32], depth_m: FloatImage, T_cw: Matrix4) -> NDArray[np.int32]:
        """The ids [H, W] but for those pixels whose surface, at depth_m [H, W] m, is not on their plane: -1.

        Nor have connected pixels an id if none of them is where that plane has been seen.
        """
        result, T_wc, limits = np.full_like(ids, NO_ID), inverse(T_cw), self.config.expert.reading
        for plane, outline in zip(self.planes, self._outlines, strict=True):
            at = np.nonzero(ids == plane.id)
            normal = T_cw[:3, :3] @ plane.normal_w
            z = depth_m[at].astype(np.float64)
            distance = np.abs(z * (self._rays[at] @ normal) + plane.offset_m - normal @ T_cw[:3, 3])
            near = distance <= limits.read_distance_m + limits.read_sigmas * self.noise.per_m2 * z**2
            rows, columns = at[0][near], at[1][near]
            seen = outline.holds(transform_points(T_wc, self._rays[rows, columns] * z[near, None]))
            if not seen.all():
                shown = np.zeros(ids.shape, np.uint8)
                shown[rows, columns] = 1
                part = cv2.connectedComponents(shown, connectivity=8)[1][rows, columns]
                seen = np.isin(part, part[seen])
            result[rows[seen], columns[seen]] = plane.id
        return result
