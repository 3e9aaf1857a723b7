"""Images of a folder by the number, or the name, that they share with what belongs to them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from tgslam.datasets.lists import ImagePair
from tgslam.errors import DatasetError

USUAL_RATE_HZ = 30.0  # of recordings that do not say when their frames were taken
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".ppm", ".bmp", ".tif", ".tiff", ".webp")
DEPTH_SUFFIXES = (".png", ".pgm", ".tif", ".tiff", ".exr", ".npy")


class Numbered(NamedTuple):
    """The files of frame number `number` of a recording."""

    number: int
    colour: Path
    depth: Path


def numbered_files(folder: Path, pattern: str) -> dict[int, Path]:
    """Files of a folder whose whole name the pattern matches, by the number that its first group is."""
    compiled = re.compile(pattern, re.IGNORECASE)
    if not folder.is_dir():
        return {}
    matches = ((compiled.fullmatch(path.name), path) for path in folder.iterdir())
    return dict(sorted((int(match[1]), path) for match, path in matches if match))


def natural_order(name: str) -> list[tuple[int, str]]:
    """A key by which frame2 comes before frame10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def pairs_by_number(
    colour: Mapping[int, Path], depth: Mapping[int, Path], folder: Path, expected: str
) -> list[Numbered]:
    """Frames of which there are both images, in order. expected: what there should be, for the message.

    Raises DatasetError when there are none.
    """
    if not colour or not depth:
        missing = " and no ".join(kind for kind, found in (("colour", colour), ("depth", depth)) if not found)
        raise DatasetError(f"{folder}: found no {missing} images; expected {expected}")
    both = [Numbered(number, path, depth[number]) for number, path in colour.items() if number in depth]
    if not both:
        raise DatasetError(f"{folder}: no colour image has the number of a depth image; expected {expected}")
    return both


def at_usual_rate(files: Iterable[Numbered]) -> list[ImagePair]:
    """At times of frames numbered from 0 on at 30 Hz."""
    return [ImagePair(number / USUAL_RATE_HZ, colour, depth) for number, colour, depth in files]
