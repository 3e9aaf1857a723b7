"""Packed images of RGB-D alignment, and the sums of its normal equations on either device."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.device import runtime
from tgslam.device.arrays import require
from tgslam.kernels import alignment as kernels
from tgslam.kernels import image as packing
from tgslam.kernels.cuda import alignment as cuda_kernels

layout = kernels  # which entries of the settings and columns of the sums mean what
SURFACE, TEXTURE = kernels.SURFACE, kernels.TEXTURE  # values of a model's pixel: normal and depth, intensity and slopes


def empty_live(camera: Camera) -> np.ndarray:
    """Device array [H, B, LIVE, 16] for a live image, B = ceil(W / 16)."""
    blocks = -(-camera.width // kernels.LANES)
    return runtime.empty((camera.height, blocks, kernels.LIVE, kernels.LANES))


def pack_live(grey: np.ndarray, depth_m: np.ndarray, live: np.ndarray) -> None:
    """Write luminance and depth, float32 [H, W] each, into a live image."""
    height, width = require("grey", grey, (None, None)).shape
    require("depth_m", depth_m, (height, width))
    require("live", live, (height, -(-width // kernels.LANES), kernels.LIVE, kernels.LANES))
    packing.pack_live(grey, depth_m, live)


def mark_saturated(half_cover: np.ndarray, whole: float, live: np.ndarray) -> None:
    """Let colours of a live image not count where half_cover [H // 2, W // 2] is below `whole`, see `images.mark_rims`.

    half_cover: which share of each pixel is not saturated.
    """
    packing.mark_saturated(half_cover, whole, live)


def sample_strength(live: np.ndarray, step_px: int, sample: np.ndarray) -> None:
    """Write the texture strength of Eq. 10 at every step-th pixel of a live image into sample [rows, columns]."""
    packing.sample_strength(live, step_px, sample)


def pack_texture(grey: np.ndarray, texture: np.ndarray) -> None:
    """Write luminance, float32 [H, W], with its first and second derivatives into texture [H, W, TEXTURE]."""
    height, width = require("grey", grey, (None, None)).shape
    require("texture", texture, (height, width, TEXTURE))
    packing.pack_texture(grey, texture)
    packing.pack_second_derivatives(texture)


class _Sums(Protocol):
    """How a device adds up the pixels of one image size; arguments have been checked."""

    def __call__(
        self, settings: np.ndarray, live: np.ndarray, surface: np.ndarray, texture: np.ndarray
    ) -> NDArray[np.float64]:
        """See `NormalSums.__call__`."""
        ...


class _CpuSums:
    """16 pixels at a time; the parts' sums are added here, in float64."""

    def __init__(self, camera: Camera) -> None:
        parts = kernels.parts(camera.height)
        self._scratch = runtime.empty((parts, kernels.PADDED_SUMS, kernels.LANES), lanes=True)
        self._packed = runtime.empty((parts, kernels.PACKED_SUMS, kernels.LANES), lanes=True)

    def __call__(
        self, settings: np.ndarray, live: np.ndarray, surface: np.ndarray, texture: np.ndarray
    ) -> NDArray[np.float64]:
        kernels.normal_equations(settings, live, surface, texture, self._scratch, self._packed)
        return self._packed.reshape(len(self._packed), -1)[:, : kernels.SUMS].sum(0, dtype=np.float64)


class _CudaSums:
    """A pixel a thread; only the totals come to the host."""

    def __init__(self, camera: Camera) -> None:
        self._by_warp = runtime.empty((cuda_kernels.warps(camera.width * camera.height), kernels.SUMS))
        self._totals = runtime.empty((kernels.SUMS,))

    def __call__(
        self, settings: np.ndarray, live: np.ndarray, surface: np.ndarray, texture: np.ndarray
    ) -> NDArray[np.float64]:
        cuda_kernels.add_pixels(settings, live, surface, texture, self._by_warp)
        cuda_kernels.add_warps(self._by_warp, self._totals)
        return runtime.to_host(self._totals).astype(np.float64)


class NormalSums:
    """The sums over all pixels of images of one size, with the scratch memory for it."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._settings = runtime.empty((kernels.SETTINGS,))
        self._add: _Sums = (_CudaSums if runtime.device() is runtime.Device.CUDA else _CpuSums)(camera)

    def __call__(
        self, settings: NDArray[np.float32], live: np.ndarray, surface: np.ndarray, texture: np.ndarray
    ) -> NDArray[np.float64]:
        """The sums [SUMS] for settings [SETTINGS] on the host; `layout` says in which order both are.

        live: as `pack_live` writes it. surface: [H, W, SURFACE], texture: [H, W, TEXTURE] of the model, on the device.
        """
        require("surface", surface, (*self._camera.shape, SURFACE))
        require("texture", texture, (*self._camera.shape, TEXTURE))
        runtime.upload(settings, self._settings)
        return self._add(self._settings, live, surface, texture)
