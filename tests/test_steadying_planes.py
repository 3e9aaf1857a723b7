"""Which planes lend their normals to a keyframe that frames are aligned to: those that leave a direction free."""

from __future__ import annotations

import numpy as np
import pytest

from tgslam.camera import Camera, SensorNoise
from tgslam.config.graph_settings import LoopConfig
from tgslam.config.plane_settings import PlanesConfig
from tgslam.geometry import se3_exp
from tgslam.map.keyframes import Keyframe
from tgslam.map.world import Map
from tgslam.mapping.plane_observation import PlaneObserver
from tgslam.tracking.steadying import steadying_planes
from tgslam.types import Exposure, Frame

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
SIGMA_PER_M2 = 0.0015
T_CW = se3_exp([0.2, -0.4, 0.1, 0.5, -0.3, 0.8])
WALL, FLOOR, SIDE = (0.0, 0.0, -1.0, 2.0), (0.0, -1.0, 0.0, 0.4), (-1.0, 0.0, 0.0, 0.6)  # in the camera's frame


def depth_of(*planes_c: tuple[float, float, float, float]) -> np.ndarray:
    """[H, W] m: the nearest of the planes, with the sensor's noise."""
    rng = np.random.default_rng(0)
    with np.errstate(divide="ignore"):
        z = np.stack([-plane[3] / (CAMERA.rays() @ plane[:3]) for plane in planes_c])
    nearest = np.where(z > 0, z, np.inf).min(0)
    return (nearest * (1.0 + SIGMA_PER_M2 * nearest * rng.normal(size=nearest.shape))).astype(np.float32)


def seen(depth_m: np.ndarray) -> Map:
    """A map with the planes of its first keyframe, which stands somewhere in the world."""
    colour, config = np.full((*depth_m.shape, 3), 0.5, np.float32), PlanesConfig(enabled=True)
    world = Map(CAMERA, SensorNoise(SIGMA_PER_M2), LoopConfig(), config)
    world.keyframes.add(Keyframe(Frame(0, 0.0, colour, depth_m), T_CW, Exposure(), np.eye(6)))
    PlaneObserver(CAMERA, config, world.noise).observe(world)
    return world


@pytest.mark.parametrize("planes", [(WALL,), (WALL, FLOOR)])
def test_planes_that_leave_a_direction_free_lend_their_normals(planes: tuple) -> None:
    found = steadying_planes(seen(depth_of(*planes)), 0)
    assert len(found) == len(planes)
    for plane in planes:
        np.testing.assert_allclose(found[np.argmax(found[:, :3] @ plane[:3])], plane, atol=0.01)


def test_they_go_with_the_keyframe() -> None:
    world = seen(depth_of(WALL, FLOOR))
    before = steadying_planes(world, 0)
    world.move({0: se3_exp([0.1, 0.0, -0.2, 0.3, 0.1, 0.0])})
    assert not np.allclose(world.keyframes[0].T_cw, T_CW, atol=0.01)
    np.testing.assert_allclose(steadying_planes(world, 0), before, atol=1e-6)


def test_planes_that_hold_the_camera_lend_none() -> None:
    world = seen(depth_of(WALL, FLOOR, SIDE))
    assert world.planes is not None and len(world.planes.instances) == 3
    assert steadying_planes(world, 0).shape == (0, 4)


def test_what_is_on_no_plane_may_hold_the_camera() -> None:
    depth_m = depth_of(WALL, FLOOR)
    depth_m[:, ::2][:, :40] -= np.float32(0.4)  # laths before half of the wall, a pixel wide
    world = seen(depth_m)
    labels = world.keyframes[0].labels
    assert labels is not None and 0.2 < (labels.image() < 0).mean() < 0.8
    assert steadying_planes(world, 0).shape == (0, 4)


def test_without_any_plane_there_are_none() -> None:
    rough = np.random.default_rng(1).uniform(1.0, 3.0, (120, 160)).astype(np.float32)
    world = seen(rough)
    assert world.planes is not None and not world.planes.instances
    assert steadying_planes(world, 0).shape == (0, 4)
