"""Poses that the user knows: held as they are, or where tracking starts; and what the command makes of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.fakes import FakeSource, FakeSystem
from tgslam import pipeline
from tgslam.adaptation import Slam
from tgslam.cli.inputs import groundtruth_to_compare, known_poses
from tgslam.cli.run import _with_poses
from tgslam.config.input_settings import SyntheticConfig
from tgslam.config.loader import load
from tgslam.config.schema import Config
from tgslam.datasets.built_in import SyntheticSource
from tgslam.datasets.known_poses import KnownPoses
from tgslam.errors import ConfigError, FrameError
from tgslam.evaluation.trajectory import ate
from tgslam.geometry import is_motion, se3_exp
from tgslam.output.run_folder import RunFolder
from tgslam.types import Frame, FrameReport, FrameStatus, Trajectory

FEW_STEPS = ("mapping.iterations=2", "mapping.final_iterations=2", "tracking.alignment_steps=[4, 6]")
SCENE = SyntheticSource(SyntheticConfig(frames=720, width=64, height=48), seed=0)
NUMBERS = (0, 12, 24, 36)
ELSEWHERE = se3_exp([0.3, -0.2, 0.5, 4.0, -2.0, 1.0])  # another world than that of the first camera


def settings(*more: str) -> Config:
    return load(None, [*FEW_STEPS, "planes.enabled=false", *more])


def poses(noise_m: float = 0.0) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [ELSEWHERE @ SCENE.pose(k) @ se3_exp([0, 0, 0, *(noise_m * rng.normal(size=3))]) for k in NUMBERS]


def played(config: Config, known: list[np.ndarray | None]) -> tuple[Slam, list[FrameStatus]]:
    slam = Slam(SCENE.camera, config)
    reports = [slam.process_frame(SCENE.read(k), T_wc) for k, T_wc in zip(NUMBERS, known, strict=True)]
    return slam, [report.status for report in reports]


def test_fixed_poses_stay_as_they_are_and_the_map_is_in_their_world() -> None:
    given = poses()
    slam, statuses = played(settings("poses.use=fixed", "keyframes.max_translation=0"), given)
    np.testing.assert_allclose(slam.trajectory().T_wc, given, atol=1e-9)
    assert statuses == [FrameStatus.INITIAL] + [FrameStatus.TRACKED] * 3
    assert len(slam.keyframe_indices()) == 4
    slam.finish()
    np.testing.assert_allclose(slam.keyframe_trajectory().T_wc, given, atol=1e-9)
    away = (slam.gaussians().mean.astype(float) - ELSEWHERE[:3, 3]) @ ELSEWHERE[:3, :3]  # in the room
    assert np.quantile(SCENE.surface_distance_m(away), 0.9) < 0.05


def test_a_prior_is_where_tracking_starts_and_no_more_than_its_deviations_say() -> None:
    given = poses(noise_m=0.02)
    slam, statuses = played(settings("poses.use=prior", "poses.sigma_m=0.02"), given)
    assert FrameStatus.LOST not in statuses
    truth = Trajectory(np.array(NUMBERS) / 30.0, np.stack([SCENE.pose(k) for k in NUMBERS]))
    raw = Trajectory(truth.timestamps_s, np.stack(given))
    assert ate(slam.trajectory(), truth, 0.001).rmse_m < 0.5 * ate(raw, truth, 0.001).rmse_m
    np.testing.assert_allclose(slam.trajectory().T_wc[0], given[0], atol=1e-12)


def test_what_is_needed_and_not_known_is_an_error_of_that_frame() -> None:
    fixed, frame = Slam(SCENE.camera, settings("poses.use=fixed")), SCENE.read(0)
    for config, T_wc, message in (
        (settings("poses.use=fixed"), None, "pose is not known, which poses.use=fixed needs"),
        (settings("poses.use=prior"), None, "pose is not known"),
        (settings(), np.eye(4), "poses.use is none"),
        (settings("poses.use=fixed"), 2.0 * np.eye(4), "no rigid motion"),
    ):
        with pytest.raises(FrameError, match=message):
            Slam(SCENE.camera, config).process_frame(frame, T_wc)
    assert len(fixed.trajectory()) == 0


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
