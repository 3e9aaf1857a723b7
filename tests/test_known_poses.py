"""Poses that the user knows: held as they are, or where tracking starts; and what the command makes of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.fakes import FakeSource, FakeSystem
from tgslam import pipeline
from tgslam.cli.inputs import groundtruth_to_compare, known_poses
from tgslam.cli.run import _with_poses
from tgslam.config.schema import Config
from tgslam.datasets.known_poses import KnownPoses
from tgslam.errors import ConfigError
from tgslam.geometry import is_motion, se3_exp
from tgslam.output.run_folder import RunFolder
from tgslam.types import Frame, FrameReport, Trajectory

ELSEWHERE = se3_exp([0.3, -0.2, 0.5, 4.0, -2.0, 1.0])


def test_what_is_a_motion() -> None:
    assert is_motion(ELSEWHERE) and is_motion(np.round(ELSEWHERE, 5))
    mirror, turned = np.diag([1.0, 1.0, -1.0, 1.0]), np.eye(4)
    turned[3, 0] = 1.0
    assert not any(map(is_motion, (mirror, turned, 1.01 * np.eye(4), np.full((4, 4), np.nan))))


# --- the command ---


def test_the_run_hands_each_frame_its_pose(tmp_path: Path) -> None:
    class Listening(FakeSystem):
        def process_frame(self, frame: Frame, T_wc: np.ndarray | None = None) -> FrameReport:
            given.append(T_wc)
            return super().process_frame(frame)

    given: list[np.ndarray | None] = []
    source = FakeSource(4)
    truth = source.groundtruth()
    known = KnownPoses(Trajectory(truth.timestamps_s[:3], truth.T_wc[:3]))
    pipeline.run(source, Listening(), RunFolder.create(tmp_path / "run", False), poses=known)
    np.testing.assert_array_equal(np.stack(given[:3]), truth.T_wc[:3])
    assert given[3] is None


def test_settings_and_options_say_the_same() -> None:
    config = Config()
    assert _with_poses(config, None, None) == config
    assert _with_poses(config, "poses.txt", None).poses == replace(config.poses, file="poses.txt", use="fixed")
    prior = replace(config, poses=replace(config.poses, file="a.txt", use="prior"))
    assert _with_poses(prior, "b.txt", None).poses == replace(prior.poses, file="b.txt")
    assert _with_poses(prior, None, "fixed").poses.use == "fixed"
    assert known_poses(config, FakeSource()) is None
    with pytest.raises(ConfigError, match="--poses FILE"):
        known_poses(_with_poses(config, None, "prior"), FakeSource())


def test_a_run_that_was_given_the_truth_is_not_compared_with_it(caplog: pytest.LogCaptureFixture) -> None:
    source, config = FakeSource(), Config()
    assert groundtruth_to_compare(config, source) is not None
    assert groundtruth_to_compare(_with_poses(config, "other.txt", None), source) is not None
    assert groundtruth_to_compare(_with_poses(config, "recording", None), source) is None
    assert "given the poses" in caplog.text
