"""What alignment needs of an image pair, fine to coarse: for the live frame and for the rendered model.

The memory is taken once and written anew for each frame.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.config.map_settings import LossConfig
from tgslam.config.tracking_settings import ModelSettings
from tgslam.device import runtime
from tgslam.ops import alignment
from tgslam.ops import image as images
from tgslam.ops.normals import PlaneFits
from tgslam.ops.rasterize import RenderImages
from tgslam.tracking.references import NO_PLANES, Reference
from tgslam.tracking.saturation import WHOLE, half_covers
from tgslam.types import Frame

# blocks of 2x2 px on each side: a rendered surface has little noise, and wide fits of a measured one round its edges
_NORMAL_RADIUS = 1


@dataclass
class LiveLevel:
    """One resolution of the live frame."""

    camera: Camera
    pixels: np.ndarray  # device array [H, B, LIVE, 16], see `ops.alignment`; B = ceil(W / 16)
    gate_low: float = 0.0  # G_min of Eq. 11, 1/px
    gate_inverse_range: float = 0.0  # 1 / (G_max - G_min + epsilon)


@dataclass(frozen=True)
class ModelLevel:
    """One resolution of what a frame is aligned to: of the rendered map, or of a keyframe as it was measured."""

    camera: Camera
    surface: np.ndarray  # device array [H, W, SURFACE], see `kernels.alignment`; no depth where the map says nothing
    texture: np.ndarray  # device array [H, W, TEXTURE]
    measured: bool = False  # its depth is as noisy as the frame's


def finest_level(camera: Camera, finest_width_px: int) -> int:
    """How often an image is halved until it is at most `finest_width_px` wide."""
    level = 0
    while camera.halved(level).width > finest_width_px:
        level += 1
    return level


class LivePyramid:
    """Levels of a frame, finest first: the frame halved `first` times, then once more for each next level."""

    def __init__(self, camera: Camera, first: int, levels: int, loss: LossConfig) -> None:
        self.loss, self._images = loss, _ImagePyramid(camera, first, levels)
        self.levels = [_live_level(camera.halved(first + level)) for level in range(levels)]
        self._samples = [_sample_for(level.camera) for level in self.levels]

    def update(self, frame: Frame) -> list[LiveLevel]:
        """Take in a frame; the result is valid until the next one."""
        base = self._images.base
        images.reduce_frame(runtime.to_device(frame.colour), runtime.to_device(frame.depth_m), base.grey, base.depth)
        for level, pair, sample in zip(self.levels, self._images.halvings(), self._samples, strict=True):
            alignment.pack_live(pair.grey, pair.depth, level.pixels)
            level.gate_low, level.gate_inverse_range = self._gate_range(level, sample)
        for level, cover in half_covers(frame.colour, self.levels):
            alignment.mark_saturated(cover, WHOLE, level.pixels)
        return self.levels

    def _gate_range(self, level: LiveLevel, sample: np.ndarray) -> tuple[float, float]:
        """G_min and 1 / (G_max - G_min + epsilon) of Eq. 11, from a grid of pixels. sample: memory for it."""
        if not self.loss.gate:
            return images.UNGATED
        alignment.sample_strength(level.pixels, images.sample_step(level.camera.shape), sample)
        texture = self.loss.expert.texture
        return images.gate_range(runtime.to_host(sample), texture.gate_percentile, texture.gate_noise_floor)


class ModelPyramid:
    """Levels of a rendering of the map, finest first, of the same sizes as those of `LivePyramid`."""

    def __init__(self, camera: Camera, first: int, levels: int, noise: SensorNoise, config: ModelSettings) -> None:
        self._config = config
        self._images = _ImagePyramid(camera, first, levels)
        self.levels = [_model_level(camera.halved(first + level)) for level in range(levels)]
        sizes = [pair.grey.shape for pair in self._images.pairs]
        self._covers = [runtime.empty(size) for size in (*sizes, images.halved(sizes[-1]))]
        self._fits = [PlaneFits(level.camera, _NORMAL_RADIUS, noise) for level in self.levels]

    def update(self, rendered: RenderImages, planes_c: NDArray[np.float64] = NO_PLANES) -> list[ModelLevel]:
        """Take in a rendering at full size; the result is valid until the next one.

        planes_c: [P, 4] known planes n . x + d = 0 in its camera's frame. What is rendered of them has their normals:
        those of the splats are off by some 30 mrad, which would hold the camera where nothing else does.
        """
        base = self._images.base
        images.reduce_rendering(
            rendered.colour,
            rendered.depth,
            rendered.opacity,
            self._config.min_opacity,
            base.grey,
            base.depth,
            self._covers[0],
        )
        for cover, half in itertools.pairwise(self._covers):
            images.halve(cover, half)
        half_covers = self._covers[-len(self.levels) :]
        for level, pair, fits, cover in zip(self.levels, self._images.halvings(), self._fits, half_covers, strict=True):
            _write_model(level, pair, fits, planes_c)
            images.mark_rims(cover, self._config.rim_opacity, level.surface)
        return self.levels


class ReferencePyramid:
    """Levels of a keyframe's own images, made just like those of the frame that is aligned to them."""

    def __init__(self, camera: Camera, first: int, levels: int, noise: SensorNoise) -> None:
        self._images = _ImagePyramid(camera, first, levels)
        self.levels = [_model_level(camera.halved(first + level), measured=True) for level in range(levels)]
        self._fits = [PlaneFits(level.camera, _NORMAL_RADIUS, noise) for level in self.levels]

    def update(self, reference: Reference) -> list[ModelLevel]:
        """Take in a keyframe; the result is valid until the next one."""
        base = self._images.base
        colour, depth_m = runtime.to_device(reference.colour), runtime.to_device(reference.depth_m)
        images.reduce_frame(colour, depth_m, base.grey, base.depth)
        for level, pair, fits in zip(self.levels, self._images.halvings(), self._fits, strict=True):
            _write_model(level, pair, fits, reference.planes_c)
        for level, cover in half_covers(colour, self.levels):
            images.mark_rims(cover, WHOLE, level.surface)
        return self.levels


@dataclass(frozen=True)
class _Pair:
    """Luminance and depth of one resolution, as device arrays [H, W]."""

    grey: np.ndarray
    depth: np.ndarray

    @classmethod
    def empty(cls, camera: Camera) -> _Pair:
        return cls(runtime.empty(camera.shape), runtime.empty(camera.shape))


class _ImagePyramid:
    """Luminance and depth at each resolution from `base` down, which is half the camera's unless `first` is 0."""

    def __init__(self, camera: Camera, first: int, levels: int) -> None:
        self._levels = levels
        self.pairs = [_Pair.empty(camera.halved(level)) for level in range(min(first, 1), first + levels)]

    @property
    def base(self) -> _Pair:
        """To be filled with the frame before `halvings`."""
        return self.pairs[0]

    def halvings(self) -> list[_Pair]:
        """Halve the base again and again; returns the levels that alignment uses, finest first."""
        for pair, half in itertools.pairwise(self.pairs):
            images.halve_pair(pair.grey, pair.depth, half.grey, half.depth)
        return self.pairs[-self._levels :]


def _live_level(camera: Camera) -> LiveLevel:
    return LiveLevel(camera, alignment.empty_live(camera))


def _model_level(camera: Camera, *, measured: bool = False) -> ModelLevel:
    surface, texture = (runtime.zeros((*camera.shape, values)) for values in (alignment.SURFACE, alignment.TEXTURE))
    return ModelLevel(camera, surface, texture, measured)


def _write_model(level: ModelLevel, pair: _Pair, fits: PlaneFits, planes_c: NDArray[np.float64]) -> None:
    alignment.pack_texture(pair.grey, level.texture)
    fits.write(pair.depth, level.surface)
    fits.adopt(planes_c, level.surface, measured=level.measured)


def _sample_for(camera: Camera) -> np.ndarray:
    step = images.sample_step(camera.shape)
    return runtime.empty((-(-camera.height // step), -(-camera.width // step)))
