"""How close a rendering is to a measured frame: PSNR, SSIM and depth L1."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.errors import EvaluationError
from tgslam.types import FloatImage, Frame, Rendering

_SSIM_WINDOW = 11  # px
_SSIM_SIGMA = 1.5  # px
_SSIM_C1, _SSIM_C2 = 0.01**2, 0.03**2  # for a data range of 1

_Channels = NDArray[np.float64]  # [3, H, W]: NumPy sums and blurs whole channels quicker than every third value


@dataclass(frozen=True)
class ImageScores:
    """Metrics of one rendering, or their means over several. None: there was no pixel to compare."""

    psnr_db: float
    psnr_affine_db: float  # after the gain and offset of each channel that fit best
    psnr_masked_db: float | None  # over pixels with measured depth
    ssim: float
    depth_l1_cm: float | None  # over pixels with both depths


def score_rendering(rendering: Rendering, frame: Frame) -> ImageScores:
    """Compare a rendering with the frame at the same pose. Raises EvaluationError for images that do not fit."""
    x, y = _prepared(rendering.colour, frame.colour)
    squared = _squared_error(x, y)
    return ImageScores(
        psnr_db=_psnr_db(float(squared.mean())),
        psnr_affine_db=_affine_psnr(x, y),
        psnr_masked_db=_masked_psnr(squared, frame.depth_m > 0),
        ssim=_ssim(x, y),
        depth_l1_cm=depth_l1_cm(rendering.depth_m, frame.depth_m),
    )


def mean_scores(scores: list[ImageScores]) -> ImageScores:
    """The mean of each metric over frames; frames where it is None are left out. Raises EvaluationError for none."""
    if not scores:
        raise EvaluationError("no frame to average image metrics over; lower evaluation.holdout_interval")
    return ImageScores(
        psnr_db=float(np.mean([score.psnr_db for score in scores])),
        psnr_affine_db=float(np.mean([score.psnr_affine_db for score in scores])),
        psnr_masked_db=_mean([score.psnr_masked_db for score in scores]),
        ssim=float(np.mean([score.ssim for score in scores])),
        depth_l1_cm=_mean([score.depth_l1_cm for score in scores]),
    )


def psnr(rendered: FloatImage, measured: FloatImage) -> float:
    """Peak signal-to-noise ratio in dB of RGB images [H, W, 3] in [0, 1], the rendered one clipped to that range.

    Infinite for equal images. Raises EvaluationError for shapes that differ or values that are not finite.
    """
    return _psnr_db(float(_squared_error(*_prepared(rendered, measured)).mean()))


def affine_psnr(rendered: FloatImage, measured: FloatImage) -> float:
    """Like `psnr`, after gain * rendered + offset with the gain and offset of each channel that make the error least.

    So exposure and white balance, which differ from image to image of many recordings, do not count.
    """
    return _affine_psnr(*_prepared(rendered, measured))


def masked_psnr(rendered: FloatImage, measured: FloatImage, mask: NDArray[np.bool_]) -> float | None:
    """Like `psnr`, over the pixels of a mask [H, W] only; None if it has none."""
    return _masked_psnr(_squared_error(*_prepared(rendered, measured)), mask)


def ssim(rendered: FloatImage, measured: FloatImage) -> float:
    """Structural similarity of RGB images [H, W, 3] in [0, 1], the rendered one clipped: 1 for equal images.

    The standard form: 11x11 Gaussian window of sigma 1.5 px, data range 1, mean over channels and over all pixels whose
    window lies inside the image. Raises EvaluationError for images below 11x11 pixels or that do not fit.
    """
    return _ssim(*_prepared(rendered, measured))


def depth_l1_cm(rendered_m: FloatImage, measured_m: FloatImage) -> float | None:
    """Mean absolute depth difference in cm over pixels with both depths (0 = none) [H, W]; None without such a pixel.

    Raises EvaluationError for shapes that differ or values that are not finite.
    """
    _check(rendered_m, measured_m)
    both = (rendered_m > 0) & (measured_m > 0)
    if not both.any():
        return None
    return float(100.0 * np.abs(rendered_m[both].astype(np.float64) - measured_m[both]).mean())


def _affine_psnr(x: _Channels, y: _Channels) -> float:
    """See `affine_psnr`: what a line through y over x leaves, channel by channel."""
    unexplained = 0.0
    for rendered, measured in zip(x, y, strict=True):
        x_off, y_off = rendered - rendered.mean(), measured - measured.mean()
        variance = float((x_off * x_off).sum())
        gain = float((x_off * y_off).sum()) / variance if variance > 0 else 0.0
        y_off -= gain * x_off
        unexplained += float((y_off * y_off).sum())
    return _psnr_db(unexplained / y.size)


def _masked_psnr(squared: NDArray[np.float64], mask: NDArray[np.bool_]) -> float | None:
    """See `masked_psnr`; squared: error by pixel [H, W]."""
    if mask.shape != squared.shape:
        raise EvaluationError(f"the mask is {mask.shape}, but the image {squared.shape}")
    return _psnr_db(float(squared[mask].mean())) if mask.any() else None


def _ssim(x: _Channels, y: _Channels) -> float:
    """See `ssim`."""
    if min(x.shape[1:]) < _SSIM_WINDOW:
        raise EvaluationError(f"SSIM needs images of {_SSIM_WINDOW}x{_SSIM_WINDOW} pixels or more, not {x.shape[1:]}")
    return float(np.mean([_similarity(*channels) for channels in zip(x, y, strict=True)]))


def _similarity(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Mean SSIM of one channel [H, W]. The two variances only count as their sum, which takes one blur."""
    mean_x, mean_y = _windowed(x), _windowed(y)
    product, squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    covariance = _windowed(x * y) - product
    variances = _windowed(x * x + y * y) - squares
    similarity = (2 * product + _SSIM_C1) * (2 * covariance + _SSIM_C2)
    similarity /= (squares + _SSIM_C1) * (variances + _SSIM_C2)
    return float(similarity.mean())


def _windowed(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gaussian mean [H - 10, W - 10] of the 11x11 window round each pixel [H, W] where it fits."""
    margin = _SSIM_WINDOW // 2
    blurred = cv2.GaussianBlur(image, (_SSIM_WINDOW, _SSIM_WINDOW), _SSIM_SIGMA)
    return blurred[margin:-margin, margin:-margin]


def _psnr_db(squared_error: float) -> float:
    return -10.0 * math.log10(squared_error) if squared_error > 0 else math.inf


def _squared_error(x: _Channels, y: _Channels) -> NDArray[np.float64]:
    """[H, W] mean over the channels."""
    error = x - y
    error *= error
    return error.mean(axis=0)


def _prepared(rendered: FloatImage, measured: FloatImage) -> tuple[_Channels, _Channels]:
    """Both images channel by channel, in float64 (small differences of large sums follow), the rendered one clipped."""
    _check(rendered, measured)
    return np.clip(_channels(rendered), 0.0, 1.0), _channels(measured)


def _channels(image: FloatImage) -> _Channels:
    return np.ascontiguousarray(np.moveaxis(image, -1, 0), np.float64)


def _check(rendered: FloatImage, measured: FloatImage) -> None:
    if rendered.shape != measured.shape or not measured.size:
        raise EvaluationError(f"the rendering is {rendered.shape}, but the measured image {measured.shape}")
    if not (np.isfinite(rendered).all() and np.isfinite(measured).all()):
        raise EvaluationError("an image holds NaN or infinite values")


def _mean(values: list[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return float(np.mean(present)) if present else None
