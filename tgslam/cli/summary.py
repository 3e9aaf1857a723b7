"""The metrics of a run as a table."""

from __future__ import annotations

from typing import Any

from tgslam.output.console import print_table

LINES = (  # label, key, format
    ("frames", "frames", "{:d}"),
    ("skipped", "frames_skipped", "{:d}"),
    ("lost", "frames_lost", "{:d}"),
    ("tracked", "tracked_fraction", "{:.1%}"),
    ("keyframes", "keyframes", "{:d}"),
    ("Gaussians", "gaussians", "{:,d}"),
    ("planes", "planes", "{:d}"),
    ("plane area", "plane_area_m2", "{:.1f} m2"),
    ("plane residual, RMS", "plane_rms_mm", "{:.1f} mm"),
    ("closure edges", "closures", "{:d}"),
    ("ATE, keyframes", "ate_rmse_cm", "{:.2f} cm"),
    ("ATE, all frames", "ate_rmse_all_cm", "{:.2f} cm"),
    ("RPE, translation", "rpe_trans_cm", "{:.3f} cm"),
    ("RPE, rotation", "rpe_rot_deg", "{:.3f} deg"),
    ("held-out frames", "heldout_frames", "{:d}"),
    ("PSNR", "psnr_db", "{:.2f} dB"),
    ("PSNR, colours fitted", "psnr_affine_db", "{:.2f} dB"),
    ("PSNR, with depth", "psnr_masked_db", "{:.2f} dB"),
    ("SSIM", "ssim", "{:.4f}"),
    ("depth L1", "depth_l1_cm", "{:.2f} cm"),
    ("plane quality (PQ)", "plane_pq", "{:.3f}"),
    ("plane quality, by frame", "plane_frame_pq", "{:.3f}"),
    ("plane IoU, mean", "plane_miou", "{:.3f}"),
    ("plane precision", "plane_precision", "{:.1%}"),
    ("plane recall", "plane_recall", "{:.1%}"),
    ("plane id switches", "plane_switches_per_100", "{:.1f} in 100 frames"),
    ("surface id switches", "plane_surface_switches_per_100", "{:.1f} in 100 frames"),
    ("plane normal error", "plane_normal_deg", "{:.2f} deg"),
    ("plane normal error, 95 %", "plane_normal_p95_deg", "{:.2f} deg"),
    ("plane offset error", "plane_offset_mm", "{:.1f} mm"),
    ("floaters", "floater_share", "{:.2%}"),
    ("speed", "fps", "{:.2f} frames/s"),
    ("wall time", "wall_s", "{:.1f} s"),
    ("peak memory", "peak_rss_mb", "{:.0f} MiB"),
)


def print_metrics(title: str, metrics: dict[str, Any]) -> None:
    """Print what applies; a metric that is null shows as `-`."""
    print_table(title, [(label, _text(metrics.get(key), form)) for label, key, form in LINES])


def _text(value: Any, form: str) -> str:
    return "-" if value is None else form.format(value)
