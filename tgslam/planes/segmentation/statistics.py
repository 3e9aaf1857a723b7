"""What the pixels of segments say of their planes: parameters, covariance, and whether they are planes at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tgslam.geometry import tangent_axes
from tgslam.ops.plane_fit import CellGrid, Floats, Indices, SegmentSums
from tgslam.planes.segment import PlaneSegment
from tgslam.planes.segmentation.moments import information, scatter, summed, width_px

_CLUSTER_CELLS = 4  # side of the squares of cells within which noise may be correlated
_FITTED = 3  # parameters of a plane
_LEAST_CELLS = 6  # that tell a paraboloid: as many as it has parameters
_DEGREES = [(degree - k, k) for degree in range(5) for k in range(degree + 1)]  # of x and y: 1, x, y, xx, xy, yy, ...
_PRODUCTS = np.array([[_DEGREES.index((a + c, b + d)) for c, d in _DEGREES[:6]] for a, b in _DEGREES[:6]])
_LEAST_WIDTH_PX = 1.0  # of what is not a line


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


def evidence(
    planes: Floats, change: Floats, sums: SegmentSums, grid: CellGrid, sigma: float, fewest_px: float
) -> list[tuple[int, Evidence]]:
    """Index and evidence of those of the planes [P, 3] that have `fewest_px` pixels or more, and not all in one line.

    change: [P, 3], of the planes since the misfits in `sums` were taken. sigma: of inverse depth, 1/m.
    """
    rows = _Rows.of(sums, planes, change, fewest_px)
    if not len(rows.index):
        return []
    fit = _Fit.of(planes[rows.index], rows, grid)
    mean_square = rows.sum(rows.sums.squares) / rows.pixels
    correlation = _correlation(rows, grid) / sigma**2
    variance = sigma**2 * np.maximum(np.maximum(1.0, mean_square / sigma**2), correlation)
    covariance = _covariances(rows.moments, fit, grid, variance)
    depth = 1.0 / np.maximum(np.sum(rows.sums.moments[:, :3] * planes[rows.sums.plane], axis=1), 1e-3 * rows.weight)
    depth *= rows.weight
    area_m2 = rows.sum(rows.sums.pixels * depth**3) / (fit.offset * grid.camera.fx * grid.camera.fy)
    rms_m = np.sqrt(mean_square * rows.sum(rows.sums.pixels * depth**4) / rows.pixels)
    bend, hessian = _bends(rows)
    curvature, width = _curvatures(hessian, fit, grid), width_px(rows.moments)
    found = []
    for k, index in enumerate(rows.index):
        segment = PlaneSegment(
            normal_c=fit.normal[k],
            offset_m=float(fit.offset[k]),
            centroid_c=fit.centroid[k],
            covariance=covariance[k],
            area_px=int(rows.pixels[k]),
            area_m2=float(area_m2[k]),
            rms_sigmas=float(np.sqrt(mean_square[k])) / sigma,
            rms_m=float(rms_m[k]),
            reliable=False,
        )
        of_segment = Evidence(
            segment,
            bend_sigmas=float(bend[k]) / sigma,
            bend_m=float(bend[k] * fit.centroid[k, 2] ** 2),
            curvature=float(curvature[k]),
            cosine=float(fit.cosine[k]),
            width_px=float(width[k]),
        )
        found.append((int(index), of_segment))
    return found


@dataclass(frozen=True)
class _Rows:
    """The sums [R] that count, in order of their planes, of which there are C."""

    index: Indices  # [C] of the planes
    sums: SegmentSums
    number: Indices  # [R] which of the C planes
    start: Indices  # [C] the first row of each
    residual: Floats  # [R] weighted sum over each cell
    moments: Floats  # [C, 10]
    pixels: Floats  # [C]

    @classmethod
    def of(cls, sums: SegmentSums, planes: Floats, change: Floats, fewest_px: float) -> _Rows:
        """Of the planes that have enough pixels, in more than a line."""
        moments, pixels = totals(sums, len(planes)), summed(sums.pixels[:, None], sums.plane, len(planes))[:, 0]
        index = np.flatnonzero(pixels >= fewest_px)
        index = index[width_px(moments[index]) >= _LEAST_WIDTH_PX]
        number = np.full(len(planes), -1)
        number[index] = np.arange(len(index))
        order = np.argsort(number[sums.plane], kind="stable")
        chosen = sums.rows(order[np.count_nonzero(number[sums.plane] < 0) :])
        of_row = number[chosen.plane]
        residual = chosen.moments[:, 6] - np.sum(chosen.moments[:, :3] * change[chosen.plane], axis=1)
        start = np.searchsorted(of_row, np.arange(len(index)))
        return cls(index, chosen, of_row, start, residual, moments[index], pixels[index])

    @property
    def weight(self) -> Floats:
        """[R] what the pixels of each row count together."""
        return self.sums.moments[:, 0]

    def sum(self, values: Floats) -> Floats:
        """[C, ...] of values [R, ...] over the rows of each plane."""
        result: Floats = np.add.reduceat(values, self.start, axis=0)
        return result


@dataclass(frozen=True)
class _Fit:
    """Planes in space, C of them."""

    normal: Floats  # [C, 3]
    offset: Floats  # [C] m
    centroid: Floats  # [C, 3] m
    cosine: Floats  # [C] of the angle between normal and line of sight at the centroid

    @classmethod
    def of(cls, planes: Floats, rows: _Rows, grid: CellGrid) -> _Fit:
        """planes: [C, 3] w = p . (x/z, y/z, 1) = -(n . x)/(d z)."""
        focal = np.array([grid.camera.fx, grid.camera.fy, 1.0])
        p = planes[:, [1, 2, 0]] * focal
        length = np.linalg.norm(p, axis=1)
        normal = -p / length[:, None]
        ray = rows.moments[:, [1, 2, 0]] / focal / rows.moments[:, :1]
        centroid = ray / np.sum(p * ray, axis=1)[:, None]
        return cls(normal, 1.0 / length, centroid, -np.sum(normal * ray, axis=1) / np.linalg.norm(ray, axis=1))


def _covariances(moments: Floats, fit: _Fit, grid: CellGrid, variance: Floats) -> Floats:
    """[C, 3, 3] of the turns about both tangents and of the shift along the normal at the centroid; see PlaneSegment.

    Turning by a1, a2 and shifting by s makes n' = n + a2 t1 - a1 t2 and d' = -n' . c - s. Moments are of px; p = -n/d.
    variance: [C] of a pixel.
    """
    to_pixels = np.array([[0.0, 0.0, 1.0], [1 / grid.camera.fx, 0.0, 0.0], [0.0, 1 / grid.camera.fy, 0.0]])
    first, second = np.moveaxis(tangent_axes(fit.normal), 1, 0)
    dn = np.stack([-second, first, np.zeros_like(first)], axis=2)  # by (a1, a2, s)
    along = [np.sum(second * fit.centroid, axis=1), -np.sum(first * fit.centroid, axis=1), -np.ones(len(first))]
    dd = np.stack(along, axis=1)
    offset = fit.offset[:, None, None]
    jacobian = to_pixels @ (-dn / offset + fit.normal[:, :, None] * dd[:, None] / offset**2)
    known = np.swapaxes(jacobian, 1, 2) @ information(moments) @ jacobian / variance[:, None, None]
    return np.asarray(np.linalg.inv(known), np.float64)


def _correlation(rows: _Rows, grid: CellGrid) -> Floats:
    """[C] 1/m^2: variance of sums of residuals over parts of a segment, as if of independent noise of single pixels.

    The largest of those for single cells, squares of 4 x 4 cells, and strips across either main axis. Correlated noise,
    the sensor's own distortion, and two surfaces taken for one show in such sums and not in single residuals.
    """
    row, column = np.divmod(rows.sums.cell, grid.shape[1])
    square = row // _CLUSTER_CELLS * grid.shape[1] + column // _CLUSTER_CELLS
    _, axes = np.linalg.eigh(scatter(rows.moments))
    places = rows.sums.moments[:, 1:3] / rows.weight[:, None]
    along = np.sum(places[:, :, None] * axes[rows.number], axis=1) / grid.cell_px
    strips = np.rint(along).astype(np.intp)
    strips -= strips.min(axis=0)
    found = np.zeros(len(rows.index))
    for key in (rows.sums.cell, square, *strips.T):
        parts = int(key.max()) + 1
        of_part = rows.number * parts + key
        weight, total = np.bincount(of_part, rows.weight), np.bincount(of_part, rows.residual)
        part = np.flatnonzero(weight > 0)
        freedom = np.bincount(part // parts, minlength=len(found)) - _FITTED
        spread = np.bincount(part // parts, total[part] ** 2 / weight[part], len(found))
        found = np.maximum(found, np.where(freedom > 0, spread / np.maximum(freedom, 1), 0.0))
    return found


def _bends(rows: _Rows) -> tuple[Floats, Floats]:
    """The paraboloids that fit the cells' residuals: their root mean squares [C], 1/m, beyond planes, and their second
    derivatives [C, 2, 2], 1/m per px^2. Both are 0 where too few cells tell.
    """
    places = rows.sums.moments[:, 1:3] / rows.weight[:, None]
    ends = (reduce.reduceat(places, rows.start, axis=0) for reduce in (np.maximum, np.minimum))
    size = np.maximum(np.subtract(*ends), 1.0)  # [C, 2] px
    cells = rows.sum(np.ones(len(places)))
    x, y = ((places - (rows.sum(places) / cells[:, None])[rows.number]) / size[rows.number]).T
    powers = [np.ones_like(x), x, y, x * x, x * y, y * y]
    powers += [power * x for power in powers[3:]] + [powers[5] * y]
    powers += [power * x for power in powers[6:]] + [powers[9] * y]
    monomials = np.stack(powers, axis=1)
    normal = rows.sum(monomials * rows.weight[:, None])[:, _PRODUCTS]
    right = rows.sum(monomials[:, :6] * rows.residual[:, None])[:, :, None]
    flat = np.linalg.pinv(normal[:, :3, :3], 1e-9, hermitian=True) @ normal[:, :3, 3:]
    curvature = normal[:, 3:, 3:] - normal[:, 3:, :3] @ flat
    slope = right[:, 3:] - np.swapaxes(flat, 1, 2) @ right[:, :3]
    found = np.linalg.pinv(curvature, 1e-6) @ slope
    enough = cells >= _LEAST_CELLS
    mean_square = np.maximum(np.sum(slope * found, axis=(1, 2)), 0.0) / rows.moments[:, 0]
    xx, xy, yy = np.where(enough, found[:, :, 0].T, 0.0) / (size[:, 0] ** 2, size[:, 0] * size[:, 1], size[:, 1] ** 2)
    hessian = np.stack([2 * xx, xy, xy, 2 * yy], axis=1).reshape(-1, 2, 2)
    return np.where(enough, np.sqrt(mean_square), 0.0), hessian


def _curvatures(hessian: Floats, fit: _Fit, grid: CellGrid) -> Floats:
    """[C] the larger principal curvature, 1/m, of surfaces with these second derivatives [C, 2, 2] of inverse depth."""
    focal = np.array([grid.camera.fx, grid.camera.fy])
    z = fit.centroid[:, 2, None, None]
    slope = fit.normal[:, :2] / np.sum(fit.normal * fit.centroid, axis=1)[:, None]  # of 1/z, per unit of x/z and y/z
    steps = np.eye(3)[:, :2] * z - fit.centroid[:, :, None] * z * slope[:, None]  # of the point, per same
    to_plane = np.linalg.inv(tangent_axes(fit.normal) @ steps / focal)
    bent = fit.offset[:, None, None] * z * (np.swapaxes(to_plane, 1, 2) @ hessian @ to_plane)
    return np.asarray(np.abs(np.linalg.eigvalsh(bent)).max(axis=1), np.float64)
