"""The owner of keyframes: poses that move, images decoded and derived once, labels that know when they change."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tgslam.camera import Camera, SensorNoise
from tgslam.geometry import inverse, se3_exp
from tgslam.map import keyframes as module
from tgslam.map.frame_poses import FramePoses
from tgslam.map.keyframes import Keyframe, Keyframes
from tgslam.map.plane_labels import PlaneLabels
from tgslam.types import Exposure, Frame

CAMERA, NOISE = Camera(32, 24, 30.0, 30.0, 15.5, 11.5), SensorNoise(0.0015)


def keyframe(index: int) -> Keyframe:
    rng = np.random.default_rng(index)
    colour = rng.random((*CAMERA.shape, 3)).astype(np.float32)
    depth_m = (2.0 + 0.01 * rng.random(CAMERA.shape)).astype(np.float32)
    depth_m[8:12, 10:20] = 0.0
    return Keyframe(
        Frame(index, 0.1 * index, colour, depth_m), se3_exp(0.1 * rng.normal(size=6)), Exposure(), np.eye(6)
    )


def some(count: int) -> Keyframes:
    result = Keyframes(CAMERA, NOISE)
    for index in range(count):
        assert result.add(keyframe(index)) == index
    return result


def test_moved_keyframes_carry_what_they_see() -> None:
    """A point that a keyframe sees at x_c lies at motion p_w afterwards."""
    keyframes, motion = some(3), se3_exp([0.1, 0.2, -0.1, 0.5, -0.3, 0.2])
    before, version = keyframes.T_cw(), keyframes.version
    keyframes.move({1: motion})
    np.testing.assert_allclose(keyframes[1].T_cw, before[1] @ inverse(motion), atol=1e-12)
    np.testing.assert_array_equal(keyframes.T_cw()[[0, 2]], before[[0, 2]])
    for number in range(3):
        np.testing.assert_allclose(keyframes.T_wc[number], inverse(keyframes[number].T_cw), atol=1e-15)
    assert keyframes.version > version


def test_poses_stay_rigid_however_often_they_move() -> None:
    keyframes = some(1)
    for step in range(200):
        keyframes.move({0: se3_exp(np.random.default_rng(step).normal(size=6))})
    R = keyframes[0].T_cw[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)


def test_the_latest_images_are_derived_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    for name in ("filled", "normals_of"):
        original = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *a, name=name, f=original: calls.append(name) or f(*a))
    keyframes = some(2)
    for _ in range(3):
        images = keyframes.latest_images
        assert images.guess.depth_m.all() and images.normals.shape == images.guessed_normals.shape
        assert images.depth_m is keyframes[1].depth_m() and images.colour is keyframes[1].colour()
    assert sorted(calls) == ["filled", "normals_of", "normals_of"]
    keyframes.add(keyframe(2))
    assert keyframes.latest_images is not images


def test_old_keyframes_keep_nothing_decoded() -> None:
    keyframes = some(5)
    assert [keyframes[k].depth_m() is keyframes[k].depth_m() for k in range(5)] == [False] * 3 + [True] * 2
    np.testing.assert_array_equal(keyframes[0].colour(), keyframe(0).colour())


@given(st.lists(st.integers(-1, 400), min_size=1, max_size=600))
def test_labels_come_back_and_count(ids: list[int]) -> None:
    image = np.array(ids, np.int64)[None]
    labels = PlaneLabels.of(image)
    np.testing.assert_array_equal(labels.image(), image)
    assert labels.image().dtype == np.int32
    assert labels.places.dtype == (np.uint8 if len(set(ids)) <= 256 else np.uint16)
    for plane_id in {*ids, 401}:
        assert labels.pixels(plane_id) == ids.count(plane_id)


def test_labels_have_a_version_that_grows_with_changes_only() -> None:
    one = keyframe(0)
    assert one.labels is None
    shown = np.full(CAMERA.shape, -1)
    one.show(shown)
    version = one.label_version
    one.show(shown.copy())
    assert one.label_version == version
    shown[3, 4] = 70_000
    one.show(shown)
    assert one.label_version == version + 1
    assert one.labels is not None and one.labels.pixels(70_000) == 1


def test_frames_follow_their_keyframes_and_only_new_poses_are_computed() -> None:
    keyframes = some(1)
    poses, expected = FramePoses(keyframes), []
    for index in range(600):  # beyond the first capacity
        if index % 150 == 149:
            keyframes.add(keyframe(index))
            poses.add(float(index))
        else:
            poses.add(float(index), se3_exp([0.0, 0.0, 0.0, 0.01 * index, 0.0, 0.0]) @ keyframes[-1].T_cw)
        expected.append(inverse(poses.latest_T_cw()))
        assert len(poses.trajectory()) == index + 1
    found = poses.trajectory()
    np.testing.assert_allclose(found.T_wc, expected, atol=1e-12)
    assert found.timestamps_s.tolist() == list(range(600))
    found.T_wc[:] = 0.0  # a copy
    motion = se3_exp([0.3, 0.0, 0.1, 1.0, 2.0, 3.0])
    keyframes.move(dict.fromkeys(range(len(keyframes)), motion))
    np.testing.assert_allclose(poses.trajectory().T_wc, motion @ np.stack(expected), atol=1e-9)
    np.testing.assert_allclose(poses.latest_T_cw(), inverse(motion @ expected[-1]), atol=1e-9)
