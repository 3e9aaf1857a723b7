"""Settings of tracking, and of when a frame becomes a keyframe."""

from __future__ import annotations

from dataclasses import dataclass

from tgslam.config.setting import setting


@dataclass(frozen=True)
class TrackingConfig:
    """Pose of each frame against the map."""

    solver: str = setting("gauss_newton", choices=("gauss_newton", "first_order"))
    finest_width_px: int = setting(400, 16, 4096, doc="images are halved until they are at most this wide")
    iterations: tuple[int, ...] = setting(
        (4, 6, 8),
        1,
        1000,
        min_items=1,
        doc="Gauss-Newton steps at most, by level of the image pyramid, fine to coarse; each is half the one before",
    )
    references: int = setting(2, 0, 8, doc="keyframes whose own images a frame is aligned to, beside the map")
    renders: int = setting(1, 1, 5, doc="the map is rendered this often at the latest estimate")
    sigma_colour: float = setting(0.05, 1e-4, 1.0, doc="intensity residual of weight 1")
    sigma_gradient: float = setting(0.02, 1e-4, 1.0, doc="gradient residual of weight 1, 1/px")
    surface_sigma_m: float = setting(0.005, 0.0, 1.0, doc="what surfaces err by beyond the sensor's noise")
    # Of the map where references show the same: renderings err alike over the whole image, slopes most of all, and draw
    # the camera with a certainty that grows with the pixels. Their depth does not count there at all
    splatted_colour: float = setting(0.2, 0.0, 1.0, doc="of the weights of colour and gradient")
    weight_depth: float = setting(1.0, 0.0, 100.0)
    weight_colour: float = setting(0.3, 0.0, 100.0)
    weight_gradient: float = setting(0.3, 0.0, 100.0)
    correlated_px: float = setting(100.0, 1.0, 1e6, doc="neighbouring pixels err alike: so many inform like one")
    # What hands do within a frame, where pixels do not say: the last velocity, but for these standard deviations
    acceleration_m: float = setting(5.0, 0.01, 1e4, doc="m/s^2")
    acceleration_rad: float = setting(20.0, 0.01, 1e4, doc="rad/s^2")
    speed_m: float = setting(1.0, 0.001, 1e3, doc="m/s, while no velocity is known")
    speed_rad: float = setting(2.0, 0.001, 1e3, doc="rad/s")
    max_distance_sigmas: float = setting(15.0, 1.0, 1000.0, doc="depth residuals beyond are no match")
    exposure: str = setting("gain", choices=("none", "gain", "gain_bias"), doc="a frame's brightness against the map")
    min_opacity: float = setting(0.8, 0.0, 1.0, doc="model pixels less covered are not used")
    rim_opacity: float = setting(0.93, 0.0, 1.0, doc="nor those round which the map covers less than that in the mean")
    first_order_iterations: tuple[int, ...] = setting((20, 20), 1, 1000, min_items=1, doc="Adam steps, likewise")
    first_order_rate: float = setting(0.002, 1e-6, 1.0, doc="Adam step, rad and m")
    lost_inlier_ratio: float = setting(0.3, 0.0, 1.0, doc="fewer matched pixels with a residual below 3 sigma: lost")
    lost_overlap: float = setting(0.1, 0.0, 1.0, doc="fewer live pixels that meet the map: lost")
    lost_agreement: float = setting(0.6, 0.0, 1.0, doc="fewer of those with the map's depth: lost")
    lost_colour_residual: float = setting(0.04, 0.0, 1.0, doc="a mean intensity residual up to this is never suspect")
    lost_colour_ratio: float = setting(3.0, 1.0, 1000.0, doc="above it, more than this times the usual one is: lost")
    lost_condition: float = setting(1e7, 1.0, 1e15, doc="worse conditioned normal equations: lost")


@dataclass(frozen=True)
class KeyframeConfig:
    """When a frame becomes a keyframe (section 3.1, co-visibility)."""

    min_overlap: float = setting(
        0.85, 0.0, 1.0, doc="Gaussians seen by frame and last keyframe, intersection over union"
    )
    max_unexplained: float = setting(0.08, 0.0, 1.0, doc="share of pixels with depth that the map does not cover")
    max_translation: float = setting(0.1, 0.0, 100.0, doc="since the last keyframe, relative to the median depth")
    max_interval: int = setting(30, 1, 100_000, doc="frames")
