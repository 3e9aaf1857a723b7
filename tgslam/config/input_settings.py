"""Settings of what a run reads, and of how it is measured."""

from __future__ import annotations

from dataclasses import dataclass, field

from tgslam.config.setting import setting

FOLDER_FORMATS = (
    "tum", "icl", "bonn", "replica", "7scenes", "tartanair", "scannet", "sens", "scannetpp", "open3d", "bundlefusion",
    "nerfstudio", "record3d", "polycam", "ros", "folder",
)  # fmt: skip


@dataclass(frozen=True)
class DatasetExpert:
    """How images of recordings are found and paired."""

    depth_tolerance_s: float = setting(
        0.02, 0.0, 1.0, doc="Time between a colour image and the depth image that belongs to it, at most, s."
    )
    colour_topic: str = setting("", doc="Topic of the colour images of a ROS bag; empty: told from what they are.")
    depth_topic: str = setting("", doc="Topic of the depth images of a ROS bag; empty: told from what they are.")


@dataclass(frozen=True)
class DepthCameraConfig:
    """The camera that depth was taken with, where depth images do not lie on colour images; none if all is empty."""

    intrinsics: tuple[float, ...] = setting((), doc="Its fx, fy, cx, cy in px; pixel centres are whole numbers.")
    lens: tuple[float, ...] = setting((), doc="Its distortion in OpenCV's order k1, k2, p1, p2, k3; none if empty.")
    size: tuple[int, ...] = setting(
        (), 1, 16384, doc="Width and height of the images that these values are for, px; if empty, of those stored."
    )
    T_colour_depth: tuple[float, ...] = setting(
        (),
        doc="Where it is for the colour camera: tx, ty, tz in m and qx, qy, qz, qw, or the 3x4 or 4x4 matrix by rows "
        "that takes points from depth to colour; in the same place if empty.",
    )


@dataclass(frozen=True)
class DatasetConfig:
    """Where frames come from. Camera values of 0 mean: take them from the dataset format (or its calibration file)."""

    format: str = setting(
        "auto",
        choices=("auto", "synthetic", *FOLDER_FORMATS),
        doc="synthetic: a built-in scene. The others are layouts of recordings (docs/recordings.md). auto: told from "
        "the files; without any, the built-in scene.",
    )
    fx: float = setting(0.0, doc="Focal length across, px.")
    fy: float = setting(
        0.0, doc="Focal length down, px; negative for ICL-NUIM, whose images are flipped as they are read."
    )
    cx: float = setting(0.0, doc="Principal point from the left, px; pixel centres are whole numbers.")
    cy: float = setting(0.0, doc="Principal point from the top, px.")
    distortion: tuple[float, ...] = setting(
        (), doc="Lens distortion in OpenCV's order k1, k2, p1, p2, k3; none if empty."
    )
    width: int = setting(0, 0, 8192, doc="Images are made so wide as they are read, px; 0 = they stay as they are.")
    depth_scale: float | None = setting(
        None,
        1e-3,
        1e6,
        doc="Units of the depth images per metre, where they hold whole numbers; null: the format's own, or what the "
        "recording says. Depth in floats is in metres.",
    )
    min_depth_m: float = setting(0.1, 0.0, 10.0, doc="Nearer measurements are dropped, m.")
    max_depth_m: float = setting(10.0, 0.1, 1000.0, doc="Farther measurements are dropped, m.")
    depth_camera: DepthCameraConfig = field(default_factory=DepthCameraConfig)
    expert: DatasetExpert = field(default_factory=DatasetExpert)


@dataclass(frozen=True)
class SyntheticConfig:
    """The built-in scenes."""

    scene: str = setting("room", doc="Name of the scene: room, loop, corridor, blank, desk or turn.")
    frames: int = setting(150, 2, 100_000, doc="Frames of the sequence.")
    width: int = setting(320, 32, 4096, doc="Width of the images, px.")
    height: int = setting(240, 32, 4096, doc="Height of the images, px.")
    noise: bool = setting(True, doc="Depth has noise and holes like a Kinect's.")
    noise_factor: float = setting(1.0, 0.01, 100.0, doc="Noise of depth, and its steps, in those of a Kinect.")
    exposure_change: float = setting(
        0.0, 0.0, 1.0, doc="Amplitude of a slow change of the camera's gain, as a part of it; 0 = none."
    )
    motion_blur: int = setting(1, 1, 32, doc="Images that are averaged over an exposure; 1 = sharp.")
    event: str = setting(
        "none",
        choices=(
            "none",
            "exposure_step",
            "white_balance",
            "cover",
            "gap",
            "kidnap_known",
            "kidnap_unknown",
            "moving_box",
        ),
        doc="What happens in the middle of it. cover: a hand before the lens for 1 s. gap: 1 s without frames. kidnap: "
        "the camera is carried off, to near its first place or to one that it has not seen.",
    )


@dataclass(frozen=True)
class EvaluationConfig:
    """The fixed protocol: held-out frames never reach mapping, and keyframes are never held out."""

    holdout_interval: int = setting(5, 2, 1000, doc="Every n-th frame that is no keyframe is held out for images.")
    truth_tolerance_s: float = setting(
        0.02, 0.0, 1.0, doc="Time between an estimated and a true pose that are compared, at most, s."
    )
    rpe_delta_frames: int = setting(1, 1, 10_000, doc="Frames over which the relative pose error is taken.")
