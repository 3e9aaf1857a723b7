"""What may happen in a built-in scene: true poses, times, colours and depth of it."""

from __future__ import annotations

import numpy as np
import pytest

from tgslam.config.input_settings import SyntheticConfig
from tgslam.datasets.built_in import SyntheticSource

FRAMES = 120


def source(event: str, scene: str = "room") -> SyntheticSource:
    config = SyntheticConfig(scene=scene, frames=FRAMES, width=48, height=36, noise=False, event=event)
    return SyntheticSource(config, seed=0)


@pytest.fixture(scope="module")
def plain() -> SyntheticSource:
    return source("none")


@pytest.mark.parametrize("event", ["exposure_step", "white_balance"])
def test_frames_are_as_bright_as_their_true_gains(event, plain):
    altered = source(event)
    gains = np.array([altered.gain(k) for k in range(FRAMES)])
    assert (gains[0] == 1.0).all() and len(np.unique(gains, axis=0)) == (3 if event == "exposure_step" else 2)
    for k in (10, 60, 110):
        expected = np.clip(plain.read(k).colour * gains[k], 0.0, 1.0)
        np.testing.assert_allclose(altered.read(k).colour, expected, atol=1e-6)
        np.testing.assert_array_equal(altered.pose(k), plain.pose(k))


def test_a_hand_covers_the_lens_for_a_second(plain):
    covered = source("cover")
    dark = [k for k in range(FRAMES) if covered.read(k).colour.max() < 0.1]
    assert len(dark) == pytest.approx(30, abs=1) and abs(dark[0] + dark[-1] - FRAMES) <= 1
    np.testing.assert_array_equal(covered.read(20).depth_m, plain.read(20).depth_m)
    assert (covered.read(60).depth_m < 0.5).all()


def test_a_gap_is_in_the_times_and_the_way(plain):
    gap = source("gap")
    truth = gap.groundtruth()
    steps_s = np.diff(truth.timestamps_s)
    assert steps_s.max() == pytest.approx(1.0 + 1.0 / 30.0) and np.argmax(steps_s) == FRAMES // 2 - 1
    assert gap.read(80).timestamp_s == truth.timestamps_s[80]
    np.testing.assert_allclose(truth.T_wc[80], plain.pose(80 + 30), atol=1e-9)


def test_a_carried_camera_sees_what_it_has_seen_or_not():
    known, unknown = source("kidnap_known"), source("kidnap_unknown")
    jump_m = known.pose(80)[:3, 3] - known.pose(0)[:3, 3]
    assert 0.05 < np.linalg.norm(jump_m) < 0.2
    ahead = [unknown.pose(k)[:3, 2] for k in range(FRAMES)]
    before, after = np.array(ahead[:39]), np.array(ahead[40:72])
    assert (before @ after.T).max() < np.cos(np.deg2rad(75.0))  # the view is 70 degrees wide
    assert (before @ ahead[-1]).max() > np.cos(np.deg2rad(10.0))


def test_a_box_crosses_the_view_and_is_on_no_plane(plain):
    box = source("moving_box")
    for k in (0, 60, 119):
        nearer = box.read(k).depth_m < plain.read(k).depth_m - 0.1
        assert nearer.any() == (k == 60)
        assert (box.labels(k)[nearer] == -1).all()
        assert (box.labels(k)[~nearer] == plain.labels(k)[~nearer]).mean() > 0.99
