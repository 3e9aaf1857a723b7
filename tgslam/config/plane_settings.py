"""Settings of planes: how views and runs find them, and what they ask of the map.

Each section holds what a user may turn. Its `expert` part holds what needs knowledge of the algorithm to be turned.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from tgslam.config.setting import setting


@dataclass(frozen=True)
class SegmentationSettings:
    """How the cells of one depth image grow into segments. Sigmas are of the sensor's inverse depth at a pixel."""

    segmentation_cells_across: int = setting(
        80, 8, 1000, doc="Cells in a row of the image, from which segments grow; a cell has at least 4 px a side."
    )
    cell_share: float = setting(0.5, 0.1, 1.0, doc="Share of a cell's pixels that must be measured.")
    cell_sigmas: float = setting(
        1.4, 0.1, 100.0, doc="Root mean square residual of a cell, in sigmas, beyond which it is not plane."
    )
    join_sigmas: float = setting(
        6.0, 0.1, 100.0, doc="Deviation of two planes under their covariances, in sigmas, up to which they are joined."
    )
    join_shift_sigmas: float = setting(
        1.2, 0.0, 100.0, doc="By how many sigmas of a pixel joining may shift planes beyond that: sensors bend planes."
    )
    join_shift_m: float = setting(
        0.01,
        0.0,
        1.0,
        doc="By how much depth, in m, joining may shift planes beyond that, on a surface without steps: "
        "real surfaces stray from planes.",
    )
    piece_share: float = setting(
        0.25, 0.0, 1.0, doc="Share of the least area of a segment that its pieces have before gaps are bridged."
    )
    pixel_sigmas: float = setting(
        3.0, 0.5, 100.0, doc="Distance of a pixel from a plane, in sigmas of its segment, up to which it lies on it."
    )
    max_rms_sigmas: float = setting(
        2.5, 0.1, 100.0, doc="Root mean square residual, in sigmas, beyond which a segment is not plane."
    )
    max_bend_sigmas: float = setting(
        0.35,
        1e-3,
        100.0,
        doc="Root mean square, in sigmas, of the part of the residual that is a paraboloid. A segment beyond this and "
        "beyond max_bend_m is not plane.",
    )
    max_bend_m: float = setting(
        0.005, 1e-5, 1.0, doc="The same in m of depth. A segment is not plane beyond both limits only."
    )


@dataclass(frozen=True)
class StepSettings:
    """When a part of a surface stands off it, as skirting boards and panels do. Sigmas are of mean misfits."""

    step_sigmas: float = setting(
        2.5, 0.1, 100.0, doc="Misfit of squares of cells, in sigmas, beyond which a part stands off its surface."
    )
    strip_sure_sigmas: float = setting(
        4.5, 0.1, 100.0, doc="Misfit along a line, in sigmas, that a strip has at one place at least."
    )
    strip_likely_sigmas: float = setting(2.0, 0.1, 100.0, doc="Misfit along a line, in sigmas, of all of a strip.")
    known_step_sigmas: float = setting(
        1.3, 0.1, 100.0, doc="Half a step that other views have told, in sigmas of a square of pixels, at least."
    )
    known_step_share: float = setting(
        0.35, 0.0, 1.0, doc="Share of a known extent that a view shows off its surface: noise puts little of it there."
    )
    known_step_odds: float = setting(
        3.0, 0.0, 100.0, doc="Logarithm of the odds, by other views, of such a surface over its extent and beside it."
    )


@dataclass(frozen=True)
class ReliabilitySettings:
    """When a segment counts by itself; other views have to confirm all others."""

    reliable_area_share: float = setting(0.01, 0.0, 1.0, doc="Least area, as a share of the image.")
    reliable_width_cells: float = setting(
        3.5, 0.0, 1000.0, doc="Least width, in cells: what is narrower may be two strips of other surfaces."
    )
    reliable_angle_rad: float = setting(0.01, 1e-5, 1.0, doc="Most standard deviation of its normal, rad.")
    reliable_offset_m: float = setting(0.005, 1e-5, 1.0, doc="Most standard deviation of its offset, m.")
    reliable_curvature: float = setting(
        0.5, 1e-3, 1000.0, doc="Most curvature, in 1/m: rounder surfaces fall into strips that look plane."
    )
    reliable_cosine: float = setting(
        0.17, 0.0, 1.0, doc="Least cosine of the angle between its normal and the line of sight."
    )
    reliable_bend_share: float = setting(
        0.7, 0.0, 1.0, doc="Most bend, as a share of the limits beyond which a segment is not plane."
    )


@dataclass(frozen=True)
class AssociationSettings:
    """Which segments may show which PGI (Eqs. 5 to 7)."""

    max_angle_rad: float = setting(
        0.2, 0.01, 1.57, doc="theta_max of Eq. 5: angle between a segment and its PGI at most, rad."
    )
    max_distance_m: float = setting(
        0.15, 0.001, 10.0, doc="Distance of a segment's centroid from the plane of its PGI at most, in m."
    )
    matching_weights: tuple[float, float, float] = setting(
        (0.5, 0.5, 1.0), 0.0, 100.0, doc="w_theta, w_d and w_o of Eq. 7: of angle, offset and overlap of masks."
    )
    max_offset_ratio: float = setting(
        0.1, 1e-3, 10.0, doc="delta_max of Eqs. 5 and 7: difference of offsets from the camera over the larger one."
    )
    gate_sigmas: float = setting(
        3.4, 0.5, 100.0, doc="Deviation of a segment from its PGI, in sigmas under both covariances, at most."
    )
    min_mask_overlap: float = setting(
        0.25, 0.0, 1.0, doc="Intersection of the masks of segment and PGI over the smaller one, at least."
    )
    careful_iou: float = setting(
        0.15, 0.0, 1.0, doc="IoU (Eq. 6) of masks that are matched one to one, at least; less is for pieces."
    )
    lenient_iou: float = setting(
        0.5, 0.0, 1.0, doc="The same in the second round, for a pose that has jumped farther than expected."
    )
    mask_width_px: int = setting(96, 16, 4096, doc="Width of the masks of Eq. 6, px, at most.")


@dataclass(frozen=True)
class GapSettings:
    """Which parts of one plane are one surface."""

    max_gap_m: float = setting(0.1, 0.0, 10.0, doc="Surfaces this close to each other in their plane adjoin, in m.")
    bridge_m: float = setting(
        3.0, 0.0, 100.0, doc="Widest gap, in m, over which two parts are joined, unless a view looks through it."
    )
    bridge_area_m2: float = setting(
        0.9, 0.0, 1000.0, doc="Least area of both parts, in m2, where some of the gap is outside the image."
    )
    across_area_m2: float = setting(
        0.5, 0.0, 1000.0, doc="Least area of the larger part, in m2, where something stands close before the gap."
    )
    close_before_m: float = setting(
        0.15,
        0.0,
        10.0,
        doc="What stands in a gap nearer to the plane than this, in m, may part two surfaces, as a board between two "
        "fronts does; what is farther before it only hides part of it.",
    )


@dataclass(frozen=True)
class UncertaintySettings:
    """How far views of one plane may differ."""

    pose_sigma_rad: float = setting(0.003, 0.0, 1.0, doc="Standard deviation of a keyframe's turn in the world, rad.")
    pose_sigma_m: float = setting(0.01, 1e-4, 1.0, doc="Standard deviation of a keyframe's place in the world, in m.")
    step_sigma_rad: float = setting(
        0.001, 0.0, 1.0, doc="Standard deviation of the turn from one keyframe to the next, rad."
    )
    step_sigma_m: float = setting(
        0.003, 0.0, 1.0, doc="Standard deviation of the motion from one keyframe to the next, in m."
    )
    planarity_sigma_m: float = setting(0.003, 1e-5, 1.0, doc="By how much real surfaces stray from planes, in m.")
    bias_per_m2: float = setting(
        0.0007, 0.0, 1.0, doc="The sensor bends surfaces at depth z by this * z^2; in 1/m, z in m."
    )
    independent_views: int = setting(
        10, 1, 100_000, doc="Views that a PGI's plane is known from as if they erred by themselves, at most."
    )


@dataclass(frozen=True)
class LifetimeSettings:
    """What is kept of PGIs, and when they end."""

    extent_cell_m: float = setting(
        0.05, 0.005, 1.0, doc="Side of the cells, in m, that say where on its plane a PGI has been seen."
    )
    kept_views: int = setting(256, 8, 100_000, doc="Views kept of each PGI, at most; thinned evenly beyond.")
    candidate_keyframes: int = setting(
        10, 1, 100_000, doc="An ambiguous segment that is not seen again in so many keyframes is dropped."
    )
    through_share: float = setting(
        0.6, 0.1, 1.0, doc="A view speaks against a PGI if it sees through at least this share of it."
    )
    through_keyframes: int = setting(
        3, 1, 1000, doc="So many keyframes, one after the other, that speak against a PGI remove it."
    )


@dataclass(frozen=True)
class CueSettings:
    """The structure cue (section 3.1): when planes in view have drifted so far that a keyframe is due."""

    cue_angle_rad: float = setting(
        0.2, 0.0, 3.15, doc="tau_theta: a plane in view has drifted if it has turned by more, rad."
    )
    cue_distance_m: float = setting(
        0.25, 0.0, 100.0, doc="tau_d: so it has if its distance from the camera has changed by more, m."
    )
    cue_ratio: float = setting(
        0.5, 0.0, 1.0, doc="tau_ratio: a keyframe is due if more than this part of the planes has drifted."
    )


@dataclass(frozen=True)
class PlanesExpert:
    """What needs knowledge of the algorithm to be turned."""

    segmentation: SegmentationSettings = field(default_factory=SegmentationSettings)
    steps: StepSettings = field(default_factory=StepSettings)
    reliability: ReliabilitySettings = field(default_factory=ReliabilitySettings)
    association: AssociationSettings = field(default_factory=AssociationSettings)
    gaps: GapSettings = field(default_factory=GapSettings)
    uncertainty: UncertaintySettings = field(default_factory=UncertaintySettings)
    lifetime: LifetimeSettings = field(default_factory=LifetimeSettings)
    cue: CueSettings = field(default_factory=CueSettings)


@dataclass(frozen=True)
class PlanesConfig:
    """Planes of single views (section 3.2), and the persistent ones (PGIs, section 3.3) that they are matched to."""

    enabled: bool = setting(True, doc="Whether planes are looked for; false: the map knows nothing of them.")
    max_segments: int = setting(32, 1, 1000, doc="K: segments of a view that are kept, the largest ones.")
    min_area_share: float = setting(0.003, 0.0, 1.0, doc="Least area of a segment, as a share of the image.")
    confirm_views: int = setting(
        3, 2, 1000, doc="Views of an ambiguous segment that make it a PGI; one less if it is parallel to a wall."
    )
    expert: PlanesExpert = field(default_factory=PlanesExpert)


@dataclass(frozen=True)
class InstanceFieldSettings:
    """How Gaussians learn which plane they are on (Eqs. 1 to 4)."""

    scalar_ids: int = setting(64, 1, 100_000, doc="Ids that can be told apart, with identity: scalar.")
    pgi_interval: int = setting(
        3, 1, 1000, doc="E_pgi takes part in every n-th refinement of a keyframe: embeddings converge in few."
    )
    charbonnier_pgi: float = setting(0.1, 1e-6, 1.0, doc="epsilon of the penalty of Eq. 4, in colour from 0 to 1.")
    edge_boost: float = setting(
        2.0, 0.0, 100.0, doc="w_edge of Eq. 4: a pixel at a boundary of planes weighs 1 + this."
    )
    no_plane_weight: float = setting(0.5, 0.0, 1.0, doc="Weight of a measured pixel that is on no plane.")
    embedding_relaxation: float = setting(1.0, 0.0, 1.9, doc="Step of embeddings; 1 = the full one.")
    fringe_share: float = setting(
        2.0,
        0.0,
        100.0,
        doc="A view moves an embedding less if it shows little of the Gaussian, next to so many times what the best "
        "view shows of it; 0 = all views alike.",
    )


@dataclass(frozen=True)
class ReadingSettings:
    """Which plane a pixel of a rendering shows, and when it shows none."""

    read_margin: float = setting(
        0.05, 0.0, 1.0, doc="Every other code is farther than the nearest one by at least this, in colour from 0 to 1."
    )
    read_opacity: float = setting(0.5, 0.01, 1.0, doc="Rendered opacity is at least this.")
    read_distance_m: float = setting(
        0.05,
        0.0,
        10.0,
        doc="The rendered surface is at most this far from the plane, in m, besides the sensor's noise.",
    )
    read_sigmas: float = setting(
        3.0, 0.0, 100.0, doc="Standard deviations of the sensor's depth that are allowed for that noise."
    )
    read_margin_m: float = setting(
        0.05,
        0.001,
        10.0,
        doc="Pixels count that are connected to one at most this far, in m, from where the plane was seen.",
    )


@dataclass(frozen=True)
class RegulariserSettings:
    """Which shape and place E_str asks for (Eqs. 8, 9)."""

    omega_flat: float = setting(1.0, 0.0, 100.0, doc="Weight in E_str of how thin Gaussians on planes are (Eq. 8).")
    omega_normal: float = setting(0.3, 0.0, 100.0, doc="Weight in E_str of how they are turned (Eq. 9).")
    omega_distance: float = setting(0.4, 0.0, 100.0, doc="Weight in E_str of their distance from the plane.")
    thinness: float = setting(0.1, 0.0, 1.0, doc="k of Eq. 8: least scale over the geometric mean of the others.")
    sigma_distance_m: float = setting(
        0.03, 1e-5, 1.0, doc="A Gaussian that is much farther than this from its plane, in m, is left where it is."
    )


@dataclass(frozen=True)
class StructureExpert:
    """What needs knowledge of the algorithm to be turned."""

    embedding: InstanceFieldSettings = field(default_factory=InstanceFieldSettings)
    reading: ReadingSettings = field(default_factory=ReadingSettings)
    shape: RegulariserSettings = field(default_factory=RegulariserSettings)


@dataclass(frozen=True)
class StructureConfig:
    """What planes ask of the map: the instance field (Eqs. 1-4) and the regularisers (Eqs. 8, 9), as of Eq. 14."""

    lambda_pgi: float = setting(0.03, 0.0, 100.0, doc="What E_pgi (Eq. 4) weighs for geometry; 0 = no instance field.")
    lambda_str: float = setting(0.08, 0.0, 100.0, doc="What E_str weighs; 0 = no regularisers.")
    identity: str = setting(
        "colour",
        choices=("colour", "scalar"),
        doc="What a Gaussian carries of its plane's id: a colour of the palette (Eq. 2), or a scalar for comparison.",
    )
    expert: StructureExpert = field(default_factory=StructureExpert)
