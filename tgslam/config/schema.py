"""Every setting of the system, one frozen dataclass a component, with its default, unit and allowed range."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any


def setting(
    default: Any,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    min_items: int = 0,
) -> Any:
    """A dataclass field with its allowed range [low, high] or choices (of a list: of each item), for `loader`."""
    metadata = {"low": low, "high": high, "choices": choices, "min_items": min_items}
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

    gate: bool = setting(True)  # False: T = 0 everywhere, and no term of the objective asks how much texture there is
    gate_percentile: float = setting(95.0, 50.0, 100.0)  # G_max of Eq. 11 is this percentile of the gradient magnitude
    gate_noise_floor: float = setting(
        0.01, 1e-6, 1.0
    )  # epsilon of Eq. 11, intensity per px: weaker gradients are noise
    gate_depth_boost: float = setting(1.0, 0.0, 100.0)  # depth residuals are weighted by 1 + this * T
    min_depth_opacity: float = setting(0.5, 0.01, 1.0)  # rendered depth counts above this opacity
    charbonnier_colour: float = setting(0.02, 1e-6, 1.0)  # epsilon, intensity in [0, 1]
    charbonnier_grad: float = setting(0.01, 1e-6, 1.0)  # epsilon, intensity per px
    charbonnier_depth_sigmas: float = setting(1.0, 1e-3, 100.0)  # epsilon, in standard deviations of the depth noise
    depth_sigma_per_m2: float = setting(0.0015, 1e-6, 1.0)  # sensor noise: sigma_z = this * z^2, 1/m
    weight_l1: float = setting(1.0, 0.0, 100.0)
    weight_grad: float = setting(0.5, 0.0, 100.0)
    weight_ssim: float = setting(0.2, 0.0, 100.0)
    weight_pho: float = setting(1.0, 0.0, 100.0)  # lambda_pho of Eq. 14
    weight_geo: float = setting(0.02, 0.0, 100.0)  # lambda_geo: one sigma of depth weighs like one epsilon of intensity


@dataclass(frozen=True)
class TrackingConfig:
    """Pose of each frame against the map."""

    solver: str = setting("gauss_newton", choices=("gauss_newton", "first_order"))
    finest_width_px: int = setting(400, 16, 4096)  # images are halved until they are at most this wide
    # Gauss-Newton steps at most, by level of the image pyramid, fine to coarse; each is half the size of the one before
    iterations: tuple[int, ...] = setting((4, 6, 8), 1, 1000, min_items=1)
    references: int = setting(2, 0, 8)  # keyframes whose own images a frame is aligned to, beside the map
    renders: int = setting(1, 1, 5)  # the map is rendered this often at the latest estimate
    sigma_colour: float = setting(0.05, 1e-4, 1.0)  # intensity residual of weight 1
    sigma_gradient: float = setting(0.02, 1e-4, 1.0)  # gradient residual of weight 1, 1/px
    surface_sigma_m: float = setting(0.005, 0.0, 1.0)  # what surfaces err by beyond the sensor's noise
    # Of the map where references show the same: renderings err alike over the whole image, slopes most of all, and draw
    # the camera with a certainty that grows with the pixels. Their depth does not count there at all
    splatted_colour: float = setting(0.2, 0.0, 1.0)  # of the weights of colour and gradient
    weight_depth: float = setting(1.0, 0.0, 100.0)
    weight_colour: float = setting(0.3, 0.0, 100.0)
    weight_gradient: float = setting(0.3, 0.0, 100.0)
    correlated_px: float = setting(100.0, 1.0, 1e6)  # neighbouring pixels err alike: so many inform like one
    # What hands do within a frame, where pixels do not say: the last velocity, but for these standard deviations
    acceleration_m: float = setting(5.0, 0.01, 1e4)  # m/s^2
    acceleration_rad: float = setting(20.0, 0.01, 1e4)  # rad/s^2
    speed_m: float = setting(1.0, 0.001, 1e3)  # m/s, while no velocity is known
    speed_rad: float = setting(2.0, 0.001, 1e3)  # rad/s
    max_distance_sigmas: float = setting(15.0, 1.0, 1000.0)  # depth residuals beyond are no match
    exposure: str = setting("gain", choices=("none", "gain", "gain_bias"))  # a frame's brightness against the map
    min_opacity: float = setting(0.8, 0.0, 1.0)  # model pixels less covered are not used
    rim_opacity: float = setting(0.93, 0.0, 1.0)  # nor those round which the map covers less than that in the mean
    first_order_iterations: tuple[int, ...] = setting((20, 20), 1, 1000, min_items=1)  # Adam steps, likewise
    first_order_rate: float = setting(0.002, 1e-6, 1.0)  # Adam step, rad and m
    lost_inlier_ratio: float = setting(0.3, 0.0, 1.0)  # fewer matched pixels with a residual below 3 sigma: lost
    lost_overlap: float = setting(0.1, 0.0, 1.0)  # fewer live pixels that meet the map: lost
    lost_agreement: float = setting(0.6, 0.0, 1.0)  # fewer of those with the map's depth: lost
    lost_colour_residual: float = setting(0.04, 0.0, 1.0)  # a mean intensity residual up to this is never suspect
    lost_colour_ratio: float = setting(3.0, 1.0, 1000.0)  # above it, more than this times the usual one is: lost
    lost_condition: float = setting(1e7, 1.0, 1e15)  # worse conditioned normal equations: lost


@dataclass(frozen=True)
class KeyframeConfig:
    """When a frame becomes a keyframe (section 3.1, co-visibility)."""

    min_overlap: float = setting(0.85, 0.0, 1.0)  # Gaussians seen by frame and last keyframe, intersection over union
    max_unexplained: float = setting(0.08, 0.0, 1.0)  # share of pixels with depth that the map does not cover
    max_translation: float = setting(0.1, 0.0, 100.0)  # since the last keyframe, relative to the median depth
    max_interval: int = setting(30, 1, 100_000)  # frames


@dataclass(frozen=True)
class SeedingConfig:
    """Gaussians from RGB-D."""

    smallest_cell_px: int = setting(2, 1, 64)  # cells at edges, texture and off planes
    cells_across: int = setting(
        80, 1, 10_000
    )  # the image, about so many of the largest cells: doublings of the smallest
    plane_cells_across: int = setting(40, 1, 10_000)  # likewise on one plane (PGI)
    plain_colour_std: float = setting(0.015, 0.0, 1.0)  # a cell whose channels vary less has no texture
    plane_colour_std: float = setting(0.022, 0.0, 1.0)  # likewise for a cell on one plane, but for a linear trend
    planar_sigmas: float = setting(2.5, 0.0, 100.0)  # a cell whose plane residual is less, in sensor sigmas, is flat
    overlap: float = setting(0.6, 0.1, 3.0)  # standard deviation of a Gaussian in cell sizes
    thickness: float = setting(0.1, 1e-3, 1.0)  # standard deviation along the normal, relative to across
    opacity: float = setting(0.9, 0.01, 0.99)


@dataclass(frozen=True)
class MappingConfig:
    """Insertion, pruning and refinement of the map."""

    optimizer: str = setting("relaxation", choices=("relaxation", "adam"))  # how colours move; geometry moves by Adam
    window: int = setting(6, 1, 1000)  # latest keyframes refined together
    anchors: str = setting(
        "structure", choices=("structure", "random", "none")
    )  # earlier ones that are refined with it
    anchor_count: int = setting(2, 0, 1000)  # SGVs, whose poses hold still
    iterations: int = setting(12, 0, 10_000)  # views rendered and refined a keyframe
    final_iterations: int = setting(120, 0, 1_000_000)  # after the last frame, over all keyframes; 0 = off
    refine_poses: bool = setting(False)  # in the window; tracking has been the better judge since it knows references
    insert_opacity: float = setting(0.6, 0.0, 1.0)  # the map does not explain a pixel that it covers less than this
    insert_sigmas: float = setting(8.0, 0.0, 1000.0)  # nor one whose surface stands this far in front of the map's
    coarse_factor: float = setting(2.5, 1.0, 100.0)  # Gaussians this much larger than needed are seeded anew, finer
    prune_opacity: float = setting(0.05, 0.0, 1.0)
    prune_weight_px: float = setting(0.05, 0.0, 1000.0)  # blend weight summed over the window's pixels
    rate_mean_px: float = setting(0.15, 0.0, 10.0)  # Adam steps: pixels of the median depth
    rate_scale: float = setting(0.005, 0.0, 1.0)  # in log scale
    rate_rotation: float = setting(0.002, 0.0, 1.0)
    rate_opacity: float = setting(0.03, 0.0, 10.0)  # in logit
    rate_colour: float = setting(0.01, 0.0, 1.0)  # only with optimizer: adam
    rate_pose: float = setting(0.0003, 0.0, 1.0)  # rad and m
    relaxation: float = setting(0.7, 0.0, 1.9)  # of colours; 1 = the full step


@dataclass(frozen=True)
class PlanesConfig:
    """Planes of single views, and the persistent ones (PGIs, section 3.3) that they are matched to."""

    enabled: bool = setting(False)  # False: the map knows nothing of planes
    # Segments of single views (section 3.2); sigmas are of the sensor's inverse depth at a pixel
    max_segments: int = setting(32, 1, 1000)  # K: the largest ones are kept
    cells_across: int = setting(80, 8, 1000)  # the image: segmentation starts from squares of at least 4 px
    cell_share: float = setting(0.5, 0.1, 1.0)  # of a cell's pixels that must be measured
    cell_sigmas: float = setting(1.4, 0.1, 100.0)  # a cell whose residual is more is not plane
    join_sigmas: float = setting(6.0, 0.1, 100.0)  # deviation of two planes under their covariances
    join_shift_sigmas: float = setting(1.2, 0.0, 100.0)  # and beyond: of a pixel, joining shifts planes at most so far
    join_shift_m: float = setting(0.01, 0.0, 1.0)  # likewise, of depth, on a surface without steps
    across_area_m2: float = setting(0.5, 0.0, 1000.0)  # of the larger of two pieces that something stands before
    pixel_sigmas: float = setting(3.0, 0.5, 100.0)  # of a pixel from its plane
    min_area_share: float = setting(0.003, 0.0, 1.0)  # of the image
    max_rms_sigmas: float = setting(2.5, 0.1, 100.0)  # residual beyond which a segment is not plane
    max_bend_sigmas: float = setting(0.35, 1e-3, 100.0)  # likewise, of the part that is a paraboloid, and that
    max_bend_m: float = setting(0.005, 1e-5, 1.0)  # in depth; only beyond both a surface is not plane
    reliable_area_share: float = setting(0.01, 0.0, 1.0)  # of the image
    reliable_width_cells: float = setting(3.5, 0.0, 1000.0)  # narrower segments may be two strips of other surfaces
    reliable_angle_rad: float = setting(0.01, 1e-5, 1.0)  # standard deviation beyond which a segment is ambiguous
    reliable_offset_m: float = setting(0.005, 1e-5, 1.0)  # likewise
    reliable_curvature: float = setting(0.5, 1e-3, 1000.0)  # 1/m; rounder surfaces fall into strips that look plane
    reliable_cosine: float = setting(0.17, 0.0, 1.0)  # of the angle between normal and line of sight
    # Planar Gaussian Instances
    cell_m: float = setting(0.05, 0.005, 1.0)  # of the grid that holds the extent of a PGI
    max_angle_rad: float = setting(0.2, 0.01, 1.57)  # theta_max of Eq. 5
    max_offset_ratio: float = setting(0.1, 1e-3, 10.0)  # delta_max of Eq. 5, offsets from the camera
    max_distance_m: float = setting(0.15, 0.001, 10.0)  # centroid of a segment to the plane of its PGI
    gate_sigmas: float = setting(3.4, 0.5, 100.0)  # deviation of a segment from its PGI under both covariances
    weight_angle: float = setting(0.5, 0.0, 100.0)  # w_theta of Eq. 7
    weight_offset: float = setting(0.5, 0.0, 100.0)  # w_d of Eq. 7
    weight_overlap: float = setting(1.0, 0.0, 100.0)  # w_o of Eq. 7
    min_overlap: float = setting(0.25, 0.0, 1.0)  # intersection of the two masks over the smaller one
    mask_width_px: int = setting(96, 16, 4096)  # the masks of Eq. 6 are at most this wide
    max_gap_m: float = setting(0.1, 0.0, 10.0)  # surfaces this close to each other in their plane adjoin
    bridge_m: float = setting(3.0, 0.0, 100.0)  # likewise across a gap, unless a view looks through it
    bridge_area_m2: float = setting(0.9, 0.0, 1000.0)  # of both, where part of the gap is outside the image
    pose_sigma_rad: float = setting(0.003, 0.0, 1.0)  # of a keyframe in the world
    pose_sigma_m: float = setting(0.01, 1e-4, 1.0)  # likewise
    step_sigma_rad: float = setting(0.001, 0.0, 1.0)  # of a keyframe relative to the one before
    step_sigma_m: float = setting(0.003, 0.0, 1.0)  # likewise
    model_sigma_m: float = setting(0.003, 1e-5, 1.0)  # real surfaces are not quite planes
    bias_per_m2: float = setting(0.0007, 0.0, 1.0)  # a sensor bends surfaces at depth z by this * z^2, 1/m
    independent_views: int = setting(10, 1, 100_000)  # however many there are, they inform no more than so many
    observations: int = setting(256, 8, 100_000)  # kept of each PGI
    confirm_views: int = setting(3, 2, 1000)  # of an ambiguous segment make it a PGI; one less if parallel to a wall
    candidate_keyframes: int = setting(10, 1, 100_000)  # in which it is not confirmed drop it
    through_share: float = setting(0.6, 0.1, 1.0)  # of a PGI seen through in a view speaks against it
    through_keyframes: int = setting(3, 1, 1000)  # that speak against a PGI, one after the other, remove it
    # Structure cue for keyframes (section 3.1)
    cue_angle_rad: float = setting(0.2, 0.0, 3.15)  # tau_theta
    cue_distance_m: float = setting(0.25, 0.0, 100.0)  # tau_d
    cue_ratio: float = setting(0.5, 0.0, 1.0)  # tau_ratio


@dataclass(frozen=True)
class StructureConfig:
    """What planes ask of the map: the instance field (Eqs. 1-4) and the regularisers (Eqs. 8, 9), as of Eq. 14."""

    lambda_pgi: float = setting(0.03, 0.0, 100.0)  # what E_pgi weighs for geometry; 0 = no instance field
    identity: str = setting("colour", choices=("colour", "scalar"))  # what a Gaussian carries of its plane's id
    scalar_ids: int = setting(64, 1, 100_000)  # with identity: scalar, ids that can be told apart
    pgi_interval: int = setting(3, 1, 1000)  # refinements of a keyframe, from one that sees its planes to the next
    charbonnier_pgi: float = setting(0.1, 1e-6, 1.0)  # epsilon of Eq. 4, colour in [0, 1]
    edge_boost: float = setting(2.0, 0.0, 100.0)  # pixels at a boundary weigh 1 + this
    weight_none: float = setting(0.5, 0.0, 1.0)  # weight of measured pixels that are on no plane
    relaxation: float = setting(1.0, 0.0, 1.9)  # of embeddings; 1 = the full step
    fringe_share: float = setting(2.0, 0.0, 100.0)  # of its best view: one that shows less of a Gaussian moves it less
    read_margin: float = setting(0.05, 0.0, 1.0)  # ids are read where no other code is less than this farther
    read_opacity: float = setting(0.5, 0.01, 1.0)  # and rendered opacity is at least this
    read_distance_m: float = setting(0.05, 0.0, 10.0)  # and the rendered surface is at most this far from the plane
    read_sigmas: float = setting(3.0, 0.0, 100.0)  # and so many standard deviations of the sensor's depth, and adjoins
    read_margin_m: float = setting(0.05, 0.001, 10.0)  # what lies no farther than this beyond where the plane was seen
    lambda_str: float = setting(0.08, 0.0, 100.0)  # what E_str weighs; 0 = no regularisers
    omega_flat: float = setting(1.0, 0.0, 100.0)  # of Eq. 8, scales relative to sqrt(s1 s2)
    omega_normal: float = setting(0.3, 0.0, 100.0)  # of Eq. 9
    omega_distance: float = setting(0.4, 0.0, 100.0)  # of the distance to the plane
    thinness: float = setting(0.1, 0.0, 1.0)  # k of Eq. 8
    sigma_distance_m: float = setting(0.03, 1e-5, 1.0)  # farther off, a Gaussian is left where it is


@dataclass(frozen=True)
class ClosureConfig:
    """The pose graph over keyframes, and what planes seen again say to it (sections 3.3, 3.4)."""

    enabled: bool = setting(False)  # False: keyframes stay where tracking has put them
    formulation: str = setting("landmarks", choices=("closures", "landmarks", "both"))  # edges, planes as variables
    solver: str = setting("incremental", choices=("incremental", "batch"))  # iSAM2, Levenberg-Marquardt
    # A step's error beyond what tracking's residuals show
    odometry_sigma_rad: float = setting(0.0002, 1e-7, 1.0)
    odometry_sigma_m: float = setting(0.0006, 1e-7, 1.0)
    # The map follows when a keyframe has moved or turned by so much
    least_shift_m: float = setting(0.003, 0.0, 1.0)
    least_turn_rad: float = setting(0.001, 0.0, 1.0)
    robust: str = setting("cauchy", choices=("none", "huber", "cauchy", "dcs"))  # noise of closures and planes
    robust_sigmas: float = setting(3.0, 0.1, 1000.0)  # beyond which an error counts less
    # By what a surface strays from its plane in one view and not in others. Most of it all views see alike: that shifts
    # the plane, and no keyframe
    surface_sigma_m: float = setting(0.0003, 1e-5, 1.0)
    relinearise: float = setting(0.02, 0.0, 1.0)  # rad and m; with solver: incremental
    # Structure closures (formulation: closures or both): which keyframes are compared, and what of it becomes an edge
    interval: int = setting(4, 1, 1000)  # k of Table 4: at every k-th keyframe
    min_gap: int = setting(2, 1, 100_000)  # keyframes between the two: small planes are in view for a few only
    max_edges: int = setting(10, 1, 100)  # of a keyframe to earlier ones
    min_angle_rad: float = setting(0.35, 0.01, 1.57)  # between the normals of two shared planes
    known_rad: float = setting(0.02, 1e-4, 10.0)  # directions of the motion that are measured no better than this
    known_m: float = setting(0.05, 1e-4, 10.0)  # count as not measured
    gate_probability: float = setting(0.99, 0.5, 1.0)  # of a right measurement to pass a chi-square test
    # Their refinement (multi-plane ICP)
    icp_rounds: int = setting(3, 0, 100)  # 0 = off
    samples_px: int = setting(2, 1, 64)  # every n-th pixel and row: of too few, fits are worse than the views' own
    model_sigma_m: float = setting(0.003, 1e-5, 1.0)  # real surfaces are not quite planes
    match_distance_m: float = setting(0.1, 0.001, 10.0)  # of points off planes; those farther apart do not match
    min_matches: int = setting(60, 1, 1_000_000)  # of them, for their word to count
    match_sigma_rad: float = setting(0.005, 1e-6, 1.0)  # what they have in error together, however many they are
    match_sigma_m: float = setting(0.01, 1e-6, 1.0)


@dataclass(frozen=True)
class LoopConfig:
    """Visual loop closures: keyframes that look the same, whatever the graph says of where they are."""

    enabled: bool = setting(False)  # not part of the method; off, what structure closures do is seen alone
    features: int = setting(400, 50, 10_000)  # of a keyframe, at most
    corner_contrast: int = setting(10, 1, 254)  # of FAST corners, steps of 1/255
    max_bits: int = setting(64, 0, 256)  # of 256 in which descriptors of one point differ
    ratio: float = setting(0.85, 0.1, 1.0)  # of that to the same for the next best point: more is ambiguous
    min_gap: int = setting(10, 1, 100_000)  # keyframes between the two
    candidates: int = setting(4, 2, 100)  # earlier keyframes that are compared with one, the most alike
    # What makes two keyframes views of one place
    min_inliers: int = setting(25, 6, 10_000)  # points that agree on one motion, each at a place of its own
    min_inlier_share: float = setting(0.5, 0.0, 1.0)  # of the points that match by their looks
    min_seen_again: float = setting(0.15, 0.0, 1.0)  # of the points that both views ought to see
    min_depth_agreement: float = setting(0.8, 0.0, 1.0)  # of depth that both views ought to see
    min_overlap: float = setting(0.2, 0.01, 1.0)  # of the images, where it agrees
    partner_gap: int = setting(6, 1, 1000)  # keyframes at most between an earlier one and a second that confirms it
    partner_rad: float = setting(0.03, 1e-4, 3.15)  # by which the two may disagree
    partner_m: float = setting(0.06, 1e-4, 10.0)
    understated: float = setting(10.0, 1.0, 1000.0)  # drift may be so many times what the graph believes
    gate_probability: float = setting(0.99, 0.5, 1.0)  # of a right motion to pass a chi-square test of that
    # The motion
    inlier_px: float = setting(3.0, 0.1, 100.0)  # at the finest level of the images, to begin with
    pixel_sigma: float = setting(0.8, 0.01, 100.0)  # of a feature, likewise
    model_sigma_m: float = setting(0.005, 1e-5, 1.0)  # of depth, beyond the sensor's noise
    common_sigma_rad: float = setting(0.002, 1e-6, 1.0)  # what all features, or all of depth, have in error together
    common_sigma_m: float = setting(0.005, 1e-6, 1.0)
    known_rad: float = setting(0.02, 1e-4, 10.0)  # a motion known no better than this in any direction is no closure
    known_m: float = setting(0.05, 1e-4, 10.0)


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
    tracking: TrackingConfig = dataclasses.field(default_factory=TrackingConfig)
    keyframes: KeyframeConfig = dataclasses.field(default_factory=KeyframeConfig)
    seeding: SeedingConfig = dataclasses.field(default_factory=SeedingConfig)
    mapping: MappingConfig = dataclasses.field(default_factory=MappingConfig)
    planes: PlanesConfig = dataclasses.field(default_factory=PlanesConfig)
    loss: LossConfig = dataclasses.field(default_factory=LossConfig)
    structure: StructureConfig = dataclasses.field(default_factory=StructureConfig)
    closures: ClosureConfig = dataclasses.field(default_factory=ClosureConfig)
    loops: LoopConfig = dataclasses.field(default_factory=LoopConfig)
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)
