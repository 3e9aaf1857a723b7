"""Normals from depth images against true planes and the float64 twin."""

import numpy as np
import pytest

from tests.reference import image as reference
from tgslam.camera import Camera, SensorNoise
from tgslam.device import runtime
from tgslam.kernels import alignment
from tgslam.ops.image import DEPTH_EDGE
from tgslam.ops.normals import PlaneFits, normals_of

VGA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
NOISE = SensorNoise(0.0015)


@pytest.fixture
def rng():
    return np.random.default_rng(11)


def plane_depth(camera, normal, distance_m):
    """Depth of the plane normal . p + distance = 0 in the camera frame."""
    return -distance_m / (camera.rays() @ normal)


def facing(angle_deg, towards_deg=0.0):
    """Unit normal towards the camera, tilted off the optical axis."""
    a, b = np.radians([angle_deg, towards_deg])
    return -np.array([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)])


def errors_deg(found, normal):
    """Angles of the valid normals to the true one, and the share of pixels that have one."""
    valid = np.linalg.norm(found, axis=2) > 0.5
    cosine = np.clip(found[valid].astype(float) @ normal, -1, 1)
    return np.degrees(np.arccos(cosine)), valid.mean()


def test_normals_match_the_twin(rng):
    camera = Camera(45, 33, 40.0, 42.0, 21.0, 17.0)
    depth = plane_depth(camera, facing(25, 70), 1.2)
    depth[:, 30:] = plane_depth(camera, facing(40, 200), 2.0)[:, 30:]
    depth += 0.0015 * depth**2 * rng.normal(size=depth.shape)
    depth[rng.random(depth.shape) < 0.1] = 0
    depth = depth.astype(np.float32)
    found = runtime.to_host(normals_of(runtime.to_device(depth), camera, NOISE, radius=2))
    expected = reference.normals(depth.astype(float), camera, 2, 0.0015, 1.3, DEPTH_EDGE)
    differ = np.linalg.norm(found - expected, axis=2) > 2e-3
    assert differ.mean() < 0.002  # a pixel at a threshold may fall on either side
    assert (np.linalg.norm(expected, axis=2) > 0.5).mean() > 0.7


@pytest.mark.parametrize("normal", [facing(0), facing(30, 45), facing(60, 180), np.array([0.0, -1.0, 0.05])])
def test_normals_of_exact_planes_are_exact(normal):
    normal = normal / np.linalg.norm(normal)
    camera = Camera(160, 121, 130.0, 131.0, 80.0, 10.0)
    depth = plane_depth(camera, normal, 1.5)
    depth[(depth < 0.2) | (depth > 6)] = 0
    found = runtime.to_host(normals_of(runtime.to_device(depth), camera, NOISE))
    errors, share = errors_deg(found, normal)
    assert errors.max() < 0.1
    assert share > 0.75 * (depth > 0).mean()


@pytest.mark.parametrize(("distance_m", "limit_deg"), [(1.0, 1.5), (2.0, 3.5), (3.0, 6.0)])
def test_normals_of_a_noisy_plane(rng, distance_m, limit_deg):
    normal = facing(20, 30)
    depth = plane_depth(VGA, normal, distance_m)
    depth += 0.0015 * depth**2 * rng.normal(size=depth.shape)
    depth[rng.random(depth.shape) < 0.03] = 0
    errors, share = errors_deg(runtime.to_host(normals_of(runtime.to_device(depth), VGA, NOISE)), normal)
    assert np.median(errors) < limit_deg
    assert share > 0.94


def test_normals_do_not_reach_across_an_edge(rng):
    depth = plane_depth(VGA, facing(0), 1.0)
    depth[:, 320:] = plane_depth(VGA, facing(35), 2.0)[:, 320:]
    found = runtime.to_host(normals_of(runtime.to_device(depth), VGA, NOISE))
    for half, normal in ((found[:, :320], facing(0)), (found[:, 320:], facing(35))):
        errors, share = errors_deg(half, normal)
        assert errors.max() < 0.5 and share > 0.98


def test_normals_without_depth_are_zero():
    assert not runtime.to_host(normals_of(runtime.zeros((480, 640)), VGA, NOISE)).any()
    lone = runtime.zeros((480, 640))
    lone[100, 100] = 1.0
    assert not runtime.to_host(normals_of(lone, VGA, NOISE)).any()


def surface_of(camera, depth):
    """[H, W, 4] of a depth image, with the fits that made it."""
    fits = PlaneFits(camera, 1, NOISE)
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


def test_the_radius_is_limited():
    for radius in (0, 4):
        with pytest.raises(ValueError, match="radius must be from 1 to 3 blocks"):
            PlaneFits(VGA, radius, NOISE)
