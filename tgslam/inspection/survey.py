"""Numbers of a recording, gathered frame by frame: of each frame a few are kept, and no image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tgslam.datasets.edge_alignment import Misalignment, misalignment
from tgslam.datasets.source import RgbdSource
from tgslam.errors import FrameError
from tgslam.sensing import learn_noise, reach_m
from tgslam.types import FloatImage, Frame

_QUANTILES = (0.05, 0.5, 0.95)
_NOISE_FRAMES = 12  # that tell noise and steps of depth, and
_EDGE_FRAMES = 6  # how depth lies on colour
_BLOCKS = (12, 16)  # of an image, whose brightness is compared from a frame to the next
_LEAST_BRIGHTNESS, _MOST_BRIGHTNESS = 0.03, 0.95  # of a block that tells


@dataclass(frozen=True)
class FrameNumbers:
    """What is kept of a frame that could be read."""

    timestamp_s: float
    depth_m: tuple[float, float, float]  # within which 5, 50 and 95 % of its measurements are; 0 without any
    measured: float  # share of its pixels that have depth
    brightness_step: float  # log of its brightness over that of the frame before where they show the same; NaN = none


@dataclass(frozen=True)
class SensorNumbers:
    """What a frame says of the depth sensor."""

    per_m2: float  # noise of sigma_z = this * z^2, 1/m
    step_m: float  # between neighbouring values of depth, at the median
    reach_m: float  # how far one sees


@dataclass
class Survey:
    """What was found in a recording."""

    frames: list[FrameNumbers] = field(default_factory=list)
    unreadable: list[str] = field(default_factory=list)
    sensor: list[SensorNumbers] = field(default_factory=list)
    off: Misalignment | None = None


def survey(source: RgbdSource, on_frame: Callable[[], None] = lambda: None) -> Survey:
    """Read every frame once."""
    found, before = Survey(), None
    noisy, edged = _some(len(source), _NOISE_FRAMES), _some(len(source), _EDGE_FRAMES)
    kept: list[Frame] = []
    for position in range(len(source)):
        try:
            frame = source.read(position)
        except FrameError as error:
            found.unreadable.append(str(error))
        else:
            blocks = _brightness(frame.colour)
            found.frames.append(_numbers(frame, blocks, before))
            before = blocks
            if position in noisy:
                found.sensor += _sensor(frame)
            if position in edged:
                kept.append(frame)
        on_frame()
    found.off = misalignment(kept)
    return found


def _some(total: int, count: int) -> set[int]:
    return set(np.linspace(0, total - 1, min(count, total)).round().astype(int).tolist())


def _numbers(frame: Frame, blocks: FloatImage, before: FloatImage | None) -> FrameNumbers:
    measured = frame.depth_m > 0
    some = frame.depth_m[::4, ::4]
    some = some[some > 0]
    low, middle, high = np.quantile(some, _QUANTILES).tolist() if len(some) else (0.0, 0.0, 0.0)
    step = np.nan if before is None else _step(blocks, before)
    return FrameNumbers(frame.timestamp_s, (low, middle, high), float(measured.mean()), step)


def _sensor(frame: Frame) -> list[SensorNumbers]:
    learnt = learn_noise(frame.depth_m)
    if learnt is None:
        return []
    middle_m = float(np.median(frame.depth_m[frame.depth_m > 0]))
    return [SensorNumbers(learnt.equivalent_per_m2(middle_m), learnt.step * middle_m, reach_m(frame.depth_m))]


def _brightness(colour: FloatImage) -> FloatImage:
    """The mean of each block [12, 16]."""
    rows, columns = (max(1, side // count) for side, count in zip(colour.shape, _BLOCKS, strict=False))
    grey = colour.mean(axis=2, dtype=np.float32)
    means = np.add.reduceat(np.add.reduceat(grey, range(0, len(grey), rows), 0), range(0, grey.shape[1], columns), 1)
    return np.asarray(means[: _BLOCKS[0], : _BLOCKS[1]] / (rows * columns), np.float32)


def _step(blocks: FloatImage, before: FloatImage) -> float:
    """The change that half of the blocks at least agree on: motion changes them in either sense."""
    both = np.stack([blocks, before])
    telling = ((both > _LEAST_BRIGHTNESS) & (both < _MOST_BRIGHTNESS)).all(axis=0)
    if telling.sum() < telling.size // 4:
        return np.nan
    ratios = np.log(blocks[telling] / before[telling])
    middle = float(np.median(ratios))
    return middle if float(np.median(np.abs(ratios - middle))) < 0.5 * abs(middle) else 0.0


def gaps_s(times_s: Sequence[float]) -> NDArray[np.float64]:
    """[N - 1] between neighbouring frames."""
    return np.diff(np.asarray(times_s, np.float64))
