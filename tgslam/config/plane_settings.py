"""Settings of planes: in single views, and persistent ones."""

from __future__ import annotations

from dataclasses import dataclass

from tgslam.config.setting import setting


@dataclass(frozen=True)
class PlanesConfig:
    """Planes of single views, and the persistent ones (PGIs, section 3.3) that they are matched to."""

    enabled: bool = setting(False, doc="False: the map knows nothing of planes")
    # Segments of single views (section 3.2); sigmas are of the sensor's inverse depth at a pixel
    max_segments: int = setting(32, 1, 1000, doc="K: the largest ones are kept")
    cells_across: int = setting(80, 8, 1000, doc="the image: segmentation starts from squares of at least 4 px")
    cell_share: float = setting(0.5, 0.1, 1.0, doc="of a cell's pixels that must be measured")
    cell_sigmas: float = setting(1.4, 0.1, 100.0, doc="a cell whose residual is more is not plane")
    join_sigmas: float = setting(6.0, 0.1, 100.0, doc="deviation of two planes under their covariances")
    join_shift_sigmas: float = setting(
        1.2, 0.0, 100.0, doc="and beyond: of a pixel, joining shifts planes at most so far"
    )
    join_shift_m: float = setting(0.01, 0.0, 1.0, doc="likewise, of depth, on a surface without steps")
    across_area_m2: float = setting(0.5, 0.0, 1000.0, doc="of the larger of two pieces that something stands before")
    pixel_sigmas: float = setting(3.0, 0.5, 100.0, doc="of a pixel from its plane")
    min_area_share: float = setting(0.003, 0.0, 1.0, doc="of the image")
    max_rms_sigmas: float = setting(2.5, 0.1, 100.0, doc="residual beyond which a segment is not plane")
    max_bend_sigmas: float = setting(0.35, 1e-3, 100.0, doc="likewise, of the part that is a paraboloid, and that")
    max_bend_m: float = setting(0.005, 1e-5, 1.0, doc="in depth; only beyond both a surface is not plane")
    reliable_area_share: float = setting(0.01, 0.0, 1.0, doc="of the image")
    reliable_width_cells: float = setting(3.5, 0.0, 1000.0, doc="narrower segments may be two strips of other surfaces")
    reliable_angle_rad: float = setting(0.01, 1e-5, 1.0, doc="standard deviation beyond which a segment is ambiguous")
    reliable_offset_m: float = setting(0.005, 1e-5, 1.0, doc="likewise")
    reliable_curvature: float = setting(0.5, 1e-3, 1000.0, doc="1/m; rounder surfaces fall into strips that look plane")
    reliable_cosine: float = setting(0.17, 0.0, 1.0, doc="of the angle between normal and line of sight")
    # Planar Gaussian Instances
    cell_m: float = setting(0.05, 0.005, 1.0, doc="of the grid that holds the extent of a PGI")
    max_angle_rad: float = setting(0.2, 0.01, 1.57, doc="theta_max of Eq. 5")
    max_offset_ratio: float = setting(0.1, 1e-3, 10.0, doc="delta_max of Eq. 5, offsets from the camera")
    max_distance_m: float = setting(0.15, 0.001, 10.0, doc="centroid of a segment to the plane of its PGI")
    gate_sigmas: float = setting(3.4, 0.5, 100.0, doc="deviation of a segment from its PGI under both covariances")
    weight_angle: float = setting(0.5, 0.0, 100.0, doc="w_theta of Eq. 7")
    weight_offset: float = setting(0.5, 0.0, 100.0, doc="w_d of Eq. 7")
    weight_overlap: float = setting(1.0, 0.0, 100.0, doc="w_o of Eq. 7")
    min_overlap: float = setting(0.25, 0.0, 1.0, doc="intersection of the two masks over the smaller one")
    mask_width_px: int = setting(96, 16, 4096, doc="the masks of Eq. 6 are at most this wide")
    max_gap_m: float = setting(0.1, 0.0, 10.0, doc="surfaces this close to each other in their plane adjoin")
    bridge_m: float = setting(3.0, 0.0, 100.0, doc="likewise across a gap, unless a view looks through it")
    bridge_area_m2: float = setting(0.9, 0.0, 1000.0, doc="of both, where part of the gap is outside the image")
    pose_sigma_rad: float = setting(0.003, 0.0, 1.0, doc="of a keyframe in the world")
    pose_sigma_m: float = setting(0.01, 1e-4, 1.0, doc="likewise")
    step_sigma_rad: float = setting(0.001, 0.0, 1.0, doc="of a keyframe relative to the one before")
    step_sigma_m: float = setting(0.003, 0.0, 1.0, doc="likewise")
    model_sigma_m: float = setting(0.003, 1e-5, 1.0, doc="real surfaces are not quite planes")
    bias_per_m2: float = setting(0.0007, 0.0, 1.0, doc="a sensor bends surfaces at depth z by this * z^2, 1/m")
    independent_views: int = setting(10, 1, 100_000, doc="however many there are, they inform no more than so many")
    observations: int = setting(256, 8, 100_000, doc="kept of each PGI")
    confirm_views: int = setting(
        3, 2, 1000, doc="of an ambiguous segment make it a PGI; one less if parallel to a wall"
    )
    candidate_keyframes: int = setting(10, 1, 100_000, doc="in which it is not confirmed drop it")
    through_share: float = setting(0.6, 0.1, 1.0, doc="of a PGI seen through in a view speaks against it")
    through_keyframes: int = setting(3, 1, 1000, doc="that speak against a PGI, one after the other, remove it")
    # Structure cue for keyframes (section 3.1)
    cue_angle_rad: float = setting(0.2, 0.0, 3.15, doc="tau_theta")
    cue_distance_m: float = setting(0.25, 0.0, 100.0, doc="tau_d")
    cue_ratio: float = setting(0.5, 0.0, 1.0, doc="tau_ratio")


@dataclass(frozen=True)
class StructureConfig:
    """What planes ask of the map: the instance field (Eqs. 1-4) and the regularisers (Eqs. 8, 9), as of Eq. 14."""

    lambda_pgi: float = setting(0.03, 0.0, 100.0, doc="what E_pgi weighs for geometry; 0 = no instance field")
    identity: str = setting("colour", choices=("colour", "scalar"), doc="what a Gaussian carries of its plane's id")
    scalar_ids: int = setting(64, 1, 100_000, doc="with identity: scalar, ids that can be told apart")
    pgi_interval: int = setting(3, 1, 1000, doc="refinements of a keyframe, from one that sees its planes to the next")
    charbonnier_pgi: float = setting(0.1, 1e-6, 1.0, doc="epsilon of Eq. 4, colour in [0, 1]")
    edge_boost: float = setting(2.0, 0.0, 100.0, doc="pixels at a boundary weigh 1 + this")
    weight_none: float = setting(0.5, 0.0, 1.0, doc="weight of measured pixels that are on no plane")
    relaxation: float = setting(1.0, 0.0, 1.9, doc="of embeddings; 1 = the full step")
    fringe_share: float = setting(
        2.0, 0.0, 100.0, doc="of its best view: one that shows less of a Gaussian moves it less"
    )
    read_margin: float = setting(0.05, 0.0, 1.0, doc="ids are read where no other code is less than this farther")
    read_opacity: float = setting(0.5, 0.01, 1.0, doc="and rendered opacity is at least this")
    read_distance_m: float = setting(0.05, 0.0, 10.0, doc="and the rendered surface is at most this far from the plane")
    read_sigmas: float = setting(
        3.0, 0.0, 100.0, doc="and so many standard deviations of the sensor's depth, and adjoins"
    )
    read_margin_m: float = setting(
        0.05, 0.001, 10.0, doc="what lies no farther than this beyond where the plane was seen"
    )
    lambda_str: float = setting(0.08, 0.0, 100.0, doc="what E_str weighs; 0 = no regularisers")
    omega_flat: float = setting(1.0, 0.0, 100.0, doc="of Eq. 8, scales relative to sqrt(s1 s2)")
    omega_normal: float = setting(0.3, 0.0, 100.0, doc="of Eq. 9")
    omega_distance: float = setting(0.4, 0.0, 100.0, doc="of the distance to the plane")
    thinness: float = setting(0.1, 0.0, 1.0, doc="k of Eq. 8")
    sigma_distance_m: float = setting(0.03, 1e-5, 1.0, doc="farther off, a Gaussian is left where it is")
