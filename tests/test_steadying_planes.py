"""Which planes lend their normals to a keyframe that frames are aligned to: those that leave a direction free."""

from __future__ import annotations

import numpy as np
import pytest

from tgslam.camera import Camera
from tgslam.config.plane_settings import PlanesConfig
from tgslam.geometry import inverse, se3_exp
from tgslam.map.keyframe import Keyframe
from tgslam.mapping.planar import PlanarMapping
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


def seen(depth_m: np.ndarray) -> tuple[PlanarMapping, Keyframe]:
    """The planes of a run's first keyframe, which stands somewhere in the world."""
    colour = np.full((*depth_m.shape, 3), 0.5, np.float32)
    keyframe = Keyframe.from_frame(Frame(0, 0.0, colour, depth_m), T_CW, Exposure(), np.eye(6))
    mapping = PlanarMapping(CAMERA, PlanesConfig(enabled=True), SIGMA_PER_M2)
    mapping.observe([keyframe])
    return mapping, keyframe


@pytest.mark.parametrize("planes", [(WALL,), (WALL, FLOOR)])
def test_planes_that_leave_a_direction_free_lend_their_normals(planes: tuple) -> None:
    mapping, keyframe = seen(depth_of(*planes))
    found = mapping.steadying(0, keyframe)
    assert len(found) == len(planes)
    for plane in planes:
        np.testing.assert_allclose(found[np.argmax(found[:, :3] @ plane[:3])], plane, atol=0.01)


def test_they_go_with_the_keyframe() -> None:
    mapping, keyframe = seen(depth_of(WALL, FLOOR))
    before = mapping.steadying(0, keyframe)
    keyframe.T_cw = T_CW @ inverse(se3_exp([0.1, 0.0, -0.2, 0.3, 0.1, 0.0]))
    mapping.follow([keyframe])
    np.testing.assert_allclose(mapping.steadying(0, keyframe), before, atol=1e-6)


def test_planes_that_hold_the_camera_lend_none() -> None:
    mapping, keyframe = seen(depth_of(WALL, FLOOR, SIDE))
    assert len(mapping.instances) == 3
    assert mapping.steadying(0, keyframe).shape == (0, 4)


def test_what_is_on_no_plane_may_hold_the_camera() -> None:
    depth_m = depth_of(WALL, FLOOR)
    depth_m[:, ::2][:, :40] -= np.float32(0.4)  # laths before half of the wall, a pixel wide
    mapping, keyframe = seen(depth_m)
    assert keyframe.plane_ids is not None and 0.2 < (keyframe.plane_ids < 0).mean() < 0.8
    assert mapping.steadying(0, keyframe).shape == (0, 4)


def test_without_any_plane_there_are_none() -> None:
    rough = np.random.default_rng(1).uniform(1.0, 3.0, (120, 160)).astype(np.float32)
    mapping, keyframe = seen(rough)
    assert not mapping.instances
    assert mapping.steadying(0, keyframe).shape == (0, 4)
