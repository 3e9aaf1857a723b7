"""A depth camera's faults: Kinect-like depth noise and holes, colour noise, exposure."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from tgslam.types import FloatImage

DEPTH_SIGMA_PER_M2 = 0.0015  # sigma_z = this * z^2, 1/m, like the Kinect's
COLOUR_SIGMA = 0.008  # intensity in [0, 1]: two steps of 8 bits
MIN_RANGE_M, MAX_RANGE_M = 0.4, 7.0  # of such a sensor
EXPOSURE_PERIOD_S = 6.0  # slow enough for neighbouring frames to look alike

_FOCAL_BASELINE_PX_M = 580.0 * 0.075  # of the sensor that sees disparity, whatever the resolution of the frames
_DISPARITY_STEP_PX = 0.125  # in which it measures disparity
_SMOOTHING_PX = 0.7  # disparity noise is correlated between neighbours
_GRAZING_COSINE = 0.14  # below: no return
_EDGE_JUMP = 0.03  # relative depth step that counts as an edge
_EDGE_HOLE_SHARE = 0.6  # of the pixels at an edge without depth
# Of the normal distribution, looked up by 16 random bits: cheaper than to draw from it
_NORMAL_QUANTILES = ndtri((np.arange(1 << 16) + 0.5) / (1 << 16)).astype(np.float32)


def exposure_gain(time_s: float, amplitude: float) -> float:
    """The slow change of gain about 1."""
    return 1.0 + amplitude * float(np.sin(2 * np.pi * time_s / EXPOSURE_PERIOD_S))


def noisy_colour(colour: FloatImage, rng: np.random.Generator) -> FloatImage:
    """Colour [H, W, 3] in [0, 1] with Gaussian noise, clipped and in steps of 1/255."""
    noisy = _gaussian(colour.shape, rng)
    noisy *= np.float32(COLOUR_SIGMA)
    noisy += colour
    np.clip(noisy, 0.0, 1.0, out=noisy)
    noisy *= np.float32(255.0)
    np.rint(noisy, out=noisy)
    noisy /= np.float32(255.0)
    return noisy


def noisy_depth(
    depth_m: FloatImage, cosine: FloatImage, rng: np.random.Generator, noise_factor: float = 1.0
) -> FloatImage:
    """Depth [H, W] m as a structured-light sensor would give it; 0 where it gives none.

    Noise and rounding are in disparity and together have sigma_z = noise_factor * 0.0015 z^2. Edges are displaced by
    up to a pixel. Holes: part of the pixels at depth edges, grazing surfaces, out of range. cosine [H, W]: |cos| of ray
    and normal.
    """
    shape = depth_m.shape
    edge = _depth_edges(depth_m)
    depth = np.where(edge, _shifted(depth_m, rng), depth_m)
    white = _gaussian(shape, rng)
    kernel = cv2.getGaussianKernel(5, _SMOOTHING_PX).astype(np.float32)
    smooth = cv2.sepFilter2D(white, -1, kernel, kernel) / np.float32((kernel**2).sum())
    total_px = DEPTH_SIGMA_PER_M2 * _FOCAL_BASELINE_PX_M
    sigma_px = np.float32(noise_factor * np.sqrt(total_px**2 - _DISPARITY_STEP_PX**2 / 12))
    valid = (depth > 0) & (cosine > _GRAZING_COSINE)
    disparity = np.float32(_FOCAL_BASELINE_PX_M) / np.maximum(depth, np.float32(1e-3)) + sigma_px * smooth
    step = np.float32(noise_factor * _DISPARITY_STEP_PX)
    disparity = np.maximum(np.rint(disparity / step), 1) * step
    result = np.float32(_FOCAL_BASELINE_PX_M) / disparity
    valid &= (result >= MIN_RANGE_M) & (result <= MAX_RANGE_M)
    valid &= ~(edge & (rng.random(shape, np.float32) < _EDGE_HOLE_SHARE))
    return np.where(valid, result, np.float32(0.0))


def _gaussian(shape: tuple[int, ...], rng: np.random.Generator) -> FloatImage:
    """Normal deviates in 65,536 steps: three times as fast as drawing them exactly."""
    return _NORMAL_QUANTILES[rng.integers(0, 1 << 16, size=shape, dtype=np.uint16)]


def _depth_edges(depth_m: FloatImage) -> NDArray[np.bool_]:
    """Pixels [H, W] whose 3 x 3 neighbourhood holds a depth step."""
    box = np.ones((3, 3), np.uint8)
    far, near = cv2.dilate(depth_m, box), cv2.erode(depth_m, box)
    curvature = np.abs(far + near - 2 * depth_m)  # a slanted plane is no edge
    return curvature > _EDGE_JUMP * np.maximum(near, 0.1)


def _shifted(depth_m: FloatImage, rng: np.random.Generator) -> FloatImage:
    """Each pixel's depth taken from itself or one of its neighbours at random."""
    height, width = depth_m.shape
    shift = rng.integers(-1, 2, size=(2, height, width), dtype=np.int8)
    rows = np.clip(np.arange(height)[:, None] + shift[0], 0, height - 1)
    columns = np.clip(np.arange(width)[None, :] + shift[1], 0, width - 1)
    return depth_m[rows, columns]
