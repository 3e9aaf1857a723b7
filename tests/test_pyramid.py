"""The levels that alignment works on, against the float64 twins of the image operations."""

import numpy as np
import pytest

from tests.reference import image as reference
from tgslam.camera import Camera
from tgslam.config.map_settings import LossConfig
from tgslam.config.tracking_settings import ModelSettings
from tgslam.device import runtime
from tgslam.kernels import alignment
from tgslam.ops import image as images
from tgslam.ops.normals import normals_of
from tgslam.ops.rasterize import RenderImages
from tgslam.tracking.pyramid import LivePyramid, ModelPyramid
from tgslam.types import Frame

LOSS = LossConfig()
LEVELS = 2
SIZES = [(48, 64), (37, 53)]


def view(size, seed=0):
    """Colour and depth of a textured, tilted surface with holes."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: size[0], : size[1]]
    colour = 0.5 + 0.3 * np.sin(0.3 * u + 0.1 * v)[..., None] * rng.uniform(0.5, 1.0, 3) + 0.05 * rng.random((*size, 3))
    depth = np.where(rng.random(size) < 0.1, 0.0, 1.5 + 0.004 * u + 0.002 * v)
    return colour.astype(np.float32), depth.astype(np.float32)


def camera_of(size):
    return Camera(size[1], size[0], 60.0, 62.0, size[1] / 2, size[0] / 2)


def pyramid_of(grey, depth, first):
    """Luminance and depth of each level by the twins."""
    levels = []
    for level in range(first + LEVELS):
        if level:
            grey, depth = reference.halve(grey), reference.halve_depth(depth, images.DEPTH_EDGE)
        levels.append((grey, depth))
    return levels[first:]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("first", [0, 1, 2])
def test_levels_of_a_frame_match_the_twin(size, first):
    pyramid = LivePyramid(camera_of(size), first, LEVELS, LOSS)
    for seed in (0, 1):  # the memory is written anew
        colour, depth = view(size, seed)
        levels = pyramid.update(Frame(0, 0.0, colour, depth))
        expected = pyramid_of(reference.luminance(colour.astype(float)), depth.astype(float), first)
        for level, (grey, depth_m) in zip(levels, expected, strict=True):
            assert grey.shape == (level.camera.height, level.camera.width)
            records = runtime.to_host(level.pixels).swapaxes(2, 3).reshape(len(grey), -1, alignment.LIVE)
            assert not records[:, grey.shape[1] :, alignment.LIVE_DEPTH].any()
            gradient = reference.sobel(grey)
            expected_records = np.stack([depth_m, grey, *gradient, np.hypot(*gradient)], axis=-1)
            np.testing.assert_allclose(records[:, : grey.shape[1]], expected_records, atol=2e-6)
            gate = 1 - np.clip((np.hypot(*gradient) - level.gate_low) * level.gate_inverse_range, 0, 1)
            twin = reference.texture_gate(
                grey, LOSS.expert.texture.gate_percentile, LOSS.expert.texture.gate_noise_floor
            )
            np.testing.assert_allclose(gate, twin, atol=1e-4)


def test_without_the_gate_every_strength_counts_as_texture():
    pyramid = LivePyramid(camera_of(SIZES[0]), 0, LEVELS, LossConfig(gate=False))
    for level in pyramid.update(Frame(0, 0.0, *view(SIZES[0]))):
        strength = np.float32([0.0, 1e-7, 0.5, 8.0])
        gate = 1 - np.clip((strength - level.gate_low) * level.gate_inverse_range, 0, 1)
        np.testing.assert_array_equal(gate, 0)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("first", [0, 1, 2])
def test_levels_of_a_rendering_match_the_twin(size, first):
    pyramid = ModelPyramid(camera_of(size), first, LEVELS, LOSS.noise, ModelSettings(min_opacity=0.5, rim_opacity=0.7))
    for seed in (0, 1):
        colour, depth = view(size, seed)
        opacity = np.random.default_rng(seed).uniform(0.45, 1.0, size).astype(np.float32)
        opacity[:, : size[1] // 3] **= 0.2  # the rest is the rim of the map, more or less
        arrays = [runtime.to_device(image) for image in (colour, depth * opacity, opacity, colour)]
        levels = pyramid.update(RenderImages(*arrays))
        covered = np.where(opacity > 0.5, depth, 0.0).astype(float)
        expected = pyramid_of(reference.luminance(colour.astype(float)), covered, first)
        for level, (grey, depth_m) in zip(levels, expected, strict=True):
            surface, texture = runtime.to_host(level.surface), runtime.to_host(level.texture)
            np.testing.assert_allclose(abs(surface[..., alignment.MODEL_DEPTH]), depth_m, atol=2e-6)
            cover = opacity.astype(float)
            while cover.shape[0] > grey.shape[0] // 2:
                cover = reference.halve(cover)
            rim = reference.rim(cover, 0.7, grey.shape) & (depth_m > 0)
            np.testing.assert_array_equal(surface[..., alignment.MODEL_DEPTH] < 0, rim)
            gx, gy = reference.sobel(grey)
            (gxx, gxy), (_, gyy) = reference.sobel(gx), reference.sobel(gy)
            np.testing.assert_allclose(texture[..., :6], np.stack([grey, gx, gy, gxx, gxy, gyy], -1), atol=2e-6)
            depth_m = runtime.to_device(abs(surface[..., alignment.MODEL_DEPTH]))
            normal = normals_of(depth_m, level.camera, LOSS.noise, radius=1)
            np.testing.assert_array_equal(surface[..., :3], runtime.to_host(normal))


@pytest.mark.parametrize("value", [np.inf, np.nan, -1.0, 1e6])
def test_what_is_no_depth_is_none(value):
    size = (48, 64)
    colour, depth = view(size)
    depth[10:20, 10:30] = value
    (level,) = LivePyramid(camera_of(size), 0, 1, LOSS).update(Frame(0, 0.0, colour, depth))
    pixels = runtime.to_host(level.pixels).swapaxes(2, 3).reshape(*size, alignment.LIVE)
    assert not pixels[10:20, 10:30, alignment.LIVE_DEPTH].any()
    arrays = [runtime.to_device(image) for image in (colour, depth, np.ones(size), colour)]
    (model,) = ModelPyramid(camera_of(size), 0, 1, LOSS.noise, ModelSettings(min_opacity=0.5, rim_opacity=0.7)).update(
        RenderImages(*arrays)
    )
    surface = runtime.to_host(model.surface)
    assert not surface[10:20, 10:30, alignment.MODEL_DEPTH].any() and np.isfinite(surface).all()
