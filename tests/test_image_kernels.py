"""Image kernels against their float64 twins."""

import numpy as np
import pytest

from tests.reference import image as reference
from tgslam.camera import Camera
from tgslam.device import runtime
from tgslam.kernels import alignment
from tgslam.ops import image as images

SIZES = [(48, 64), (37, 51), (2, 3), (700, 5)]
VGA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)


@pytest.fixture
def rng():
    return np.random.default_rng(11)


@pytest.mark.parametrize("size", SIZES)
def test_luminance_halving_and_gradient_magnitude_match_the_twin(rng, size):
    colour = rng.random((*size, 3), np.float32)
    grey = images.luminance(runtime.to_device(colour))
    np.testing.assert_allclose(runtime.to_host(grey), reference.luminance(colour.astype(float)), atol=1e-6)
    for image in (colour, runtime.to_host(grey)):
        half = runtime.to_host(images.halve(runtime.to_device(image)))
        np.testing.assert_allclose(half, reference.halve(image.astype(float)), atol=1e-6)
    expected = reference.sobel(runtime.to_host(grey).astype(float))
    np.testing.assert_allclose(runtime.to_host(images.sobel_magnitude(grey)), np.hypot(*expected), atol=1e-6)


def test_gradient_magnitude_of_a_ramp_is_its_slope():
    v, u = np.mgrid[:20, :30]
    magnitude = images.sobel_magnitude(runtime.to_device(0.03 * u - 0.04 * v))
    np.testing.assert_allclose(runtime.to_host(magnitude)[1:-1, 1:-1], 0.05, atol=1e-6)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("halved", [False, True])
def test_reduced_frames_and_renderings_match_the_twin(rng, size, halved):
    colour, opacity = rng.random((*size, 3), np.float32), rng.random(size, np.float32)
    depth = rng.choice([1.0, 1.02, 1.049, 1.06, 2.0, 2.05, 0.0], size).astype(np.float32)
    reduced = tuple(n // 2 for n in size) if halved else size
    grey, small = runtime.empty(reduced), runtime.empty(reduced)
    luma = reference.luminance(colour.astype(float))
    luma = reference.halve(luma) if halved else luma

    def expected_depth(image):
        return reference.halve_depth(image.astype(float), images.DEPTH_EDGE) if halved else image

    images.reduce_frame(*(runtime.to_device(image) for image in (colour, depth)), grey, small)
    np.testing.assert_allclose(runtime.to_host(grey), luma, atol=1e-6)
    np.testing.assert_allclose(runtime.to_host(small), expected_depth(depth), rtol=1e-6)
    rendering = [runtime.to_device(image) for image in (colour, depth * opacity, opacity)]
    cover = runtime.empty(reduced)
    images.reduce_rendering(*rendering, 0.4, grey, small, cover)
    mean_opacity = reference.halve(opacity.astype(float)) if halved else opacity
    np.testing.assert_allclose(runtime.to_host(cover), mean_opacity, atol=1e-6)
    np.testing.assert_allclose(runtime.to_host(grey), luma, atol=1e-6)
    np.testing.assert_allclose(runtime.to_host(small), expected_depth(np.where(opacity > 0.4, depth, 0.0)), rtol=1e-6)


@pytest.mark.parametrize("size", SIZES)
def test_the_rim_of_the_map_has_negative_depth(rng, size):
    half_cover = rng.uniform(0.6, 1.0, (size[0] // 2, size[1] // 2)).astype(np.float32)
    surface = rng.random((*size, alignment.SURFACE), np.float32) + 0.5
    marked = runtime.to_device(surface.copy())
    images.mark_rims(runtime.to_device(half_cover), 0.8, marked)
    rim = reference.rim(half_cover.astype(float), 0.8, size)
    assert rim.any() and (min(size) < 4 or not rim.all())
    expected = surface.copy()
    expected[rim, alignment.MODEL_DEPTH] *= -1
    np.testing.assert_array_equal(runtime.to_host(marked), expected)


@pytest.mark.parametrize("size", SIZES)
def test_halving_a_pair_is_halving_each(rng, size):
    grey = runtime.to_device(rng.random(size))
    depth = runtime.to_device(rng.choice([0.0, 1.0, 1.03, 1.2], size))
    halves = [runtime.empty((size[0] // 2, size[1] // 2)) for _ in range(2)]
    images.halve_pair(grey, depth, *halves)
    np.testing.assert_array_equal(runtime.to_host(halves[0]), runtime.to_host(images.halve(grey)))
    np.testing.assert_array_equal(runtime.to_host(halves[1]), runtime.to_host(images.halve_depth(depth)))


def test_a_sample_is_a_grid_of_some_120_rows(rng):
    for size, step in (((480, 640), 4), ((250, 261), 2), ((37, 51), 1)):
        image = rng.random(size, np.float32)
        np.testing.assert_array_equal(images.sampled(runtime.to_device(image)), image[::step, ::step])


@pytest.mark.parametrize("size", SIZES)
def test_halved_depth_matches_the_twin(rng, size):
    depth = rng.choice([1.0, 1.02, 1.049, 1.06, 2.0, 2.05, 0.0], size).astype(np.float32)
    half = runtime.to_host(images.halve_depth(runtime.to_device(depth), 0.05))
    np.testing.assert_allclose(half, reference.halve_depth(depth.astype(float), 0.05), rtol=1e-6)


def test_halved_depth_never_mixes_surfaces():
    depth = np.full((8, 8), 3.0, np.float32)
    depth[:, :3] = 1.0
    depth[0, :] = 0
    half = runtime.to_host(images.halve_depth(runtime.to_device(depth)))
    assert set(np.unique(half)) == {1.0, 3.0}
    assert not runtime.to_host(images.halve_depth(runtime.zeros((6, 6)))).any()


@pytest.mark.parametrize("size", [(48, 64), (37, 51), (300, 261)])
def test_gate_matches_the_twin(rng, size):
    u = np.arange(size[1])
    grey = np.float32(0.5 + 0.3 * np.sin(0.02 * u * (u > size[1] // 2)) + 0.05 * rng.random(size))
    found = runtime.to_host(images.texture_gate(runtime.to_device(grey), 90.0, 0.004))
    np.testing.assert_allclose(found, reference.texture_gate(grey.astype(float), 90.0, 0.004), atol=1e-4)
    assert found.min() == 0 and found.max() == 1


def test_gate_of_a_constant_image_is_one_and_of_faint_noise_stays_high(rng):
    assert (runtime.to_host(images.texture_gate(runtime.to_device(np.full((30, 40), 0.3)))) == 1).all()
    noise = 0.5 + 0.004 * rng.normal(size=(240, 320))
    assert runtime.to_host(images.texture_gate(runtime.to_device(noise))).mean() > 0.85


def test_gate_survives_one_strong_edge(rng):
    grey = 0.5 + 0.1 * np.sin(np.arange(160)[None, :] * 0.8) * np.ones((120, 1))
    with_edge = grey.copy()
    with_edge[60:] += 5.0
    gates = [runtime.to_host(images.texture_gate(runtime.to_device(image))) for image in (grey, with_edge)]
    np.testing.assert_allclose(gates[0][:50], gates[1][:50], atol=0.05)


def test_wrong_images_are_named():
    with pytest.raises(ValueError, match=r"colour must have shape \[any, any, 3\]"):
        images.luminance(runtime.zeros((4, 4)))
    with pytest.raises(ValueError, match="image must be float32"):
        images.sobel_magnitude(np.zeros((4, 4)))
    with pytest.raises(ValueError, match="C-contiguous"):
        images.sobel_magnitude(np.zeros((4, 8), np.float32)[:, ::2])
    with pytest.raises(ValueError, match=r"grey must have shape \[2, 3\]"):
        images.reduce_frame(
            runtime.zeros((4, 6, 3)), runtime.zeros((4, 6)), runtime.zeros((3, 6)), runtime.zeros((2, 3))
        )
    with pytest.raises(ValueError, match="cannot be halved"):
        images.halve(runtime.zeros((1, 4)))
    with pytest.raises(ValueError, match="out must have shape"):
        images.luminance(runtime.zeros((4, 4, 3)), runtime.zeros((4, 5)))
