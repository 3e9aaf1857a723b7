"""Gaussians that are too large for a keyframe: which they are, and their parts at the rim of the image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tgslam.camera import Camera
from tgslam.map.gaussians import GaussianMap
from tgslam.map.keyframes import Keyframe
from tgslam.mapping.coarse import halved, seen_in_part, seen_whole
from tgslam.mapping.surface import Surface
from tgslam.ops.rasterize import Rasterizer
from tgslam.types import Exposure, Frame, Gaussians

CAMERA = Camera(80, 60, 60.0, 60.0, 39.5, 29.5)
WALL_M = 0.6  # to the right of the camera, seen at a grazing angle
STEEPEST = 0.1
CELL_STDS = 1.0 / 0.6


def wall(spacing_m: float) -> Gaussians:
    """The wall x = WALL_M from 0.3 to 4 m ahead, of Gaussians that are long along it."""
    z, y = (a.ravel() for a in np.meshgrid(np.arange(0.3, 4.0, spacing_m), np.arange(-1.5, 1.5, 0.08), indexing="ij"))
    n = len(z)
    thin = np.tile(np.log([0.6 * spacing_m, 0.6 * 0.08, 0.002]), (n, 1))
    quat = np.tile([np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0], (n, 1))  # local x along z, local z along x
    none = np.full(n, -1, np.int32)
    return Gaussians(
        *(a.astype(np.float32) for a in (np.stack([np.full(n, WALL_M), y, z], -1), thin, quat, np.full(n, 3.0))),
        *(np.zeros((n, 3), np.float32), np.zeros((n, 3), np.float32), none, np.arange(n, dtype=np.int32)),
    )


def exact_depth_m() -> np.ndarray:
    """[H, W] of the wall, 0 where it is not seen."""
    x = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx
    row = np.where(x > WALL_M / 4.0, WALL_M / np.maximum(x, 1e-3), 0.0)
    return np.tile(row.astype(np.float32), (CAMERA.height, 1))


@pytest.fixture
def keyframe() -> Keyframe:
    colour = np.full((CAMERA.height, CAMERA.width, 3), 0.5, np.float32)
    frame = Frame(0, 0.0, colour, exact_depth_m())
    return Keyframe(frame, np.eye(4), Exposure(), np.eye(6))


def surface_of(gaussians: GaussianMap, keyframe: Keyframe) -> Surface:
    return Surface(keyframe.depth_m(), keyframe.T_cw, CAMERA, gaussians, 0.05)


def test_parts_tile_what_they_are_parts_of(keyframe: Keyframe) -> None:
    gaussians = GaussianMap.from_gaussians(wall(0.4))
    surface = surface_of(gaussians, keyframe)
    rows = np.flatnonzero(seen_in_part(gaussians, surface, STEEPEST))
    assert len(rows) > 5
    parts, of = halved(gaussians, rows, surface, STEEPEST, CELL_STDS)
    for row in rows:
        mine = np.flatnonzero(of == row)
        count = len(mine)
        assert count in (2, 4, 8, 16)
        parent = gaussians.rows(np.array([row]))
        assert_allclose(np.exp(parts.log_scale[mine]), np.exp(parent.log_scale) / [count, 1, 1] + np.zeros((count, 3)))
        along = np.sort(parts.mean[mine, 2] - parent.mean[0, 2])
        assert_allclose(along, 0.4 * ((np.arange(count) + 0.5) / count - 0.5), atol=1e-5)
        assert_allclose(parts.mean[mine, :2], np.tile(parent.mean[0, :2], (count, 1)), atol=1e-5)
        assert (parts.birth_keyframe[mine] == parent.birth_keyframe).all()
        steepness = np.exp(parts.log_scale[mine, 0]) / parent.mean[0, 2]
        assert steepness.max() <= STEEPEST or count == 16
        assert 2 * steepness.max() > STEEPEST


def test_a_wall_beside_the_camera_is_where_it_is_once_it_is_split(keyframe: Keyframe) -> None:
    gaussians = GaussianMap.from_gaussians(wall(0.4))
    surface = surface_of(gaussians, keyframe)
    part = seen_in_part(gaussians, surface, STEEPEST)
    parts, _ = halved(gaussians, np.flatnonzero(part), surface, STEEPEST, CELL_STDS)
    rasterizer, rim = Rasterizer(CAMERA), np.s_[15:45, 66:78]
    exact = keyframe.depth_m()[rim]
    errors_m = []
    before = rasterizer.render(gaussians, np.eye(4)).depth_m[rim]
    gaussians.keep(~part)
    gaussians.append(parts)
    after = rasterizer.render(gaussians, np.eye(4)).depth_m[rim]
    errors_m = [np.abs(depth_m - exact).max() for depth_m in (before, after)]
    assert errors_m[1] < 0.03
    assert errors_m[1] < 0.3 * errors_m[0]


def test_only_what_the_image_shows_and_nothing_hides_is_split(keyframe: Keyframe) -> None:
    seen = wall(0.4)
    behind = replace(seen, mean=seen.mean * np.float32(3.0))
    gaussians = GaussianMap.from_gaussians(behind)
    assert not seen_in_part(gaussians, surface_of(gaussians, keyframe), STEEPEST).any()
    gaussians = GaussianMap.from_gaussians(replace(seen, mean=seen.mean * np.float32([-1.0, 1.0, -1.0])))
    assert not seen_in_part(gaussians, surface_of(gaussians, keyframe), STEEPEST).any()
    gaussians = GaussianMap.from_gaussians(wall(0.02))
    assert not seen_in_part(gaussians, surface_of(gaussians, keyframe), STEEPEST).any()


def test_large_ones_are_replaced_only_well_inside_the_image(keyframe: Keyframe) -> None:
    gaussians = GaussianMap.from_gaussians(wall(0.4))
    surface = surface_of(gaussians, keyframe)
    whole = seen_whole(gaussians, surface, np.full((CAMERA.height, CAMERA.width), 2.0))
    assert whole.any()
    assert not seen_whole(gaussians, surface, np.full((CAMERA.height, CAMERA.width), 200.0)).any()
    std_px = surface.axes_px(gaussians, np.flatnonzero(whole)).max(axis=1)
    u, v = surface.exact_u[whole], surface.exact_v[whole]
    assert (np.minimum(np.minimum(u, 79 - u), np.minimum(v, 59 - v)) >= 2.0 * std_px).all()
    assert (std_px > 2.0).all()
