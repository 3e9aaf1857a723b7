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
    return ImageScores(
        psnr_db=psnr(rendering.colour, frame.colour),
        psnr_affine_db=affine_psnr(rendering.colour, frame.colour),
        psnr_masked_db=masked_psnr(rendering.colour, frame.colour, frame.depth_m > 0),
        ssim=ssim(rendering.colour, frame.colour),
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
    return _psnr_db(_squared_error(rendered, measured))


def affine_psnr(rendered: FloatImage, measured: FloatImage) -> float:
    """Like `psnr`, after gain * rendered + offset with the gain and offset of each channel that make the error least.

    So exposure and white balance, which differ from image to image of many recordings, do not count.
    """
    x, y = _prepared(rendered, measured)
    x_off, y_off = x - x.mean((0, 1)), y - y.mean((0, 1))
    variance = (x_off**2).sum((0, 1))
    gain = (x_off * y_off).sum((0, 1)) / np.where(variance > 0, variance, 1.0)
    return _psnr_db((gain * x_off - y_off) ** 2)


def masked_psnr(rendered: FloatImage, measured: FloatImage, mask: NDArray[np.bool_]) -> float | None:
    """Like `psnr`, over the pixels of a mask [H, W] only; None if it has none."""
    if mask.shape != measured.shape[:2]:
        raise EvaluationError(f"the mask is {mask.shape}, but the image {measured.shape[:2]}")
    return _psnr_db(_squared_error(rendered, measured)[mask]) if mask.any() else None


def ssim(rendered: FloatImage, measured: FloatImage) -> float:
    """Structural similarity of RGB images [H, W, 3] in [0, 1], the rendered one clipped: 1 for equal images.

    The standard form: 11x11 Gaussian window of sigma 1.5 px, data range 1, mean over channels and over all pixels whose
    window lies inside the image. Raises EvaluationError for images below 11x11 pixels or that do not fit.
    """
    x, y = _prepared(rendered, measured)
    if min(x.shape[:2]) < _SSIM_WINDOW:
        raise EvaluationError(f"SSIM needs images of {_SSIM_WINDOW}x{_SSIM_WINDOW} pixels or more, not {x.shape[:2]}")
    mean_x, mean_y = _windowed(x), _windowed(y)
    variance_x = _windowed(x * x) - mean_x**2
    variance_y = _windowed(y * y) - mean_y**2
    covariance = _windowed(x * y) - mean_x * mean_y
    similarity = ((2 * mean_x * mean_y + _SSIM_C1) * (2 * covariance + _SSIM_C2)) / (
        (mean_x**2 + mean_y**2 + _SSIM_C1) * (variance_x + variance_y + _SSIM_C2)
    )
    return float(similarity.mean())


def depth_l1_cm(rendered_m: FloatImage, measured_m: FloatImage) -> float | None:
    """Mean absolute depth difference in cm over pixels with both depths (0 = none) [H, W]; None without such a pixel.

    Raises EvaluationError for shapes that differ or values that are not finite.
    """
    _check(rendered_m, measured_m)
    both = (rendered_m > 0) & (measured_m > 0)
    if not both.any():
        return None
    return float(100.0 * np.abs(rendered_m[both].astype(np.float64) - measured_m[both]).mean())


def _windowed(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gaussian mean [H - 10, W - 10, C] of the 11x11 window round each pixel where it fits."""
    margin = _SSIM_WINDOW // 2
    blurred = cv2.GaussianBlur(image, (_SSIM_WINDOW, _SSIM_WINDOW), _SSIM_SIGMA)
    return blurred[margin:-margin, margin:-margin]


def _psnr_db(squared_error: NDArray[np.float64]) -> float:
    mean = float(squared_error.mean())
    return -10.0 * math.log10(mean) if mean > 0 else math.inf


def _squared_error(rendered: FloatImage, measured: FloatImage) -> NDArray[np.float64]:
    x, y = _prepared(rendered, measured)
    return (x - y) ** 2


def _prepared(rendered: FloatImage, measured: FloatImage) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Both images in float64 (small differences of large sums follow), the rendered one clipped."""
    _check(rendered, measured)
    return np.clip(rendered, 0.0, 1.0).astype(np.float64), measured.astype(np.float64)


def _check(rendered: FloatImage, measured: FloatImage) -> None:
    if rendered.shape != measured.shape or not measured.size:
        raise EvaluationError(f"the rendering is {rendered.shape}, but the measured image {measured.shape}")
    if not (np.isfinite(rendered).all() and np.isfinite(measured).all()):
        raise EvaluationError("an image holds NaN or infinite values")


def _mean(values: list[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return float(np.mean(present)) if present else None
