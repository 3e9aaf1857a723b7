"""One picture of a run: an input image, the map rendered there, its planes, and the floor plan with the path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.output.floorplan import WallLine, plan_points, scale_bar_m, up_direction, wall_lines
from tgslam.output.plane_overlay import Bytes, as_bytes, print_text, with_planes
from tgslam.types import FloatImage, Matrix4, Plane

_PANEL_WIDTH = 440  # px
_GAP = 10  # px between panels and round them
_CAPTION = 26  # px above a panel
_FONT = cv2.FONT_HERSHEY_DUPLEX
_CAPTION_SCALE, _ID_SCALE, _BAR_SCALE = 0.5, 0.4, 0.45
_INK, _CASING, _PATH, _VIEW = (40, 40, 40), (85, 85, 85), (200, 30, 30), (245, 222, 222)
_MARGIN_M = 0.25  # of the floor plan
_LEAST_EXTENT_M = 0.5  # of the floor plan, for a camera that stands still before nothing upright
_BAR_ROW = 30  # px at the bottom of the floor plan that hold its scale bar
_BAR_SHARE = 0.3  # of the plan's width, at most
_LABEL_PLACES = (0.5, 0.9, 0.1, 0.75, 0.25)  # along a line
_LABEL_PX = (18, 14)  # room of an id
_LEVELS = 64  # of a colour: noise of the sensor that nobody sees would treble the size of the file
_SHIFT = 4  # OpenCV takes coordinates in 1/16 px

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Overview:
    """What the picture shows."""

    title: str  # of the input image
    colour: FloatImage  # [H, W, 3] RGB, as the camera saw it
    rendering: FloatImage  # [H, W, 3] RGB: the map, seen from the same pose
    ids: NDArray[np.int32]  # [H, W] planes that the map shows there, -1 = none
    planes: Sequence[Plane]
    T_wc: Matrix4  # the pose of these images
    centres_w: Vector  # [N, 3] m: the camera's path
    half_width: float  # tangent of half of the angle that the image is wide


def draw_overview(view: Overview) -> FloatImage:
    """The picture [H, W, 3] RGB: two rows of two panels of equal size, each with its caption."""
    size = (_PANEL_WIDTH, round(_PANEL_WIDTH * view.colour.shape[0] / view.colour.shape[1]))
    rendering = _fitted(view.rendering, size)
    ids = cv2.resize(view.ids, size, interpolation=cv2.INTER_NEAREST)
    panels = (
        (view.title, as_bytes(_fitted(view.colour, size))),
        ("rendering of the map", as_bytes(rendering)),
        (f"planes ({len(view.planes)} in the map)", with_planes(rendering, ids, view.planes)),
        ("floor plan and camera path", _floor_plan(view, size)),
    )
    width, height = size
    page = np.full((2 * (_CAPTION + height + _GAP), 2 * width + 3 * _GAP, 3), 255, np.uint8)
    for number, (caption, panel) in enumerate(panels):
        left = _GAP + (number % 2) * (width + _GAP)
        top = _CAPTION + (number // 2) * (height + _GAP + _CAPTION)
        page[top : top + height, left : left + width] = panel
        cv2.putText(page, caption, (left, top - 8), _FONT, _CAPTION_SCALE, _INK, 1, cv2.LINE_AA)
    levels = np.round(page.astype(np.float32) * np.float32((_LEVELS - 1) / 255.0))
    return np.asarray(levels / np.float32(_LEVELS - 1))


def _fitted(image: FloatImage, size: tuple[int, int]) -> FloatImage:
    """The image [H, W, 3] at that (width, height), in [0, 1]."""
    way = cv2.INTER_AREA if image.shape[1] > size[0] else cv2.INTER_LINEAR
    return np.asarray(np.clip(cv2.resize(np.asarray(image, np.float32), size, interpolation=way), 0.0, 1.0))


def _floor_plan(view: Overview, size: tuple[int, int]) -> Bytes:
    """[H, W, 3] RGB: upright planes in their colours, the path in red, and where the camera of the images looks."""
    up_w = up_direction(view.planes)
    lines = wall_lines(view.planes, up_w)
    path_m = plan_points(view.centres_w, up_w)
    page = _Page(np.concatenate([path_m, *(line.ends_m for line in lines)]), size)
    page.fill(_view_cone(view, up_w, page.extent_m / 4.0), _VIEW)
    for line in lines:
        page.line(line.ends_m, _CASING, 5)
        page.line(line.ends_m, tuple(as_bytes(line.plane.colour).tolist()), 3)
    page.line(path_m, _PATH, 2)
    page.dot(plan_points(view.T_wc[None, :3, 3], up_w)[0], _PATH)
    for line in _longest(lines):
        page.label(line)
    page.scale_bar()
    return page.image


def _view_cone(view: Overview, up_w: Vector, length_m: float) -> Vector:
    """[3, 2] m in the plan's axes: the camera, and the ends of what is `length_m` ahead of it in view."""
    sides_c = length_m * np.array([[0.0, 0.0, 0.0], [-view.half_width, 0.0, 1.0], [view.half_width, 0.0, 1.0]])
    return plan_points(sides_c @ view.T_wc[:3, :3].T + view.T_wc[:3, 3], up_w)


def _longest(lines: Sequence[WallLine]) -> list[WallLine]:
    """The longest line of each plane, the shortest of them first: there is least room for its id."""
    by_length = sorted(lines, key=lambda line: float(np.linalg.norm(line.ends_m[1] - line.ends_m[0])))
    longest = {line.plane.id: line for line in by_length}
    return [line for line in by_length if longest[line.plane.id] is line]


class _Page:
    """A white image that points [N, 2] m of the plan fit into, with room for a scale bar at the bottom."""

    def __init__(self, points_m: Vector, size: tuple[int, int]) -> None:
        low, high = points_m.min(axis=0) - _MARGIN_M, points_m.max(axis=0) + _MARGIN_M
        room_px = np.array([size[0], size[1] - _BAR_ROW], np.float64)
        self.image: Bytes = np.full((size[1], size[0], 3), 255, np.uint8)
        self.extent_m = float((high - low).max())
        self._px_per_m = float((room_px / np.maximum(high - low, _LEAST_EXTENT_M)).min())
        self._labels_px: list[tuple[int, int]] = []
        self._middle_m, self._middle_px = (low + high) / 2.0, room_px / 2.0
        cv2.rectangle(self.image, (0, 0), (size[0] - 1, size[1] - 1), (200, 200, 200))

    def line(self, points_m: Vector, colour: Sequence[int], width_px: int) -> None:
        """A line through the points."""
        cv2.polylines(self.image, [self._place(points_m)], False, colour, width_px, cv2.LINE_AA, _SHIFT)

    def fill(self, points_m: Vector, colour: Sequence[int]) -> None:
        """A convex area between the points."""
        cv2.fillConvexPoly(self.image, self._place(points_m), colour, cv2.LINE_AA, _SHIFT)

    def dot(self, point_m: Vector, colour: Sequence[int]) -> None:
        """A dot on a point."""
        x, y = self._place(point_m[None])[0].tolist()
        cv2.circle(self.image, (x, y), 4 << _SHIFT, colour, cv2.FILLED, cv2.LINE_AA, _SHIFT)

    def label(self, line: WallLine) -> None:
        """The id of a plane on its line, at the first place where no other id stands; without one it is left out."""
        for share in _LABEL_PLACES:
            point_m = (1.0 - share) * line.ends_m[0] + share * line.ends_m[1]
            x, y = (self._place(point_m[None])[0] >> _SHIFT).tolist()
            if all(abs(x - left) >= _LABEL_PX[0] or abs(y - top) >= _LABEL_PX[1] for left, top in self._labels_px):
                self._labels_px.append((x, y))
                print_text(self.image, str(line.plane.id), (x, y), _ID_SCALE)
                return

    def scale_bar(self) -> None:
        """A bar of a round length, at the lower left."""
        height, width = self.image.shape[:2]
        length_m = scale_bar_m(_BAR_SHARE * width / self._px_per_m)
        left, y, right = 12, height - 10, 12 + round(length_m * self._px_per_m)
        corners = np.array([[left, y - 5], [left, y], [right, y], [right, y - 5]], np.int32)
        cv2.polylines(self.image, [corners], False, _INK, 1)
        place = (right + 8, y + 1)
        cv2.putText(self.image, f"{length_m:g} m", place, _FONT, _BAR_SCALE, _INK, 1, cv2.LINE_AA)

    def _place(self, points_m: Vector) -> NDArray[np.int32]:
        """[N, 2] in 1/16 px, y down."""
        offset_m = (points_m - self._middle_m) * (1.0, -1.0)
        px = self._middle_px + self._px_per_m * offset_m
        return np.asarray(np.round(px * (1 << _SHIFT)), np.int32)
