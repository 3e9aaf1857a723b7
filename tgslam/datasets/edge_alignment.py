"""Whether depth images lie on their colour images, told by their edges. NumPy and OpenCV only.

Where one surface hides another, depth jumps, and colour mostly changes too. Depth that was never registered to colour
has its jumps beside those changes, shifted and, as its camera sees wider or narrower, scaled about the middle.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.datasets.read_ahead import read_frames
from tgslam.datasets.source import RgbdSource
from tgslam.types import Frame

_log = logging.getLogger(__name__)
_FRAMES = 6  # of a recording that are looked at
_WIDTH_PX = 160  # images are halved until they are at most this wide
_JUMP = 0.06  # of the depth, between neighbours: an edge
_REACH = 0.15  # of the width: a larger shift is not looked for
_SCALES = np.arange(0.85, 1.16, 0.025)
_SMALLEST = 0.012  # of the width: less is an edge's own width
_LEAST_EDGES = 1200  # pixels of jumps, in all frames together
_CLEAR = 6.0  # standard deviations by which the best place stands out
_BETTER = 1.7  # times as high above chance as the place where depth is now


@dataclass(frozen=True)
class Misalignment:
    """Depth fits colour if it is scaled about the image's middle, then shifted."""

    right_px: float
    down_px: float
    scale: float


def warn_of_misalignment(source: RgbdSource) -> None:
    """Say so where depth of a recording does not lie on colour, by a few of its frames."""
    numbers = np.unique(np.linspace(0, len(source) - 1, _FRAMES).round().astype(int)).tolist()
    off = misalignment(frame for frame in read_frames(source, False, numbers) if isinstance(frame, Frame))
    if off is not None:
        _log.warning("%s: %s", source.name, said_of(off))


def misalignment(frames: Iterable[Frame]) -> Misalignment | None:
    """How depth is off against colour in some frames of a recording; None where it is not, or where nothing says so."""
    jumps, changes, step = [], [], 1
    for frame in frames:
        step = max(1, -(-frame.depth_m.shape[1] // _WIDTH_PX))
        jumps.append(_jumps(frame.depth_m, step))
        changes.append(_changes(frame.colour, step))
    if not jumps or sum(float(one.sum()) for one in jumps) < _LEAST_EDGES:
        return None
    height, width = jumps[0].shape
    reach = max(2, round(_REACH * width))
    spectra = [np.fft.rfft2(one, (2 * height, 2 * width)) for one in changes]
    maps = np.stack([_agreement(jumps, spectra, float(scale), reach) for scale in _SCALES])
    return _judge(maps, reach, width, step)


def _judge(maps: NDArray[np.float64], reach: int, width: int, step: int) -> Misalignment | None:
    """maps: [scales, shifts down, shifts right] of how well jumps meet changes there."""
    smallest = max(1, round(_SMALLEST * width))
    standing = (maps - np.median(maps)) / max(float(np.std(maps)), 1e-12)
    unscaled = int(np.argmin(np.abs(_SCALES - 1.0)))
    here = standing[
        unscaled - 1 : unscaled + 2, reach - smallest : reach + smallest + 1, reach - smallest : reach + smallest + 1
    ]
    number, down, right = np.unravel_index(int(standing.argmax()), standing.shape)
    best = float(standing[number, down, right])
    if best < _CLEAR or best < _BETTER * max(float(here.max()), 0.0):
        return None
    return Misalignment(float(right - reach) * step, float(down - reach) * step, float(_SCALES[number]))


def _agreement(
    jumps: list[NDArray[np.float32]], spectra: list[NDArray[np.complex128]], scale: float, reach: int
) -> NDArray[np.float64]:
    """[2 reach + 1, 2 reach + 1] mean change of colour where depth jumps, by how far the jumps are shifted."""
    height, width = jumps[0].shape
    M = np.array([[scale, 0.0, (1.0 - scale) * (width - 1) / 2], [0.0, scale, (1.0 - scale) * (height - 1) / 2]])
    total, count = np.zeros((2 * reach + 1, 2 * reach + 1)), 0.0
    for jump, spectrum in zip(jumps, spectra, strict=True):
        scaled = cv2.warpAffine(jump, M, (width, height))
        met = np.fft.irfft2(spectrum * np.conj(np.fft.rfft2(scaled, (2 * height, 2 * width))))
        total += np.roll(met, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1]
        count += float(scaled.sum())
    return total / max(count, 1.0)


def _jumps(depth_m: NDArray[np.float32], step: int) -> NDArray[np.float32]:
    """[H, W] 1 on both sides of where depth jumps to a neighbour, 0 elsewhere; every step-th pixel and row."""
    depth = depth_m[step // 2 :: step, step // 2 :: step]
    found = np.zeros(depth.shape, np.float32)
    for axis in (0, 1):
        first, second = (depth[:-1], depth[1:]) if axis == 0 else (depth[:, :-1], depth[:, 1:])
        jump = (np.minimum(first, second) > 0) & (np.abs(first - second) > _JUMP * np.minimum(first, second))
        for side in (found[:-1], found[1:]) if axis == 0 else (found[:, :-1], found[:, 1:]):
            side[jump] = 1.0
    return found


def _changes(colour: NDArray[np.float32], step: int) -> NDArray[np.float32]:
    """[H, W] how much intensity changes at a pixel against its surroundings, about 0; every step-th pixel and row."""
    grey = cv2.blur(colour.mean(axis=2, dtype=np.float32), (step, step))[step // 2 :: step, step // 2 :: step]
    slope = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    strength = np.minimum(slope / max(float(np.quantile(slope, 0.95)), 1e-6), 1.0)
    around = max(3, slope.shape[1] // 8) | 1
    return np.asarray(strength - cv2.blur(strength, (around, around)), np.float32)


def said_of(off: Misalignment) -> str:
    """What it means, and what to do."""
    scaled = "" if off.scale == 1.0 else f", scaled by {off.scale:.2f}"
    return (
        f"depth does not lie on colour: its edges fit if it is shifted by about {off.right_px:.0f} px to the right and "
        f"{off.down_px:.0f} px down{scaled}; depth that has a camera of its own needs dataset.depth_camera, or to be "
        "registered to colour first"
    )
