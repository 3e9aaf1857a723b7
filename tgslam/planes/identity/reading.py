"""Which plane a rendering of the map shows at each pixel: read off the rendered embedding, and checked by its depth."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.config.plane_settings import StructureConfig
from tgslam.device import runtime
from tgslam.geometry import inverse, rotate_rows
from tgslam.ops.render_images import RenderImages
from tgslam.planes.identity import codes
from tgslam.planes.identity.outline import Outline
from tgslam.planes.instances.instance import NO_ID
from tgslam.types import FloatImage, Matrix4, Plane

_BEYOND_PX = 2  # of an edge that is blurred
_AROUND = tuple((dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx)  # in steps of _BEYOND_PX


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
        self._rays = np.ascontiguousarray(camera.rays().reshape(-1, 3).T)

    def read(self, images: RenderImages, T_cw: Matrix4) -> NDArray[np.int32]:
        """The plane [H, W] that each pixel shows, -1 = none. images: a rendering from T_cw with its embedding."""
        ids = codes.read_ids(images.embedding, images.opacity, [plane.id for plane in self.planes], self.config)
        opacity = np.maximum(runtime.to_host(images.opacity), np.float32(1e-3))
        depth_m = runtime.to_host(images.depth) / opacity
        held = self.on_planes(ids, depth_m, T_cw)
        mixed = self._unmixed(held, runtime.to_host(images.embedding), opacity)
        return self._extended(held, mixed, depth_m, T_cw)

    def _unmixed(self, ids: NDArray[np.int32], embedding: FloatImage, opacity: FloatImage) -> NDArray[np.int32]:
        """The ids [H, W], where those that are -1 but covered have what most of a mixture is that explains the colour.

        A pixel at an edge shows two surfaces, or one and what is no plane: one of the pixels around shows each of them
        by itself. embedding: [H, W, 3] and opacity: [H, W] as they are rendered.
        """
        undecided = (ids == NO_ID) & (opacity >= self.config.expert.reading.read_opacity)
        rows, columns = np.nonzero(undecided & _near_some(ids != NO_ID))
        width = ids.shape[1] + 2 * _BEYOND_PX
        border = cv2.copyMakeBorder(ids, *4 * (_BEYOND_PX,), cv2.BORDER_REPLICATE).ravel()
        centre = (rows + _BEYOND_PX) * width + columns + _BEYOND_PX
        around = [border[centre + _BEYOND_PX * (dy * width + dx)] for dy, dx in _AROUND]
        nearby = np.sort(np.stack([*around, np.full(len(rows), NO_ID, np.int32)], axis=1), axis=1)
        colours = embedding[rows, columns] / opacity[rows, columns, None]
        nearby, count = _distinct(nearby)
        result = ids.copy()
        for n in np.unique(count):
            of = count == n
            result[rows[of], columns[of]] = codes.unmixed(colours[of], nearby[of, :n], self.config)
        return result

    def on_planes(self, ids: NDArray[np.int32], depth_m: FloatImage, T_cw: Matrix4) -> NDArray[np.int32]:
        """The ids [H, W] but for those pixels whose surface, at depth_m [H, W] m, is not on their plane: -1.

        Nor have connected pixels an id if none of them is where that plane has been seen.
        """
        return self._extended(np.full(ids.shape, NO_ID, np.int32), ids, depth_m, T_cw)

    def _extended(
        self, held: NDArray[np.int32], ids: NDArray[np.int32], depth_m: FloatImage, T_cw: Matrix4
    ) -> NDArray[np.int32]:
        """What `on_planes` makes of ids [H, W]; where it is known already it is held [H, W], -1 = open."""
        result, T_wc, limits = held.copy(), inverse(T_cw), self.config.expert.reading
        pixels, ends = self._by_plane(np.where(held == NO_ID, ids, NO_ID).ravel())
        depths = depth_m.ravel()[pixels].astype(np.float64)
        points_w = rotate_rows(T_wc[:3, :3], self._rays.take(pixels, axis=1) * depths) + T_wc[:3, 3:]
        limit_m = limits.read_distance_m + limits.read_sigmas * self.noise.per_m2 * depths**2
        for plane, outline, first, end in zip(self.planes, self._outlines, ends[:-1], ends[1:], strict=True):
            (x, y, z), (a, b, c) = points_w[:, first:end], plane.normal_w
            near = first + np.flatnonzero(np.abs(a * x + b * y + c * z + plane.offset_m) <= limit_m[first:end])
            if not len(near):
                continue
            at, seen = pixels[near], outline.holds(points_w.take(near, axis=1).T)
            if not seen.all():
                rows, columns = np.divmod(at, ids.shape[1])
                seen = _connected(rows, columns, seen, held, plane.id)
            result.ravel()[at[seen]] = plane.id
        return result

    def _by_plane(self, ids: NDArray[np.int32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """The pixels of ids [N] that show a plane, plane after plane; and [P + 1] where each plane's begin."""
        place = np.full(max((plane.id for plane in self.planes), default=NO_ID) + 2, len(self.planes), np.uint16)
        place[[plane.id for plane in self.planes]] = np.arange(len(self.planes))
        shown = np.flatnonzero(ids != NO_ID)
        places = place[np.minimum(ids[shown], len(place) - 1)]
        ends = np.cumsum(np.bincount(places, minlength=len(self.planes) + 1))[: len(self.planes)]
        return shown[np.argsort(places, kind="stable")], np.append(0, ends)  # a radix sort, since they have 16 bits


def _near_some(shown: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The pixels [H, W] round which, at `_AROUND`, there is one of these [H, W]; beyond the border is what is on it."""
    steps = 2 * _BEYOND_PX + 1
    places = np.zeros((steps, steps), np.uint8)
    places[::_BEYOND_PX, ::_BEYOND_PX] = 1
    places[_BEYOND_PX, _BEYOND_PX] = 0
    return cv2.dilate(shown.astype(np.uint8), places, borderType=cv2.BORDER_REPLICATE) > 0


def _connected(
    rows: NDArray[np.intp], columns: NDArray[np.intp], seen: NDArray[np.bool_], held: NDArray[np.int32], plane_id: int
) -> NDArray[np.bool_]:
    """Which of a plane's pixels [N], one at least, are connected with those that are `seen` [N] or `held` [H, W]."""
    top, left = max(rows.min() - 1, 0), max(columns.min() - 1, 0)
    sure = held[top : rows.max() + 2, left : columns.max() + 2] == plane_id
    shown = sure.astype(np.uint8)
    shown[rows - top, columns - left] = 1
    count, part = cv2.connectedComponents(shown, connectivity=8)
    own = part[rows - top, columns - left]
    holds = np.zeros(count, bool)
    holds[part[sure]] = True
    holds[own[seen]] = True
    return holds[own]


def _distinct(ids: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.intp]]:
    """Rows [N, K] in ascending order without what they repeat, and how long they are [N]; what follows is undefined."""
    place = np.cumsum(np.diff(ids, axis=1, prepend=ids[:, :1]) != 0, axis=1)
    result = np.empty_like(ids)
    np.put_along_axis(result, place, ids, axis=1)
    return result, place[:, -1] + 1
