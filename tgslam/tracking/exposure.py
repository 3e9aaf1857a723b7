"""Brightness of a frame relative to the map, from the intensities that alignment has matched."""

from __future__ import annotations

from dataclasses import dataclass

from tgslam.types import Exposure


@dataclass(frozen=True)
class IntensityMoments:
    """Robustly weighted sums over the matched pixels; l = live intensity, m = the model's."""

    w: float
    l: float  # noqa: E741
    m: float
    ll: float
    lm: float


def fit_exposure(moments: IntensityMoments, model: str, fallback: Exposure) -> Exposure:
    """The exposure by the model "none", "gain" or "gain_bias"; `fallback` where the pixels do not determine it.

    A rendered model is blurred, and a least-squares fit takes lost contrast for gain < 1 and bias > 0.
    The ratio of the mean intensities ("gain") does not see blur. "gain_bias" is the least-squares fit.
    """
    if model == "none":
        return Exposure()
    if moments.w < 1.0 or moments.l < 1e-3 * moments.w or moments.m < 1e-3 * moments.w:
        return fallback
    if model == "gain":
        return Exposure(moments.m / moments.l)
    variance = moments.ll - moments.l**2 / moments.w
    if variance < 1e-6 * moments.w:
        return Exposure(moments.m / moments.l)
    gain = (moments.lm - moments.l * moments.m / moments.w) / variance
    if not 0.1 < gain < 10.0:
        return fallback
    return Exposure(gain, (moments.m - gain * moments.l) / moments.w)
