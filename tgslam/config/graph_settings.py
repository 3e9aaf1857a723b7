"""Settings of the pose graph and of the closures that correct it."""

from __future__ import annotations

from dataclasses import dataclass, field

from tgslam.config.setting import setting


@dataclass(frozen=True)
class AcceptanceSettings:
    """When a measured motion between two keyframes counts, and in which directions."""

    known_rad: float = setting(
        0.02, 1e-4, 10.0, doc="A turn that is measured no better than this counts as not measured, rad."
    )
    known_m: float = setting(
        0.05, 1e-4, 10.0, doc="A shift that is measured no better than this counts as not measured, m."
    )
    gate_probability: float = setting(
        0.99, 0.5, 1.0, doc="Probability with which a right measurement passes a chi-square test."
    )


@dataclass(frozen=True)
class SolvingSettings:
    """How the pose graph is solved."""

    graph_solver: str = setting(
        "incremental",
        choices=("incremental", "batch"),
        doc="incremental: iSAM2. batch: Levenberg-Marquardt over everything, each time.",
    )
    relinearise: float = setting(
        0.02,
        0.0,
        1.0,
        doc="A variable that has moved by more than this, rad and m, is linearised anew; only with graph_solver: "
        "incremental.",
    )
    robust: str = setting(
        "cauchy",
        choices=("none", "huber", "cauchy", "dcs"),
        doc="Noise model of structure closures and planes, which limits what a wrong one does.",
    )
    robust_sigmas: float = setting(
        3.0, 0.1, 1000.0, doc="An error beyond so many standard deviations counts less, with any robust model."
    )


@dataclass(frozen=True)
class EvidenceSettings:
    """How far the pose graph trusts tracking and the planes of single views."""

    odometry_sigma_rad: float = setting(
        0.0002, 1e-7, 1.0, doc="Error of a step's rotation beyond what tracking's residuals show, rad."
    )
    odometry_sigma_m: float = setting(
        0.0006, 1e-7, 1.0, doc="Error of a step's translation beyond what tracking's residuals show, m."
    )
    view_sigma_m: float = setting(
        0.0003,
        1e-5,
        1.0,
        doc="By how much a surface strays from its plane in one view and not in others, m. Most of it all views see "
        "alike: that shifts the plane, and no keyframe.",
    )


@dataclass(frozen=True)
class FollowSettings:
    """When the map follows the pose graph: once any keyframe has moved so far."""

    least_shift_m: float = setting(0.003, 0.0, 1.0, doc="The map follows when a keyframe has shifted by this, m.")
    least_turn_rad: float = setting(0.001, 0.0, 1.0, doc="The map follows when a keyframe has turned by this, rad.")


@dataclass(frozen=True)
class IcpSettings:
    """Refinement of structure closures on the points of both views (multi-plane ICP)."""

    icp_rounds: int = setting(3, 0, 100, doc="Rounds of fitting planes anew and solving for the motion; 0 = off.")
    samples_px: int = setting(
        2, 1, 64, doc="Step between pixels that are used, px. Of too few, fits are worse than the views' own."
    )
    flatness_sigma_m: float = setting(
        0.003, 1e-5, 1.0, doc="By how much real surfaces stray from planes, beyond the sensor's noise, m."
    )
    match_distance_m: float = setting(
        0.1, 0.001, 10.0, doc="Points off the planes match surfaces of the other view up to this far away, m."
    )
    min_matches: int = setting(60, 1, 1_000_000, doc="Fewer matches of points off the planes say nothing.")
    match_sigma_rad: float = setting(
        0.005, 1e-6, 1.0, doc="Error in rotation that all such matches have in common, however many they are, rad."
    )
    match_sigma_m: float = setting(0.01, 1e-6, 1.0, doc="Error in translation that all such matches have in common, m.")


@dataclass(frozen=True)
class EdgeSettings:
    """Between which keyframes there are structure closures; with formulation: closures or both."""

    max_edges: int = setting(10, 1, 100, doc="Structure closures of a keyframe to earlier ones, at most.")
    min_angle_rad: float = setting(
        0.35, 0.01, 1.57, doc="Two keyframes must share planes whose normals differ by this, rad."
    )


@dataclass(frozen=True)
class ClosureExpert:
    """What needs knowledge of the algorithm to be turned."""

    solving: SolvingSettings = field(default_factory=SolvingSettings)
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)
    follow: FollowSettings = field(default_factory=FollowSettings)
    edges: EdgeSettings = field(default_factory=EdgeSettings)
    icp: IcpSettings = field(default_factory=IcpSettings)
    acceptance: AcceptanceSettings = field(default_factory=AcceptanceSettings)


@dataclass(frozen=True)
class ClosureConfig:
    """The pose graph over keyframes, and what planes seen again say to it (section 3.4)."""

    enabled: bool = setting(
        True, doc="Planes correct the keyframes' poses. Off, or without planes: they stay where tracking put them."
    )
    formulation: str = setting(
        "landmarks",
        choices=("closures", "landmarks", "both"),
        doc="How planes enter the graph. landmarks: as variables. closures: as motions between keyframes that see "
        "the same planes.",
    )
    interval: int = setting(
        4,
        1,
        1000,
        doc="Every k-th keyframe is compared with earlier ones (k of Table 4); with formulation: closures or both.",
    )
    closure_gap: int = setting(
        2,
        1,
        100_000,
        doc="Keyframes that lie between two that are compared for their planes. Small planes are in view for a few "
        "only.",
    )
    expert: ClosureExpert = field(default_factory=ClosureExpert)


@dataclass(frozen=True)
class FeatureSettings:
    """Which corners of a keyframe are kept, and which of two keyframes' match."""

    corner_contrast: int = setting(10, 1, 254, doc="Contrast of FAST corners, in steps of 1/255 of the intensity.")
    max_bits: int = setting(64, 0, 256, doc="Bits of 256 in which two descriptors of one point differ at most.")
    match_ratio: float = setting(
        0.85, 0.1, 1.0, doc="A match that differs by more than this part of what the next best does is ambiguous."
    )


@dataclass(frozen=True)
class PlaceSettings:
    """What makes two keyframes views of one place."""

    min_inliers: int = setting(
        25, 6, 10_000, doc="Points that must agree on one motion, each at a place of its own in the image."
    )
    min_inlier_share: float = setting(
        0.5, 0.0, 1.0, doc="Least part of the points that match by their looks that agree on one motion."
    )
    min_seen_again: float = setting(
        0.15, 0.0, 1.0, doc="Least part of the points that both views ought to see that match."
    )
    min_depth_agreement: float = setting(
        0.8, 0.0, 1.0, doc="Least part of the depth that both views ought to see that agrees."
    )
    min_depth_overlap: float = setting(0.2, 0.01, 1.0, doc="Least part of either image whose depth agrees.")


@dataclass(frozen=True)
class LoopMotionSettings:
    """How the motion between two such views is measured."""

    inlier_px: float = setting(
        3.0, 0.1, 100.0, doc="Error up to which a point agrees with a sampled motion, px of the full image."
    )
    pixel_sigma: float = setting(
        0.8, 0.01, 100.0, doc="Standard deviation of a feature's place, px at the pyramid level where it was found."
    )
    depth_floor_sigma_m: float = setting(0.005, 1e-5, 1.0, doc="Error of depth beyond the sensor's noise, m.")
    common_sigma_rad: float = setting(
        0.002, 1e-6, 1.0, doc="Error in rotation that all features, or all of depth, have in common, rad."
    )
    common_sigma_m: float = setting(
        0.005, 1e-6, 1.0, doc="Error in translation that all features, or all of depth, have in common, m."
    )


@dataclass(frozen=True)
class ConfirmationSettings:
    """What a verified loop has to agree with: a second earlier keyframe, and the pose graph."""

    partner_gap: int = setting(
        6, 1, 1000, doc="Keyframes at most between an earlier one and a second that confirms it."
    )
    partner_rad: float = setting(0.03, 1e-4, 3.15, doc="Rotation by which the two may disagree, rad.")
    partner_m: float = setting(0.06, 1e-4, 10.0, doc="Translation by which the two may disagree, m.")
    understated: float = setting(10.0, 1.0, 1000.0, doc="Drift may be so many times what the pose graph believes.")


@dataclass(frozen=True)
class LoopExpert:
    """What needs knowledge of the algorithm to be turned."""

    matching: FeatureSettings = field(default_factory=FeatureSettings)
    place: PlaceSettings = field(default_factory=PlaceSettings)
    measuring: LoopMotionSettings = field(default_factory=LoopMotionSettings)
    confirmation: ConfirmationSettings = field(default_factory=ConfirmationSettings)
    acceptance: AcceptanceSettings = field(default_factory=AcceptanceSettings)


@dataclass(frozen=True)
class LoopConfig:
    """Visual loop closures: keyframes that look the same, whatever the graph says of where they are."""

    enabled: bool = setting(
        True, doc="Places that look the same close loops. Not part of the method: off, planes are seen at work alone."
    )
    features: int = setting(400, 50, 10_000, doc="Features that are kept of a keyframe, at most.")
    candidates: int = setting(4, 2, 100, doc="Earlier keyframes that a keyframe is compared with: the most alike.")
    loop_gap: int = setting(10, 1, 100_000, doc="Keyframes that lie between two that are compared for their looks.")
    expert: LoopExpert = field(default_factory=LoopExpert)
