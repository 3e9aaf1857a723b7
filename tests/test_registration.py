"""Depth of a camera of its own, brought to the colour camera: occlusion, holes, sizes, and what settings say of it."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.reference import registration as reference
from tgslam.camera import Camera
from tgslam.config.input_settings import DatasetConfig, DepthCameraConfig, SyntheticConfig
from tgslam.config.loader import load
from tgslam.datasets import open_source
from tgslam.datasets.calibration import Calibration
from tgslam.datasets.depth_camera import configured_depth_camera, motion_of, rays_of
from tgslam.datasets.source import FrameRange, uses_kernels
from tgslam.errors import ConfigError, DatasetError
from tgslam.geometry import inverse, quat_wxyz_from_matrix, se3_exp
from tgslam.ops.registration import Registration

SETTINGS = (0.0015, 4.2)
DEPTH = Camera(48, 36, 40.0, 41.0, 23.0, 18.0)
COLOUR = Camera(60, 40, 55.0, 54.0, 30.0, 19.0)
T_CD = se3_exp([0.02, -0.03, 0.01, 0.06, 0.02, -0.01])
PLANE = np.array([0.2, -0.1, 1.0, -2.5])  # n . x + d = 0, depth camera
BOX_M = 1.2


def registered(
    depth_m: np.ndarray, T_cd: np.ndarray = T_CD, depth: Camera = DEPTH, colour: Camera = COLOUR
) -> np.ndarray:
    return Registration(depth.rays()[..., :2], T_cd, colour)(depth_m.astype(np.float32))


def plane_depth(camera: Camera, plane: np.ndarray = PLANE) -> np.ndarray:
    """[H, W] exact depth of a plane of that camera's frame."""
    return -plane[3] / (camera.rays() @ plane[:3])


def as_seen(plane: np.ndarray, T_cd: np.ndarray) -> np.ndarray:
    """A plane of the depth camera's frame in the colour camera's."""
    return plane @ inverse(T_cd)


def ragged(camera: Camera, seed: int) -> np.ndarray:
    """A slanted wall, a box and a thin pole before it, noise and holes."""
    rng = np.random.default_rng(seed)
    depth_m = plane_depth(camera)
    depth_m[8:20, 10:25] = BOX_M
    depth_m[:, 33] = 1.7
    depth_m += 0.0015 * depth_m**2 * rng.normal(size=depth_m.shape)
    depth_m[rng.random(depth_m.shape) < 0.1] = 0.0
    return depth_m.astype(np.float32)


@pytest.mark.parametrize("colour", [COLOUR, Camera(25, 31, 22.0, 23.0, 11.0, 15.0), Camera(96, 72, 80, 82, 46.5, 36.5)])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_kernel_matches_the_twin(colour: Camera, seed: int) -> None:
    depth_m, rays = ragged(DEPTH, seed), DEPTH.rays()[..., :2]
    slope = 5.7 / DEPTH.fx
    expected = reference.register(
        depth_m.astype(float), rays, T_CD[:3], colour.intrinsics, colour.shape, *SETTINGS, slope
    )
    found = registered(depth_m, colour=colour)
    assert ((found > 0) != (expected > 0)).mean() < 2e-3  # float32 may put a pixel on the other side of a rim
    both = (found > 0) & (expected > 0)
    assert both.mean() > 0.3
    assert (np.abs(found - expected)[both] > 1e-4).mean() < 2e-3
    np.testing.assert_array_equal(registered(depth_m, colour=colour), found)  # whatever threads do


@pytest.mark.parametrize("scale", [1, 2, 5])
def test_a_plane_is_where_it_is_without_holes_at_any_size(scale: int) -> None:
    colour = Camera(60 * scale, 40 * scale, 55.0 * scale, 54.0 * scale, 30.0 * scale, 19.0 * scale)
    found = registered(plane_depth(DEPTH), colour=colour)
    truth = plane_depth(colour, as_seen(PLANE, T_CD))
    seen = found > 0
    np.testing.assert_allclose(found[seen], truth[seen], rtol=0.006)  # rims lie up to half a depth pixel off
    inner = cv2.erode(cv2.morphologyEx(seen.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((15, 15))), np.ones((7, 7))) > 0
    assert seen[inner].all() and inner.mean() > 0.3
    np.testing.assert_allclose(found[inner], truth[inner], rtol=1e-5)


def test_the_nearest_wins_and_nothing_is_made_up_behind_it() -> None:
    depth_m = np.full((36, 48), 3.0)
    depth_m[10:26, 16:32] = BOX_M
    shifted = np.eye(4)
    shifted[0, 3] = -0.1  # the colour camera stands 10 cm to the right: by 3.3 px at the box and 1.3 px at the wall
    found = registered(depth_m, shifted, DEPTH, DEPTH)
    row, off_box, off_wall = found[18], 0.1 * 40.0 / BOX_M, 0.1 * 40.0 / 3.0
    assert not ((found > 0) & (np.abs(found - BOX_M) > 1e-5) & (np.abs(found - 3.0) > 1e-5)).any()
    box = np.flatnonzero(np.abs(row - BOX_M) < 1e-5)
    assert box[0] == round(16 - off_box) and box[-1] == round(31 - off_box)
    assert (np.diff(box) == 1).all()  # the wall behind does not show through
    shadow = np.flatnonzero(row == 0)
    shadow = shadow[shadow < 45]
    assert shadow[0] == box[-1] + 1 and shadow[-1] == round(32 - off_wall) - 1


def test_a_single_measurement_stays_one_pixel_and_is_seen_before_a_wall() -> None:
    depth_m = np.full((36, 48), 3.0)
    depth_m[12, 20] = 1.0
    found = registered(depth_m, np.eye(4), DEPTH, DEPTH)
    assert np.argwhere(np.abs(found - 1.0) < 1e-5).tolist() == [[12, 20]]
    alone = np.zeros((36, 48))
    alone[12, 20] = 1.0
    big = Camera(480, 360, 400.0, 410.0, 234.5, 184.5)
    assert np.count_nonzero(registered(alone, np.eye(4), DEPTH, big)) == 1


def test_a_surface_is_not_seen_from_behind() -> None:
    turned, wide = se3_exp([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]), Camera(192, 144, 160.0, 164.0, 95.5, 71.5)
    wall = np.full((36, 48), 2.0)
    assert not registered(wall, turned, DEPTH, wide).any()  # it looks away
    assert (registered(wall, np.eye(4), DEPTH, wide) > 0).mean() > 0.9
    turned[2, 3] = 4.0  # it stands behind the wall and looks back: measurements alone show, as far apart as they are
    found = registered(wall, turned, DEPTH, wide)
    assert 0 < np.count_nonzero(found) <= wall.size < 0.1 * found.size


# --- what settings say ---


def test_rays_of_a_lens_are_where_opencv_projects_them() -> None:
    lens = (0.2, -0.3, 0.002, 0.003, 0.05)
    calibration = Calibration(40.0, 41.0, 23.0, 18.0, lens)
    rays = rays_of(calibration, 48, 36)
    points = np.concatenate([rays, np.ones((36, 48, 1))], -1).reshape(-1, 3)
    seen = cv2.projectPoints(points, np.zeros(3), np.zeros(3), calibration.matrix, np.array(lens))[0]
    v, u = np.mgrid[:36, :48]
    np.testing.assert_allclose(seen.reshape(36, 48, 2), np.stack([u, v], -1), atol=0.02)
    assert np.abs(rays - DEPTH.rays()[..., :2]).max() > 0.01


def test_the_motion_is_given_as_numbers_or_as_a_matrix() -> None:
    x, y, z, w = np.roll(quat_wxyz_from_matrix(T_CD[:3, :3]), -1)
    for values in ((*T_CD[:3, 3], x, y, z, w), T_CD[:3].ravel(), T_CD.ravel()):
        np.testing.assert_allclose(motion_of(tuple(float(value) for value in values)), T_CD, atol=1e-12)
    np.testing.assert_array_equal(motion_of(()), np.eye(4))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"intrinsics": (40.0, 41.0)}, "must be fx, fy, cx, cy"),
        ({"intrinsics": (40.0, 41.0, 320.0, 18.0)}, "another size"),
        ({"lens": (0.1,)}, "OpenCV's models"),
        ({"size": (640, 480)}, "for images of 640x480, but depth images are 48x36"),
        ({"T_colour_depth": (1.0, 2.0)}, "has 2 values"),
        ({"T_colour_depth": (25.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)}, "millimetres"),
        ({"T_colour_depth": (2.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)}, "no mirror"),
    ],
)
def test_a_depth_camera_that_cannot_be(changes: dict, message: str) -> None:
    config = replace(DepthCameraConfig(intrinsics=(40.0, 41.0, 23.0, 18.0)), **changes)
    with pytest.raises(ConfigError, match=message):
        configured_depth_camera(config, (48, 36))


def write(folder: Path, depth_m: np.ndarray, colour: Camera) -> Path:
    """Two frames of the same."""
    for kind, image in (("rgb", np.full((*colour.shape, 3), 90, np.uint8)), ("depth", np.rint(depth_m * 5000))):
        (folder / kind).mkdir()
        for k in range(2):
            pixels = image.astype(np.uint8 if kind == "rgb" else np.uint16)
            (folder / kind / f"{k}.png").write_bytes(cv2.imencode(".png", pixels)[1].tobytes())
        (folder / f"{kind}.txt").write_text("".join(f"{k} {kind}/{k}.png\n" for k in range(2)))
    return folder


def opened(folder: Path, *settings: str):
    camera = [f"dataset.{key}={getattr(COLOUR, key)}" for key in ("fx", "fy", "cx", "cy")]
    config = load(None, ["dataset.format=tum", *camera, *settings])
    return open_source(config.dataset, SyntheticConfig(), 0, folder)


def test_a_recording_with_a_depth_camera_of_its_own(tmp_path: Path) -> None:
    write(tmp_path, plane_depth(DEPTH), COLOUR)
    numbers = ", ".join(map(repr, T_CD.ravel().tolist()))
    source = opened(
        tmp_path,
        "dataset.depth_camera.intrinsics=40, 41, 23, 18",
        f"dataset.depth_camera.T_colour_depth={numbers}",
    )
    depth_m = source.read(1).depth_m
    assert depth_m.shape == COLOUR.shape and (depth_m > 0).mean() > 0.5
    truth = plane_depth(COLOUR, as_seen(PLANE, T_CD))
    np.testing.assert_allclose(depth_m[depth_m > 0], truth[depth_m > 0], rtol=0.006)
    assert uses_kernels(source) and uses_kernels(FrameRange(source, 1))


def test_depth_of_another_resolution_shows_the_same_view(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, logger="tgslam")
    half = Camera(30, 20, 27.5, 27.0, 14.75, 9.25)  # what COLOUR is in blocks of 2x2
    source = opened(write(tmp_path, plane_depth(half), COLOUR))
    depth_m = source.read(0).depth_m
    assert "depth is 30x20, and is brought to colour's size" in caplog.text
    assert (depth_m[1:-1, 1:-1] > 0).all()
    np.testing.assert_allclose(depth_m[1:-1, 1:-1], plane_depth(COLOUR)[1:-1, 1:-1], rtol=0.01)
    assert not uses_kernels(FrameRange(opened(write_registered(tmp_path / "registered")), 1))


def write_registered(folder: Path) -> Path:
    folder.mkdir()
    return write(folder, plane_depth(COLOUR), COLOUR)


def test_depth_of_another_shape_needs_a_camera(tmp_path: Path) -> None:
    write(tmp_path, plane_depth(DEPTH), COLOUR)
    with pytest.raises(DatasetError, match=r"48x36, colour images 60x40.*dataset\.depth_camera"):
        opened(tmp_path)
    config = replace(DatasetConfig(format="tum", fx=55.0, fy=-54.0, cx=30.0, cy=19.0))
    flipped = replace(config, depth_camera=DepthCameraConfig(intrinsics=(40.0, 41.0, 23.0, 18.0)))
    with pytest.raises(ConfigError, match=r"negative dataset\.fy"):
        open_source(flipped, SyntheticConfig(), 0, tmp_path)
