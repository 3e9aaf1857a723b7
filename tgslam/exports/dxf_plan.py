"""The floor plan as DXF (R12, the plainest that every CAD program reads): lines of walls in metres, and their ids."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from tgslam.files.atomic import write_text
from tgslam.output.floorplan import WallLine, up_direction, wall_lines
from tgslam.types import Plane

Tag = tuple[int, str]

WALLS, IDS = "WALLS", "PLANE_IDS"
_COLOURS = {WALLS: 7, IDS: 8}  # white or black, and grey, in AutoCAD's numbers
_TEXT_HEIGHT_M = 0.1
_METRES = 6  # of $INSUNITS


def write_dxf(path: Path, planes: Sequence[Plane]) -> None:
    """Write the plan; its axes are those of floorplan.svg, with y upwards. Raises OSError."""
    lines = wall_lines(planes, up_direction(planes))
    tags = [*_header(lines), *_layers(), *_entities(lines), (0, "EOF")]
    write_text(path, "".join(f"{code}\n{value}\n" for code, value in tags))


def _header(lines: Sequence[WallLine]) -> Iterator[Tag]:
    corners = np.concatenate([np.zeros((1, 2)), *(line.ends_m for line in lines)])
    yield from [(0, "SECTION"), (2, "HEADER"), (9, "$ACADVER"), (1, "AC1009")]
    yield from [(9, "$INSUNITS"), (70, str(_METRES))]
    for name, (x, y) in (("$EXTMIN", corners.min(axis=0)), ("$EXTMAX", corners.max(axis=0))):
        yield from [(9, name), (10, f"{x:.6f}"), (20, f"{y:.6f}"), (30, "0.0")]
    yield (0, "ENDSEC")


def _layers() -> Iterator[Tag]:
    yield from [(0, "SECTION"), (2, "TABLES")]
    yield from [(0, "TABLE"), (2, "LTYPE"), (70, "1"), (0, "LTYPE"), (2, "CONTINUOUS"), (70, "0")]
    yield from [(3, "Solid line"), (72, "65"), (73, "0"), (40, "0.0"), (0, "ENDTAB")]
    yield from [(0, "TABLE"), (2, "LAYER"), (70, str(len(_COLOURS)))]
    for name, colour in _COLOURS.items():
        yield from [(0, "LAYER"), (2, name), (70, "0"), (62, str(colour)), (6, "CONTINUOUS")]
    yield from [(0, "ENDTAB"), (0, "ENDSEC")]


def _entities(lines: Sequence[WallLine]) -> Iterator[Tag]:
    yield from [(0, "SECTION"), (2, "ENTITIES")]
    for line in lines:
        (x1, y1), (x2, y2) = line.ends_m
        yield from [(0, "LINE"), (8, WALLS), (10, f"{x1:.6f}"), (20, f"{y1:.6f}"), (30, "0.0")]
        yield from [(11, f"{x2:.6f}"), (21, f"{y2:.6f}"), (31, "0.0")]
        x, y = line.ends_m.mean(axis=0)
        yield from [(0, "TEXT"), (8, IDS), (10, f"{x:.6f}"), (20, f"{y:.6f}"), (30, "0.0")]
        yield from [(40, str(_TEXT_HEIGHT_M)), (1, str(line.plane.id))]
    yield (0, "ENDSEC")
