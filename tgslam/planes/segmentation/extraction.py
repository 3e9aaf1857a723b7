"""Planes of a single depth image (section 3.2): cells -> graph -> agglomeration -> pixels -> fit -> judgement."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np

from tgslam.camera import Camera, SensorNoise
from tgslam.config.plane_settings import PlanesConfig, ReliabilitySettings, SegmentationSettings
from tgslam.device import runtime
from tgslam.ops.plane_fit import CellGrid, Floats, Indices, PixelLabels
from tgslam.planes.segment import PlaneSegment, PlaneView
from tgslam.planes.segmentation.bridging import Pieces, bridge
from tgslam.planes.segmentation.cells import CellGraph, planar_cells
from tgslam.planes.segmentation.layers import bordering, group_moments, parallel, part_layers, settle
from tgslam.planes.segmentation.merging import Agreement, agglomerate
from tgslam.planes.segmentation.moments import NOISE, noise_of, planes_of, squared_residuals
from tgslam.planes.segmentation.statistics import Evidence, evidence, totals

_ROBUST_ROUNDS = 2  # of labels and fit: the first labels are by planes of whole cells, the second by planes of pixels
_CHARBONNIER_SIGMAS = 1.5  # of the sensor: what is farther off a plane counts less and less in its fit
_MIN_CELLS = 2  # of a piece: one cell has no neighbour to agree with
_LAYER_PIECES = 4  # times as large as a piece is a part that is taken out of one
_LARGE_SHARE = 0.05  # of the image, that a group has for cells to join it from anywhere
_SQUARE_CELLS = 4  # side of the squares that tell the sensor's far-reaching errors from those of a few pixels
_FEWEST_PX = 6  # of a segment, however small the image: twice as many as a plane has parameters


def extract_planes(depth_m: np.ndarray, camera: Camera, config: PlanesConfig, noise: SensorNoise) -> PlaneView:
    """Find the planes that a depth image shows, the largest first.

    depth_m: device float32 [H, W], m, 0 = none. noise: the sensor's; in inverse depth, in which planes are affine in
    the pixel, it is the same everywhere. Pixels of no plane are labelled -1. Segments that other views have to confirm
    (small, thin, grazing, rough) come with reliable=False.
    """
    limits, sigma = config.expert.segmentation, noise.per_m2
    grid = CellGrid.across(camera, limits.segmentation_cells_across)
    pieces, agreement = _pieces(depth_m, grid, config, sigma)
    if not len(pieces.moments):
        return PlaneView(np.full(camera.shape, -1, np.int32), ())
    pixels = PixelLabels(depth_m, grid, pieces.labels)
    seen_sigma, pairs = noise_of(pieces.moments), bordering(pieces.labels)
    planes, _, _ = parallel(planes_of(pieces.moments), pieces.moments, pairs, agreement, grid.cell_px)
    spread = np.sqrt(squared_residuals(pieces.moments) / pieces.moments[:, 0])
    tolerance = limits.pixel_sigmas * np.clip(spread, seen_sigma, limits.max_rms_sigmas * seen_sigma)
    for _ in range(_ROBUST_ROUNDS):
        pixels.assign(planes, tolerance)
        before = planes
        sums = pixels.sums(before, _CHARBONNIER_SIGMAS * sigma)
        moments = np.column_stack([totals(sums, len(before)), seen_sigma**2])
        moments[:, NOISE] *= moments[:, 0]
        planes, aligned, stepped = parallel(before + planes_of(moments), moments, pairs, agreement, grid.cell_px)
    fewest_px = max(config.min_area_share * camera.width * camera.height, _FEWEST_PX)
    seen = evidence(planes, planes - before, sums, grid, sigma, fewest_px)
    found = _with_alignment(_judged(seen, seen_sigma / sigma, grid, config), aligned)
    number = np.full(len(planes) + 1, -1, np.int32)
    number[[index for index, _ in found]] = np.arange(len(found))
    steps = frozenset((int(number[i]), int(number[j])) for i, j in stepped if number[i] >= 0 and number[j] >= 0)
    return PlaneView(number.take(pixels.read()), tuple(segment for _, segment in found), steps)


def _pieces(depth_m: np.ndarray, grid: CellGrid, config: PlanesConfig, sigma: float) -> tuple[Pieces, Agreement]:
    """Groups of cells that lie on one plane each; what is too small to become a segment is left out.

    Returns with how far parts of one surface may differ.
    """
    limits = config.expert.segmentation
    graph = planar_cells(depth_m, grid, sigma, limits.cell_share, limits.cell_sigmas)
    squares = graph.squares(grid.shape, _SQUARE_CELLS, limits.cell_sigmas)
    agreement = Agreement.seen_among(graph, squares, sigma, limits.join_sigmas, limits.join_shift_sigmas)
    lenient = dataclasses.replace(agreement, shift_m=limits.join_shift_m)
    group, moments = agglomerate(graph.moments, _continuous(graph, agreement), lenient)
    image_px = grid.camera.width * grid.camera.height
    least_px = limits.piece_share * config.min_area_share * image_px
    group = np.where(moments[group, 0] >= least_px, group, -1)
    group, parent = part_layers(graph, grid.shape, group, lenient, _LAYER_PIECES * least_px, config.expert.steps)
    group = settle(graph, grid.shape, group, _LARGE_SHARE * image_px, parent)
    pieces = _numbered(graph, group, grid, least_px)
    return bridge(pieces, runtime.to_host(depth_m), grid, agreement, config.expert.gaps), lenient


def _numbered(graph: CellGraph, group: Indices, grid: CellGrid, least_px: float) -> Pieces:
    """The groups [N] that have several cells and `least_px` points, numbered from 0."""
    moments = group_moments(graph, group)[:-1]
    kept = (moments[:, 0] >= least_px) & (np.bincount(group[group >= 0], minlength=len(moments)) >= _MIN_CELLS)
    number = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)  # -1 takes the last one
    labels = np.full(len(grid), -1, np.int32)
    labels[graph.cell] = number[group]
    return Pieces(labels.reshape(grid.shape), moments[kept])


def _continuous(graph: CellGraph, agreement: Agreement) -> Indices:
    """[E, 2] those edges of the graph across which the surface has no step."""
    return graph.edges[agreement.admits(graph.joints)]


def _judged(
    candidates: Iterable[tuple[int, Evidence]], noise_sigmas: Floats, grid: CellGrid, config: PlanesConfig
) -> list[tuple[int, PlaneSegment]]:
    """Index and segment of the largest ones that are planes. noise_sigmas: [P] the noise as the sensor's standard."""
    found, limits = [], config.expert.segmentation
    for index, seen in candidates:
        smooth = seen.segment.rms_sigmas <= limits.max_rms_sigmas * noise_sigmas[index]
        bend = _bend(seen, limits)
        if smooth and bend <= 1.0:
            reliable = _is_reliable(seen, bend, grid, config.expert.reliability)
            found.append((index, dataclasses.replace(seen.segment, reliable=reliable)))
    found.sort(key=lambda item: (-item[1].area_px, item[0]))
    return found[: config.max_segments]


def _with_alignment(found: list[tuple[int, PlaneSegment]], aligned: dict[int, int]) -> list[tuple[int, PlaneSegment]]:
    """Index and segment, where those that have their normal from another one know it as well as that."""
    segments = dict(found)
    for small, large in aligned.items():
        if small in segments and large in segments:
            covariance = np.zeros((3, 3))
            covariance[:2, :2] = segments[large].covariance[:2, :2]
            covariance[2, 2] = segments[small].covariance[2, 2]
            segments[small] = dataclasses.replace(segments[small], covariance=covariance)
    return list(segments.items())


def _bend(seen: Evidence, limits: SegmentationSettings) -> float:
    """By how much a surface is bent, over what is allowed: what the sensor may feign, or a real plane's unevenness."""
    return min(seen.bend_sigmas / limits.max_bend_sigmas, seen.bend_m / limits.max_bend_m)


def _is_reliable(seen: Evidence, bend: float, grid: CellGrid, limits: ReliabilitySettings) -> bool:
    """Whether a segment counts by itself: other views have to confirm small, thin, grazing, rough and bent ones.

    bend: as of `_bend`.
    """
    segment, image_px = seen.segment, grid.camera.width * grid.camera.height
    turn = float(np.sqrt(np.linalg.eigvalsh(segment.covariance[:2, :2])[-1]))
    return bool(
        segment.area_px >= limits.reliable_area_share * image_px
        and turn <= limits.reliable_angle_rad
        and np.sqrt(segment.covariance[2, 2]) <= limits.reliable_offset_m
        and seen.cosine >= limits.reliable_cosine
        and bend <= limits.reliable_bend_share
        and seen.curvature <= limits.reliable_curvature
        and seen.width_px >= limits.reliable_width_cells * grid.cell_px
    )
