"""Settings of what a run reads, and of how it is measured."""

from __future__ import annotations

from dataclasses import dataclass

from tgslam.config.setting import setting


@dataclass(frozen=True)
class DatasetConfig:
    """Where frames come from. Camera values of 0 mean: take them from the dataset format (or its calibration file)."""

    format: str = setting("synthetic", choices=("synthetic", "tum", "icl"))
    fx: float = setting(0.0, doc="px")
    fy: float = setting(0.0, doc="px, negative for ICL-NUIM: resolved by flipping the image at load time")
    cx: float = setting(0.0, doc="px")
    cy: float = setting(0.0, doc="px")
    distortion: tuple[float, ...] = setting((), doc="OpenCV order k1, k2, p1, p2, k3; () = none")
    depth_scale: float = setting(5000.0, 1e-3, 1e6, doc="raw depth units per metre")
    association_tolerance_s: float = setting(0.02, 0.0, 1.0, doc="colour to depth")
    min_depth_m: float = setting(0.1, 0.0, 10.0)
    max_depth_m: float = setting(10.0, 0.1, 1000.0)


@dataclass(frozen=True)
class SyntheticConfig:
    """The built-in scenes."""

    scene: str = setting("room", doc="names: see tgslam.synthetic")
    frames: int = setting(150, 2, 100_000)
    width: int = setting(320, 32, 4096)
    height: int = setting(240, 32, 4096)
    noise: bool = setting(True, doc="Kinect-like depth noise and holes")
    exposure_change: float = setting(0.0, 0.0, 1.0, doc="amplitude of the slow gain change; 0 = none")
    motion_blur: int = setting(1, 1, 32, doc="images averaged per exposure; 1 = sharp")


@dataclass(frozen=True)
class EvaluationConfig:
    """The fixed protocol: held-out frames never reach mapping, and keyframes are never held out."""

    holdout_interval: int = setting(5, 2, 1000, doc="every n-th frame is held out")
    association_tolerance_s: float = setting(0.02, 0.0, 1.0, doc="estimate to ground truth")
    rpe_delta_frames: int = setting(1, 1, 10_000)
