"""Points of a colour image that can be recognised from elsewhere, with their depth: ORB features through OpenCV."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.graph_settings import FeatureSettings
from tgslam.ops.image import DEPTH_EDGE
from tgslam.types import FloatImage

_LEVEL_RATIO = 1.2  # of ORB's image pyramid
_SURPLUS = 4  # so many times more corners are found than are kept
_SQUARES_ACROSS = 20  # the image, over which they are spread
_PATCH = np.mgrid[-1:2, -1:2].reshape(2, -1)  # (dv, du) px of 3 x 3 neighbours
_DUPLICATE_PX = 6.0  # one corner is found on several levels; nearer features are no rivals of each other
_UNLIKE = 257  # bits: no two descriptors differ in more than 256


@dataclass(frozen=True)
class Features:
    """A keyframe's features on continuous surfaces."""

    pixels: NDArray[np.float32]  # [N, 2] px
    scale: NDArray[np.float32]  # [N] of the pyramid level that each was found on, 1 = the image itself
    depth_m: NDArray[np.float32]  # [N]
    descriptors: NDArray[np.uint8]  # [N, 32]

    def __len__(self) -> int:
        return len(self.pixels)

    def points(self, camera: Camera) -> NDArray[np.float64]:
        """[N, 3] m, camera frame."""
        u, v = self.pixels.astype(np.float64).T
        return camera.points_at(u, v, self.depth_m)


class Detector:
    """ORB with a given number of features, spread over the image."""

    def __init__(self, count: int, corner_contrast: int) -> None:
        """count: of features at most. corner_contrast: of FAST corners, steps of 1/255."""
        self._count = count
        self._orb = cv2.ORB.create(_SURPLUS * count, _LEVEL_RATIO, fastThreshold=corner_contrast)

    def detect(self, colour: FloatImage, depth_m: FloatImage) -> Features:
        """Features of colour [H, W, 3] in [0, 1] whose neighbourhood in depth [H, W] m is measured and continuous."""
        grey = grey_image(colour)
        corners = self._orb.detect(grey, None)
        if corners:
            smooth = np.flatnonzero(_depth_at(_pixels(corners), depth_m)[1])
            strength = np.array([corners[int(k)].response for k in smooth])
            chosen = smooth[_spread(_pixels(corners)[smooth], strength, depth_m.shape[1], self._count)]
            corners, descriptors = self._orb.compute(grey, [corners[int(k)] for k in chosen])
        if not corners:
            none = np.zeros(0, np.float32)
            return Features(none.reshape(0, 2), none, none, np.zeros((0, 32), np.uint8))
        pixels = _pixels(corners)
        return Features(pixels, _scales(corners), _depth_at(pixels, depth_m)[0], descriptors)


def grey_image(colour: FloatImage) -> NDArray[np.uint8]:
    """Colour [H, W, 3] in [0, 1] -> luma [H, W], 0 .. 255."""
    rounded = np.rint(np.clip(colour, 0.0, 1.0) * np.float32(255.0)).astype(np.uint8)
    grey: NDArray[np.uint8] = cv2.cvtColor(rounded, cv2.COLOR_RGB2GRAY)
    return grey


def matches(a: Features, b: Features, config: FeatureSettings) -> NDArray[np.int64]:
    """Pairs of rows [M, 2] of `a` and `b` that are each other's best, and clearly better than the next best."""
    if len(a) == 0 or len(b) == 0:
        return np.zeros((0, 2), np.int64)
    bits = _differences(a.descriptors, b.descriptors)
    of_a = bits.argmin(axis=1)
    least = bits[np.arange(len(a)), of_a]
    mutual = (bits.argmin(axis=0)[of_a] == np.arange(len(a))) & (least <= config.max_bits)
    rows, columns = np.flatnonzero(mutual), of_a[mutual]
    apart = np.linalg.norm(b.pixels[columns, None] - b.pixels, axis=2) > _DUPLICATE_PX * b.scale[columns, None]
    next_best = np.where(apart, bits[rows], _UNLIKE).min(axis=1)
    clear = least[rows] < config.match_ratio * next_best
    return np.column_stack([rows[clear], columns[clear]])


def _differences(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.int16]:
    """[N, M] in how many bits descriptors [N, 32] and [M, 32] differ."""
    words_a, words_b = (np.ascontiguousarray(x).view(np.uint64) for x in (a, b))
    bits = np.zeros((len(a), len(b)), np.int16)
    for k in range(words_a.shape[1]):
        bits += np.bitwise_count(words_a[:, k, None] ^ words_b[:, k])
    return bits


def _scales(corners: Sequence[cv2.KeyPoint]) -> NDArray[np.float32]:
    """[N] of their pyramid levels."""
    return np.array([_LEVEL_RATIO**corner.octave for corner in corners], np.float32)


def _pixels(corners: Sequence[cv2.KeyPoint]) -> NDArray[np.float32]:
    """[N, 2] px. ORB multiplies a level's coordinates by its scale, which takes pixel corners to pixel corners, and
    centres beside centres.
    """
    corrected: NDArray[np.float32] = cv2.KeyPoint.convert(corners) + np.float32(0.5) * (_scales(corners)[:, None] - 1)
    return corrected


def _spread(pixels: NDArray[np.float32], strength: NDArray[np.float64], width: int, count: int) -> NDArray[np.int64]:
    """Rows of at most `count` pixels [N, 2]: the strongest of every square of the image, then the second ones, ..."""
    square = (pixels // (width / _SQUARES_ACROSS)).astype(np.int64) @ (1, _SQUARES_ACROSS)
    order = np.lexsort((-strength, square))
    grouped = square[order]
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order)) - np.searchsorted(grouped, grouped)
    return np.lexsort((-strength, rank))[:count]


def _depth_at(pixels: NDArray[np.float32], depth_m: FloatImage) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Mean depth [N] of 3 x 3 pixels, and whether all of them are measured and on one surface."""
    height, width = depth_m.shape
    u, v = np.rint(pixels).astype(np.int64).T[:, :, None]
    patch = depth_m[np.clip(v + _PATCH[0], 0, height - 1), np.clip(u + _PATCH[1], 0, width - 1)]
    near, far = patch.min(axis=1), patch.max(axis=1)
    return patch.mean(axis=1), (near > 0) & (far - near <= DEPTH_EDGE * near)
