"""floorplan.svg: the upright planes from above, as lines with their ids, and a scale bar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from tgslam.files.atomic import write_text
from tgslam.types import Plane

Vector = NDArray[np.float64]

IMAGE_UP_W = (0.0, -1.0, 0.0)  # the first camera's image is the right way up, more or less
_PX_PER_M = 100.0
_MARGIN_M = 0.6
_LEVEL_COSINE = np.cos(np.deg2rad(45.0))  # of a plane's normal with the image's up, for the plane to be level
_SAME_COSINE = np.cos(np.deg2rad(8.0))  # of normals that are of one direction
_UPRIGHT_SINE = np.sin(np.deg2rad(15.0))  # of the slant of walls
_BAR_LENGTHS_M = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
_BAR_SHARE = 0.3  # of the plan's width, at most


@dataclass(frozen=True)
class WallLine:
    """An upright plane's piece seen from above."""

    plane: Plane
    ends_m: Vector  # [2, 2] m, in the plan's axes


def up_direction(planes: Sequence[Plane]) -> Vector:
    """The unit vector [3] that points up in the world, which is the first camera's frame.

    Among the planes that are level rather than upright as the first image sees it, those of one direction that cover
    the largest area, floor, ceiling and table tops, say what is level; up is their mean normal, area by area, on the
    side of the image's up. Without such a plane it is the first image's up, `IMAGE_UP_W`, as it is for a camera that
    was held level; a first image that is upside down or on its side turns the plan.
    """
    up = np.array(IMAGE_UP_W)
    normals = np.array([plane.normal_w for plane in planes]).reshape(-1, 3)
    normals = normals * np.where(normals @ up < 0, -1.0, 1.0)[:, None]
    level = normals @ up > _LEVEL_COSINE
    if not level.any():
        return up
    normals, areas = normals[level], np.array([plane.area_m2 for plane in planes])[level]
    alike = normals @ normals.T > _SAME_COSINE
    mean = (areas * alike[int(np.argmax(alike @ areas))]) @ normals
    length = float(np.linalg.norm(mean))
    return mean / length if length > 0 else up


def wall_lines(planes: Sequence[Plane], up_w: Vector) -> list[WallLine]:
    """One line for each outline of each upright plane, as long as it is wide.

    The plan's axes are level: y is the way that the first camera looks (its image's up, should it look along up_w), and
    x is to the right of it as seen from above.
    """
    axes = plan_axes(up_w)
    lines = []
    for plane in planes:
        if abs(float(plane.normal_w @ up_w)) > _UPRIGHT_SINE:
            continue
        along = np.cross(up_w, plane.normal_w)
        for polygon in plane.polygons_w:
            place = polygon @ along
            ends = polygon[[int(np.argmin(place)), int(np.argmax(place))]]
            middle = polygon.mean(axis=0)
            ends = middle + np.outer((ends - middle) @ along, along) / float(along @ along)
            lines.append(WallLine(plane, ends @ axes.T))
    return lines


def plan_points(points_w: Vector, up_w: Vector) -> Vector:
    """World points [N, 3] m in the plan's axes [N, 2] m."""
    return np.asarray(points_w @ plan_axes(up_w).T)


def scale_bar_m(most_m: float) -> float:
    """The longest round length that is no longer than `most_m`."""
    return max((length for length in _BAR_LENGTHS_M if length <= most_m), default=_BAR_LENGTHS_M[0])


def write_floorplan(path: Path, planes: Sequence[Plane]) -> None:
    """Write the plan; without upright planes it has nothing but its scale bar. Raises OSError."""
    lines = wall_lines(planes, up_direction(planes))
    corners = np.concatenate([np.zeros((1, 2)), *(line.ends_m for line in lines)])
    low, high = corners.min(axis=0) - _MARGIN_M, corners.max(axis=0) + _MARGIN_M
    width, height = (high - low) * _PX_PER_M
    svg = ElementTree.Element(
        "svg",
        xmlns="http://www.w3.org/2000/svg",
        viewBox=f"0 0 {width:.0f} {height:.0f}",
        width=f"{width:.0f}",
        height=f"{height:.0f}",
    )
    ElementTree.SubElement(svg, "rect", width="100%", height="100%", fill="white")
    for line in lines:
        _draw_wall(svg, line, low, high)
    for line in lines:
        _draw_id(svg, line, low, high)
    _draw_scale_bar(svg, width, height)
    ElementTree.indent(svg)
    write_text(path, ElementTree.tostring(svg, encoding="unicode") + "\n")


def plan_axes(up_w: Vector) -> Vector:
    """[2, 3] unit: right and ahead of the first camera, both level."""
    ahead = np.array([0.0, 0.0, 1.0])
    if abs(float(ahead @ up_w)) > 0.9:
        ahead = np.array(IMAGE_UP_W)
    ahead = ahead - (ahead @ up_w) * up_w
    ahead = ahead / np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, up_w), ahead])


def _on_page(points_m: Vector, low: Vector, high: Vector) -> Vector:
    """Plan points [N, 2] m as px, y down."""
    return np.column_stack([points_m[:, 0] - low[0], high[1] - points_m[:, 1]]) * _PX_PER_M


def _draw_wall(svg: ElementTree.Element, line: WallLine, low: Vector, high: Vector) -> None:
    """A line in the plane's colour, cased in grey, since some colours are nearly white."""
    (x1, y1), (x2, y2) = _on_page(line.ends_m, low, high)
    ends = {"x1": f"{x1:.1f}", "y1": f"{y1:.1f}", "x2": f"{x2:.1f}", "y2": f"{y2:.1f}", "stroke-linecap": "round"}
    colour = "#" + "".join(f"{round(255 * value):02x}" for value in line.plane.colour)
    ElementTree.SubElement(svg, "line", {"class": "casing", **ends, "stroke": "#555555", "stroke-width": "8"})
    wall = ElementTree.SubElement(svg, "line", {"class": "wall", **ends, "stroke": colour, "stroke-width": "6"})
    ElementTree.SubElement(wall, "title").text = f"plane {line.plane.id}, {line.plane.area_m2:.2f} m2"


def _draw_id(svg: ElementTree.Element, line: WallLine, low: Vector, high: Vector) -> None:
    ((x, y),) = _on_page(line.ends_m.mean(axis=0, keepdims=True), low, high)
    text = _text(svg, x, y + 5.0, str(line.plane.id))
    text.attrib |= {"stroke": "white", "stroke-width": "3", "paint-order": "stroke"}


def _draw_scale_bar(svg: ElementTree.Element, width: float, height: float) -> None:
    length_m = scale_bar_m(_BAR_SHARE * width / _PX_PER_M)
    left, y = 0.2 * _PX_PER_M, height - 0.15 * _PX_PER_M
    right = left + length_m * _PX_PER_M
    path = f"M{left:.1f} {y - 5:.1f} V{y:.1f} H{right:.1f} V{y - 5:.1f}"
    ElementTree.SubElement(svg, "path", {"class": "scale", "d": path, "fill": "none", "stroke": "black"})
    _text(svg, (left + right) / 2, y - 8.0, f"{length_m:g} m")


def _text(svg: ElementTree.Element, x: float, y: float, content: str) -> ElementTree.Element:
    text = ElementTree.SubElement(svg, "text", {"x": f"{x:.1f}", "y": f"{y:.1f}", "text-anchor": "middle"})
    text.attrib |= {"font-family": "sans-serif", "font-size": "14"}
    text.text = content
    return text
