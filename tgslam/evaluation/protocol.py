"""The fixed protocol of every figure that tgslam reports: which frames are compared with what.

Trajectory: SE(3)-aligned ATE over keyframes and over all frames, RPE over all frames. Images: every
`holdout_interval`-th frame that is no keyframe, rendered at its estimated pose and full resolution. Only the metric
that says so in its name compensates for exposure.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from tgslam.config.input_settings import EvaluationConfig
from tgslam.errors import EvaluationError
from tgslam.evaluation.image_metrics import ImageScores, mean_scores
from tgslam.evaluation.trajectory import ate, rpe
from tgslam.types import FrameReport, FrameStatus, Matrix4, Trajectory

_log = logging.getLogger(__name__)

Metrics = dict[str, float | None]

TRAJECTORY_KEYS = ("ate_rmse_cm", "ate_rmse_all_cm", "rpe_trans_cm", "rpe_rot_deg")
IMAGE_KEYS = ("psnr_db", "psnr_affine_db", "ssim", "lpips", "psnr_masked_db", "depth_l1_cm", "heldout_frames")


def is_held_out(frame_index: int, interval: int) -> bool:
    """Whether `Frame.index` is one that mapping must not see: the last of every `interval` frames."""
    return frame_index % interval == interval - 1


def trajectory_metrics(
    every_frame: Trajectory, keyframes: Trajectory, groundtruth: Trajectory, config: EvaluationConfig
) -> Metrics:
    """The values of `TRAJECTORY_KEYS`; null, with a logged reason, for what too few poses leave open."""
    tolerance_s = config.truth_tolerance_s

    def absolute(trajectory: Trajectory) -> tuple[float]:
        return (100.0 * ate(trajectory, groundtruth, tolerance_s).rmse_m,)

    def relative() -> tuple[float, float]:
        result = rpe(every_frame, groundtruth, tolerance_s, config.rpe_delta_frames)
        return 100.0 * result.trans_rmse_m, result.rot_rmse_deg

    return {
        **_or_null(("ate_rmse_cm",), lambda: absolute(keyframes)),
        **_or_null(("ate_rmse_all_cm",), lambda: absolute(every_frame)),
        **_or_null(("rpe_trans_cm", "rpe_rot_deg"), relative),
    }


def _or_null(keys: tuple[str, ...], compute: Callable[[], tuple[float, ...]]) -> Metrics:
    try:
        return dict(zip(keys, compute(), strict=True))
    except EvaluationError as error:
        _log.warning("%s: null, since %s", ", ".join(keys), error)
        return dict.fromkeys(keys)


def held_out_poses(reports: Sequence[FrameReport], every_frame: Trajectory, interval: int) -> list[tuple[int, Matrix4]]:
    """(position in the source, T_wc) of the held-out frames of a run.

    reports: one a frame of the source, in order. every_frame: one pose for each of them that was not skipped.
    Raises EvaluationError when the two do not belong together.
    """
    posed = [(position, report) for position, report in enumerate(reports) if report.status is not FrameStatus.SKIPPED]
    if len(posed) != len(every_frame):
        raise EvaluationError(
            f"the log lists {len(posed)} frames with a pose, but the trajectory has {len(every_frame)} poses; "
            "they are not of one run"
        )
    return [
        (position, T_wc)
        for (position, report), T_wc in zip(posed, every_frame.T_wc, strict=True)
        if is_held_out(report.index, interval) and not report.is_keyframe
    ]


def mean_image_metrics(scores: list[ImageScores]) -> Metrics:
    """The values of `IMAGE_KEYS` over the held-out frames that could be read; null when there is none."""
    if not scores:
        _log.warning("no frame was held out: the image metrics are null")
        return dict.fromkeys(IMAGE_KEYS)
    return {**dict.fromkeys(IMAGE_KEYS), **vars(mean_scores(scores)), "heldout_frames": len(scores)}
