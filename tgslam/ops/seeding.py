"""Which square cells of a frame one flat Gaussian can stand for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.device import runtime
from tgslam.device.arrays import require
from tgslam.kernels import seeding as kernels

ON_PLANE = kernels.ON_PLANE  # what `plain_and_planar` says of cells that lie on one plane


def plain_and_planar(
    colour: np.ndarray,
    depth_m: np.ndarray,
    plane_ids: np.ndarray,
    shape: tuple[int, int],
    size_px: int,
    *,
    plain_std: float,
    plane_std: float,
    planar_rms: float,
    on_planes_only: bool,
) -> NDArray[np.int32]:
    """The cells [rows, columns], on the host, that have depth everywhere, hardly any texture and one plane.

    0 = no, ON_PLANE = yes, and on one plane, 1 = yes, otherwise. colour: float32 [H, W, 3], depth_m: float32 [H, W] m,
    0 = none, and plane_ids: int32 [H, W], -1 = none, on the device. shape: rows and columns of cells of size_px pixels.
    plain_std: a channel's standard deviation below which a cell is plain; plane_std: likewise on one plane, but for a
    linear trend. planar_rms: 1/m, residual of inverse depth below which it is planar. on_planes_only: others do not
    count.
    """
    height, width = require("depth_m", depth_m, (None, None)).shape
    require("colour", colour, (height, width, 3))
    require("plane_ids", plane_ids, (height, width), np.int32)
    cells = runtime.empty(shape, np.int32)
    kernels.plain_and_planar(
        colour, depth_m, plane_ids, size_px, plain_std, plane_std, planar_rms, on_planes_only, cells
    )
    return runtime.to_host(cells)
