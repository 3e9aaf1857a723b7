"""Image kernels against their float64 twins, and normals against true planes."""

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


def plane_depth(camera, normal, distance_m):
    """Depth of the plane normal . p + distance = 0 in the camera frame."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    return -distance_m / (rays @ normal)


def facing(angle_deg, towards_deg=0.0):
    """Unit normal towards the camera, tilted off the optical axis."""
    a, b = np.radians([angle_deg, towards_deg])
    return -np.array([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)])


def errors_deg(found, normal):
    """Angles of the valid normals to the true one, and the share of pixels that have one."""
    valid = np.linalg.norm(found, axis=2) > 0.5
    cosine = np.clip(found[valid].astype(float) @ normal, -1, 1)
    return np.degrees(np.arccos(cosine)), valid.mean()


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


def test_normals_match_the_twin(rng):
    camera = Camera(45, 33, 40.0, 42.0, 21.0, 17.0)
    depth = plane_depth(camera, facing(25, 70), 1.2)
    depth[:, 30:] = plane_depth(camera, facing(40, 200), 2.0)[:, 30:]
    depth += 0.0015 * depth**2 * rng.normal(size=depth.shape)
    depth[rng.random(depth.shape) < 0.1] = 0
    depth = depth.astype(np.float32)
    found = runtime.to_host(images.normals(runtime.to_device(depth), camera, radius=2))
    expected = reference.normals(depth.astype(float), camera, 2, 0.0015, 1.3, images.DEPTH_EDGE)
    differ = np.linalg.norm(found - expected, axis=2) > 2e-3
    assert differ.mean() < 0.002  # a pixel at a threshold may fall on either side
    assert (np.linalg.norm(expected, axis=2) > 0.5).mean() > 0.7


@pytest.mark.parametrize("normal", [facing(0), facing(30, 45), facing(60, 180), np.array([0.0, -1.0, 0.05])])
def test_normals_of_exact_planes_are_exact(normal):
    normal = normal / np.linalg.norm(normal)
    camera = Camera(160, 121, 130.0, 131.0, 80.0, 10.0)
    depth = plane_depth(camera, normal, 1.5)
    depth[(depth < 0.2) | (depth > 6)] = 0
    found = runtime.to_host(images.normals(runtime.to_device(depth), camera))
    errors, share = errors_deg(found, normal)
    assert errors.max() < 0.1
    assert share > 0.75 * (depth > 0).mean()


@pytest.mark.parametrize(("distance_m", "limit_deg"), [(1.0, 1.5), (2.0, 3.5), (3.0, 6.0)])
def test_normals_of_a_noisy_plane(rng, distance_m, limit_deg):
    normal = facing(20, 30)
    depth = plane_depth(VGA, normal, distance_m)
    depth += 0.0015 * depth**2 * rng.normal(size=depth.shape)
    depth[rng.random(depth.shape) < 0.03] = 0
    errors, share = errors_deg(runtime.to_host(images.normals(runtime.to_device(depth), VGA)), normal)
    assert np.median(errors) < limit_deg
    assert share > 0.94


def test_normals_do_not_reach_across_an_edge(rng):
    depth = plane_depth(VGA, facing(0), 1.0)
    depth[:, 320:] = plane_depth(VGA, facing(35), 2.0)[:, 320:]
    found = runtime.to_host(images.normals(runtime.to_device(depth), VGA))
    for half, normal in ((found[:, :320], facing(0)), (found[:, 320:], facing(35))):
        errors, share = errors_deg(half, normal)
        assert errors.max() < 0.5 and share > 0.98


def test_normals_without_depth_are_zero():
    assert not runtime.to_host(images.normals(runtime.zeros((480, 640)), VGA)).any()
    lone = runtime.zeros((480, 640))
    lone[100, 100] = 1.0
    assert not runtime.to_host(images.normals(lone, VGA)).any()


def surface_of(camera, depth):
    """[H, W, 4] of a depth image, with the fits that made it."""
    fits = images.PlaneFits(camera, 1, 0.0015)
    surface = runtime.zeros((camera.height, camera.width, alignment.SURFACE))
    fits.write(runtime.to_device(depth), surface)
    return fits, surface


@pytest.mark.parametrize(("measured", "least_cosine"), [(False, 0.98), (True, 0.8)])
def test_adopted_normals_match_the_twin(rng, measured, least_cosine):
    camera = Camera(45, 33, 40.0, 42.0, 21.0, 17.0)
    depth = plane_depth(camera, facing(25, 70), 1.2)
    depth[:, 30:] = plane_depth(camera, facing(40, 200), 2.0)[:, 30:]
    depth += 0.003 * np.sin(0.9 * np.arange(45)) + 0.012 * rng.normal(size=depth.shape).cumsum(1) / 7.0
    depth[rng.random(depth.shape) < 0.1] = 0
    planes = np.array([[*facing(25, 70), 1.2], [*facing(40, 200), 2.0], [*facing(27, 70), 1.215], [0, 0, 1, -1.5]])
    fits, surface = surface_of(camera, depth)
    before = runtime.to_host(surface).astype(float)
    fits.adopt(planes, surface, measured=measured)
    expected = reference.adopted_normals(before, planes, camera, 0.0015, least_cosine, 0.01, 1.5)
    found = runtime.to_host(surface)
    differ = np.linalg.norm(found[..., :3] - expected, axis=2) > 1e-5
    assert differ.mean() < 0.002  # a pixel at a threshold may fall on either side
    np.testing.assert_array_equal(found[..., 3], before[..., 3])
    for plane in planes[:3]:
        assert (np.abs(expected - plane[:3]).max(2) < 1e-9).any()
    kept = (np.abs(expected - before[..., :3]).max(2) < 1e-9) & before[..., :3].any(2)
    assert kept.any()


def test_of_two_near_planes_a_surface_adopts_the_one_it_is_on():
    """A board stands 1.5 cm before its wall."""
    depth = np.full((480, 640), 2.0)
    depth[300:] = 1.985
    fits, surface = surface_of(VGA, depth)
    wall, board = np.array([*facing(1.0), 2.0]), np.array([*facing(1.0, 90.0), 1.985])
    fits.adopt(np.array([wall, board]), surface)
    normals = runtime.to_host(surface)[235:245, 315:325, :3]
    np.testing.assert_allclose(normals, np.broadcast_to(wall[:3], normals.shape), atol=1e-6)
    below = np.abs(runtime.to_host(surface)[310:330, 315:325, :3] - board[:3]).max(2) < 1e-6
    assert below.all()


def test_what_is_measured_of_a_plane_feigns_hardly_any_information_along_it(rng):
    """Kinect-like noise turns its normals by 0.1 to 0.2 rad: those turned most must not be the ones that stay."""
    depth = 2.0 + 0.0015 * 4.0 * rng.normal(size=(240, 320))
    wall = np.array([[*facing(0.0), 2.0]])
    camera = Camera(320, 240, 262.0, 262.0, 159.5, 119.5)

    def feigned(measured):
        fits, surface = surface_of(camera, depth)
        fits.adopt(wall, surface, measured=measured)
        return float((runtime.to_host(surface)[..., 0] ** 2).mean())

    assert feigned(measured=True) < 1e-4
    assert feigned(measured=False) > 5.0 * feigned(measured=True)


def test_without_planes_and_on_none_of_them_normals_stay():
    fits, surface = surface_of(VGA, plane_depth(VGA, facing(30), 1.5))
    before = runtime.to_host(surface).copy()
    for planes in (np.zeros((0, 4)), np.array([[*facing(30), 1.7], [*facing(50), 1.5], [*-facing(30), -1.5]])):
        fits.adopt(planes, surface)
        np.testing.assert_array_equal(runtime.to_host(surface), before)


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
