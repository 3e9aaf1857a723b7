"""Settings of tracking, and of when a frame becomes a keyframe."""

from __future__ import annotations

from dataclasses import dataclass, field

from tgslam.config.setting import setting


@dataclass(frozen=True)
class ResidualSettings:
    """How residuals of a frame against a model image are weighed."""

    weight_depth: float = setting(1.0, 0.0, 100.0, doc="Weight of depth residuals.")
    weight_colour: float = setting(0.3, 0.0, 100.0, doc="Weight of intensity residuals.")
    weight_gradient: float = setting(0.3, 0.0, 100.0, doc="Weight of gradient residuals.")
    sigma_colour: float = setting(0.05, 1e-4, 1.0, doc="Intensity residual of weight 1, intensity in [0, 1].")
    sigma_gradient: float = setting(0.02, 1e-4, 1.0, doc="Gradient residual of weight 1, intensity per px.")
    surface_sigma_m: float = setting(0.005, 0.0, 1.0, doc="Error of surfaces beyond the sensor's noise, m.")
    splatted_colour: float = setting(
        0.2,
        0.0,
        1.0,
        doc="Part of the weights of intensity and gradient that is left to a rendering where references show the "
        "same; its depth then does not count at all. Renderings err alike over the whole image, slopes most of all.",
    )
    correlated_px: float = setting(100.0, 1.0, 1e6, doc="Neighbouring pixels err alike: so many px inform like one.")
    max_distance_sigmas: float = setting(
        15.0, 1.0, 1000.0, doc="Pixels whose depth residual is more standard deviations than this are no match."
    )


@dataclass(frozen=True)
class ModelSettings:
    """The rendering of the map that a frame is aligned to."""

    renders: int = setting(1, 1, 5, doc="How often the map is rendered, each time at the latest estimate.")
    min_opacity: float = setting(0.8, 0.0, 1.0, doc="Pixels that the map covers less than this are not used.")
    rim_opacity: float = setting(
        0.93,
        0.0,
        1.0,
        doc="Pixels round which the map covers less than this in the mean are at its rim, and have no say in colour.",
    )


@dataclass(frozen=True)
class MotionSettings:
    """What hands do within a frame, where pixels do not say: the last velocity goes on, but for these deviations."""

    acceleration_m: float = setting(5.0, 0.01, 1e4, doc="Standard deviation of the acceleration, m/s^2.")
    acceleration_rad: float = setting(20.0, 0.01, 1e4, doc="Standard deviation of the turn's acceleration, rad/s^2.")
    speed_m: float = setting(1.0, 0.001, 1e3, doc="Standard deviation of the speed while it is not known, m/s.")
    speed_rad: float = setting(
        2.0, 0.001, 1e3, doc="Standard deviation of the turn's speed while it is not known, rad/s."
    )


@dataclass(frozen=True)
class FirstOrderSettings:
    """Adam on the pose; with solver: first_order."""

    adam_steps: tuple[int, ...] = setting(
        (20, 20), 1, 1000, min_items=1, doc="Adam steps by level of the image pyramid, fine to coarse."
    )
    adam_rate: float = setting(0.002, 1e-6, 1.0, doc="Size of an Adam step, rad and m.")


@dataclass(frozen=True)
class LostSettings:
    """When a tracked pose is not to be believed."""

    min_inlier_ratio: float = setting(
        0.3,
        0.0,
        1.0,
        doc="Lost if less than this part of the matched pixels has a residual below three standard deviations.",
    )
    min_map_overlap: float = setting(
        0.1, 0.0, 1.0, doc="Lost if less than this part of the frame's pixels meets the map."
    )
    min_map_agreement: float = setting(
        0.6, 0.0, 1.0, doc="Lost if less than this part of the pixels that meet the map has its depth."
    )
    sound_colour_residual: float = setting(
        0.04, 0.0, 1.0, doc="A mean intensity residual up to this is never suspect, intensity in [0, 1]."
    )
    max_colour_ratio: float = setting(
        3.0,
        1.0,
        1000.0,
        doc="Lost if the mean intensity residual is suspect, and more than this many times the usual one.",
    )
    max_condition: float = setting(1e7, 1.0, 1e15, doc="Lost if the normal equations are worse conditioned.")


@dataclass(frozen=True)
class TrackingExpert:
    """What needs knowledge of the algorithm to be turned."""

    residuals: ResidualSettings = field(default_factory=ResidualSettings)
    model: ModelSettings = field(default_factory=ModelSettings)
    motion: MotionSettings = field(default_factory=MotionSettings)
    first_order: FirstOrderSettings = field(default_factory=FirstOrderSettings)
    lost: LostSettings = field(default_factory=LostSettings)


@dataclass(frozen=True)
class TrackingConfig:
    """Pose of each frame against the map."""

    solver: str = setting(
        "gauss_newton",
        choices=("gauss_newton", "first_order"),
        doc="gauss_newton: alignment to a rendering and to keyframes. first_order: Adam through the rasterizer, as in "
        "the paper.",
    )
    finest_width_px: int = setting(400, 16, 4096, doc="Images are halved until they are at most this wide, px.")
    alignment_steps: tuple[int, ...] = setting(
        (4, 6, 8),
        1,
        1000,
        min_items=1,
        doc="Gauss-Newton steps at most by level of the image pyramid, fine to coarse; each level is half as large as "
        "the one before.",
    )
    references: int = setting(
        2, 0, 8, doc="Keyframes whose own images a frame is aligned to, beside the map; with solver: gauss_newton."
    )
    exposure: str = setting(
        "gain", choices=("none", "gain", "gain_bias"), doc="What is fitted of a frame's brightness against the map."
    )
    recognition: bool = setting(
        True, doc="Frames whose alignment is in doubt, or that are lost, are also sought where they are recognised."
    )
    expert: TrackingExpert = field(default_factory=TrackingExpert)


@dataclass(frozen=True)
class KeyframeConfig:
    """When a frame becomes a keyframe (section 3.1, co-visibility)."""

    min_covisibility: float = setting(
        0.85,
        0.0,
        1.0,
        doc="A keyframe is due if the Gaussians that frame and last keyframe see share less than this "
        "(intersection over union).",
    )
    max_unexplained: float = setting(
        0.08, 0.0, 1.0, doc="A keyframe is due if the map does not cover more than this part of the pixels with depth."
    )
    max_translation: float = setting(
        0.1,
        0.0,
        100.0,
        doc="A keyframe is due if the camera has moved more than this part of the median depth since the last one.",
    )
    max_interval: int = setting(30, 1, 100_000, doc="A keyframe is due after so many frames without one.")
