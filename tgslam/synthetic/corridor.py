"""An endless staircase of corridors at right angles: repeated doors, blank walls, and no place seen twice."""

from __future__ import annotations

import numpy as np

from tgslam.synthetic import furniture as f
from tgslam.synthetic.scene import Lighting, Scene, SceneBuilder, Vector

LEG_M = 12.0  # between corners
WIDTH_M = 2.0
HEIGHT_M = 2.5
SPEED_M_S = 0.55  # of the camera along it: a slow walk
_DOOR_STEP_M = 3.0  # between doors of one wall
_START_M = 1.2  # room behind the camera's first position


def centre_line(length_m: float) -> Vector:
    """Corners [K, 2] m of a centre line of at least that length: legs along +x and +y in turn, from (0, 0)."""
    legs = max(int(np.ceil(length_m / LEG_M)), 1)
    steps = np.array([(LEG_M, 0.0) if i % 2 == 0 else (0.0, LEG_M) for i in range(legs)])
    return np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])


def corridor(length_m: float) -> Scene:
    """The corridor of `centre_line(length_m)` with walls, doors and a few things that stand about."""
    line = centre_line(length_m)
    builder = SceneBuilder(Lighting(ambient=0.6, fill=0.4, lamp=0.0, fill_direction_w=(0.5, -0.7, 0.45)))
    low = line.min(axis=0) - WIDTH_M
    high = line.max(axis=0) + 2 * WIDTH_M
    f.floor_and_ceiling(builder, (low[0], low[1]), (high[0], high[1]), HEIGHT_M, f.FLOOR_TILES)
    left, right = _side(line, 1.0), _side(line, -1.0)
    for leg in range(len(line) - 1):
        forward, backward = left[leg : leg + 2], right[leg : leg + 2][::-1]
        _furnish(builder, f.wall(builder, _xy(forward[0]), _xy(forward[1]), HEIGHT_M, f.WHITE_WALL), forward, leg, 0)
        _furnish(builder, f.wall(builder, _xy(backward[0]), _xy(backward[1]), HEIGHT_M, f.WHITE_WALL), backward, leg, 1)
    f.wall(builder, _xy(right[0]), _xy(left[0]), HEIGHT_M, f.PLASTER)
    f.wall(builder, _xy(left[-1]), _xy(right[-1]), HEIGHT_M, f.PLASTER)
    return builder.build(occlusion=False)


def _xy(point: Vector) -> tuple[float, float]:
    return float(point[0]), float(point[1])


def _side(line: Vector, sign: float) -> Vector:
    """The wall line [K, 2] left (+1) or right (-1) of the centre line, mitred at corners, with room at both ends."""
    directions = np.diff(line, axis=0) / LEG_M
    normals = sign * WIDTH_M / 2 * np.column_stack([-directions[:, 1], directions[:, 0]])
    corners = line.copy()
    corners[0] += normals[0] - _START_M * directions[0]
    corners[1:-1] += normals[:-1] + normals[1:]
    corners[-1] += normals[-1] + 2 * _START_M * directions[-1]
    return corners


def _furnish(builder: SceneBuilder, on: f.Wall, ends: Vector, leg: int, side: int) -> None:
    """The same doors every 3 m, now and then a notice, a bin or a box; some walls stay blank."""
    length_m = float(np.linalg.norm(ends[1] - ends[0]))
    f.skirting(builder, on, length_m - 0.1)
    rng = np.random.default_rng((leg, side))
    places = np.arange(-length_m / 2 + 1.6, length_m / 2 - 1.4, _DOOR_STEP_M)
    for i, s_m in enumerate(places):
        if (leg + side) % 3 != 2:
            f.door(builder, on, float(s_m))
        middle_m = float(s_m) + _DOOR_STEP_M / 2
        if middle_m > length_m / 2 - 0.6:
            continue
        kind = rng.integers(5)
        if kind == 0:
            size = (float(rng.uniform(0.4, 0.9)), float(rng.uniform(0.3, 0.6)))
            colour = (float(rng.uniform(0.3, 0.6)), 0.45, float(rng.uniform(0.3, 0.6)))
            f.hang(builder, on, middle_m, 1.5, size, f.picture(colour, 200 + 40 * leg + 20 * side + i))
        elif kind == 1:
            builder.cylinder(on.at(middle_m, 0.0, 0.2), 0.15, 0.55, f.METAL)
        elif kind == 2:
            f.box_at(builder, on, middle_m, 0.25, (0.5, 0.35, 0.5), f.CARDBOARD)
