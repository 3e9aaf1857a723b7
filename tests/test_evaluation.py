"""Metrics against independent implementations: evo for trajectories, a plain loop for SSIM."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tgslam.config.input_settings import DatasetConfig, SyntheticConfig
from tgslam.datasets import open_source
from tgslam.errors import EvaluationError
from tgslam.evaluation import image_metrics as images
from tgslam.evaluation.trajectory import align_se3, associate, ate, rpe
from tgslam.geometry import inverse, se3_exp, transform_points
from tgslam.types import Frame, Rendering, Trajectory

TOLERANCE_S = 0.02


def random_walk(count: int, seed: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = [se3_exp(rng.normal(size=6))]
    for _ in range(count - 1):
        poses.append(poses[-1] @ se3_exp(rng.normal(size=6) * 0.05))
    return Trajectory(100.0 + np.arange(count) / 30, np.stack(poses))


def perturbed(trajectory: Trajectory, seed: int, scale: float = 0.02) -> Trajectory:
    """Noise on every pose, and another world frame."""
    rng = np.random.default_rng(seed)
    T_other = se3_exp(rng.normal(size=6))
    poses = np.stack([T_other @ T @ se3_exp(rng.normal(size=6) * scale) for T in trajectory.T_wc])
    return Trajectory(trajectory.timestamps_s + rng.uniform(-0.004, 0.004, len(trajectory)), poses)


def evo_scores(estimate: Trajectory, truth: Trajectory, delta: int) -> dict[str, float]:
    metrics = pytest.importorskip("evo.core.metrics")
    from evo.core.trajectory import PoseTrajectory3D

    first, second = (PoseTrajectory3D(poses_se3=list(t.T_wc), timestamps=t.timestamps_s) for t in (estimate, truth))
    relation = metrics.PoseRelation
    scores = {}
    for name, kind in (("trans", relation.translation_part), ("rot", relation.rotation_angle_deg)):
        metric = metrics.RPE(kind, delta=delta, delta_unit=metrics.Unit.frames, all_pairs=True)
        metric.process_data((second, first))
        scores[name] = metric.get_statistic(metrics.StatisticsType.rmse)
    first.align(second, correct_scale=False)
    metric = metrics.APE(relation.translation_part)
    metric.process_data((second, first))
    return scores | metric.get_all_statistics()


def assert_agrees_with_evo(estimate: Trajectory, truth: Trajectory) -> None:
    matched, reference = associate(estimate, truth, TOLERANCE_S)
    for delta in (1, 7):
        theirs = evo_scores(matched, reference, delta)
        ours, drift = ate(estimate, truth, TOLERANCE_S), rpe(estimate, truth, TOLERANCE_S, delta)
        assert ours.rmse_m == pytest.approx(theirs["rmse"], abs=1e-6)
        assert ours.mean_m == pytest.approx(theirs["mean"], abs=1e-6)
        assert ours.median_m == pytest.approx(theirs["median"], abs=1e-6)
        assert ours.max_m == pytest.approx(theirs["max"], abs=1e-6)
        assert drift.trans_rmse_m == pytest.approx(theirs["trans"], abs=1e-6)
        assert drift.rot_rmse_deg == pytest.approx(theirs["rot"], abs=1e-6)
        assert ours.matched == len(matched) and drift.pairs == len(matched) - delta


@pytest.mark.parametrize("seed", range(4))
def test_random_trajectories_score_as_in_evo(seed: int) -> None:
    truth = random_walk(60, seed)
    assert_agrees_with_evo(perturbed(truth, seed + 10), truth)


def test_unrelated_trajectories_score_as_in_evo() -> None:
    assert_agrees_with_evo(random_walk(40, 1), random_walk(40, 2))


def test_perturbed_tum_groundtruth_scores_as_in_evo(tum_clip: Path) -> None:
    truth = open_source(DatasetConfig(format="tum"), SyntheticConfig(), 0, tum_clip).groundtruth()
    assert truth is not None
    part = Trajectory(truth.timestamps_s[::5], truth.T_wc[::5])
    assert_agrees_with_evo(perturbed(part, 5), truth)


def test_icl_files_match_by_image_number_in_evo(icl_clip: Path, tmp_path: Path) -> None:
    """A trajectory in the first camera's frame aligns with the published file as it is."""
    sync = pytest.importorskip("evo.core.sync")
    from evo.tools.file_interface import read_tum_trajectory_file

    from tgslam.output.trajectory_io import write_trajectory

    truth = open_source(DatasetConfig(format="icl"), SyntheticConfig(), 0, icl_clip).groundtruth()
    assert truth is not None
    estimate = Trajectory(truth.timestamps_s, inverse(truth.T_wc[0]) @ truth.T_wc)
    write_trajectory(tmp_path / "trajectory.txt", estimate)
    published = read_tum_trajectory_file(str(icl_clip / "groundtruth.txt"))
    ours = read_tum_trajectory_file(str(tmp_path / "trajectory.txt"))
    reference, matched = sync.associate_trajectories(published, ours)
    matched.align(reference)
    assert matched.num_poses == 100
    assert np.abs(matched.positions_xyz - reference.positions_xyz).max() < 1e-5
    assert ate(estimate, truth, TOLERANCE_S).rmse_m < 1e-9


@settings(max_examples=30)
@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6), st.integers(0, 1000))
def test_ate_does_not_depend_on_the_estimates_world(xi: list[float], seed: int) -> None:
    truth = random_walk(15, seed)
    estimate = perturbed(truth, seed + 1)
    moved = Trajectory(estimate.timestamps_s, se3_exp(xi) @ estimate.T_wc)
    before, after = ate(estimate, truth, TOLERANCE_S), ate(moved, truth, TOLERANCE_S)
    assert after.rmse_m == pytest.approx(before.rmse_m, abs=1e-9)
    np.testing.assert_allclose(after.T_alignment @ se3_exp(xi), before.T_alignment, atol=1e-6)


def test_ate_of_a_known_error() -> None:
    truth = Trajectory(np.arange(4.0), np.tile(np.eye(4), (4, 1, 1)))
    truth.T_wc[:, :2, 3] = [[1, 1], [1, -1], [-1, -1], [-1, 1]]
    estimate = Trajectory(np.arange(4.0), truth.T_wc.copy())
    estimate.T_wc[:, 2, 3] = [0.1, -0.1, 0.1, -0.1]
    result = ate(estimate, truth, 0.0)
    assert result.rmse_m == pytest.approx(0.1) and result.max_m == pytest.approx(0.1) and result.matched == 4
    np.testing.assert_allclose(result.T_alignment, np.eye(4), atol=1e-9)


def test_a_mirrored_trajectory_is_not_aligned_by_a_reflection() -> None:
    truth = random_walk(40, 3)
    mirrored = Trajectory(truth.timestamps_s, truth.T_wc.copy())
    mirrored.T_wc[:, 0, 3] *= -1
    result = ate(mirrored, truth, TOLERANCE_S)
    assert np.linalg.det(result.T_alignment[:3, :3]) == pytest.approx(1.0)
    assert result.rmse_m > 0.01


@pytest.mark.parametrize("rank", [0, 1, 2])
def test_alignment_of_points_that_leave_it_open(rank: int) -> None:
    rng = np.random.default_rng(rank)
    points = np.zeros((10, 3))
    points[:, :rank] = rng.normal(size=(10, rank))
    T_true = se3_exp([0.3, -1.0, 2.0, 1.0, 2.0, 3.0])
    T = align_se3(points, transform_points(T_true, points))
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(transform_points(T, points), transform_points(T_true, points), atol=1e-9)


def test_alignment_of_unusable_points() -> None:
    for first, second in (
        (np.zeros((0, 3)), np.zeros((0, 3))),
        (np.zeros((4, 3)), np.zeros((5, 3))),
        (np.full((4, 3), np.nan), np.zeros((4, 3))),
    ):
        with pytest.raises(EvaluationError):
            align_se3(first, second)


def test_too_few_matches() -> None:
    truth = random_walk(10, 0)
    late = Trajectory(truth.timestamps_s + 50, truth.T_wc)
    two = Trajectory(truth.timestamps_s[:2], truth.T_wc[:2])
    empty = Trajectory(np.empty(0), np.empty((0, 4, 4)))
    with pytest.raises(EvaluationError, match=r"none of 10 poses.*covers 150\.000"):
        associate(late, truth, TOLERANCE_S)
    with pytest.raises(EvaluationError, match="is empty"):
        ate(empty, truth, TOLERANCE_S)
    with pytest.raises(EvaluationError, match="only 2 of 2"):
        ate(two, truth, TOLERANCE_S)
    for delta in (0, 2):
        with pytest.raises(EvaluationError, match="rpe_delta_frames"):
            rpe(two, truth, TOLERANCE_S, delta)


def test_poses_that_are_not_finite() -> None:
    truth = random_walk(10, 0)
    broken = Trajectory(truth.timestamps_s, truth.T_wc.copy())
    broken.T_wc[4, :3, 3] = np.nan
    for metric in (ate, rpe):
        with pytest.raises(EvaluationError, match="NaN"):
            metric(broken, truth, TOLERANCE_S)


def test_rpe_of_a_known_drift() -> None:
    step, drift = se3_exp([0, 0, 0.1, 0.05, 0, 0]), se3_exp([np.radians(2.0), 0, 0, 0, 0.01, 0])
    truth = Trajectory(np.arange(6.0), np.stack([np.linalg.matrix_power(step, k) for k in range(6)]))
    estimate = Trajectory(np.arange(6.0), np.stack([np.linalg.matrix_power(step @ drift, k) for k in range(6)]))
    result = rpe(estimate, truth, 0.0)
    assert result.rot_rmse_deg == pytest.approx(2.0) and result.pairs == 5
    assert result.trans_rmse_m == pytest.approx(np.linalg.norm(drift[:3, 3]))


# --- images ---


def picture(seed: int, shape: tuple[int, ...] = (20, 26, 3)) -> np.ndarray:
    return np.random.default_rng(seed).uniform(size=shape).astype(np.float32)


def slow_ssim(x: np.ndarray, y: np.ndarray) -> float:
    """Window by window, from the definition."""
    offsets = np.arange(11) - 5
    kernel = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    kernel /= kernel.sum()
    values = []
    for c in range(3):
        for i in range(x.shape[0] - 10):
            for j in range(x.shape[1] - 10):
                a, b = (im[i : i + 11, j : j + 11, c].astype(np.float64) for im in (x, y))
                ma, mb = (kernel * a).sum(), (kernel * b).sum()
                va, vb = (kernel * (a - ma) ** 2).sum(), (kernel * (b - mb) ** 2).sum()
                cov = (kernel * (a - ma) * (b - mb)).sum()
                values.append((2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)))
    return float(np.mean(values))


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.5])
def test_ssim_is_the_definition(noise: float) -> None:
    x = picture(0)
    y = np.clip(x + noise * (picture(1) - 0.5), 0, 1).astype(np.float32)
    assert images.ssim(x, y) == pytest.approx(slow_ssim(x, y), abs=1e-9)


def test_ssim_of_smooth_and_equal_images() -> None:
    flat = np.full((16, 16, 3), 0.5, np.float32)
    assert images.ssim(flat, flat) == pytest.approx(1.0)
    assert images.ssim(picture(2), picture(2)) == pytest.approx(1.0)
    with pytest.raises(EvaluationError, match="11x11"):
        images.ssim(picture(0, (10, 20, 3)), picture(1, (10, 20, 3)))


def test_psnr_of_known_errors() -> None:
    flat = np.full((8, 8, 3), 0.5, np.float32)
    assert images.psnr(flat + 0.1, flat) == pytest.approx(20.0, abs=1e-4)
    assert images.psnr(flat, flat) == math.inf
    assert images.psnr(flat + 10.0, np.ones_like(flat)) == math.inf  # the rendering is clipped
    mask = np.zeros((8, 8), bool)
    assert images.masked_psnr(flat, flat, mask) is None
    mask[2] = True
    half = flat.copy()
    half[2] += 0.01
    assert images.masked_psnr(half, flat, mask) == pytest.approx(40.0, abs=1e-3)
    assert images.psnr(half, flat) == pytest.approx(40.0 + 10 * math.log10(8), abs=1e-3)


def test_psnr_of_fitted_colours_does_not_see_gains_and_offsets_of_channels() -> None:
    measured = 0.2 + 0.5 * picture(0)
    other = ((measured - [0.1, 0.05, 0.0]) / [0.8, 1.0, 1.2]).astype(np.float32)
    assert images.psnr(other, measured) < 30 and images.affine_psnr(other, measured) > 100
    noise = 0.01 * np.sign(picture(1) - 0.5).astype(np.float32)
    assert images.affine_psnr(other, measured + noise) == pytest.approx(40.0, abs=0.2)
    assert images.affine_psnr(np.zeros_like(measured), measured) == pytest.approx(
        -10 * math.log10(np.mean((measured - measured.mean((0, 1))) ** 2)), abs=1e-4
    )
    assert images.affine_psnr(measured + noise, measured) >= images.psnr(measured + noise, measured)


def test_depth_l1_counts_pixels_with_both_depths() -> None:
    rendered = np.array([[1.0, 2.0, 0.0, 3.0]], np.float32)
    measured = np.array([[1.1, 0.0, 5.0, 2.7]], np.float32)
    assert images.depth_l1_cm(rendered, measured) == pytest.approx(20.0, abs=1e-4)
    assert images.depth_l1_cm(rendered, np.zeros_like(measured)) is None


def test_scores_of_a_rendering_and_their_mean() -> None:
    colour, depth_m = picture(0), picture(1, (20, 26)) + 1
    frame = Frame(0, 0.0, colour, depth_m)
    noisy = Rendering(colour * 0.9, depth_m + 0.02, np.ones_like(depth_m))
    score = images.score_rendering(noisy, frame)
    assert score.depth_l1_cm == pytest.approx(2.0, abs=1e-3)
    assert score.psnr_masked_db == pytest.approx(score.psnr_db) and 0 < score.ssim < 1
    assert score.psnr_affine_db > score.psnr_db + 20
    blind = images.score_rendering(noisy, Frame(0, 0.0, colour, np.zeros_like(depth_m)))
    assert blind.depth_l1_cm is None and blind.psnr_masked_db is None
    mean = images.mean_scores([score, blind])
    assert mean.depth_l1_cm == score.depth_l1_cm and mean.ssim == pytest.approx(score.ssim)
    with pytest.raises(EvaluationError):
        images.mean_scores([])


def test_scores_are_their_definitions() -> None:
    x, y, depth_m = 1.2 * picture(3) - 0.1, picture(4), np.where(picture(5)[..., 0] < 0.7, 1.0, 0.0)
    score = images.score_rendering(Rendering(x, depth_m, depth_m), Frame(0, 0.0, y, depth_m))
    shown, error = np.clip(x, 0.0, 1.0).astype(np.float64), 0.0
    for channel in range(3):
        a, b = shown[..., channel].ravel(), y[..., channel].ravel().astype(np.float64)
        error += float(np.sum((np.polyval(np.polyfit(a, b, 1), a) - b) ** 2)) / y.size
    assert score.psnr_db == pytest.approx(-10 * math.log10(np.mean((shown - y) ** 2)))
    assert score.psnr_masked_db == pytest.approx(-10 * math.log10(np.mean((shown - y)[depth_m > 0] ** 2)))
    assert score.psnr_affine_db == pytest.approx(-10 * math.log10(error))
    assert score.ssim == pytest.approx(slow_ssim(shown, y))
    assert (score.psnr_db, score.ssim) == (images.psnr(x, y), images.ssim(x, y))


def test_images_that_cannot_be_compared() -> None:
    good = picture(0)
    broken = good.copy()
    broken[0, 0, 0] = np.nan
    for metric in (images.psnr, images.ssim, images.depth_l1_cm):
        with pytest.raises(EvaluationError):
            metric(good, good[1:])
        with pytest.raises(EvaluationError, match="NaN"):
            metric(broken, good)
    with pytest.raises(EvaluationError, match="mask"):
        images.masked_psnr(good, good, np.ones((3, 3), bool))
