"""Settings of the map: how it is seeded and refined, and under which objective."""

from __future__ import annotations

from dataclasses import dataclass, field

from tgslam.camera import USUAL_NOISE, SensorNoise
from tgslam.config.setting import setting


@dataclass(frozen=True)
class FlatnessSettings:
    """When one Gaussian can stand for a cell of the quadtree, so that the cell is not split."""

    plain_colour_std: float = setting(
        0.015,
        0.0,
        1.0,
        doc="A cell has no texture if its channels' standard deviations are less, intensity in [0, 1].",
    )
    plane_colour_std: float = setting(
        0.022, 0.0, 1.0, doc="The same for a cell on one plane (PGI), whose colour may have a linear trend besides."
    )
    planar_sigmas: float = setting(
        2.5, 0.0, 100.0, doc="A cell is flat if it strays from a plane by less, in standard deviations of the sensor."
    )


@dataclass(frozen=True)
class NewGaussianSettings:
    """The Gaussian that a cell gets."""

    overlap: float = setting(0.6, 0.1, 3.0, doc="Standard deviation across the surface, in sides of the cell.")
    thickness: float = setting(0.1, 1e-3, 1.0, doc="Standard deviation along the normal, as a part of that across.")
    seed_opacity: float = setting(0.9, 0.01, 0.99, doc="Opacity at its centre.")


@dataclass(frozen=True)
class SeedingExpert:
    """What needs knowledge of the algorithm to be turned."""

    flatness: FlatnessSettings = field(default_factory=FlatnessSettings)
    gaussians: NewGaussianSettings = field(default_factory=NewGaussianSettings)


@dataclass(frozen=True)
class SeedingConfig:
    """Gaussians from a keyframe: one for each cell of a quadtree. Cells are large where the image is plain and flat.

    Sizes of cells double from the smallest to the largest.
    """

    smallest_cell_px: int = setting(
        2, 1, 64, doc="Side of the smallest cells in px. They are used at edges and where there is texture."
    )
    largest_cells_across: int = setting(80, 1, 10_000, doc="The largest cells in a row of the image, about so many.")
    largest_plane_cells_across: int = setting(
        40, 1, 10_000, doc="The same on one plane (PGI), where cells may be larger still."
    )
    expert: SeedingExpert = field(default_factory=SeedingExpert)


@dataclass(frozen=True)
class InsertionSettings:
    """Where a keyframe adds Gaussians to the map."""

    insert_opacity: float = setting(
        0.6, 0.0, 1.0, doc="Gaussians are added where the rendered opacity of the map is less than this."
    )
    insert_sigmas: float = setting(
        8.0,
        0.0,
        1000.0,
        doc="Gaussians are added where the keyframe's surface stands in front of the map's by more than this, in "
        "standard deviations of the sensor; up to this, a measurement supports the Gaussians there.",
    )
    coarse_factor: float = setting(
        2.5, 1.0, 100.0, doc="Gaussians that are this many times larger than the keyframe asks for are seeded anew."
    )


@dataclass(frozen=True)
class PruningSettings:
    """Which Gaussians are removed after refinement."""

    prune_opacity: float = setting(0.05, 0.0, 1.0, doc="Gaussians of less opacity go.")
    prune_weight_px: float = setting(
        0.05,
        0.0,
        1000.0,
        doc="Gaussians go whose blend weight, summed over the pixels of any view, has been less in all of them, px.",
    )


@dataclass(frozen=True)
class StepSizeSettings:
    """How far a step of refinement goes. All but colour_relaxation are rates of Adam: the size of a step."""

    rate_mean_px: float = setting(0.15, 0.0, 10.0, doc="Of means, px at a depth of 1 m.")
    rate_scale: float = setting(0.005, 0.0, 1.0, doc="Of scales, in their logarithm.")
    rate_rotation: float = setting(0.002, 0.0, 1.0, doc="Of rotations, in components of the unit quaternion.")
    rate_opacity: float = setting(0.03, 0.0, 10.0, doc="Of opacities, in their logit.")
    rate_colour: float = setting(0.01, 0.0, 1.0, doc="Of colours, intensity in [0, 1]; only with optimizer: adam.")
    rate_pose: float = setting(0.0003, 0.0, 1.0, doc="Of keyframe poses, rad and m; only with refine_poses.")
    colour_relaxation: float = setting(
        0.7, 0.0, 1.9, doc="Part of the full step of colours that is taken; only with optimizer: relaxation."
    )


@dataclass(frozen=True)
class FinalStepSettings:
    """How far a step goes in the final pass, where it differs: every view has its turn, so that none is forgotten."""

    final_rate_scale: float = setting(0.06, 0.0, 1.0, doc="Of scales, in their logarithm.")
    final_rate_rotation: float = setting(0.01, 0.0, 1.0, doc="Of rotations, in components of the unit quaternion.")
    final_rate_opacity: float = setting(0.1, 0.0, 10.0, doc="Of opacities, in their logit.")


@dataclass(frozen=True)
class MappingExpert:
    """What needs knowledge of the algorithm to be turned."""

    insertion: InsertionSettings = field(default_factory=InsertionSettings)
    pruning: PruningSettings = field(default_factory=PruningSettings)
    step_sizes: StepSizeSettings = field(default_factory=StepSizeSettings)
    final_step_sizes: FinalStepSettings = field(default_factory=FinalStepSettings)


@dataclass(frozen=True)
class MappingConfig:
    """How the map is refined (section 3.4): on the window of latest keyframes, and on a few earlier ones."""

    optimizer: str = setting(
        "relaxation",
        choices=("relaxation", "adam"),
        doc="How colours move. relaxation: by a damped step to their best value. adam: by Adam, as geometry does with "
        "either.",
    )
    window: int = setting(6, 1, 1000, doc="Latest keyframes that are refined together.")
    anchors: str = setting(
        "structure",
        choices=("structure", "random", "none"),
        doc="Earlier keyframes that are refined with the window, so that it does not leave them behind. structure: the "
        "sparse global viewpoints, by the planes that they share; random ones without planes.",
    )
    anchor_count: int = setting(2, 0, 1000, doc="How many such earlier keyframes; their poses hold still.")
    iterations: int = setting(12, 0, 10_000, doc="Steps of refinement at a keyframe, each on one view.")
    final_iterations: int = setting(
        120, 0, 1_000_000, doc="Steps of refinement after the last frame, over all keyframes; 0 = none."
    )
    final_rounds: int = setting(
        4, 0, 100_000, doc="In the end every keyframe gets so many steps at least; with final_iterations: 0 none."
    )
    budget: float = setting(
        1.0, 0.0, 1000.0, doc="What all these steps are multiplied by: time for sharpness, as `--quality`."
    )
    refine_poses: bool = setting(
        False,
        doc="Poses of the window are refined with the map. Tracking against keyframes has been the better judge.",
    )
    expert: MappingExpert = field(default_factory=MappingExpert)


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
    depth_sigma_per_m2: float | None = setting(
        None,
        1e-6,
        100.0,
        doc="The sensor's noise: the standard deviation of a depth z is this * z^2; 1/m. null: learnt from the first "
        "frame, 0.0015 unless that is far noisier.",
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
        """The sensor's; the usual one while it is not known."""
        return USUAL_NOISE if self.depth_sigma_per_m2 is None else SensorNoise(self.depth_sigma_per_m2)
