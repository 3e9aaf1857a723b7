"""Settings of the map: how it is seeded and refined, and under which objective."""

from __future__ import annotations

from dataclasses import dataclass, field

from tgslam.camera import SensorNoise
from tgslam.config.setting import setting


@dataclass(frozen=True)
class SeedingConfig:
    """Gaussians from RGB-D."""

    smallest_cell_px: int = setting(2, 1, 64, doc="cells at edges, texture and off planes")
    cells_across: int = setting(
        80, 1, 10_000, doc="the image, about so many of the largest cells: doublings of the smallest"
    )
    plane_cells_across: int = setting(40, 1, 10_000, doc="likewise on one plane (PGI)")
    plain_colour_std: float = setting(0.015, 0.0, 1.0, doc="a cell whose channels vary less has no texture")
    plane_colour_std: float = setting(0.022, 0.0, 1.0, doc="likewise for a cell on one plane, but for a linear trend")
    planar_sigmas: float = setting(
        2.5, 0.0, 100.0, doc="a cell whose plane residual is less, in sensor sigmas, is flat"
    )
    overlap: float = setting(0.6, 0.1, 3.0, doc="standard deviation of a Gaussian in cell sizes")
    thickness: float = setting(0.1, 1e-3, 1.0, doc="standard deviation along the normal, relative to across")
    opacity: float = setting(0.9, 0.01, 0.99)


@dataclass(frozen=True)
class MappingConfig:
    """Insertion, pruning and refinement of the map."""

    optimizer: str = setting(
        "relaxation", choices=("relaxation", "adam"), doc="how colours move; geometry moves by Adam"
    )
    window: int = setting(6, 1, 1000, doc="latest keyframes refined together")
    anchors: str = setting(
        "structure", choices=("structure", "random", "none"), doc="earlier ones that are refined with it"
    )
    anchor_count: int = setting(2, 0, 1000, doc="SGVs, whose poses hold still")
    iterations: int = setting(12, 0, 10_000, doc="views rendered and refined a keyframe")
    final_iterations: int = setting(120, 0, 1_000_000, doc="after the last frame, over all keyframes; 0 = off")
    refine_poses: bool = setting(
        False, doc="in the window; tracking has been the better judge since it knows references"
    )
    insert_opacity: float = setting(0.6, 0.0, 1.0, doc="the map does not explain a pixel that it covers less than this")
    insert_sigmas: float = setting(8.0, 0.0, 1000.0, doc="nor one whose surface stands this far in front of the map's")
    coarse_factor: float = setting(2.5, 1.0, 100.0, doc="Gaussians this much larger than needed are seeded anew, finer")
    prune_opacity: float = setting(0.05, 0.0, 1.0)
    prune_weight_px: float = setting(0.05, 0.0, 1000.0, doc="blend weight summed over the window's pixels")
    rate_mean_px: float = setting(0.15, 0.0, 10.0, doc="Adam steps: pixels of the median depth")
    rate_scale: float = setting(0.005, 0.0, 1.0, doc="in log scale")
    rate_rotation: float = setting(0.002, 0.0, 1.0)
    rate_opacity: float = setting(0.03, 0.0, 10.0, doc="in logit")
    rate_colour: float = setting(0.01, 0.0, 1.0, doc="only with optimizer: adam")
    rate_pose: float = setting(0.0003, 0.0, 1.0, doc="rad and m")
    relaxation: float = setting(0.7, 0.0, 1.9, doc="of colours; 1 = the full step")


@dataclass(frozen=True)
class TextureGateSettings:
    """How much texture a pixel has to have for its colour to count (Eqs. 10, 11)."""

    gate_percentile: float = setting(
        95.0, 50.0, 100.0, doc="G_max of Eq. 11 is this percentile of the gradient magnitude; G_min mirrors it."
    )
    gate_noise_floor: float = setting(
        0.01, 1e-6, 1.0, doc="epsilon of Eq. 11: weaker gradients are noise, intensity per px."
    )
    gate_depth_boost: float = setting(1.0, 0.0, 100.0, doc="Depth residuals are weighted by 1 + this * T.")


@dataclass(frozen=True)
class PenaltySettings:
    """The Charbonnier penalties of the objective's parts, and where depth counts."""

    charbonnier_colour: float = setting(0.02, 1e-6, 1.0, doc="epsilon of colour, intensity in [0, 1].")
    charbonnier_grad: float = setting(0.01, 1e-6, 1.0, doc="epsilon of gradients, intensity per px.")
    charbonnier_depth_sigmas: float = setting(
        1.0, 1e-3, 100.0, doc="epsilon of depth, in standard deviations of the sensor's noise."
    )
    min_depth_opacity: float = setting(0.5, 0.01, 1.0, doc="Rendered depth counts above this opacity.")


@dataclass(frozen=True)
class LossExpert:
    """What needs knowledge of the algorithm to be turned."""

    texture: TextureGateSettings = field(default_factory=TextureGateSettings)
    penalties: PenaltySettings = field(default_factory=PenaltySettings)


@dataclass(frozen=True)
class LossConfig:
    """The adaptive RGB-depth objective, Eqs. 10-13."""

    gate: bool = setting(
        True, doc="Colour counts by how much texture a pixel has (Eq. 11). Off: T = 0 everywhere, and all count alike."
    )
    depth_sigma_per_m2: float = setting(
        0.0015, 1e-6, 1.0, doc="The sensor's noise: the standard deviation of a depth z is this * z^2; 1/m."
    )
    weight_l1: float = setting(1.0, 0.0, 100.0, doc="Weight of colour in E_pho.")
    weight_grad: float = setting(0.5, 0.0, 100.0, doc="Weight of gradients in E_pho.")
    weight_ssim: float = setting(0.2, 0.0, 100.0, doc="Weight of structural similarity in E_pho.")
    weight_pho: float = setting(1.0, 0.0, 100.0, doc="lambda_pho of Eq. 14: weight of E_pho.")
    weight_geo: float = setting(
        0.02,
        0.0,
        100.0,
        doc="lambda_geo of Eq. 14: weight of depth. At the default one standard deviation of depth weighs like one "
        "epsilon of intensity.",
    )
    expert: LossExpert = field(default_factory=LossExpert)

    @property
    def noise(self) -> SensorNoise:
        """The sensor's."""
        return SensorNoise(self.depth_sigma_per_m2)
