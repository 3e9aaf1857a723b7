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
        self._rays = camera.rays().reshape(-1, 3)

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
        rows, columns, nearby = rows[beside], columns[beside], _distinct(nearby[beside])
        result = ids.copy()
        result[rows, columns] = codes.unmixed(colours[rows, columns], nearby, self.config)
        return result

    def on_planes(self, ids: NDArray[np.int32], depth_m: FloatImage, T_cw: Matrix4) -> NDArray[np.int32]:
        """The ids [H, W] but for those pixels whose surface, at depth_m [H, W] m, is not on their plane: -1.

        Nor have connected pixels an id if none of them is where that plane has been seen.
        """
        result, T_wc, limits = np.full(ids.size, NO_ID, np.int32), inverse(T_cw), self.config.expert.reading
        pixels = np.flatnonzero(ids != NO_ID)
        pixels = pixels[np.argsort(ids.ravel()[pixels], kind="stable")]  # plane after plane
        ends = np.searchsorted(ids.ravel()[pixels], [plane.id for plane in self.planes], side="right")
        for plane, outline, at in zip(self.planes, self._outlines, np.split(pixels, ends)[:-1], strict=True):
            at = at[ids.ravel()[at] == plane.id]
            if not len(at):
                continue
            normal, rays, z = T_cw[:3, :3] @ plane.normal_w, self._rays[at], depth_m.ravel()[at].astype(np.float64)
            distance = np.abs(z * (rays @ normal) + plane.offset_m - normal @ T_cw[:3, 3])
            near = distance <= limits.read_distance_m + limits.read_sigmas * self.noise.per_m2 * z**2
            at = at[near]
            seen = outline.holds(transform_points(T_wc, rays[near] * z[near, None]))
            if not seen.all():
                part = _connected(*np.divmod(at, ids.shape[1]))
                seen = np.isin(part, part[seen])
            result[at[seen]] = plane.id
        return result.reshape(ids.shape)


def _connected(rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.int32]:
    """Which of the connected parts of an image [N] the pixels belong to that are set in it, one at least."""
    rows, columns = rows - rows.min(), columns - columns.min()
    shown = np.zeros((rows.max() + 1, columns.max() + 1), np.uint8)
    shown[rows, columns] = 1
    parts: NDArray[np.int32] = cv2.connectedComponents(shown, connectivity=8)[1][rows, columns]
    return parts


def _distinct(ids: NDArray[np.int32]) -> NDArray[np.int32]:
    """Rows [N, K] in ascending order without what they repeat, filled up with their last: [N, most of any row]."""
    place = np.cumsum(np.diff(ids, axis=1, prepend=ids[:, :1]) != 0, axis=1)
    result = np.repeat(ids[:, -1:], place.max(initial=0) + 1, axis=1)
    np.put_along_axis(result, place, ids, axis=1)
    return result
