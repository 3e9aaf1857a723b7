"""Settings of the pose graph and of the closures that correct it."""

from __future__ import annotations

from dataclasses import dataclass

from tgslam.config.setting import setting


@dataclass(frozen=True)
class ClosureConfig:
    """The pose graph over keyframes, and what planes seen again say to it (sections 3.3, 3.4)."""

    enabled: bool = setting(False, doc="False: keyframes stay where tracking has put them")
    formulation: str = setting("landmarks", choices=("closures", "landmarks", "both"), doc="edges, planes as variables")
    solver: str = setting("incremental", choices=("incremental", "batch"), doc="iSAM2, Levenberg-Marquardt")
    odometry_sigma_rad: float = setting(0.0002, 1e-7, 1.0, doc="A step's error beyond what tracking's residuals show")
    odometry_sigma_m: float = setting(0.0006, 1e-7, 1.0)
    least_shift_m: float = setting(
        0.003, 0.0, 1.0, doc="The map follows when a keyframe has moved or turned by so much"
    )
    least_turn_rad: float = setting(0.001, 0.0, 1.0)
    robust: str = setting("cauchy", choices=("none", "huber", "cauchy", "dcs"), doc="noise of closures and planes")
    robust_sigmas: float = setting(3.0, 0.1, 1000.0, doc="beyond which an error counts less")
    surface_sigma_m: float = setting(
        0.0003,
        1e-5,
        1.0,
        doc="By what a surface strays from its plane in one view and not in others. Most of it all views see alike: "
        "that shifts the plane, and no keyframe",
    )
    relinearise: float = setting(0.02, 0.0, 1.0, doc="rad and m; with solver: incremental")
    # Structure closures (formulation: closures or both): which keyframes are compared, and what of it becomes an edge
    interval: int = setting(4, 1, 1000, doc="k of Table 4: at every k-th keyframe")
    min_gap: int = setting(2, 1, 100_000, doc="keyframes between the two: small planes are in view for a few only")
    max_edges: int = setting(10, 1, 100, doc="of a keyframe to earlier ones")
    min_angle_rad: float = setting(0.35, 0.01, 1.57, doc="between the normals of two shared planes")
    known_rad: float = setting(0.02, 1e-4, 10.0, doc="directions of the motion that are measured no better than this")
    known_m: float = setting(0.05, 1e-4, 10.0, doc="count as not measured")
    gate_probability: float = setting(0.99, 0.5, 1.0, doc="of a right measurement to pass a chi-square test")
    # Their refinement (multi-plane ICP)
    icp_rounds: int = setting(3, 0, 100, doc="0 = off")
    samples_px: int = setting(2, 1, 64, doc="every n-th pixel and row: of too few, fits are worse than the views' own")
    model_sigma_m: float = setting(0.003, 1e-5, 1.0, doc="real surfaces are not quite planes")
    match_distance_m: float = setting(0.1, 0.001, 10.0, doc="of points off planes; those farther apart do not match")
    min_matches: int = setting(60, 1, 1_000_000, doc="of them, for their word to count")
    match_sigma_rad: float = setting(0.005, 1e-6, 1.0, doc="what they have in error together, however many they are")
    match_sigma_m: float = setting(0.01, 1e-6, 1.0)


@dataclass(frozen=True)
class LoopConfig:
    """Visual loop closures: keyframes that look the same, whatever the graph says of where they are."""

    enabled: bool = setting(False, doc="not part of the method; off, what structure closures do is seen alone")
    features: int = setting(400, 50, 10_000, doc="of a keyframe, at most")
    corner_contrast: int = setting(10, 1, 254, doc="of FAST corners, steps of 1/255")
    max_bits: int = setting(64, 0, 256, doc="of 256 in which descriptors of one point differ")
    ratio: float = setting(0.85, 0.1, 1.0, doc="of that to the same for the next best point: more is ambiguous")
    min_gap: int = setting(10, 1, 100_000, doc="keyframes between the two")
    candidates: int = setting(4, 2, 100, doc="earlier keyframes that are compared with one, the most alike")
    # What makes two keyframes views of one place
    min_inliers: int = setting(25, 6, 10_000, doc="points that agree on one motion, each at a place of its own")
    min_inlier_share: float = setting(0.5, 0.0, 1.0, doc="of the points that match by their looks")
    min_seen_again: float = setting(0.15, 0.0, 1.0, doc="of the points that both views ought to see")
    min_depth_agreement: float = setting(0.8, 0.0, 1.0, doc="of depth that both views ought to see")
    min_overlap: float = setting(0.2, 0.01, 1.0, doc="of the images, where it agrees")
    partner_gap: int = setting(6, 1, 1000, doc="keyframes at most between an earlier one and a second that confirms it")
    partner_rad: float = setting(0.03, 1e-4, 3.15, doc="by which the two may disagree")
    partner_m: float = setting(0.06, 1e-4, 10.0)
    understated: float = setting(10.0, 1.0, 1000.0, doc="drift may be so many times what the graph believes")
    gate_probability: float = setting(0.99, 0.5, 1.0, doc="of a right motion to pass a chi-square test of that")
    # The motion
    inlier_px: float = setting(3.0, 0.1, 100.0, doc="at the finest level of the images, to begin with")
    pixel_sigma: float = setting(0.8, 0.01, 100.0, doc="of a feature, likewise")
    model_sigma_m: float = setting(0.005, 1e-5, 1.0, doc="of depth, beyond the sensor's noise")
    common_sigma_rad: float = setting(
        0.002, 1e-6, 1.0, doc="what all features, or all of depth, have in error together"
    )
    common_sigma_m: float = setting(0.005, 1e-6, 1.0)
    known_rad: float = setting(
        0.02, 1e-4, 10.0, doc="a motion known no better than this in any direction is no closure"
    )
    known_m: float = setting(0.05, 1e-4, 10.0)
