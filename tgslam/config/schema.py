"""Every setting of the system, one frozen dataclass a component, with its default, unit and allowed range."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any


def setting(default: Any, low: float | None = None, high: float | None = None, choices: tuple[str, ...] = ()) -> Any:
    """A dataclass field with its allowed range [low, high] or choices, which `loader` checks."""
    metadata = {"low": low, "high": high, "choices": choices}
    if isinstance(default, tuple):
        return dataclasses.field(default_factory=lambda: default, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True)
class DatasetConfig:
    """Where frames come from. Camera values of 0 mean: take them from the dataset format (or its calibration file)."""

    format: str = setting("synthetic", choices=("synthetic", "tum", "icl"))
    fx: float = setting(0.0)  # px
    fy: float = setting(0.0)  # px, negative for ICL-NUIM: resolved by flipping the image at load time
    cx: float = setting(0.0)  # px
    cy: float = setting(0.0)  # px
    distortion: tuple[float, ...] = setting(())  # OpenCV order k1, k2, p1, p2, k3; () = none
    depth_scale: float = setting(5000.0, 1e-3, 1e6)  # raw depth units per metre
    association_tolerance_s: float = setting(0.02, 0.0, 1.0)  # colour to depth
    min_depth_m: float = setting(0.1, 0.0, 10.0)
    max_depth_m: float = setting(10.0, 0.1, 1000.0)


@dataclass(frozen=True)
class SyntheticConfig:
    """The built-in scenes."""

    scene: str = setting("room")  # names: see tgslam.synthetic
    frames: int = setting(150, 2, 100_000)
    width: int = setting(320, 32, 4096)
    height: int = setting(240, 32, 4096)
    noise: bool = setting(True)  # Kinect-like depth noise and holes
    exposure_change: float = setting(0.0, 0.0, 1.0)  # amplitude of the slow gain change; 0 = none
    motion_blur: int = setting(1, 1, 32)  # images averaged per exposure; 1 = sharp


@dataclass(frozen=True)
class LossConfig:
    """The adaptive RGB-depth objective, Eqs. 10-13."""

    gate_percentile: float = setting(95.0, 50.0, 100.0)  # G_max of Eq. 11 is this percentile of the gradient magnitude
    charbonnier_colour: float = setting(0.02, 1e-6, 1.0)  # epsilon, intensity in [0, 1]
    charbonnier_depth_sigmas: float = setting(1.0, 1e-3, 100.0)  # epsilon, in standard deviations of the depth noise
    depth_sigma_per_m2: float = setting(0.0015, 1e-6, 1.0)  # sensor noise: sigma_z = this * z^2, 1/m
    weight_l1: float = setting(1.0, 0.0, 100.0)
    weight_grad: float = setting(0.5, 0.0, 100.0)
    weight_ssim: float = setting(0.2, 0.0, 100.0)


@dataclass(frozen=True)
class EvaluationConfig:
    """The fixed protocol: held-out frames never reach mapping, and keyframes are never held out."""

    holdout_interval: int = setting(5, 2, 1000)  # every n-th frame is held out
    association_tolerance_s: float = setting(0.02, 0.0, 1.0)  # estimate to ground truth
    rpe_delta_frames: int = setting(1, 1, 10_000)


@dataclass(frozen=True)
class Config:
    """The whole of a run's settings."""

    seed: int = setting(0, 0, 2**31 - 1)
    dataset: DatasetConfig = dataclasses.field(default_factory=DatasetConfig)
    synthetic: SyntheticConfig = dataclasses.field(default_factory=SyntheticConfig)
    loss: LossConfig = dataclasses.field(default_factory=LossConfig)
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)
