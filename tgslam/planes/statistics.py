"""What the pixels of a segment say of its plane: parameters, covariance, and whether it is a plane at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tgslam.plane_fit import CellGrid, Floats, SegmentSums
from tgslam.planes.moments import information, planes_of, scatter, summed, width_px
from tgslam.planes.segment import PlaneSegment, tangents

_CLUSTER_CELLS = 4  # side of the squares of cells within which noise may be correlated
_FITTED = 3  # parameters


@dataclass(frozen=True)
class Evidence:
    """A segment that nobody has judged yet, and what else there is to judge it by."""

    segment: PlaneSegment
    bend_sigmas: float  # root mean square of the part of the residual that is a paraboloid, in standard deviations
    bend_m: float  # the same, of depth at the centroid
    curvature: float  # 1/m, the larger one of that paraboloid
    cosine: float  # of the angle between normal and line of sight at the centroid
    width_px: float  # across its longest direction, of a rectangle as wide


def totals(sums: SegmentSums, planes: int) -> Floats:
    """[P, 10] moments of each plane's misfits."""
    return summed(sums.moments, sums.plane, planes)


def refined(planes: Floats, sums: SegmentSums) -> Floats:
    """[P, 3] planes moved by the least-squares fit of their misfits."""
    return planes + planes_of(totals(sums, len(planes)))


def evidence(plane: Floats, change: Floats, rows: SegmentSums, grid: CellGrid, sigma: float) -> Evidence:
    """Weigh the pixels of one plane [3]; they must not lie on one line.

    change: [3], of the plane since the misfits in `rows` were taken. sigma: of inverse depth, 1/m.
    """
    moments, pixels = rows.moments.sum(axis=0), float(rows.pixels.sum())
    design = rows.moments[:, :3]
    residual = rows.moments[:, 6] - design @ change  # weighted sums over each cell
    p = plane[[1, 2, 0]] * np.array([grid.camera.fx, grid.camera.fy, 1.0])  # w = p . (x/z, y/z, 1) = -(n . x)/(d z)
    normal, offset = -p / np.linalg.norm(p), 1.0 / float(np.linalg.norm(p))
    mean_ray = np.array([moments[1] / grid.camera.fx, moments[2] / grid.camera.fy, moments[0]]) / moments[0]
    centroid = mean_ray / (p @ mean_ray)
    mean_square = float(rows.squares.sum()) / pixels
    depth = 1.0 / np.maximum(design @ plane / rows.moments[:, 0], 1e-3)
    inflation = max(1.0, mean_square / sigma**2, _correlation(residual, rows, grid, sigma))
    segment = PlaneSegment(
        normal_c=normal,
        offset_m=offset,
        centroid_c=centroid,
        covariance=_covariance(moments, p, normal, offset, centroid, grid, sigma**2 * inflation),
        area_px=int(pixels),
        area_m2=float((rows.pixels * depth**3).sum() / (offset * grid.camera.fx * grid.camera.fy)),
        rms_sigmas=float(np.sqrt(mean_square)) / sigma,
        rms_m=float(np.sqrt(mean_square * (rows.pixels * depth**4).sum() / pixels)),
        reliable=False,
    )
    bend, hessian = _bend(residual, rows.moments)
    return Evidence(
        segment,
        bend_sigmas=bend / sigma,
        bend_m=bend * float(centroid[2]) ** 2,
        curvature=_curvature(hessian, segment, grid),
        cosine=float(-normal @ mean_ray / np.linalg.norm(mean_ray)),
        width_px=width_px(moments),
    )


def _covariance(
    moments: Floats, p: Floats, normal: Floats, offset: float, centroid: Floats, grid: CellGrid, variance: float
) -> Floats:
    """[3, 3] of the turns about both tangents and of the shift along the normal at the centroid; see PlaneSegment.

    Turning by a1, a2 and shifting by s makes n' = n + a2 t1 - a1 t2 and d' = -n' . c - s. Moments are of px; p = -n/d.
    """
    to_pixels = np.array([[0.0, 0.0, 1.0], [1 / grid.camera.fx, 0.0, 0.0], [0.0, 1 / grid.camera.fy, 0.0]])
    first, second = tangents(normal)
    dn = np.stack([-second, first, np.zeros(3)], axis=1)  # by (a1, a2, s)
    dd = np.array([second @ centroid, -first @ centroid, -1.0])
    dp = -dn / offset + np.outer(normal, dd) / offset**2
    jacobian = to_pixels @ dp
    return np.asarray(np.linalg.inv(jacobian.T @ information(moments) @ jacobian / variance), np.float64)


def _correlation(residual: Floats, rows: SegmentSums, grid: CellGrid, sigma: float) -> float:
    """Variance of sums of residuals over parts of a segment, over what independent noise of sigma would give.

    The largest of those for single cells, squares of 4 x 4 cells, and strips across either main axis. Correlated noise,
    the sensor's own distortion, and two surfaces taken for one show in such sums and not in single residuals.
    """
    cells = np.stack(np.divmod(rows.cell, grid.shape[1]), axis=1)
    square = cells[:, 0] // _CLUSTER_CELLS * grid.shape[1] + cells[:, 1] // _CLUSTER_CELLS
    _, axes = np.linalg.eigh(scatter(rows.moments.sum(axis=0)))
    places = rows.moments[:, 1:3] / rows.moments[:, :1]
    strips = np.rint(places @ axes / grid.cell_px).astype(np.intp)
    strips -= strips.min(axis=0)
    found = 0.0
    for key in (rows.cell, square, *strips.T):
        weight, total = np.bincount(key, rows.moments[:, 0]), np.bincount(key, residual)
        weight, total = weight[weight > 0], total[weight > 0]
        if len(weight) > _FITTED:
            found = max(found, float((total**2 / weight).sum()) / (len(weight) - _FITTED) / sigma**2)
    return found


def _bend(residual: Floats, moments: Floats) -> tuple[float, Floats]:
    """The paraboloid that fits the cells' residuals [R], moments [R, 10]: its root mean square, 1/m, beyond a plane,
    and its second derivatives [2, 2], 1/m per px^2.
    """
    weight = moments[:, 0]
    if len(weight) < 6:
        return 0.0, np.zeros((2, 2))
    x, y = moments[:, 1] / weight, moments[:, 2] / weight
    width, height = max(np.ptp(x), 1.0), max(np.ptp(y), 1.0)
    x, y = (x - x.mean()) / width, (y - y.mean()) / height
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    normal, right = basis * weight @ basis.T, basis @ residual
    flat = np.linalg.lstsq(normal[:3, :3], normal[:3, 3:], rcond=1e-9)[0]
    curvature, slope = normal[3:, 3:] - normal[3:, :3] @ flat, right[3:] - flat.T @ right[:3]
    xx, xy, yy = found = np.linalg.lstsq(curvature, slope, rcond=1e-6)[0]
    hessian = np.array([[2 * xx / width**2, xy / (width * height)], [xy / (width * height), 2 * yy / height**2]])
    return float(np.sqrt(max(slope @ found, 0.0) / weight.sum())), hessian


def _curvature(hessian: Floats, segment: PlaneSegment, grid: CellGrid) -> float:
    """The larger principal curvature, 1/m, of a surface whose inverse depth has these second derivatives [2, 2]."""
    z, focal = segment.centroid_c[2], np.array([grid.camera.fx, grid.camera.fy])
    slope = segment.normal_c[:2] / (segment.normal_c @ segment.centroid_c)  # of 1/z, per unit of x/z and y/z
    steps = np.vstack([np.eye(2), np.zeros(2)]) * z - np.outer(segment.centroid_c * z, slope)  # of the point, per same
    to_plane = np.linalg.inv(tangents(segment.normal_c) @ steps / focal)
    return float(np.abs(np.linalg.eigvalsh(segment.offset_m * z * to_plane.T @ hessian @ to_plane)).max())
