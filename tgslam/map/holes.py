"""What a sensor's depth image lacks: holes are guessed."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.ops.depth import STEEPEST

_SAME_PLANE = 0.1  # of inverse depth by which a guess differs in the median from a plane that it goes on
_AFFINE_WINDOW_PX = 15  # over which a plane is fitted to what a hole begins at
_NARROW_PX = 2  # a hole's pixels that are no farther from a measurement are at an edge


def nearest_measured(depth_m: NDArray[np.float32]) -> NDArray[np.int64]:
    """The measured pixel nearest to each pixel [H, W], as an index into the flat image; itself where it is measured.

    depth_m: [H, W], 0 = none, with at least one measurement.
    """
    valid = depth_m > 0
    regions = cv2.distanceTransformWithLabels(
        (~valid).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )[1]
    pixels = np.zeros(regions.max() + 1, np.int64)
    pixels[regions[valid]] = np.flatnonzero(valid)
    return pixels[regions]


@dataclass(frozen=True)
class Guess:
    """A depth image without holes."""

    depth_m: NDArray[np.float32]  # [H, W]
    source: NDArray[np.int64]  # [H, W] at steps the measured pixel behind them, in the flat image; -1 = elsewhere


def filled(depth_m: NDArray[np.float32], focal_px: float) -> Guess:
    """Guess the depth of holes: near measurements that of the nearest one, farther off a smooth mean of those around.

    Narrow holes lie at the edges of things. Whatever is there is one of the surfaces around; a mean of them would hang
    in the air between. Wide ones are mostly surfaces that return no light, and the mean continues them: it is of
    inverse depth, in which planes are affine, interpolated from coarser and coarser means. Where that is steeper than
    what returns light, it leads from one surface to another: a side too grazing for the sensor, or what the nearer one
    hides from its light. How far that goes is not known, and the guess is the farther surface: nothing hangs before it.
    But where the nearer one's plane leads there as well, a floor perhaps, it goes on.

    depth_m: [H, W], 0 = none. Measurements stay as they are; an image without any comes back as it is.
    """
    valid = depth_m > 0
    source = np.full(depth_m.shape, -1, np.int64)
    if valid.all() or not valid.any():
        return Guess(depth_m, source)
    inverse = np.where(valid, 1.0 / np.where(valid, depth_m, 1.0), 0.0).astype(np.float32)
    mean = np.maximum(_push_pull(inverse, valid.astype(np.float32)), 1e-3)
    near = cv2.dilate(valid.astype(np.uint8), _square(_NARROW_PX)) > 0
    guess_m = np.where(near, depth_m.ravel()[nearest_measured(depth_m)], 1.0 / mean)
    step = ~near & _steep(mean, focal_px)
    step &= ~_goes_on(np.where(valid, inverse, np.float32(0.0)), mean, step)
    behind_m = np.where(valid & (inverse < _least_around(mean, step)), depth_m, np.float32(0.0))
    if behind_m.any():
        nearest = nearest_measured(behind_m)
        source = np.where(step & (depth_m.ravel()[nearest] > guess_m), nearest, source)
        guess_m = np.where(source >= 0, depth_m.ravel()[source], guess_m)
    return Guess(guess_m.astype(np.float32), source)


def _goes_on(inverse: NDArray[np.float32], mean: NDArray[np.float32], step: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """[H, W] the connected steps through which the surface before them continues: the mean is its plane's.

    inverse: [H, W] of depth, 1/m, 0 = none.
    """
    goes_on = np.zeros(step.shape, bool)
    most = cv2.dilate(np.where(step, mean, np.float32(0.0)), _square(_NARROW_PX + 1))
    before = (most > 0) & (inverse > most)
    if not before.any():
        return goes_on
    nearest = nearest_measured(before.astype(np.float32))[step]
    w, across, down = (image.ravel()[nearest] for image in _affine(inverse))
    v, u = np.nonzero(step)
    from_v, from_u = np.divmod(nearest, step.shape[1])
    off = np.abs((w + across * (u - from_u) + down * (v - from_v)) / mean[step] - 1.0)
    number = cv2.connectedComponents(step.astype(np.uint8))[1][step]
    for index in range(1, int(number.max()) + 1):
        part = number == index
        goes_on[v[part], u[part]] = np.median(off[part]) < _SAME_PLANE
    return goes_on


def _affine(image: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Local least squares planes of what is not 0: value and slopes across and down, px^-1, each [H, W]."""
    v, u = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float64)
    given = (image > 0).astype(np.float64)

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        window = (_AFFINE_WINDOW_PX, _AFFINE_WINDOW_PX)
        return np.asarray(cv2.blur(given * values, window, borderType=cv2.BORDER_CONSTANT) / share)

    share = np.maximum(cv2.blur(given, (_AFFINE_WINDOW_PX, _AFFINE_WINDOW_PX), borderType=cv2.BORDER_CONSTANT), 1e-9)
    mu, mv, mw = mean(u), mean(v), mean(image.astype(np.float64))
    uu, vv, uv = mean(u * u) - mu * mu, mean(v * v) - mv * mv, mean(u * v) - mu * mv
    uw, vw = mean(u * image) - mu * mw, mean(v * image) - mv * mw
    det = np.maximum(uu * vv - uv * uv, 1e-6)
    across, down = (vv * uw - uv * vw) / det, (uu * vw - uv * uw) / det
    return mw + across * (u - mu) + down * (v - mv), across, down


def _least_around(image: NDArray[np.float32], chosen: NDArray[np.bool_]) -> NDArray[np.float32]:
    """[H, W] the least of the chosen pixels just beyond a narrow hole's reach; 0 where there are none."""
    least = cv2.erode(np.where(chosen, image, np.float32(np.inf)), _square(_NARROW_PX + 1), borderValue=np.inf)
    return np.where(np.isfinite(least), least, np.float32(0.0))


def _square(reach_px: int) -> NDArray[np.uint8]:
    """What `cv2.dilate` looks at, as far as `reach_px` from a pixel."""
    return np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)


def _steep(inverse_depth: NDArray[np.float32], focal_px: float) -> NDArray[np.bool_]:
    """[H, W] where an image of inverse depth, 1/m, is steeper than a surface that a sensor measures."""
    down = cv2.Sobel(inverse_depth, -1, 0, 1, scale=0.125)
    across = cv2.Sobel(inverse_depth, -1, 1, 0, scale=0.125)
    steep: NDArray[np.bool_] = np.hypot(down, across) > STEEPEST / focal_px * inverse_depth
    return steep


def _push_pull(value: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """Weighted means of ever coarser images fill what has no weight; value is 0 where weight is."""
    height, width = value.shape
    if min(height, width) <= 1:
        return np.full_like(value, (weight * value).sum() / max(float(weight.sum()), 1e-12))
    size = ((width + 1) // 2, (height + 1) // 2)
    total = cv2.resize(value * weight, size, interpolation=cv2.INTER_AREA)
    share = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    mean = np.where(share > 1e-6, total / np.maximum(share, 1e-6), 0.0).astype(np.float32)
    coarse = _push_pull(mean, np.minimum(4.0 * share, 1.0).astype(np.float32))
    smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    return (weight * value + (1.0 - weight) * smooth).astype(np.float32)
